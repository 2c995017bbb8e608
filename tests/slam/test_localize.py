"""Localisation in a known map against plain dense filters, and what is left out or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.map_file import LandmarkMap, MapLandmarks, no_landmarks
from redetect.slam.errors import SlamError
from redetect.slam.filters.localizer import Localizer
from redetect.slam.filters.run import Associator, frames_of, run_filter
from redetect.slam.models import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_robot,
    disc_jacobians,
    move,
    move_jacobians,
)
from redetect.slam.recording import LineRows, Recording, read_recording
from tests.slam.ekf_rows import CAMERA_XY, circle_rows, spd


def landmarks(rng: np.random.Generator, count: int, scale: float) -> MapLandmarks:
    return MapLandmarks(
        ids=np.arange(count) + 10,
        xy=rng.uniform(-4, 4, (count, 2)),
        covariance=np.array([spd(rng, 2, scale) for _ in range(count)]),
        rows=np.ones(count, dtype=np.int64),
    )


def drive(seed: int, *, noise: float = 1.0) -> tuple[Recording, LandmarkMap, FloatArray]:
    """A run among discs and lines; some rows show one disc twice, or two lines at once."""
    rng = np.random.default_rng(seed)
    some = LandmarkMap(discs=landmarks(rng, 12, 0.05), lines=landmarks(rng, 8, 0.05))
    pose, poses, steps = np.zeros(3), [np.zeros(3)], []
    covariances = np.array([spd(rng, 3, 0.02) for _ in range(60)])
    circles, lines = [], []
    for k in range(60):
        step = np.array([0.05, -0.3, 0.1])
        pose = move(pose, step)
        poses.append(pose)
        steps.append(step + noise * rng.multivariate_normal(np.zeros(3), covariances[k]))
        for i in rng.choice(12, 3):
            spread = spd(rng, 2, 0.05)
            error = noise * rng.multivariate_normal(np.zeros(2), spread)
            circles.append((k, disc_in_robot(pose, some.discs.xy[i]) + error, spread, i + 10))
        for _ in range(2):
            seen = rng.choice(8, rng.integers(1, 3), replace=False)
            bearings = bearing_of_vertical(pose, some.lines.xy[seen], CAMERA_XY)
            if np.ptp(bearings) < 1.0:
                bearing = bearings.mean() + noise * rng.normal(0, 0.02)
                lines.append((k, bearing, 0.02, tuple(int(i) + 10 for i in seen)))
    return (
        Recording(
            prefixes=tuple(f"b.{k}" for k in range(60)),
            steps=np.array(steps),
            step_covariance=covariances,
            circles=circle_rows(circles),
            lines=LineRows.of(lines),
        ),
        some,
        np.array(poses),
    )


def dense(
    recording: Recording,
    some: LandmarkMap,
    joint: FloatArray | None = None,
    *,
    exact: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Poses and covariances by full matrices of pose and map, the map's gain set to zero.

    With the gains of an exact map, the covariances are still those of a map with errors.
    """
    places = np.concatenate([some.discs.xy, some.lines.xy])
    size = 3 + 2 * len(places)
    pose, P = np.zeros(3), np.zeros((size, size))
    blocks = np.zeros((size, size))
    for i, block in enumerate(np.concatenate([some.discs.covariance, some.lines.covariance])):
        blocks[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = block
    P += blocks
    if joint is not None:
        P[3:, 3:] = joint
    # The covariance from which the gain is calculated.
    Q = np.zeros((size, size)) if exact else P
    predicted = pose
    poses, covariances = [pose], [P[:3, :3]]
    for k, rows in enumerate(frames_of(recording)):
        by_pose, by_step = move_jacobians(pose, recording.steps[k])
        pose = move(pose, recording.steps[k])
        F = np.eye(size)
        F[:3, :3] = by_pose
        if np.any(Q[3:, 3:]):
            F[0, 2], F[1, 2] = predicted[1] - pose[1], pose[0] - predicted[0]
            predicted = pose
        added = np.zeros((size, size))
        added[:3, :3] = by_step @ recording.step_covariance[k] @ by_step.T
        P, Q = (F @ C @ F.T + added for C in (P, Q))
        H, v, R = [], [], []
        for j, number in enumerate(rows.circles.ids.tolist()):
            i = number - 10
            own = np.zeros((2, size))
            own[:, :3], own[:, 3 + 2 * i : 5 + 2 * i] = disc_jacobians(pose, places[i])
            H.append(own)
            v.append(rows.circles.xy[j] - disc_in_robot(pose, places[i]))
            R.append(rows.circles.covariance[j])
        for j, numbers in enumerate(rows.lines.ids):
            own, innovation = np.zeros((1, size)), np.zeros(1)
            for number in numbers:
                i = len(some.discs) + number - 10
                first, second = bearing_jacobians(pose, places[i], CAMERA_XY)
                own[0, :3] += first / len(numbers)
                own[0, 3 + 2 * i : 5 + 2 * i] += second / len(numbers)
                bearing = bearing_of_vertical(pose, places[i], CAMERA_XY)
                innovation += wrap_angle(rows.lines.bearing_rad[j] - bearing) / len(numbers)
            H.append(own)
            v.append(innovation)
            R.append(np.array([[rows.lines.sigma_rad[j] ** 2]]))
        stacked = np.concatenate(H)
        noise = np.zeros((len(stacked), len(stacked)))
        at = 0
        for block in R:
            noise[at : at + len(block), at : at + len(block)] = block
            at += len(block)
        gain = Q @ stacked.T @ np.linalg.inv(stacked @ Q @ stacked.T + noise)
        gain[3:] = 0.0
        pose = pose + gain[:3] @ np.concatenate(v)
        keep = np.eye(size) - gain @ stacked
        P, Q = (keep @ C @ keep.T + gain @ noise @ gain.T for C in (P, Q))
        poses.append(pose)
        covariances.append(P[:3, :3])
    return np.array(poses), np.array(covariances)


@pytest.mark.parametrize("exact", [False, True])
def test_the_localizer_is_the_plain_dense_filter(exact: bool) -> None:
    recording, some, _ = drive(1)
    run = run_filter(recording, Localizer(some, camera_xy=CAMERA_XY, exact=exact))
    poses, covariances = dense(recording, some, exact=exact)
    np.testing.assert_allclose(run.path.poses, poses, rtol=0, atol=1e-10)
    assert run.path.covariance is not None
    np.testing.assert_allclose(run.path.covariance, covariances, rtol=0, atol=1e-12)
    assert (run.count.discs, run.count.lines) == (len(recording.circles), len(recording.lines))
    assert not run.count.left_out


def test_errors_that_landmarks_have_in_common_are_considered() -> None:
    recording, some, _ = drive(8)
    joint = spd(np.random.default_rng(8), 40, 0.1)
    localizer = Localizer(replace(some, joint_covariance=joint), camera_xy=CAMERA_XY)
    run = run_filter(recording, localizer)
    poses, covariances = dense(recording, some, joint)
    np.testing.assert_allclose(run.path.poses, poses, rtol=0, atol=1e-10)
    assert run.path.covariance is not None
    np.testing.assert_allclose(run.path.covariance, covariances, rtol=0, atol=1e-12)


def test_a_map_moved_as_a_whole_moves_the_path() -> None:
    """The pose is as uncertain as the map's place, but its landmarks are trusted to each other."""
    recording, some, truth = drive(9, noise=0.0)
    places = np.concatenate([some.discs.xy, some.lines.xy])
    # How landmarks and poses move when the map is shifted and turned about the origin.
    by_frame = np.zeros((len(places), 2, 3))
    by_frame[:, :, :2] = np.eye(2)
    by_frame[:, 0, 2], by_frame[:, 1, 2] = -places[:, 1], places[:, 0]
    flat = by_frame.reshape(-1, 3)
    frame = np.diag([0.3**2, 0.2**2, 0.1**2])
    joint = flat @ frame @ flat.T + 1e-8 * np.eye(len(flat))
    # Next to nothing is known of the start, so that all there is to know comes from the map.
    start = 1e4 * np.eye(3)
    jointly = replace(some, joint_covariance=joint)
    localizer = Localizer(jointly, start_covariance=start, camera_xy=CAMERA_XY)
    run = run_filter(recording, localizer)
    np.testing.assert_allclose(run.path.poses, truth, atol=1e-6)
    assert run.path.covariance is not None
    for pose, found in zip(truth[20:], run.path.covariance[20:]):
        by = np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])
        least = by @ frame @ by.T
        # Never surer than the map is of its own place, and hardly less sure.
        assert np.min(np.linalg.eigvalsh(found - 0.999 * least)) > -1e-9
        assert found[2, 2] < 1.2 * least[2, 2]
    assert localizer.pose_covariance[2, 2] == pytest.approx(0.1**2, rel=0.2)


