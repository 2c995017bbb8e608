"""Laser tracking: the kernels' derivatives and covariances, whole tracks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.commands.lasers import perform_laser
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.acquisition import (
    ScanSets,
    acquire,
    fixed_scanners,
    sets_of_scans,
)
from redetect.groundtruth.lasers.icp import fit_outline
from redetect.groundtruth.lasers.outline import robot_body
from redetect.groundtruth.lasers.scanners import Robot, Scanner, Scans
from redetect.groundtruth.lasers.tracking import (
    SetStatus,
    combined_poses,
    track_by_lasers,
    track_without_suspects,
    usual_sets_per_pose,
)
from redetect.groundtruth.lasers.tracking_kernels import (
    FixedScanners,
    NewReadings,
    ScanSet,
    explain_set,
    new_points,
    refine_outline,
)
from redetect.groundtruth.options import Laser
from redetect.groundtruth.settings import LaserSettings
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import wrap_angle
from redetect.plane import compose, invert
from tests.groundtruth.lasers.scene import (
    FRONTED,
    PLAIN,
    ROOM,
    cast,
    circle,
    empty_scans,
    ranges_mm,
    record,
    scanner,
    sides,
    tables_of,
    write_session,
)

FloatArray = NDArray[np.float64]

GATE_M = LaserSettings().gate_m


def one_set(
    scanners: tuple[Scanner, ...], pose: FloatArray, outline: FloatArray,
    rng: np.random.Generator | None,
) -> ScanSets:  # fmt: skip
    scans = [
        Scans(np.zeros(1), ranges_mm(s, np.vstack([ROOM, sides(outline, pose)]), rng)[None])
        for s in scanners
    ]
    return sets_of_scans(scans)


def seen_in(sets: ScanSets, tables: FixedScanners, pose: FloatArray, index: int = 0) -> NewReadings:
    return new_points(sets[index], tables, pose[:2], 2.0, np.zeros(3), np.zeros(2))


def test_points_are_moved_on_with_the_robot() -> None:
    """A reading of a robot that drives and turns, moved from the scan's time to the set's."""
    age, motion = 0.01, np.array([0.7, -0.4, 0.9])
    pose = np.array([3.0, 2.0, 0.4])
    then = pose - motion * age
    mark = np.array([-0.4, 0.1])  # on the robot, in its frame
    origin = np.array([0.5, 0.3])
    c, s = np.cos(then[2]), np.sin(then[2])
    place = then[:2] + np.array([c * mark[0] - s * mark[1], s * mark[0] + c * mark[1]])
    ray = place - origin
    length = np.hypot(*ray)
    ranges = np.array([[round(1e3 * length)]], dtype=np.uint16)
    # Part of the age is that of the beam within its scan.
    scan = ScanSet(ranges, np.zeros(1, dtype=np.int64), np.array([0.6 * age]))
    fixed = FixedScanners(
        np.full((1, 1), 1e9), (ray / length)[None, None], origin[None], np.ones(1), np.eye(3),
        np.full((1, 1), -0.4 * age),
    )  # fmt: skip
    points, _, _, range_m = new_points(scan, fixed, pose[:2], 1.0, motion, pose[:2])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    expected = pose[:2] + np.array([c * mark[0] - s * mark[1], s * mark[0] + c * mark[1]])
    assert points[0] == pytest.approx(expected, abs=6e-4)  # readings are in millimetres
    assert range_m[0] == pytest.approx(length, abs=6e-4)


# --- one set


def exact(scanners: tuple[Scanner, ...], pose: FloatArray, tables: FixedScanners) -> NewReadings:
    """Readings without noise nor rounding."""
    parts: list[list[FloatArray]] = [[], [], [], []]
    for k, one in enumerate(scanners):
        walls = cast(one.pose, one.angles_rad, ROOM)
        ranges = cast(one.pose, one.angles_rad, sides(FRONTED, pose))
        hit = ranges < walls
        beams = tables.direction[k][hit]
        parts[0].append(one.pose[:2] + ranges[hit, None] * beams)
        parts[1].append(np.full(int(hit.sum()), k))
        parts[2].append(beams)
        parts[3].append(ranges[hit])
    points, scanner_index, direction, range_m = (np.concatenate(p) for p in parts)
    return NewReadings(points, scanner_index.astype(np.int64), direction, range_m)


def test_exact_readings_give_the_exact_pose(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    pose = np.array([4.0, 2.9, 0.5])
    body = robot_body(FRONTED)
    seen = exact(scanners, pose, tables)
    start = pose + np.array([0.03, -0.02, 0.05])
    found, rms, count = fit_outline(seen.points, body.faces, start, 0.2, 0.95, 1e-9, 500)
    assert found == pytest.approx(pose, abs=2e-3)
    assert rms < 1e-3
    assert count >= 0.9 * len(seen.points)
    refined = refine_outline(seen, body, found, tables, GATE_M, 0.02)
    assert refined.pose == pytest.approx(pose, abs=1e-8)
    assert refined.used == len(seen.points)
    assert refined.undetermined_directions == 0


def test_derivatives_by_the_scanners_poses(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    """Moving a scanner moves the pose as the kernel says: finite differences."""
    pose, body = np.array([4.0, 2.9, 0.5]), robot_body(FRONTED)
    seen = exact(scanners, pose, tables)
    refined = refine_outline(seen, body, pose, tables, GATE_M, 0.02)
    h = 1e-6
    for k in range(len(scanners)):
        mine = seen.scanner == k
        for axis in range(3):
            moved = []
            for sign in (h, -h):
                shift = np.zeros(3)
                shift[axis] = sign
                points, direction = seen.points.copy(), seen.direction.copy()
                arm = points[mine] - tables.origins[k]
                c, s = np.cos(shift[2]), np.sin(shift[2])
                turn = np.array([[c, -s], [s, c]])
                points[mine] = tables.origins[k] + shift[:2] + arm @ turn.T
                direction[mine] = direction[mine] @ turn.T
                other = seen._replace(points=points, direction=direction)
                moved.append(refine_outline(other, body, pose, tables, GATE_M, 0.02).pose)
            numeric = (moved[0] - moved[1]) / (2 * h)
            assert refined.by_scanner[:, 3 * k + axis] == pytest.approx(numeric, abs=2e-3)


def test_covariance_of_a_set_is_right(scanners: tuple[Scanner, ...], tables: FixedScanners) -> None:
    rng, body = np.random.default_rng(3), robot_body(FRONTED)
    squared = []
    for _ in range(300):
        pose = np.array([*rng.uniform([2.0, 1.5], [6.0, 4.5]), rng.uniform(-np.pi, np.pi)])
        sets = one_set(scanners, pose, FRONTED, rng)
        seen = seen_in(sets, tables, pose)
        start = fit_outline(seen.points, body.faces, pose, 0.2, 0.95, 1e-5, 60)[0]
        found = refine_outline(seen, body, start, tables, GATE_M, 0.02)
        error = found.pose - pose
        error[2] = wrap_angle(error[2])
        squared.append(error @ np.linalg.solve(found.covariance, error) / 3.0)
    # Readings along a face and the outline's own tolerance have a margin that these lack: 0.9 is
    # expected. 3 sigma of a mean of 300 draws of chi squared with 3 degrees of freedom: 0.14.
    assert float(np.mean(squared)) == pytest.approx(0.9, abs=0.14)


def test_beams_that_agree_see_through_and_are_hidden(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    pose, body = np.array([4.0, 2.9, 0.5]), robot_body(FRONTED)
    sets = one_set(scanners, pose, FRONTED, None)
    expected, agree, through, hidden, none, beside = explain_set(sets[0], tables, body, pose)
    assert agree == expected > 25
    assert through == hidden == none == beside == 0
    away = explain_set(sets[0], tables, body, pose + np.array([0.0, 1.2, 0.0]))
    assert away[1] < 0.2 * away[0]
    assert away[2] > 0.5 * away[0]
    without = sets[0]._replace(rows=np.full(len(scanners), -1))
    assert not any(explain_set(without, tables, body, pose))


def test_one_scanner_before_a_flat_side_leaves_a_direction_open() -> None:
    lone = (scanner("lone", np.array([4.0, 0.1, np.pi / 2])),)
    tables, body = tables_of(lone), robot_body(PLAIN)
    pose = np.array([4.0, 3.0, 0.0])  # its long side to the scanner
    seen = seen_in(one_set(lone, pose, PLAIN, np.random.default_rng(4)), tables, pose)
    found = refine_outline(seen, body, pose + np.array([0.05, 0.0, 0.0]), tables, GATE_M, 0.3)
    assert found.undetermined_directions == 1
    assert np.abs(found.weakest) == pytest.approx([1.0, 0.0, 0.0], abs=0.1)
    # Along it the pose stays where it was, and says so; across it is known.
    assert found.pose[0] == pytest.approx(4.05, abs=0.02)
    assert found.pose[1] == pytest.approx(3.0, abs=0.02)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.3, rel=0.05)
    assert np.sqrt(found.covariance[1, 1]) < 0.01


# --- finding it


def test_the_robot_is_found_anywhere(scanners: tuple[Scanner, ...], tables: FixedScanners) -> None:
    rng, body, settings = np.random.default_rng(5), robot_body(FRONTED), LaserSettings()
    found = 0
    for _ in range(20):
        pose = np.array([*rng.uniform([1.5, 1.2], [6.5, 4.6]), rng.uniform(-np.pi, np.pi)])
        result = acquire(one_set(scanners, pose, FRONTED, rng)[0], tables, body, settings)
        if result is None:
            continue
        found += 1
        choices = [pose, compose(pose, body.symmetries[0])]
        assert min(np.hypot(*(result - c)[:2]) for c in choices) < 0.05
        assert min(abs(wrap_angle(result[2] - c[2])) for c in choices) < np.radians(5.0)
    assert found >= 18


def test_people_are_no_robot(scanners: tuple[Scanner, ...], tables: FixedScanners) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    legs = np.stack([0.12 * np.cos(angles), 0.12 * np.sin(angles)], axis=-1)
    rng = np.random.default_rng(6)
    for place in ([3.0, 2.0, 0.0], [5.0, 4.0, 0.3]):
        sets = one_set(scanners, np.array(place), legs, rng)
        assert acquire(sets[0], tables, robot_body(FRONTED), LaserSettings()) is None


# --- tracks


def path_with_gap(t: float) -> FloatArray | None:
    return None if 2.0 <= t < 3.0 else circle(t)


@pytest.fixture(scope="module")
def recorded(scanners: tuple[Scanner, ...]) -> ScanSets:
    return sets_of_scans(record(scanners, path_with_gap, (0.0, 5.0), FRONTED, 11))


def errors(times: FloatArray, poses: FloatArray) -> FloatArray:
    error: FloatArray = poses - np.array([circle(t) for t in times.tolist()])
    error[:, 2] = wrap_angle(error[:, 2])
    return error


def test_a_track_through_a_loss(recorded: ScanSets, tables: FixedScanners) -> None:
    track = track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0))
    t = track.times_s
    gap = (t > 2.02) & (t < 2.98)
    there = ((t > 0.1) & (t < 1.98)) | ((t > 3.1) & (t < 4.95))
    good = track.is_determined
    assert np.isin(track.status[gap], (SetStatus.LOST, SetStatus.COASTING)).all()
    assert np.isnan(track.poses[gap]).all()
    assert good[there].mean() > 0.98
    assert int((track.status == SetStatus.REACQUIRED).sum()) == 2
    assert len(track.fronts) == 2
    error = errors(t[good], track.poses[good])
    assert np.hypot(error[:, 0], error[:, 1]).mean() < 0.005
    assert abs(np.degrees(error[:, 2].mean())) < 0.1
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariances[good]), error) / 3
    assert float(squared.mean()) == pytest.approx(1.0, abs=0.15)
    assert not any(reason == "" for reason in track.reasons.values())
    assert np.abs(track.motion[good] @ [0.0, 0.0, 1.0] - 0.5).mean() < 0.1


@pytest.mark.parametrize("rate_hz", [5.0, 10.0])
def test_scans_of_slow_scanners_are_moved_on_along_the_arc(
    rate_hz: float, scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    """They are up to a fifth of a second apart, in which the robot drives and turns."""
    scans = record(scanners, circle, (0.0, 6.0), FRONTED, 5, rate_hz=rate_hz)
    track = track_by_lasers(sets_of_scans(scans), tables, Robot(FRONTED, 1.0, 1.0))
    good = track.is_determined
    assert good.mean() > 0.95
    assert len(track.fronts) == 1
    error = errors(track.times_s[good], track.poses[good])
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(track.covariances[good]), error)
    assert float(squared.mean()) / 3.0 < 1.5
    assert float(squared.max()) < 30.0


def test_combined_poses(recorded: ScanSets, tables: FixedScanners) -> None:
    track = track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0))
    one, six = combined_poses(track, 1), combined_poses(track, 6)
    good = track.is_determined | (track.status == SetStatus.UNDETERMINED_DIRECTION)
    assert len(one) == good.sum()
    assert one.poses == pytest.approx(track.poses[good])
    assert len(one) / 6 <= len(six) < len(one) / 6 + 10
    error = errors(six.times_s, six.poses)
    assert six.covariances is not None
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(six.covariances), error) / 3
    assert float(squared.mean()) == pytest.approx(1.0, abs=0.45)
    assert np.degrees(np.abs(error[:, 2]).mean()) < 0.25
    # Sets of slow scanners are farther apart, and of one block as well.
    slow = combined_poses(replace(track, times_s=15.0 * track.times_s), 6)
    np.testing.assert_allclose(slow.times_s, 15.0 * six.times_s)


def test_what_all_readings_share_is_not_averaged_away(
    scanners: tuple[Scanner, ...], recorded: ScanSets, tables: FixedScanners
) -> None:
    shared = tables._replace(covariance=np.diag(np.tile([1e-4, 1e-4, 1e-6], 4)))
    exactly = track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0))
    track = track_by_lasers(recorded, shared, Robot(FRONTED, 1.0, 1.0))
    for sets in (1, 6):
        a, b = combined_poses(exactly, sets), combined_poses(track, sets)
        assert a.covariances is not None
        assert b.covariances is not None
        more = (b.covariances - a.covariances)[:, 0, 0]
        assert np.median(more) > 1e-5


def test_the_front_of_a_plain_box_shows_when_it_drives(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    sets = sets_of_scans(record(scanners, circle, (0.0, 3.0), PLAIN, 12))
    track = track_by_lasers(sets, tables, Robot(PLAIN, 1.0, 1.0))
    good = track.is_determined
    assert good.mean() > 0.95
    error = errors(track.times_s[good], track.poses[good])
    assert np.degrees(np.abs(error[:, 2]).max()) < 5.0
    assert all("driven forward" in front for front in track.fronts.values())

    still = sets_of_scans(record(scanners, lambda t: circle(1.0), (0.0, 1.0), PLAIN, 13))
    standing = track_by_lasers(still, tables, Robot(PLAIN, 1.0, 1.0))
    assert (standing.status == SetStatus.FRONT_UNKNOWN).mean() > 0.9
    assert len(combined_poses(standing)) == 0


def test_a_single_set_does_not_show_the_front(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    """Its corners are cut by two centimetres only."""
    cut = np.array(
        [[-0.4, 0.3], [-0.4, -0.3], [0.28, -0.3], [0.3, -0.28], [0.3, 0.28], [0.28, 0.3]]
    )
    sets = one_set(scanners, circle(1.0), cut, np.random.default_rng(14))
    track = track_by_lasers(sets, tables, Robot(cut, 1.0, 1.0))
    assert track.status.tolist() == [SetStatus.FRONT_UNKNOWN]


def test_a_wrong_scanner_is_marked_and_its_effect_bounded(
    scanners: tuple[Scanner, ...], recorded: ScanSets
) -> None:
    shift = np.array([0.04, -0.03, 0.01])
    wrong = (*scanners[:2], replace(scanners[2], pose=scanners[2].pose + shift), scanners[3])
    track = track_by_lasers(recorded, tables_of(scanners), Robot(FRONTED, 1.0, 1.0))
    moved = fixed_scanners(wrong, empty_scans(scanners, 7))
    off = track_by_lasers(recorded, moved, Robot(FRONTED, 1.0, 1.0))
    size = np.hypot(off.corrections[:, 0], off.corrections[:, 1])
    assert int(np.argmax(size)) == 2
    assert size[2] > 0.005
    assert np.hypot(track.corrections[:, 0], track.corrections[:, 1]).max() < 0.002
    without, left_out = track_without_suspects(recorded, moved, Robot(FRONTED, 1.0, 1.0), wrong)
    assert list(left_out) == ["fixed2"]
    good = without.is_determined
    error = errors(without.times_s[good], without.poses[good])
    assert np.hypot(error[:, 0], error[:, 1]).mean() < 0.006
    good = off.is_determined
    error = errors(off.times_s[good], off.poses[good])
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.1
    assert np.nanmean(off.covariances[good, 0, 0]) > 1.5 * np.nanmean(track.covariances[:, 0, 0])


def test_a_passer_by_is_marked_and_the_effect_bounded(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 9)[:-1]
    legs = np.stack([0.08 * np.cos(angles), 0.08 * np.sin(angles)], axis=-1)

    def passing(t: float) -> FloatArray:
        # Straight past the robot, half a metre from its middle.
        robot = circle(t)
        return sides(legs, compose(robot, np.array([2.0 - 2.0 * t, 0.5, 0.0])))

    sets = sets_of_scans(record(scanners, circle, (0.0, 2.0), FRONTED, 14, passing))
    track = track_by_lasers(sets, tables, Robot(FRONTED, 1.0, 1.0))
    good = track.is_determined | (track.status == SetStatus.UNDETERMINED_DIRECTION)
    near = np.abs(track.times_s - 1.0) < 0.2
    far = np.abs(track.times_s - 1.0) > 0.6
    assert good[near].mean() > 0.8
    disturbed = track.beams[:, 3] + track.beams[:, 5]
    assert disturbed[near & good].mean() > 2.5 > 2.0 * disturbed[far & good].mean()
    error = errors(track.times_s[good], track.poses[good])
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.06


# --- the command


def test_somebody_right_behind_the_robot_does_not_pull_its_pose(
    scanners: tuple[Scanner, ...], tables: FixedScanners
) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    body = np.stack([0.14 * np.cos(angles), 0.25 * np.sin(angles)], axis=-1)
    behind = np.array([-0.57, 0.0, 0.0])  # a gap of 3 cm

    def somebody(t: float) -> FloatArray:
        return sides(body, compose(circle(t), behind)) if t > 2.0 else np.empty((0, 4))

    sets = sets_of_scans(record(scanners, circle, (0.0, 8.0), FRONTED, 5, somebody, rate_hz=15.0))
    track = track_by_lasers(sets, tables, Robot(FRONTED, 1.0, 1.0))
    assert np.all(track.is_determined)
    exact = np.array([circle(t) for t in sets.times_s])
    assert np.max(np.abs(track.poses - exact)[:, :2]) < 0.015


def test_the_command_writes_the_same_bytes_again(
    tmp_path: Path, scanners: tuple[Scanner, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    scans = record(scanners, circle, (0.0, 1.5), FRONTED, 15)
    write_session(tmp_path, scanners, scans, FRONTED)
    assert perform_laser(Laser(tmp_path)) == 0
    first = {e: (tmp_path / f"laser.{e}").read_bytes() for e in ("csv", "jsonl", "json")}
    with pytest.raises(FileExistsError):
        perform_laser(Laser(tmp_path))
    assert perform_laser(Laser(tmp_path, force=True)) == 0
    assert first == {e: (tmp_path / f"laser.{e}").read_bytes() for e in first}
    poses = read_planar_poses(tmp_path / "laser.csv")
    assert poses.covariances is not None
    error = errors(poses.times_s, poses.poses)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.02
    lines = [json.loads(line) for line in first["jsonl"].decode().splitlines()]
    assert len(lines) == len(sets_of_scans(scans))
    assert {line["status"] for line in lines} <= {"ok", "reacquired", "lost", "coasting"}
    content = json.loads(first["json"])
    assert content["settings"]["keep"] == 0.95
    assert not any(entry["suspect"] for entry in content["scanners"])
    assert "6 poses" not in capsys.readouterr().err


def test_a_session_without_the_robot_gives_no_pose(
    tmp_path: Path, scanners: tuple[Scanner, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    scans = record(scanners, lambda t: None, (0.0, 0.4), FRONTED, 16)
    write_session(tmp_path, scanners, scans, FRONTED)
    assert perform_laser(Laser(tmp_path)) == 1
    assert "error: no pose: " in capsys.readouterr().err
    assert (tmp_path / "laser.jsonl").exists()
    assert not (tmp_path / "laser.csv").exists()
    # Nor does an older one stay, which would look like the result.
    (tmp_path / "laser.csv").write_text("old\n")
    assert perform_laser(Laser(tmp_path, force=True)) == 1
    assert not (tmp_path / "laser.csv").exists()


def test_settings_are_checked() -> None:
    with pytest.raises(GroundTruthError, match="keep"):
        LaserSettings(keep=1.2)
    with pytest.raises(GroundTruthError, match="gate_m"):
        LaserSettings(gate_m=float("nan"))
    assert invert(np.zeros(3)) == pytest.approx(np.zeros(3))


def test_sets_are_averaged_over_a_time_not_over_a_number(
    recorded: ScanSets, tables: FixedScanners
) -> None:
    """The mean of poses over a quarter of a second is off while the robot speeds up."""
    track = track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0))
    for slower, expected in ((1.0, 6), (1.875, 3), (3.0, 2), (7.5, 1)):
        assert usual_sets_per_pose(replace(track, times_s=slower * track.times_s)) == expected
    assert usual_sets_per_pose(replace(track, times_s=track.times_s[:1])) == 1


@pytest.mark.parametrize("scale", [0.95, 1.06])
def test_an_outline_of_a_wrong_size_is_moved_to_the_readings(
    scale: float, recorded: ScanSets, tables: FixedScanners
) -> None:
    exact = track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0))
    assert exact.outline_moved_m == 0.0
    assert exact.seen_through < 0.05
    wrong = track_by_lasers(recorded, tables, Robot(scale * FRONTED, 1.0, 1.0))
    # Its sides are 0.3 m and its ends 0.35 m from its middle.
    assert wrong.outline_moved_m == pytest.approx(0.325 * (1.0 - scale), abs=0.006)
    assert wrong.seen_through < 0.08
    assert np.array_equal(np.isfinite(exact.poses), np.isfinite(wrong.poses))
    assert np.nanmedian(np.hypot(*(exact.poses - wrong.poses)[:, :2].T)) < 0.005


def test_errors_of_single_sides_of_an_outline_are_in_the_covariance(
    recorded: ScanSets, tables: FixedScanners
) -> None:
    assert track_by_lasers(recorded, tables, Robot(FRONTED, 1.0, 1.0)).outline_sigma_m == 0.0
    squares = []
    for seed in range(3):
        drawn = FRONTED + np.random.default_rng(seed).normal(0.0, 0.012, FRONTED.shape)
        track = track_by_lasers(recorded, tables, Robot(drawn, 1.0, 1.0))
        assert track.outline_sigma_m > 0.002
        good = track.is_determined
        error, inverse = errors(track.times_s, track.poses)[good], np.linalg.inv(track.covariances)
        squares.append(float(np.mean(np.einsum("ni,nij,nj->n", error, inverse[good], error))) / 3.0)
    assert np.mean(squares) < 2.5
