"""Association of whole small runs whose truth is known, and the transformations in it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle, write_frames
from redetect.plane import between, chain_steps
from redetect.slam.association.frame_to_frame import associate_locally
from redetect.slam.association.run import associate_run, without_clutter
from redetect.slam.association.scoring import score_association
from redetect.slam.cli import main
from redetect.slam.models import OdometryNoise, bearing_of_vertical, disc_in_robot, tilt_jacobian
from redetect.slam.recording import CircleRows, LineRows, Recording, frames_of_discs
from redetect.slam.settings import AssociateSettings, Method
from tests.slam.ekf_rows import circle_rows

CAMERA_XY = (0.02, -0.08)
STEP_SIGMA = np.array([0.004, 0.004, 0.006])
DISC_SIGMA, LINE_SIGMA = 0.03, 0.002


def circuit(laps: float, side_m: float = 8.0) -> FloatArray:
    """Poses along a square, a step every 0.2 m and eight steps to turn at a corner."""
    per_side = round(side_m / 0.2)
    steps: list[tuple[float, float, float]] = []
    while len(steps) < laps * 4 * (per_side + 8):
        steps += [(0.0, -0.2, 0.0)] * per_side + [(0.0, 0.0, np.pi / 16)] * 8
    return chain_steps(np.array(steps[: int(laps * 4 * (per_side + 8))]))


def drive(
    path: FloatArray,
    discs: FloatArray,
    lines: FloatArray,
    seed: int,
    step_covariance: FloatArray | None = None,
    bias_rad: float = 0.0,
) -> Recording:
    """What a robot on a path measures: discs within 3.5 m ahead, lines within 6 m."""
    rng = np.random.default_rng(seed)
    count = len(path) - 1
    covariance = np.tile(np.diag(STEP_SIGMA**2), (count, 1, 1))
    if step_covariance is not None:
        covariance = step_covariance.copy()
    root = np.linalg.cholesky(covariance)
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
    steps = between(path[:-1], path[1:]) + error
    steps[:, 2] += bias_rad
    covariance[:, 2, 2] = (np.sqrt(covariance[:, 2, 2]) + abs(bias_rad)) ** 2
    seen: list[tuple[int, int, FloatArray]] = []
    upright: list[tuple[int, int, float]] = []
    for k, pose in enumerate(path[1:]):
        place = disc_in_robot(pose, discs)
        for i in np.flatnonzero((place[:, 1] < -0.7) & (place[:, 1] > -3.5)):
            if abs(place[i, 0]) < 0.3 - 0.6 * place[i, 1] and rng.random() < 0.85:
                seen.append((k, int(i), place[i] + DISC_SIGMA * rng.normal(size=2)))
        bearing = bearing_of_vertical(pose, lines, CAMERA_XY) if len(lines) else np.zeros(0)
        reach = np.linalg.norm(lines - pose[:2], axis=1)
        for i in np.flatnonzero((np.abs(bearing) < 0.9) & (reach < 6.0)):
            upright.append((k, int(i), float(bearing[i] + LINE_SIGMA * rng.normal())))
    return Recording(
        prefixes=tuple(f"s.{k}" for k in range(count)),
        steps=steps,
        step_covariance=covariance,
        circles=circle_rows((k, xy, DISC_SIGMA**2 * np.eye(2), i) for k, i, xy in seen),
        lines=LineRows.of((k, float(wrap_angle(b)), LINE_SIGMA, (i,)) for k, i, b in upright),
    )


def scattered(seed: int, count: int, apart_m: float, side_m: float = 8.0) -> FloatArray:
    """Random places along the square, none nearer to another than a distance."""
    rng = np.random.default_rng(seed)
    path = circuit(1.0, side_m)
    places: list[FloatArray] = []
    while len(places) < count:
        place = path[rng.integers(len(path)), :2] + rng.uniform(-2.0, 2.0, 2)
        if all(np.linalg.norm(place - other) > apart_m for other in places):
            places.append(place)
    return np.array(places)


def ids_of(recording: Recording) -> list[tuple[int, ...]]:
    return [(int(i),) if i >= 0 else () for i in recording.circles.ids]


NO_LINES = np.zeros((0, 2))


def test_tilt_moves_discs_as_rays_through_the_camera_do() -> None:
    discs = np.array([[0.4, -2.0], [-1.1, -3.5], [0.0, -0.8]])
    height, small = 1.5, 1e-6
    for axis in (0, 1):
        turn = np.zeros(3)
        turn[axis] = small
        rays = np.concatenate([discs, np.full((3, 1), -height)], axis=1)
        rays = rays + np.cross(turn, rays)
        hit = rays[:, :2] * (height / -rays[:, 2:])
        found = tilt_jacobian(discs, height)[:, :, axis]
        assert found == pytest.approx((hit - discs) / small, rel=1e-4, abs=1e-4)


def test_a_swaying_robot_is_followed_where_the_sway_is_told() -> None:
    """Rows far more precise than the sway that moves them."""
    recording = drive(circuit(0.3), scattered(13, 60, 0.5), NO_LINES, seed=14)
    rng = np.random.default_rng(15)
    tilt = 0.012 * rng.normal(size=(len(recording), 2))
    circles = recording.circles
    place = circles.xy + np.einsum(
        "nij,nj->ni", tilt_jacobian(circles.xy, 1.5), tilt[circles.frame]
    )
    # What is left of the measurement noise is told; the sway is not.
    swaying = replace(recording, circles=replace(circles, xy=place))
    ids = ids_of(swaying)
    blind = associate_locally(swaying, AssociateSettings(sigma_scale=1.0))
    told = associate_locally(swaying, AssociateSettings(sigma_scale=1.0, tilt_sigma_deg=0.7))
    assert score_association(blind[0], ids).pair_recall < 0.9
    score = score_association(told[0], ids)
    assert score.pair_recall > 0.95
    assert score.pair_precision > 0.98


@pytest.mark.parametrize("method", ["nearest", "joint"])
def test_well_separated_landmarks_are_followed_without_a_mistake(method: Method) -> None:
    path = circuit(0.9)
    recording = drive(path, scattered(1, 60, 0.6), scattered(2, 25, 1.0), seed=3)
    of_discs, of_lines, _ = associate_locally(
        recording, AssociateSettings(method=method), camera_xy=CAMERA_XY
    )
    discs = score_association(of_discs, ids_of(recording))
    assert (discs.pair_precision, discs.wrong_merges) == (1.0, 0)
    assert discs.pair_recall > 0.98
    lines = score_association(of_lines, list(recording.lines.ids))
    assert lines.pair_precision > (0.99 if method == "joint" else 0.95)
    assert lines.pair_recall > 0.8


def test_ids_in_the_file_are_not_looked_at_and_the_result_is_the_same_every_time() -> None:
    recording = drive(circuit(0.5), scattered(4, 40, 0.4), NO_LINES, seed=5)
    blind = replace(
        recording, circles=replace(recording.circles, ids=recording.circles.ids * 0 - 1)
    )
    one, other = associate_run(recording), associate_run(blind)
    assert one.circle_labels.tolist() == other.circle_labels.tolist()
    assert one.circle_labels.tolist() == associate_run(recording).circle_labels.tolist()


def test_a_lost_first_step_does_not_matter() -> None:
    recording = drive(circuit(0.2), scattered(7, 40, 0.4), NO_LINES, seed=8)
    covariance = recording.step_covariance.copy()
    covariance[0] = np.diag([1e6, 1e6, 1e2])
    lost = associate_run(replace(recording, step_covariance=covariance))
    assert lost.circle_labels.tolist() == associate_run(recording).circle_labels.tolist()


def test_lines_do_not_change_what_becomes_of_the_discs() -> None:
    discs = scattered(7, 40, 0.4)
    recording = drive(circuit(0.2), discs, scattered(16, 60, 0.02), seed=8)
    none = LineRows.of()
    alone = associate_run(replace(recording, lines=none))
    both = associate_run(recording, camera_xy=CAMERA_XY)
    assert both.circle_labels.tolist() == alone.circle_labels.tolist()
    assert len(both.line_labels) == len(recording.lines)


@pytest.mark.long
def test_a_second_lap_is_recognised_though_odometry_drifts() -> None:
    """By a bias of 0.004 rad a step the second lap is turned by 0.8 rad and metres away."""
    discs = scattered(9, 150, 0.3)
    path = circuit(2.0)
    recording = drive(path, discs, NO_LINES, seed=10, bias_rad=0.004)
    found = associate_run(recording)
    before = score_association(found.local_circle_labels, ids_of(recording))
    after = score_association(found.circle_labels, ids_of(recording))
    assert before.pair_recall < 0.7
    assert after.pair_precision > 0.999
    assert (after.found_landmarks, after.splits) == (150, 0)
    assert after.unlabelled_rows < 0.02 * after.rows
    assert found.path is not None
    assert np.linalg.norm(found.path[-1, :2] - path[-1, :2]) < 0.15


@pytest.mark.long
def test_two_places_that_only_look_alike_in_part_stay_apart() -> None:
    """No loop: a straight way past 120 discs at random; nothing may be merged over a distance."""
    rng = np.random.default_rng(11)
    path = chain_steps(np.tile([0.0, -0.2, 0.0], (300, 1)))
    discs = np.stack([rng.uniform(-2, 2, 120), rng.uniform(-63, 0, 120)], axis=1)
    recording = drive(path, discs, NO_LINES, seed=12)
    found = associate_run(recording)
    assert found.matches == ()
    assert score_association(found.circle_labels, ids_of(recording)).pair_precision > 0.99


def twin_rooms(seed: int, apart_m: float) -> FloatArray:
    """Discs of a room, at random, and the same once more further on along the robot's way."""
    rng = np.random.default_rng(seed)
    room: list[FloatArray] = []
    while len(room) < 20:
        place = rng.uniform([-2.0, -6.0], [2.0, -1.0])
        if all(np.linalg.norm(place - other) > 0.4 for other in room):
            room.append(place)
    return np.concatenate([room, np.array(room) - [0.0, apart_m]])


