"""Simulated laser sessions: what their files say fits the truth, and faults do what they say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import (
    Scanner,
    find_scans,
    read_robot,
    read_scanners,
    read_scans,
)
from redetect.groundtruth.trajectories.streams import PlanarPoses, read_planar_poses
from redetect.groundtruth.validation.reference_poses import (
    read_dimensions,
    read_distances,
    read_fiducial_distances,
    read_survey,
)
from redetect.landmarks import wrap_angle
from redetect.plane import compose
from tools.simulator.__main__ import main
from tools.simulator.laser.session import EPOCH_S, SessionPlan, plan_session
from tools.simulator.laser.session_files import (
    camera_covariances,
    camera_stream,
    exact_poses,
    measured_distances,
    odometry_stream,
    survey_of,
    write_session,
)
from tools.simulator.laser.settings import Faults, LaserSettings
from tools.simulator.laser.site import Passer, chain, is_covered, legs_of

FloatArray = NDArray[np.float64]

SMALL = LaserSettings(
    visits=1, visit_s=14.0, between_s=0.0, references=3, stand_s=0.6, passers=1, rate_hz=20.0,
    onboard_hz=10.0, empty_s=0.5, clock_offset_s=0.3, clock_drift=1e-3,
)  # fmt: skip
SEED = 4


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SessionPlan]:
    folder = tmp_path_factory.mktemp("laser") / "small"
    return folder, write_session(SMALL, folder, seed=SEED)


def truth_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "truth.json").read_text())
    return content


def placed(scanner: Scanner, poses: FloatArray, ranges_mm: Any) -> list[FloatArray]:
    """Per scan the (M, 2) points in the world, for scanners at (N, 3) poses."""
    points = []
    for pose, local in zip(poses, scanner.points(ranges_mm)):
        hit = local[np.isfinite(local[:, 0])]
        padded = np.column_stack([hit, np.zeros(len(hit))])
        points.append(compose(np.tile(pose, (len(hit), 1)), padded)[:, :2])
    return points


def gap_to(points: FloatArray, walls: FloatArray) -> FloatArray:
    """(M,) distances of points to the nearest wall, written without what the simulator uses."""
    best = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in walls:
        along = np.array([x2 - x1, y2 - y1])
        share = np.clip(((points - [x1, y1]) @ along) / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - [x1, y1] - share[:, None] * along, axis=1))
    return best


def interpolated(poses: PlanarPoses, times: FloatArray) -> FloatArray:
    columns = [poses.poses[:, 0], poses.poses[:, 1], np.unwrap(poses.poses[:, 2])]
    return np.column_stack([np.interp(times, poses.times_s, column) for column in columns])


def to_truth_time(folder: Path, robot_times: FloatArray) -> FloatArray:
    """The clock's line of truth.json, solved for the ground truth's time."""
    (piece,) = truth_of(folder)["clock"]["pieces"]
    late = robot_times - piece["reference_s"] - piece["offset_s"]
    return np.asarray(piece["reference_s"] + late / (1.0 + piece["drift"]))


def test_what_fixed_scanners_saw_is_walls_robot_and_legs(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    robot = read_robot(folder / "robot.json")
    truth = read_planar_poses(folder / "truth.csv")
    on_robot = 0
    for scanner in read_scanners(folder / "scanners.truth.json"):
        scans = read_scans(find_scans(folder, scanner.name), scanner.readings)
        some = slice(0, None, 16)
        times, ranges_mm = scans.times_s[some], scans.ranges_mm[some]
        stood = interpolated(truth, times)
        clouds = placed(scanner, np.tile(scanner.pose, (len(times), 1)), ranges_mm)
        gaps = []
        for time, pose, cloud in zip(times, stood, clouds):
            corners = compose(
                np.tile(pose, (len(robot.outline), 1)),
                np.column_stack([robot.outline, np.zeros(len(robot.outline))]),
            )[:, :2]
            legs = legs_of(list(plan.passers), np.array([time]))[0]
            body = gap_to(cloud, chain(corners, closed=True))
            near = np.minimum(gap_to(cloud, plan.site.solid), body)
            for x, y, radius in legs:
                if radius > 0.0:
                    far = np.abs(np.linalg.norm(cloud - [x, y], axis=1) - radius)
                    near = np.minimum(near, far)
            on_robot += int((body < 0.03).sum())
            gaps.append(near)
        gap = np.concatenate(gaps)
        assert np.mean(gap < 0.045) > 0.97  # the rest: mixed at edges
        assert np.median(gap) < 0.01
    assert on_robot > 500


def test_the_empty_room_is_empty(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    for scanner in read_scanners(folder / "scanners.truth.json"):
        scans = read_scans(find_scans(folder / "empty", scanner.name), scanner.readings)
        assert scans.times_s[-1] < plan.route.start_s
        cloud = np.concatenate(
            placed(scanner, np.tile(scanner.pose, (len(scans), 1)), scans.ranges_mm)
        )
        # The rest is mixed at edges.
        assert np.mean(gap_to(cloud, plan.site.solid) < 0.045) > 0.97


def test_scans_on_board_fit_the_building_by_the_robots_clock_only(
    session: tuple[Path, SessionPlan],
) -> None:
    folder, plan = session
    robot = read_robot(folder / "robot.json")
    truth = read_planar_poses(folder / "truth.csv")
    shares = []
    for scanner in robot.scanners:
        scans = read_scans(find_scans(folder, scanner.name), scanner.readings)
        for times in (to_truth_time(folder, scans.times_s), scans.times_s):
            carrier = interpolated(truth, times)
            poses = compose(carrier, np.tile(scanner.pose, (len(times), 1)))
            cloud = np.concatenate(placed(scanner, poses, scans.ranges_mm))
            shares.append(np.mean(gap_to(cloud, plan.site.solid) < 0.045))
    assert min(shares[0], shares[2]) > 0.96
    assert max(shares[1], shares[3]) < 0.8


def test_scanners_have_phases_of_their_own(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    period = 1.0 / SMALL.rate_hz
    phases = []
    for scanner in plan.scanners:
        times = read_scans(find_scans(folder, scanner.name)).times_s
        np.testing.assert_allclose(
            np.diff(times) / period, np.rint(np.diff(times) / period), atol=1e-4
        )
        phases.append(np.mod(times[0], period))
    assert np.diff(np.sort(phases)).min() > 1e-4


def test_odometry_follows_the_truth_by_the_robots_clock(session: tuple[Path, SessionPlan]) -> None:
    folder, _ = session
    odometry = read_planar_poses(folder / "odometry.csv")
    np.testing.assert_allclose(np.diff(odometry.times_s), 0.02, atol=2e-6)
    times = to_truth_time(folder, odometry.times_s)
    true = interpolated(read_planar_poses(folder / "truth.csv"), times)
    turned = np.unwrap(odometry.poses[:, 2])
    # A hundredth of all turns, some drift and noise.
    np.testing.assert_allclose(turned - turned[0], true[:, 2] - true[0, 2], atol=0.25)
    way = np.hypot(*np.diff(odometry.poses[:, :2], axis=0).T).sum()
    assert way / np.hypot(*np.diff(true[:, :2], axis=0).T).sum() == pytest.approx(1.008, abs=0.01)


def test_errors_of_marker_poses_are_those_of_their_covariances() -> None:
    squares = []
    drive = plan_session(replace(SMALL, visit_s=40.0), SEED)
    for seed in range(10):
        plan = replace(drive, seed=seed)
        camera = camera_stream(plan)
        assert camera.covariances is not None
        error = camera.poses - plan.route.poses(camera.times_s)
        error[:, 2] = wrap_angle(error[:, 2])
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(camera.covariances), error))
        assert is_covered(plan.route.poses(camera.times_s)[:, :2]).all()
    square = np.concatenate(squares)
    # Mean 3, standard deviation sqrt(6 / N).
    assert abs(square.mean() - 3.0) < 3.0 * np.sqrt(6.0 / len(square))
    shapes = camera_covariances(np.array([[1.0, 1.0, 0.0], [9.0, 1.0, 0.0]]))
    assert np.all(np.linalg.eigvalsh(shapes)[:, 0] > 0.0)


def test_distances_are_measured_while_the_robot_stands(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    survey = read_survey(folder / "fiducials.json")
    rows = read_distances(folder / "distances.csv", survey)
    reference = read_planar_poses(folder / "reference.csv")
    assert sorted({row.pose for row in rows}) == list(range(SMALL.references))
    errors = []
    for row in rows:
        begin, end = plan.references[row.pose]
        assert begin < row.time_s < end
        pose = reference.poses[row.pose]
        np.testing.assert_allclose(
            pose[:2], interpolated(exact_poses(plan, np.linspace(begin, end, 3)),
                                   np.array([row.time_s]))[0, :2], atol=2e-6,
        )  # fmt: skip
        c, s = np.cos(pose[2]), np.sin(pose[2])
        point = pose[:2] + np.array([[c, -s], [s, c]]) @ survey.robot_points[row.point]
        errors.append(row.distance_m - np.linalg.norm(point - survey.fiducials[row.fiducial]))
    assert np.std(errors) == pytest.approx(SMALL.distance_sigma_m, rel=0.4)
    many = replace(SMALL, references=23, visit_s=60.0)
    assert len(measured_distances(plan_session(many, 2))) == 23 * 3 * 4


def test_points_on_the_robot_are_on_its_outline(session: tuple[Path, SessionPlan]) -> None:
    _, plan = session
    points = np.stack(list(survey_of(plan).robot_points.values()))
    np.testing.assert_allclose(
        gap_to(points, chain(plan.robot.outline, closed=True)), 0.0, atol=1e-12
    )


def test_the_drawing_is_the_map(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    rows, drawing = (read_building(folder / f"building.{end}") for end in ("csv", "dxf"))
    np.testing.assert_allclose(rows, drawing, atol=1e-9)
    np.testing.assert_allclose(rows, plan.site.walls, atol=1e-6)


def test_the_tape_measures_the_building_not_the_drawing(session: tuple[Path, SessionPlan]) -> None:
    folder, plan = session
    survey = read_survey(folder / "fiducials.json")
    between = read_fiducial_distances(folder / "fiducial_distances.csv", survey)
    exact = [np.hypot(*(survey.fiducials[a] - survey.fiducials[b])) for a, b, _ in between]
    errors = np.subtract([distance_m for _, _, distance_m in between], exact)
    assert len(errors) == 15
    assert 0.002 < errors.std() < 0.009
    drawn, measured = np.array([d[1:] for d in read_dimensions(folder / "dimensions.csv")]).T
    walls = plan.site.walls
    longest = np.sort(np.hypot(*(walls[:, 2:] - walls[:, :2]).T))[::-1][:12]
    np.testing.assert_allclose(drawn, longest, atol=2e-4)  # the drawing is exact unasked
    assert 0.0 < np.abs(measured - longest).max() < 0.025


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(
    session: tuple[Path, SessionPlan], tmp_path: Path
) -> None:
    folder, _ = session
    write_session(SMALL, tmp_path / "again", seed=SEED)
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert len(files) == 25
    for file in files:
        assert (folder / file).read_bytes() == (tmp_path / "again" / file).read_bytes(), file
    other = plan_session(SMALL, SEED + 1)
    assert not np.array_equal(other.scanners[0].pose, plan_session(SMALL, SEED).scanners[0].pose)


@pytest.mark.parametrize("seed", [101, 115])
def test_a_way_is_found_out_of_dead_ends(seed: int) -> None:
    plan = plan_session(LaserSettings(), seed)
    times = np.arange(plan.route.start_s, plan.route.end_s, 0.2)
    places = plan.route.poses(times)[:, :2]
    assert gap_to(places, plan.site.solid).min() > 0.55  # the robot reaches 0.54 m


# -- faults ---------------------------------------------------------------------------------


def test_visits_are_as_far_apart_as_asked_for_and_the_log_may_pause() -> None:
    settings = replace(SMALL, visits=3, between_s=130.0, straight=True, pause_log=True)
    plan = plan_session(settings, 1)
    assert len(plan.visits) == 3
    for (_, left), (entered, _) in zip(plan.visits, plan.visits[1:]):
        assert entered - left == pytest.approx(130.0, abs=3.0)
    logged = odometry_stream(plan).times_s
    assert np.sort(np.diff(logged))[-2:].min() > 110.0
    assert np.median(np.diff(logged)) == pytest.approx(0.02, abs=1e-5)
    inside = [t for begin, end in plan.visits for t in np.arange(begin + 1.0, end - 1.0, 0.1)]
    headings = plan.route.poses(np.array(inside))[:, 2]
    assert np.ptp(np.mod(headings + np.pi, 2 * np.pi)) < 0.6  # straight through


def test_a_wrong_scanner_is_wrong_by_hand_only(tmp_path: Path) -> None:
    faults = Faults(wrong_scanner="fixed1", by=(1.0, -2.0, 0.5))
    for name, settings in (("good", SMALL), ("bad", replace(SMALL, faults=faults))):
        write_session(replace(settings, rate_hz=4.0, onboard_hz=1.0), tmp_path / name, seed=2)
    good, bad = (read_scanners(tmp_path / n / "scanners.json") for n in ("good", "bad"))
    for a, b in zip(good, bad):
        moved = [1.0, -2.0, 0.5] if a.name == "fixed1" else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(b.pose - a.pose, moved, atol=1e-12)
        np.testing.assert_allclose(np.sqrt(np.diag(b.covariance)), [0.05, 0.05, np.deg2rad(2.0)])
    for name in ("fixed1", "empty/fixed1"):
        first, second = (read_scans(tmp_path / n / f"{name}.scans.npz") for n in ("good", "bad"))
        np.testing.assert_array_equal(first.ranges_mm, second.ranges_mm)


def test_a_knocked_scanner_moved_after_the_empty_room_was_scanned(tmp_path: Path) -> None:
    settings = replace(SMALL, rate_hz=4.0, onboard_hz=1.0, passers=0)
    settings = replace(settings, faults=Faults(moved_scanner="fixed2", by=(0.2, -0.2, 0.1)))
    plan = write_session(settings, tmp_path / "s", seed=2)
    scanner = read_scanners(tmp_path / "s" / "scanners.truth.json")[2]
    in_session = np.array(truth_of(tmp_path / "s")["scanners_in_session"]["fixed2"])
    np.testing.assert_allclose(in_session - scanner.pose, [0.2, -0.2, 0.1])
    shares = []
    for place, pose in (("empty", scanner.pose), ("", in_session), ("", scanner.pose)):
        scans = read_scans(find_scans(tmp_path / "s" / place, "fixed2"))
        cloud = np.concatenate(placed(scanner, np.tile(pose, (len(scans), 1)), scans.ranges_mm))
        shares.append(np.mean(gap_to(cloud, plan.site.solid) < 0.045))
    assert min(shares[:2]) > 0.85 > 0.6 > shares[2]


def test_streams_are_lost_when_they_are_to_be_lost(tmp_path: Path) -> None:
    faults = Faults(lost_camera_at_s=4.0, lost_camera_s=3.0, lost_laser_at_s=8.0, lost_laser_s=2.0)
    settings = replace(SMALL, faults=faults, camera_misses=0.0, onboard_hz=1.0)
    settings = replace(settings, reading=replace(settings.reading, lost_scans=0.0))
    plan = write_session(settings, tmp_path / "s", seed=2)
    camera = read_planar_poses(tmp_path / "s" / "camera.csv").times_s - plan.visits[0][0]
    assert not np.any((camera >= 4.0) & (camera < 7.0))
    assert np.sort(np.diff(camera))[-2:] == pytest.approx([0.2, 3.2], abs=0.21)
    for name in ("fixed0", "fixed3"):
        laser = read_scans(find_scans(tmp_path / "s", name)).times_s - plan.visits[0][0]
        assert not np.any((laser >= 8.0) & (laser < 10.0))
        assert np.sort(np.diff(laser))[-2:] == pytest.approx([0.05, 2.05], abs=0.051)


def test_a_clock_that_is_set_shows_in_all_of_the_robots_stamps() -> None:
    faults = Faults(clock_jump_s=0.4, clock_jump_at_s=5.0)
    plain = plan_session(SMALL, 2)
    set_ = plan_session(replace(SMALL, faults=faults), 2)
    difference = odometry_stream(set_).times_s - odometry_stream(plain).times_s
    np.testing.assert_allclose(np.unique(difference.round(5)), [0.0, 0.4])
    jump = odometry_stream(plain).times_s[np.argmax(difference > 0.2)]
    assert jump == pytest.approx(plain.clock.robot_times([plain.visits[0][0] + 5.0])[0], abs=0.021)
    np.testing.assert_array_equal(odometry_stream(set_).poses, odometry_stream(plain).poses)


def test_people_keep_away_from_the_robot_unless_they_are_to_cross() -> None:
    for seed in range(3):
        plan = plan_session(replace(SMALL, passers=2, faults=Faults(crossing=True)), seed)
        *passers, last = plan.passers

        def nearest(passer: Passer, plan: SessionPlan = plan) -> float:
            times = np.arange(passer.from_s, passer.to_s, 0.01)
            gaps = passer.places(times)[0] - plan.route.poses(times)[:, :2]
            return float(np.nanmin(np.linalg.norm(gaps, axis=1)))

        assert all(nearest(passer) > 0.89 for passer in passers)
        assert 0.5 < nearest(last) < 0.7
        assert last.from_s < np.mean(plan.visits[0]) < last.to_s


# -- the command ----------------------------------------------------------------------------


QUICK = ("--visits", "1", "--visit-s", "8", "--references", "0", "--rate-hz", "4",
         "--onboard-hz", "4", "--empty-s", "0.5", "--seed", "3")  # fmt: skip


def test_the_command_writes_and_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["laser-session", str(tmp_path / "s"), *QUICK]) == 0
    assert "1 visits" in capsys.readouterr().out
    assert truth_of(tmp_path / "s")["references"] == []
    assert main(["laser-session", str(tmp_path / "s"), *QUICK]) == 1
    assert "--force" in capsys.readouterr().err
    assert main(["laser-session", str(tmp_path / "t"), "--visits", "0"]) == 1
    assert "visits is 0" in capsys.readouterr().err
    assert not (tmp_path / "t").exists()


@pytest.mark.long
def test_a_session_of_three_visits_has_what_the_methods_need(tmp_path: Path) -> None:
    settings = LaserSettings(rate_hz=25.0, onboard_hz=25.0)
    plan = write_session(settings, tmp_path / "s", seed=11)
    lengths = [end - begin for begin, end in plan.visits]
    assert len(lengths) == 3
    assert min(lengths) > 50.0
    assert len(plan.references) == 23
    truth = read_planar_poses(tmp_path / "s" / "truth.csv")
    assert np.diff(truth.times_s).max() < 1.0 / 75.0
    assert truth.times_s[0] == EPOCH_S
    for name in ("fixed0", "fixed1", "fixed2", "fixed3", "front", "rear"):
        scans = read_scans(tmp_path / "s" / f"{name}.scans.npz", 181)
        assert len(scans) > 0.98 * 25.0 * sum(lengths)
