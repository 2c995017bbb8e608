"""Least-squares maps of runs whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from camera.model import PARAMETERS
from camera.rotations import rotation_of
from camera.uncertainty import covariance_of, with_covariance
from redetect.array_types import FloatArray
from redetect.landmarks import read_frames
from redetect.plane import between, chain_steps
from redetect.slam.errors import SlamError
from redetect.slam.filters.ekf_slam import filtered_poses
from redetect.slam.mapping.graph import first_sight, graph_of_recording, place_lines
from redetect.slam.mapping.graph_terms import PLACE_PRIOR_M, Weighting
from redetect.slam.mapping.run_map import MappedRun, map_run
from redetect.slam.mapping.solve import solve
from redetect.slam.mapping.solve_gtsam import solve_gtsam
from redetect.slam.models import disc_in_robot, move
from redetect.slam.mounting import levelled_camera, mounted_camera, rows_through_mounting
from redetect.slam.recording import (
    LineRows,
    Recording,
    read_recording,
    recording_of_frames,
)
from tests.slam.ekf_rows import circle_rows
from tests.slam.small_run import CAMERA_XY, SmallRun, small_run


def _only_discs(run: SmallRun) -> Recording:
    none = LineRows.of()
    return replace(run.recording, lines=none)


def _with_camera_place(camera: Camera) -> Camera:
    """The camera, standing where the small run's bearings are taken from."""
    matrix = np.array(camera.robot_from_camera)
    matrix[:2, 3] = CAMERA_XY
    return _mounted(camera, matrix)


def _mounted(camera: Camera, matrix: FloatArray) -> Camera:
    first, second, third = (tuple(float(x) for x in row) for row in matrix)
    return replace(camera, robot_from_camera=(first, second, third))  # type: ignore[arg-type]


def test_exact_rows_give_the_truth_back(published_camera: Camera) -> None:
    run = small_run(1, noise=0.0)
    mapped = map_run(run.recording, _with_camera_place(published_camera))
    np.testing.assert_allclose(mapped.estimate.poses, run.poses, atol=1e-6)
    np.testing.assert_allclose(
        mapped.estimate.disc_xy, run.disc_xy[mapped.graph.disc_ids - 1], atol=1e-6
    )
    np.testing.assert_allclose(
        mapped.estimate.line_xy, run.line_xy[mapped.graph.line_ids - 1], atol=1e-6
    )
    assert len(mapped.graph.line_ids) == len(run.line_xy)
    assert mapped.table.chi_squared < 1e-6


@pytest.mark.long
def test_errors_and_chi_squared_are_as_the_covariances_say(published_camera: Camera) -> None:
    camera = _with_camera_place(published_camera)
    chi_squared, expected = 0.0, 0
    disc_nees: list[float] = []
    line_nees: list[float] = []
    pose_nees: list[float] = []
    for seed in range(30):
        run = small_run(seed)
        mapped = map_run(run.recording, camera)
        chi_squared += mapped.table.chi_squared
        expected += mapped.table.expected
        for off, spread, into in (
            (
                mapped.estimate.disc_xy - run.disc_xy[mapped.graph.disc_ids - 1],
                mapped.covariance.discs,
                disc_nees,
            ),
            (
                mapped.estimate.line_xy - run.line_xy[mapped.graph.line_ids - 1],
                mapped.covariance.lines,
                line_nees,
            ),
            (
                (mapped.estimate.poses - run.poses)[-1:],
                mapped.covariance.poses[-1:],
                pose_nees,
            ),
        ):
            squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
            into.append(float(np.mean(squared)))
    # 95 % of chi-squared / its degrees of freedom lies within 1.96 sqrt(2 / dof); twice that here.
    assert chi_squared / expected == pytest.approx(1.0, abs=4 * np.sqrt(2 / expected))
    # Landmarks of one run err together: as if each run gave a few independent ones.
    assert np.mean(disc_nees) == pytest.approx(2.0, abs=0.6)
    assert np.mean(line_nees) == pytest.approx(2.0, abs=0.6)
    assert np.mean(pose_nees) == pytest.approx(3.0, abs=4 * np.sqrt(2 * 3 / 30))