@pytest.mark.long
@pytest.mark.parametrize("laps", [1, 3])
def test_rooms_that_look_alike_stay_apart_where_odometry_tells_them(laps: int) -> None:
    """Two rooms without a difference, visited in turn, once or again and again."""
    discs = twin_rooms(17, apart_m=7.0)
    way, turn = [(0.0, -0.1, 0.0)] * 150, [(0.0, 0.0, np.pi / 20)] * 20
    true = np.array(([*way, *turn] * laps)[: -len(turn)])
    noise = OdometryNoise()
    recording = drive(chain_steps(true), discs, NO_LINES, 18, noise.covariance(true))
    found = associate_run(recording)
    score = score_association(found.circle_labels, ids_of(recording))
    assert (score.pair_precision, score.wrong_merges, score.splits) == (1.0, 0, 0)
    assert score.found_landmarks == len(np.unique(recording.circles.ids))
    assert (len(found.matches) > 0) == (laps > 1)


def with_clutter(recording: Recording, count: int, seed: int) -> Recording:
    """The run with rows of nothing, of which every third comes again in the next frame."""
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, len(recording) - 1, count)
    xy = np.stack([rng.uniform(-1.5, 1.5, count), rng.uniform(-3.5, -1.0, count)], axis=1)
    again = np.arange(0, count, 3)
    circles = recording.circles
    frames = np.concatenate([circles.frame, frame, frame[again] + 1])
    order = np.argsort(frames, kind="stable")
    return replace(
        recording,
        circles=CircleRows(
            frames[order],
            np.concatenate([circles.xy, xy, xy[again] + [0.0, 0.2]])[order],
            np.tile(DISC_SIGMA**2 * np.eye(2), (len(order), 1, 1)),
            np.concatenate([circles.ids, np.full(count + len(again), -1)])[order],
        ),
    )