def test_without_noise_the_path_is_the_true_one() -> None:
    recording, some, truth = drive(2, noise=0.0)
    run = run_filter(recording, Localizer(some, camera_xy=CAMERA_XY))
    np.testing.assert_allclose(run.path.poses, truth, atol=1e-9)
    assert run.path.prefixes[:2] == ("start", "b.0")
    assert run.count.innovation_squared == pytest.approx(0.0, abs=1e-12)
    assert run.count.degrees_of_freedom == 2 * len(recording.circles) + len(recording.lines)


def test_a_wrong_start_is_forgotten_when_it_is_said_to_be_uncertain() -> None:
    recording, some, truth = drive(3, noise=0.0)
    localizer = Localizer(
        some,
        np.array([0.3, -0.2, 0.1]),
        np.diag([0.25, 0.25, 0.04]),
        CAMERA_XY,
        exact=True,
    )
    run = run_filter(recording, localizer)
    assert np.hypot(*(run.path.poses[-1] - truth[-1])[:2]) < 0.01


def test_rows_that_show_nothing_in_the_map_are_left_out_and_counted() -> None:
    recording, some, _ = drive(4)
    recording.circles.ids[:2] = -1
    recording.circles.ids[2] = 999
    lines = recording.lines
    ids = ((), (10, 777), *lines.ids[2:])
    changed = replace(recording, lines=replace(lines, ids=ids))
    run = run_filter(changed, Localizer(some, camera_xy=CAMERA_XY))
    assert run.count.left_out == {
        "disc without ID": 2,
        "disc not in the map": 1,
        "line without ID": 1,
        "line not in the map": 1,
    }
    assert run.count.discs == len(recording.circles) - 3