def test_a_known_first_pose_moves_the_whole_map(published_camera: Camera) -> None:
    recording, camera = small_run(2).recording, _with_camera_place(published_camera)
    start = (3.0, -2.0, 0.7)
    plain = map_run(recording, camera)
    moved = map_run(recording, camera, start=start)
    np.testing.assert_allclose(moved.estimate.poses[0], start)
    expected = move(start, plain.estimate.poses)
    np.testing.assert_allclose(moved.estimate.poses, expected, atol=1e-5)
    for one, other in (("disc_xy", plain.estimate.disc_xy), ("line_xy", plain.estimate.line_xy)):
        at = np.pad(other, ((0, 0), (0, 1)))
        np.testing.assert_allclose(getattr(moved.estimate, one), move(start, at)[:, :2], atol=1e-5)
    assert moved.table.chi_squared == pytest.approx(plain.table.chi_squared)


def test_gtsam_finds_the_same_minimum() -> None:
    pytest.importorskip("gtsam")
    ours = map_run(_only_discs(small_run(2)))
    theirs = solve_gtsam(ours.graph, ours.estimate, Weighting())
    # Its error of a step is a logarithm: other in the second order.
    assert theirs.costs[-1] == pytest.approx(ours.cost, rel=1e-5)
    np.testing.assert_allclose(ours.estimate.poses, theirs.at.poses, atol=1e-3)
    np.testing.assert_allclose(ours.estimate.disc_xy, theirs.at.disc_xy, atol=1e-3)