def test_clutter_gets_no_label_and_harms_no_disc() -> None:
    clean = drive(circuit(0.6), scattered(4, 60, 0.5), NO_LINES, seed=5)
    recording = with_clutter(clean, 60, seed=6)
    found = associate_run(recording)
    clutter = recording.circles.ids < 0
    assert np.mean(found.circle_labels[clutter] < 0) > 0.85
    assert np.mean(found.circle_labels[~clutter] < 0) < 0.06
    score = score_association(found.circle_labels, ids_of(recording))
    assert (score.pair_precision, score.splits, score.wrong_merges) == (1.0, 0, 0)
    counts = np.bincount(clean.circles.ids)
    assert score.found_landmarks >= np.count_nonzero(counts >= 5)
    assert found.circle_labels.max() + 1 <= np.count_nonzero(counts) + 3


def test_a_row_far_from_its_disc_loses_its_label() -> None:
    """A disc that is cut by the border of the image, say: followed all the same, but not mapped."""
    recording = drive(circuit(0.2), scattered(4, 60, 0.5), NO_LINES, seed=5)
    circles = recording.circles
    seen = np.bincount(circles.ids)[circles.ids]
    hit = int(np.flatnonzero(seen >= 10)[5])
    xy = circles.xy.copy()
    xy[hit] += [0.0, 0.15]
    moved_row = replace(recording, circles=replace(circles, xy=xy))
    assert associate_run(recording).circle_labels[hit] >= 0
    labels = associate_run(moved_row).circle_labels
    assert labels[hit] == -1
    assert associate_run(moved_row, AssociateSettings(fewest_rows=1)).circle_labels[hit] == -1