@pytest.mark.parametrize("method", ["nearest", "joint"])
def test_identities_are_found_in_the_map(method: str) -> None:
    recording, some, _ = drive(5, noise=0.2)
    # One row of a line each, and no disc twice in a frame: else a row has no one right answer.
    single = np.array([len(numbers) == 1 for numbers in recording.lines.ids])
    pairs = np.stack([recording.circles.frame, recording.circles.ids], axis=1)
    first = np.sort(np.unique(pairs, axis=0, return_index=True)[1])
    circles = recording.circles.only(np.isin(np.arange(len(pairs)), first))
    one = replace(recording, circles=circles, lines=recording.lines.only(single))
    certain = MapLandmarks(
        some.discs.ids, some.discs.xy, some.discs.covariance * 1e-3, some.discs.rows
    )
    exact = MapLandmarks(
        some.lines.ids, some.lines.xy, some.lines.covariance * 1e-3, some.lines.rows
    )
    run = run_filter(
        one,
        Localizer(LandmarkMap(certain, exact), camera_xy=CAMERA_XY),
        Associator("joint" if method == "joint" else "nearest"),
    )
    right = run.disc_ids == circles.ids
    assert np.mean(right | (run.disc_ids < 0)) > 0.99
    assert np.mean(right) > 0.97
    assert np.mean([found == ids for found, ids in zip(run.line_ids, one.lines.ids)]) > 0.9


def test_covariances_that_contradict_each_other_are_refused() -> None:
    recording, some, _ = drive(6)
    recording.circles.covariance[recording.circles.frame == 1] = -1e3 * np.eye(2)
    with pytest.raises(SlamError, match=r"step 2 \(b\.1\): the covariance of the innovation"):
        run_filter(recording, Localizer(some, camera_xy=CAMERA_XY))


@pytest.mark.parametrize("probability", [0.0, 1.0, -1.0, float("nan")])
def test_a_gate_that_is_no_probability_is_refused(probability: float) -> None:
    with pytest.raises(SlamError, match="gate_probability"):
        Associator("nearest", probability)


def test_a_run_without_rows_is_odometry() -> None:
    recording, _, _ = drive(7)
    empty = LandmarkMap(no_landmarks(), no_landmarks())
    run = run_filter(recording, Localizer(empty))
    pose = np.zeros(3)
    for k, step in enumerate(recording.steps):
        pose = move(pose, step)
        np.testing.assert_allclose(run.path.poses[k + 1], pose, atol=1e-12)


def test_the_demo_run_is_near_its_truth(project_root: Path) -> None:
    """The filters on the demo run: its rows are exact, so that only odometry is wrong."""
    import json

    from redetect.plane import between
    from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
    from redetect.slam.recording import camera_xy_of

    run_folder = project_root / "images" / "e"
    recording = read_recording(run_folder, circles=True, lines=True)
    camera_xy = camera_xy_of(recording, run_folder)
    truth = json.loads((run_folder / "truth.json").read_text())
    start = np.array(truth["start"])
    poses = np.array([start] + [frame["pose"] for frame in truth["frames"]])
    true_poses = between(start, poses)
    ekf = EkfSlam(camera_xy=camera_xy)
    mapped = run_ekf(recording, ekf)
    located = run_filter(recording, Localizer(ekf.landmark_map(), camera_xy=camera_xy))
    for run in (mapped, located):
        error = run.path.poses - true_poses
        assert np.max(np.hypot(error[:, 0], error[:, 1])) < 0.25
        assert np.max(np.abs((error[:, 2] + np.pi) % (2 * np.pi) - np.pi)) < np.radians(3)