@pytest.mark.parametrize("weighting", [Weighting(calibrate=True), Weighting(loss="cauchy")])
def test_gtsam_does_plain_least_squares(published_camera: Camera, weighting: Weighting) -> None:
    pytest.importorskip("gtsam")
    with pytest.raises(SlamError, match="plain least squares of discs only"):
        map_run(_only_discs(small_run(2)), published_camera, weighting, solver="gtsam")


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman-mcclure"])
def test_a_loss_withstands_wrong_identifiers(loss: str) -> None:
    run = small_run(6, noise=0.0)
    circles = run.recording.circles
    ids = circles.ids.copy()
    rng = np.random.default_rng(1)
    wrong = rng.choice(len(ids), len(ids) // 25, replace=False)
    ids[wrong] = ids[wrong] % 14 + 1
    spoilt = replace(_only_discs(run), circles=replace(circles, ids=ids))
    off = {}
    for name in ("none", loss):
        mapped = map_run(spoilt, weighting=Weighting(loss=name))  # type: ignore[arg-type]
        off[name] = np.max(np.abs(mapped.estimate.poses - run.poses))
    assert off[loss] < off["none"] / 2


def written_when_mounted(
    recording: Recording, calibrated: Camera, mounting: FloatArray
) -> Recording:
    """The rows that a camera writes that is mounted otherwise than its file says."""
    mounted = _mounted(calibrated, mounting)
    backward = np.column_stack([calibrated.rotation, calibrated.centre])
    written, _ = rows_through_mounting(mounted, recording.circles.xy, backward)
    return replace(recording, circles=replace(recording.circles, xy=written))


@pytest.mark.parametrize("row_errors", ["corrected", "recorded"])
def test_calibration_recovers_a_wrong_mounting(published_camera: Camera, row_errors: str) -> None:
    true = np.array([-0.03, 0.012, 0.005, 0.02, 0.07, -0.03])
    turn = rotation_of(true[:3])
    mounting = np.column_stack(
        [turn @ published_camera.rotation, published_camera.centre + true[3:]]
    )
    run = small_run(7, noise=0.0, steps=90, weave_rad=0.2)
    spoilt = written_when_mounted(_only_discs(run), published_camera, mounting)
    # So certain that what is believed of the camera's place does not matter.
    certain = replace(spoilt.circles, covariance=1e-6 * spoilt.circles.covariance)
    spoilt = replace(spoilt, circles=certain, step_covariance=1e-6 * spoilt.step_covariance)
    plain = map_run(spoilt, published_camera)
    mapped = map_run(
        spoilt,
        published_camera,
        Weighting(calibrate=True, row_errors=row_errors),  # type: ignore[arg-type]
    )
    assert mapped.mounting is not None
    np.testing.assert_allclose(mapped.mounting.change, true, atol=2e-5)
    assert mapped.mounting.gain == pytest.approx(plain.table.chi_squared, rel=1e-3)
    assert plain.table.chi_squared > 10.0
    np.testing.assert_allclose(mapped.estimate.poses, run.poses, atol=2e-4)
    assert mapped.table.expected == plain.table.expected - 6


def test_the_mounting_contains_what_has_levelled_the_rows(published_camera: Camera) -> None:
    """Whether frames were levelled or not, the camera is mounted the same way."""
    true, levelled_by = np.array([-0.03, 0.012, 0.0, 0.02, 0.07, -0.03]), (-0.025, 0.008)
    turn = rotation_of(true[:3])
    mounting = np.column_stack(
        [turn @ published_camera.rotation, published_camera.centre + true[3:]]
    )
    run = _only_discs(small_run(7, noise=0.0, steps=90, weave_rad=0.2))
    certain = replace(run.circles, covariance=1e-6 * run.circles.covariance)
    run = replace(run, circles=certain, step_covariance=1e-6 * run.step_covariance)
    level = levelled_camera(published_camera, levelled_by)
    changes = []
    for camera, by in ((published_camera, (0.0, 0.0)), (level, levelled_by)):
        rows = replace(written_when_mounted(run, camera, mounting), levelled_by=by)
        mapped = map_run(rows, published_camera, Weighting(calibrate=True))
        assert mapped.mounting is not None
        changes.append(mapped.mounting.change)
    np.testing.assert_allclose(changes[0], true, atol=2e-5)
    np.testing.assert_allclose(changes[1], changes[0], atol=2e-5)


def test_errors_of_a_mounting_are_as_its_covariance_says(published_camera: Camera) -> None:
    true = np.array([-0.03, 0.012, 0.005, 0.02, 0.07, -0.03])
    squared = []
    for seed in range(30):
        run = _only_discs(small_run(seed, steps=90, weave_rad=0.2))
        turn = rotation_of(true[:3]) @ published_camera.rotation
        mounting = np.column_stack([turn, published_camera.centre + true[3:]])
        # Errors are those of the rows as they are written.
        exact = _only_discs(small_run(seed, noise=0.0, steps=90, weave_rad=0.2))
        written = written_when_mounted(exact, published_camera, mounting)
        rows = replace(run.circles, xy=written.circles.xy + run.circles.xy - exact.circles.xy)
        run = replace(run, circles=rows)
        mapped = map_run(run, published_camera, Weighting(calibrate=True))
        assert mapped.mounting is not None
        off = mapped.mounting.change - true
        squared.append(off @ np.linalg.solve(mapped.mounting.covariance, off) / len(off))
    assert 0.7 < np.mean(squared) < 1.35


def test_a_straight_drive_leaves_the_cameras_place_as_calibrated(published_camera: Camera) -> None:
    run = small_run(3, noise=0.0, steps=40)
    steps = np.tile([0.0, -0.1, 0.0], (40, 1))
    poses = chain_steps(steps)
    discs = np.array([(x, -y) for x in (-1.0, 0.4, 1.2) for y in np.linspace(1.5, 6.0, 7)])
    rows = []
    for k in range(40):
        seen = disc_in_robot(poses[k + 1], discs)
        ahead = (seen[:, 1] < -1.2) & (np.hypot(*seen.T) < 3.5)
        rows += [(k, seen[i], 1e-4 * np.eye(2), int(i)) for i in np.flatnonzero(ahead)]
    straight = replace(_only_discs(run), steps=steps, circles=circle_rows(rows))
    mapped = map_run(straight, published_camera, Weighting(calibrate=True))
    assert mapped.mounting is not None
    np.testing.assert_allclose(mapped.mounting.change, 0.0, atol=1e-6)
    sigma = np.sqrt(np.diag(mapped.mounting.covariance))
    np.testing.assert_allclose(sigma[3:5], PLACE_PRIOR_M, rtol=0.1)


def test_a_mounted_camera_states_the_covariance_of_its_mounting(published_camera: Camera) -> None:
    lens = np.diag(np.linspace(1.0, 2.0, PARAMETERS)) * 1e-6
    stated = with_covariance(published_camera, lens)
    mounting = np.array(published_camera.robot_from_camera) + 0.01 * np.eye(3, 4, 3)
    of_change = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-4
    mounted = mounted_camera(stated, mounting, of_change)
    found = covariance_of(mounted)
    assert found is not None
    np.testing.assert_allclose(np.diag(found)[-6:], np.array([4, 5, 6, 1, 2, 3]) * 1e-4)
    np.testing.assert_allclose(found[:-6, :-6], lens[:-6, :-6], rtol=1e-5)
    np.testing.assert_array_equal(np.array(mounted.robot_from_camera), mounting)
    assert mounted_camera(published_camera, mounting, of_change).covariance is None


def test_lines_without_parallax_and_lines_always_joined_are_left_out() -> None:
    run = small_run(1, noise=0.0)
    lines = run.recording.lines
    # Line 1 only from two poses next to each other; lines 2 and 3 only together.
    seen_one = [k for k, (i,) in enumerate(lines.ids) if i == 1][:2]
    kept = [k for k, (i,) in enumerate(lines.ids) if i != 1] + seen_one
    kept.sort()
    ids = tuple((2, 3) if lines.ids[k][0] in (2, 3) else lines.ids[k] for k in kept)
    rows = LineRows(lines.frame[kept], lines.bearing_rad[kept], np.full(len(kept), 0.03), ids)
    placed = place_lines(run.poses, rows, CAMERA_XY)
    assert placed.unplaced.tolist() == [1, 2, 3]
    np.testing.assert_allclose(placed.xy, run.line_xy[placed.ids - 1], atol=1e-9)


def test_rows_of_left_out_lines_are_counted(published_camera: Camera) -> None:
    run = small_run(1)
    lines = run.recording.lines
    joined = tuple((i, 99) if k == 5 else (i,) for k, (i,) in enumerate(lines.ids))
    spoilt = replace(run.recording, lines=replace(lines, ids=joined))
    mapped = map_run(spoilt, _with_camera_place(published_camera))
    assert mapped.left_out.lines_without_parallax == 1
    assert mapped.left_out.line_rows == 1
    assert mapped.table.measurements == len(run.recording.circles) + len(lines) - 1


def test_a_disc_seen_once_is_in_the_map_and_counted() -> None:
    run = small_run(8)
    circles = run.recording.circles
    ids = circles.ids.copy()
    ids[10] = 77
    mapped = map_run(replace(_only_discs(run), circles=replace(circles, ids=ids)))
    assert mapped.left_out.discs_seen_once == 1
    assert 77 in mapped.graph.disc_ids
    assert mapped.table.expected == 2 * len(circles) - 2 * (len(run.disc_xy) + 1)


def test_a_run_without_identifiers_is_refused() -> None:
    run = small_run(1)
    nameless = replace(
        run.recording.circles, ids=np.full(len(run.recording.circles), -1, dtype=np.int64)
    )
    with pytest.raises(SlamError, match=r"no row has an identifier.*three rows or more"):
        map_run(replace(_only_discs(run), circles=nameless))


def test_lines_without_a_calibration_are_refused() -> None:
    with pytest.raises(SlamError, match="calibration"):
        map_run(small_run(1).recording)


def test_calibration_with_another_cameras_rows_is_refused(published_camera: Camera) -> None:
    run = small_run(1)
    circles = run.recording.circles
    behind = replace(circles, xy=circles.xy + np.array([0.0, 9.0]))
    with pytest.raises(SlamError, match="are not visible to the camera"):
        map_run(
            replace(_only_discs(run), circles=behind), published_camera, Weighting(calibrate=True)
        )


def _lost_at(run: SmallRun, step: int) -> Recording:
    covariance = run.recording.step_covariance.copy()
    covariance[step] = np.diag([1e6, 1e6, 1e2])
    return replace(_only_discs(run), step_covariance=covariance)


def test_a_lost_step_bridged_by_landmarks_is_no_matter() -> None:
    run = small_run(9)
    mapped = map_run(_lost_at(run, 40))
    assert np.max(np.abs(mapped.estimate.poses - run.poses)) < 0.3


def test_a_disconnected_run_is_refused() -> None:
    run = small_run(9)
    lost = _lost_at(run, 40)
    ids = lost.circles.ids.copy()
    ids[lost.circles.frame >= 40] += 100
    # One disc in common leaves the second part free to turn about it.
    ids[np.flatnonzero(lost.circles.frame >= 40)[0]] = ids[0]
    with pytest.raises(SlamError, match=r"disconnected at step 41 \(s\.0040\).*share 1 landmarks"):
        map_run(replace(lost, circles=replace(lost.circles, ids=ids)), name="r")


def test_a_run_that_begins_with_a_lost_step_is_refused() -> None:
    with pytest.raises(SlamError, match=r"step 1 \(s\.0000\).*share 0 .*, or zeros as the"):
        map_run(_lost_at(small_run(9), 0))


def test_parts_may_be_joined_by_way_of_a_third() -> None:
    run = small_run(9)
    mapped = map_run(_lost_at(_run_lost_twice(run), 45))
    assert np.max(np.abs(mapped.estimate.poses - run.poses)) < 0.3


def _run_lost_twice(run: SmallRun) -> SmallRun:
    return replace(run, recording=_lost_at(run, 20))


def test_not_a_number_is_refused_where_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "r.circles"
    path.write_text(
        "STEP a 0.1 0 0 0.1 0 0.1 0 0 0.1\nLANDMARK_C nan 1 1 0.1 0 0.1 3\n", encoding="ascii"
    )
    with pytest.raises(ValueError, match=r"r\.circles:2.*nan"):
        map_run(read_recording(path))


def test_a_landmark_before_any_step_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.circles"
    path.write_text("LANDMARK_C 1 1 1 0.1 0 0.1 3\n", encoding="ascii")
    with pytest.raises(ValueError, match=r"r\.circles:1.*STEP"):
        map_run(read_recording(path))


@pytest.fixture(scope="module")
def run_e_as_shipped(shared_data: Path) -> Recording:
    return read_recording(shared_data / "dlr" / "map.circles")


@pytest.fixture(scope="module")
def plain_map(run_e_as_shipped: Recording) -> MappedRun:
    return map_run(run_e_as_shipped)


@pytest.mark.long
def test_the_reports_table(plain_map: MappedRun) -> None:
    table = plain_map.table
    assert (table.poses, table.landmarks, table.steps, table.measurements) == (
        3298,
        576,
        3298,
        14309,
    )
    assert table.chi_squared == pytest.approx(56_871.45, abs=0.01)
    assert table.expected == 27_466
    assert round(table.factor, 2) == 2.07
    assert round(table.root, 2) == 1.44


@pytest.mark.long
def test_the_known_solution_of_run_e(shared_data: Path, plain_map: MappedRun) -> None:
    known = np.loadtxt(shared_data / "dlr" / "least_squares_path.csv", delimiter=",")
    np.testing.assert_allclose(plain_map.estimate.poses[:, :2], known[:, :2], atol=2e-3)


@pytest.mark.long
@pytest.mark.parametrize(
    ("row_errors", "place", "chi_squared", "change"),
    [
        ("corrected", False, 41_396.34, (-0.0403, 0.0100, 0.0016, 0.0, 0.0, -0.0454)),
        ("recorded", False, 37_450.18, (-0.0366, 0.0099, 0.0024, 0.0, 0.0, -0.0111)),
        ("recorded", True, 33_759.46, (-0.0398, 0.0133, -0.0032, 0.0248, 0.1028, -0.0123)),
    ],
)
def test_calibration_of_run_e(
    run_e_as_shipped: Recording,
    published_camera: Camera,
    row_errors: str,
    place: bool,
    chi_squared: float,
    change: tuple[float, ...],
) -> None:
    weighting = Weighting(calibrate=True, place=place, row_errors=row_errors)  # type: ignore[arg-type]
    mapped = map_run(run_e_as_shipped, published_camera, weighting)
    assert mapped.table.chi_squared == pytest.approx(chi_squared, abs=0.1)
    assert mapped.mounting is not None
    np.testing.assert_allclose(mapped.mounting.change, change, atol=1e-4)


@pytest.mark.long
def test_gtsam_finds_the_reports_minimum(run_e_as_shipped: Recording, plain_map: MappedRun) -> None:
    pytest.importorskip("gtsam")
    mapped = map_run(run_e_as_shipped, solver="gtsam")
    assert mapped.table.chi_squared == pytest.approx(plain_map.table.chi_squared, abs=0.2)
    np.testing.assert_allclose(mapped.estimate.disc_xy, plain_map.estimate.disc_xy, atol=0.03)


def test_headings_far_off_still_lead_to_the_minimum() -> None:
    """Odometry with a heading error that bends two laps into one and a half."""
    run = small_run(3)
    recording = _only_discs(run)
    minimum = map_run(recording).cost
    graph = graph_of_recording(recording)
    start = first_sight(graph)
    bent = start.poses + np.linspace(0.0, 1.0, len(start.poses))[:, None] * [1.0, -1.0, 1.5]
    assert solve(graph, replace(start, poses=bent), Weighting()).costs[-1] == pytest.approx(minimum)


def test_singular_covariances_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.circles"
    path.write_text(
        "STEP a 0.1 0 0 0.1 0.1 0.1 0 0 0.1\nLANDMARK_C 1 1 1 0.1 0 0.1 3\n", encoding="ascii"
    )
    with pytest.raises(SlamError, match=r"step 1 \(a\).*positive definite"):
        recording_of_frames(list(read_frames(path)), str(path))


def test_odometry_that_winds_up_does_not_wind_the_map() -> None:
    """Each turn is wrong by ten standard deviations, the heading in the end by more than a turn."""
    run = small_run(1, steps=120)
    recording = _only_discs(run)
    recording = replace(recording, steps=recording.steps + np.array([0.0, 0.0, 0.06]))
    graph = graph_of_recording(recording)
    from_odometry = solve(graph, first_sight(graph), Weighting())
    from_truth = solve(graph, first_sight(graph, poses=run.poses), Weighting())
    assert from_odometry.costs[-1] > 1.5 * from_truth.costs[-1]
    mapped = map_run(recording)
    assert mapped.cost == pytest.approx(from_truth.costs[-1], rel=1e-6)
    assert np.max(np.abs(mapped.estimate.poses[:, 2] - run.poses[:, 2])) < np.pi / 2


def test_filtered_start_begins_again_after_a_lost_step() -> None:
    run = small_run(2)
    recording = _only_discs(run)
    steps, covariance = recording.steps.copy(), recording.step_covariance.copy()
    steps[30] += [5.0, 5.0, 1.0]
    covariance[30] = np.diag([1e6, 1e6, 1e2])
    poses = filtered_poses(replace(recording, steps=steps, step_covariance=covariance))
    true = between(run.poses[:1], run.poses)
    assert np.hypot(*(poses[:31] - true[:31]).T[:2]).max() < 0.5
    # The second part is displaced, but has the same shape.
    assert poses[31] == pytest.approx(move(poses[30], steps[30]), abs=1e-9)
    shape = between(poses[31:32], poses[31:]) - between(run.poses[31:32], run.poses[31:])
    assert np.hypot(*shape.T[:2]).max() < 0.5