def test_without_map_level_the_labels_are_the_local_ones() -> None:
    recording = drive(circuit(0.5), scattered(4, 40, 0.4), NO_LINES, seed=5)
    found = associate_run(recording, AssociateSettings(map_level=False))
    assert found.circle_labels.tolist() == found.local_circle_labels.tolist()
    assert found.path is None


def test_a_run_without_landmarks_is_associated_to_nothing() -> None:
    recording = drive(circuit(0.1), np.zeros((0, 2)), NO_LINES, seed=1)
    found = associate_run(recording)
    assert len(found.circle_labels) == 0
    assert len(found.line_labels) == 0


@pytest.mark.parametrize("seed", [4, 5])
def test_a_corridor_with_regular_pairs_of_discs_is_not_laid_on_itself(seed: int) -> None:
    """Odometry alone would allow the corridor to bend until its end lies on its beginning."""
    path = chain_steps(np.tile([0.0, -0.2, 0.0], (300, 1)))
    along = -np.arange(0.0, 62.0, 1.5)
    sides = [np.column_stack([np.full(len(along), side), along]) for side in (-1.2, 1.2)]
    discs = np.concatenate(sides)
    discs += np.random.default_rng(seed).normal(0.0, 0.02, discs.shape)
    covariance = OdometryNoise().covariance(between(path[:-1], path[1:]))
    recording = drive(path, discs, NO_LINES, seed, covariance)
    found = associate_run(recording)
    score = score_association(found.circle_labels, ids_of(recording))
    assert score.pair_precision == 1.0
    assert score.pair_recall > 0.99


@pytest.mark.parametrize(("seed", "scatter_m"), [(1, 0.0), (2, 0.004), (3, 0.01)])
def test_a_grid_of_discs_is_not_closed_a_cell_off(seed: int, scatter_m: float) -> None:
    """Discs on the corners of tiles: each cell looks like all others."""
    grid = np.stack(np.meshgrid(*[1.2 * np.arange(-4, 14)] * 2), axis=-1).reshape(-1, 2)
    discs = grid + np.random.default_rng(seed).normal(0.0, scatter_m, grid.shape)
    recording = drive(circuit(2.0, 10.0), discs, NO_LINES, seed)
    found = associate_run(recording)
    score = score_association(found.circle_labels, ids_of(recording))
    assert score.pair_precision > 0.999


def test_clutter_does_not_keep_the_labels_of_a_disc_apart() -> None:
    path = chain_steps(np.tile([0.0, -0.1, 0.0], (12, 1)))
    discs = np.array([[0.5 * (i % 3), -3.0 - 0.5 * (i // 3)] for i in range(8)])
    rows = [(k, disc_in_robot(path[k + 1], xy), i) for k in range(12) for i, xy in enumerate(discs)]
    rows.insert(24, (2, np.array([0.0, -2.2]), 8))
    recording = Recording(
        tuple(map(str, range(12))),
        between(path[:-1], path[1:]),
        np.tile(1e-6 * np.eye(3), (12, 1, 1)),
        circle_rows((k, xy, DISC_SIGMA**2 * np.eye(2), i) for k, xy, i in rows),
        LineRows.of(),
    )
    ids, frame = recording.circles.ids, recording.circles.frame
    # From frame 6 on, the first disc has the label of the clutter.
    labels = np.where((ids == 0) & (frame >= 6), 8, ids)
    found = without_clutter(recording, labels, path, AssociateSettings())
    assert found.tolist() == np.where(ids == 8, -1, ids).tolist()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_dozen_discs_round_which_the_robot_drives_slowly_are_found_again(seed: int) -> None:
    """Steps of 0.1 m: fifty frames show too few discs to recognise a place by."""
    fast = circuit(2.5, 4.0)
    steps = np.repeat(0.5 * between(fast[:-1], fast[1:]), 2, axis=0)
    path, covariance = chain_steps(steps), OdometryNoise().covariance(steps)
    recording = drive(path, scattered(seed, 12, 0.8, 4.0), NO_LINES, seed, covariance)
    score = score_association(associate_run(recording).circle_labels, ids_of(recording))
    assert score.pair_precision == 1.0
    assert score.splits == 0
    assert score.found_landmarks == score.true_landmarks


def slow_circuit(laps: float) -> FloatArray:
    """Round a small square, in steps of 0.05 m."""
    fast = circuit(laps, 3.0)
    return chain_steps(np.repeat(0.25 * between(fast[:-1], fast[1:]), 4, axis=0))


def slow_drive(path: FloatArray, discs: FloatArray) -> Recording:
    return drive(path, discs, NO_LINES, 1, OdometryNoise().covariance(between(path[:-1], path[1:])))


def test_loops_are_closed_where_most_labels_are_clutter() -> None:
    """A slow robot sees a disc dozens of times: a tenth of clutter gives more labels than discs."""
    recording = slow_drive(slow_circuit(1.6), scattered(1, 40, 0.4, 3.0))
    cluttered = with_clutter(recording, len(recording.circles) // 8, 2)
    found = associate_run(cluttered)
    local = np.unique(found.local_circle_labels[cluttered.circles.ids < 0])
    assert len(local) > 3 * 40
    assert len(found.matches) > 20
    score = score_association(found.circle_labels, ids_of(cluttered))
    assert score.pair_precision == 1.0
    assert score.pair_recall > 0.93


@pytest.mark.parametrize("recognised", [False, True])
def test_a_return_without_a_closed_loop_is_said(
    recognised: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each lap has discs of its own, or the same ones."""
    path = slow_circuit(2.0)
    middle = len(path) // 2
    laps = [
        slow_drive(part, scattered(1 if recognised else seed, 30, 0.4, 3.0))
        for seed, part in ((1, path[: middle + 1]), (2, path[middle:]))
    ]
    first, second = (lap.circles for lap in laps)
    second = replace(second, frame=second.frame + middle)
    rows = CircleRows(*map(np.concatenate, zip(vars(first).values(), vars(second).values())))
    run = replace(slow_drive(path, np.zeros((0, 2))), circles=rows)
    for name, part in (("once", run.part(0, middle - 20)), ("twice", run)):
        write_frames(tmp_path / f"{name}.circles", frames_of_discs(part))
        file = str(tmp_path / f"{name}.circles")
        assert main(["associate", file, "-o", str(tmp_path / f"found_{name}.circles")]) == 0
        said = capsys.readouterr().err
        assert ("no loop is closed" in said) == (name == "twice" and not recognised)
    if not recognised:
        later, earlier = re.findall(r"s\.(\d+)", said)
        assert int(later) - int(earlier) == pytest.approx(middle, abs=20)
