"""EKF-SLAM against a plain dense filter, batch least squares, and Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from landmarks import wrap_angle
from slam.ekf import EkfSlam, JacobiansAt, run_ekf
from slam.ekf_covariance import JointCovariance
from slam.ekf_lines import start_line, triangulate
from slam.ekf_views import MOST_KEPT_POSES
from slam.errors import SlamError
from slam.filter_association import Associator
from slam.filter_frames import FrameRows
from slam.filter_kernels import frame_innovation
from slam.measurement import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_map,
    disc_in_map_jacobians,
    disc_in_robot,
    disc_jacobians,
)
from slam.motion import move, move_jacobians
from slam.recording import CircleRows, LineRows, Recording

FloatArray = NDArray[np.float64]
CAMERA_XY = np.array([0.0179777, -0.0808609])
NOTHING = LineRows(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), ())
NO_DISCS = CircleRows(
    np.zeros(0, dtype=np.int64),
    np.zeros((0, 2)),
    np.zeros((0, 2, 2)),
    np.zeros(0, dtype=np.int64),
)


def spd(rng: np.random.Generator, size: int, scale: float) -> FloatArray:
    """A random covariance whose numbers are correlated."""
    root = rng.normal(0, 1, (size, size))
    return np.asarray(scale**2 * (root @ root.T / size + 0.3 * np.eye(size)))


def drive(
    rng: np.random.Generator, *, steps: int, discs: int, noise: float = 1.0, sees: int = 5
) -> tuple[Recording, FloatArray, FloatArray]:
    """A run on a circle among discs, the true poses and the discs' true places."""
    places = rng.uniform(-4, 4, (discs, 2))
    pose, poses = np.zeros(3), [np.zeros(3)]
    measured, covariances, rows = [], [], []
    for k in range(steps):
        step = np.array([0.0, -0.3, 2 * np.pi / 60])
        covariance = spd(rng, 3, 0.01)
        pose = move(pose, step)
        measured.append(rng.multivariate_normal(step, noise**2 * covariance))
        covariances.append(covariance)
        poses.append(pose)
        for i in rng.choice(discs, sees, replace=False):
            spread = spd(rng, 2, 0.03)
            seen = rng.multivariate_normal(disc_in_robot(pose, places[i]), noise**2 * spread)
            rows.append((k, seen, spread, i + 1))
    recording = Recording(
        prefixes=tuple(f"a.{k:04d}" for k in range(steps)),
        steps=np.array(measured),
        step_covariance=np.array(covariances),
        circles=CircleRows(
            frame=np.array([r[0] for r in rows]),
            xy=np.array([r[1] for r in rows]),
            covariance=np.array([r[2] for r in rows]),
            ids=np.array([r[3] for r in rows]),
        ),
        lines=NOTHING,
    )
    return recording, np.array(poses), places


def dense_filter(recording: Recording) -> tuple[FloatArray, FloatArray, list[int]]:
    """EKF-SLAM written down plainly: full matrices, Joseph's form, the models of the report."""
    state, covariance, known = np.zeros(3), np.zeros((3, 3)), list[int]()
    circles = recording.circles
    for k in range(len(recording)):
        by_pose, by_step = move_jacobians(state[:3], recording.steps[k])
        state[:3] = move(state[:3], recording.steps[k])
        F = np.eye(len(state))
        F[:3, :3] = by_pose
        covariance = F @ covariance @ F.T
        covariance[:3, :3] += by_step @ recording.step_covariance[k] @ by_step.T
        here = np.flatnonzero(circles.frame == k)
        old = [i for i in here if int(circles.ids[i]) in known]
        if old:
            H = np.zeros((2 * len(old), len(state)))
            R = np.zeros((2 * len(old), 2 * len(old)))
            v = np.zeros(2 * len(old))
            for j, i in enumerate(old):
                at = 3 + 2 * known.index(int(circles.ids[i]))
                rows = slice(2 * j, 2 * j + 2)
                disc = state[at : at + 2]
                H[rows, :3], H[rows, at : at + 2] = disc_jacobians(state[:3], disc)
                v[rows] = circles.xy[i] - disc_in_robot(state[:3], disc)
                R[rows, rows] = circles.covariance[i]
            K = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + R)
            state = state + K @ v
            keep = np.eye(len(state)) - K @ H
            covariance = keep @ covariance @ keep.T + K @ R @ K.T
        for i in here:
            if i in old:
                continue
            by_pose, by_seen = disc_in_map_jacobians(state[:3], circles.xy[i])
            G = np.zeros((2, len(state)))
            G[:, :3] = by_pose
            own = G @ covariance @ G.T + by_seen @ circles.covariance[i] @ by_seen.T
            covariance = np.block([[covariance, covariance @ G.T], [G @ covariance, own]])
            state = np.concatenate([state, disc_in_map(state[:3], circles.xy[i])])
            known.append(int(circles.ids[i]))
    return state, covariance, known


@pytest.mark.parametrize("seed", [1, 2])
def test_the_filter_is_the_plain_dense_one(seed: int) -> None:
    # So long that its covariance is written anew several times, and so large that it grows.
    recording, _, _ = drive(np.random.default_rng(seed), steps=150, discs=60)
    ekf = EkfSlam(jacobians="latest")
    run_ekf(recording, ekf)
    state, covariance, known = dense_filter(recording)
    assert list(ekf.disc_slots) == known
    np.testing.assert_allclose(ekf.state, state, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ekf.covariance.dense(), covariance, rtol=0, atol=1e-12)
    landmarks = ekf.landmark_map().discs
    np.testing.assert_array_equal(landmarks.ids, known)
    np.testing.assert_allclose(landmarks.covariance[7], covariance[17:19, 17:19], atol=1e-12)
    assert landmarks.rows.sum() == len(recording.circles)


def batch_solution(recording: Recording, size: int) -> tuple[FloatArray, FloatArray]:
    """Last pose and discs by Gauss-Newton on all poses and discs, and their covariance."""
    steps, circles = len(recording), recording.circles
    from slam.motion import chain_steps, relative_pose, relative_pose_jacobians

    poses = chain_steps(recording.steps)
    discs = np.zeros((size, 2))
    for i in reversed(range(len(circles))):
        discs[circles.ids[i] - 1] = disc_in_map(poses[circles.frame[i] + 1], circles.xy[i])
    unknowns = 3 * steps + 2 * size
    for _ in range(20):
        normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        for k in range(steps):
            error = recording.steps[k] - relative_pose(poses[k], poses[k + 1])
            error[2] = wrap_angle(error[2])
            J = np.zeros((3, unknowns))
            first, second = relative_pose_jacobians(poses[k], poses[k + 1])
            if k:
                J[:, 3 * k - 3 : 3 * k] = first
            J[:, 3 * k : 3 * k + 3] = second
            weight = np.linalg.inv(recording.step_covariance[k])
            normal += J.T @ weight @ J
            right += J.T @ weight @ error
        for i in range(len(circles)):
            k, d = circles.frame[i], circles.ids[i] - 1
            J = np.zeros((2, unknowns))
            at = 3 * steps + 2 * d
            J[:, 3 * k : 3 * k + 3], J[:, at : at + 2] = disc_jacobians(poses[k + 1], discs[d])
            weight = np.linalg.inv(circles.covariance[i])
            normal += J.T @ weight @ J
            right += J.T @ weight @ (circles.xy[i] - disc_in_robot(poses[k + 1], discs[d]))
        change = np.linalg.solve(normal, right)
        poses[1:] += change[: 3 * steps].reshape(-1, 3)
        discs += change[3 * steps :].reshape(-1, 2)
    wanted = np.arange(3 * steps - 3, unknowns)
    covariance = np.linalg.inv(normal)[np.ix_(wanted, wanted)]
    return np.concatenate([poses[-1], discs.ravel()]), np.asarray(covariance)


def test_the_filter_is_batch_least_squares_where_all_is_nearly_linear() -> None:
    rng = np.random.default_rng(3)
    # Errors of a hundredth of what the covariances say: linearised at the truth, nearly.
    recording, _, _ = drive(rng, steps=25, discs=8, noise=0.01)
    ekf = EkfSlam()
    run_ekf(recording, ekf)
    assert set(ekf.disc_slots) == set(range(1, 9))
    order = np.concatenate(
        [[0, 1, 2], *(np.array([0, 1]) + ekf.disc_slots[i] for i in range(1, 9))]
    ).astype(np.int64)
    state, covariance = batch_solution(recording, 8)
    sigma = np.sqrt(np.diag(covariance))
    # Both agree far better than they are apart from the odometry they started from.
    np.testing.assert_allclose((ekf.state[order] - state) / sigma, 0.0, atol=2e-3)
    ratio = ekf.covariance.dense()[np.ix_(order, order)] / np.outer(sigma, sigma)
    np.testing.assert_allclose(ratio, covariance / np.outer(sigma, sigma), atol=5e-3)


def test_covariance_of_a_new_disc_by_monte_carlo() -> None:
    rng = np.random.default_rng(4)
    pose, spread = np.array([1.0, -2.0, 0.7]), spd(rng, 3, 0.01)
    seen, noise = np.array([0.4, -1.8]), spd(rng, 2, 0.02)
    ekf = EkfSlam(pose, spread)
    ekf.measure(rows_of([(5, seen, noise)]))
    poses = rng.multivariate_normal(pose, spread, 200_000)
    sampled = disc_in_map(poses, rng.multivariate_normal(seen, noise, len(poses)))
    joint = np.cov(np.column_stack([poses, sampled]).T)
    found = ekf.covariance.dense()
    sigma = np.sqrt(np.diag(found))
    np.testing.assert_allclose(
        joint / np.outer(sigma, sigma), found / np.outer(sigma, sigma), atol=0.01
    )


def test_covariance_of_a_new_line_by_monte_carlo() -> None:
    rng = np.random.default_rng(6)
    line, step = np.array([1.5, -3.0]), np.array([-0.6, -0.8, 0.2])
    spread, moved = spd(rng, 3, 1e-3), spd(rng, 3, 1e-3)
    first, second = np.zeros(3), move(np.zeros(3), step)
    ekf = EkfSlam(first, spread, CAMERA_XY)
    sigma = 2e-3
    for pose in (first, second):
        if pose is second:
            ekf.predict(step, moved)
        ekf.measure(bearings_of([((7,), float(bearing_of_vertical(pose, line, CAMERA_XY)), sigma)]))
    slot = ekf.line_slots[7]
    np.testing.assert_allclose(ekf.state[slot : slot + 2], line, atol=1e-12)
    count = 200_000
    before = rng.multivariate_normal(first, spread, count)
    poses = move(before, rng.multivariate_normal(step, moved, count))
    normals, origins = [], []
    for pose, samples in ((first, before), (second, poses)):
        angle = bearing_of_vertical(pose, line, CAMERA_XY) + rng.normal(0, sigma, count)
        # The ray looks along (sin, -cos) of its bearing, turned by the heading.
        angle += samples[:, 2]
        normals.append(np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        origins.append(disc_in_map(samples, CAMERA_XY))
    rays = np.stack(normals, axis=1)
    places = np.linalg.solve(rays, np.sum(rays * np.stack(origins, axis=1), -1)[..., None])[..., 0]
    joint = np.cov(np.column_stack([poses, places]).T)
    index = np.array([0, 1, 2, slot, slot + 1])
    found = ekf.covariance.block(index)
    scale = np.outer(np.sqrt(np.diag(found)), np.sqrt(np.diag(found)))
    np.testing.assert_allclose(joint / scale, found / scale, atol=0.01)


def rows_of(discs: list[tuple[int, FloatArray, FloatArray]]) -> FrameRows:
    return FrameRows(
        disc_ids=tuple(number for number, _, _ in discs),
        disc_xy=np.array([xy for _, xy, _ in discs]),
        disc_covariance=np.array([c for _, _, c in discs]),
        line_ids=(),
        bearing_rad=np.zeros(0),
        sigma_rad=np.zeros(0),
    )


def bearings_of(lines: list[tuple[tuple[int, ...], float, float]]) -> FrameRows:
    return FrameRows(
        disc_ids=(),
        disc_xy=np.zeros((0, 2)),
        disc_covariance=np.zeros((0, 2, 2)),
        line_ids=tuple(numbers for numbers, _, _ in lines),
        bearing_rad=np.array([bearing for _, bearing, _ in lines]),
        sigma_rad=np.array([sigma for _, _, sigma in lines]),
    )


def test_a_line_is_not_placed_without_parallax() -> None:
    ekf = EkfSlam(camera_xy=CAMERA_XY)
    line = np.array([0.2, -9.0])
    for _ in range(100):
        ekf.predict(np.array([0.0, -0.01, 0.0]), 1e-8 * np.eye(3))
        bearing = float(bearing_of_vertical(ekf.state[:3], line, CAMERA_XY))
        ekf.measure(bearings_of([((3,), bearing, 2e-3)]))
    assert not ekf.line_slots
    assert ekf.count.lines == 0
    # However long it takes, only so many poses are kept.
    assert len(ekf.state) <= 3 + 3 * (MOST_KEPT_POSES + 1)
    # Until it is passed; then what was kept is used, and every row has been counted.
    for _ in range(20):
        ekf.predict(np.array([0.0, -0.3, 0.0]), 1e-8 * np.eye(3))
        bearing = float(bearing_of_vertical(ekf.state[:3], line, CAMERA_XY))
        ekf.measure(bearings_of([((3,), bearing, 2e-3)]))
    slot = ekf.line_slots[3]
    np.testing.assert_allclose(ekf.state[slot : slot + 2], line, atol=1e-9)
    assert ekf.count.lines > 20
    assert ekf.count.lines + ekf.count.left_out.total() == 120


def test_lines_that_are_lost_from_sight_are_given_up() -> None:
    ekf = EkfSlam(camera_xy=CAMERA_XY)
    nothing = bearings_of([])
    ekf.predict(np.zeros(3), 1e-8 * np.eye(3))
    ekf.measure(bearings_of([((3,), 0.1, 2e-3)]))
    for _ in range(60):
        ekf.predict(np.zeros(3), 1e-8 * np.eye(3))
        ekf.measure(nothing)
    assert ekf.count.left_out == {"line without parallax": 1}
    ekf.measure(bearings_of([((3,), 0.1, 2e-3)]))
    # The pose kept now takes the place of the one that was given up.
    assert len(ekf.state) == 6
    ekf.finish()
    assert ekf.count.left_out == {"line without parallax": 2}


def test_a_copy_of_the_pose_is_used_again_when_its_lines_are_placed() -> None:
    ekf = EkfSlam(camera_xy=CAMERA_XY)
    lines = np.array([[1.0, -2.0], [-1.5, -2.5], [2.0, -1.0]])
    for k in range(3):
        ekf.predict(np.array([0.0, -0.5, 0.1]), 1e-8 * np.eye(3))
        seen = [0, 1] if k < 2 else [2]
        bearings = bearing_of_vertical(ekf.state[:3], lines[seen], CAMERA_XY)
        ekf.measure(bearings_of([((i,), float(b), 1e-3) for i, b in zip(seen, bearings)]))
    assert set(ekf.line_slots) == {0, 1}
    # Pose, one copy of it (first of frame 0, then of frame 2), two lines.
    assert len(ekf.state) == 3 + 3 + 4
    np.testing.assert_allclose(ekf.state[3:6], ekf.state[:3])
    np.testing.assert_allclose(
        ekf.covariance.block(np.arange(3, 6)), ekf.covariance.pose(), atol=1e-15
    )


@pytest.mark.parametrize("jacobians", ["first", "latest"])
def test_lines_by_all_their_bearings_are_batch_least_squares(jacobians: JacobiansAt) -> None:
    """Each bearing counts once: those that waited, and those after the line was placed."""
    rng = np.random.default_rng(21)
    lines = np.array([[1.5, -3.0], [-1.0, -3.5], [1.2, -4.5]])
    share, steps, sigma = 0.01, 12, 4e-3
    covariance = spd(rng, 3, 0.004)
    pose, measured, rows = np.zeros(3), [], []
    for k in range(steps):
        step = np.array([-0.05, -0.25, 0.03])
        pose = move(pose, step)
        measured.append(step + share * rng.multivariate_normal(np.zeros(3), covariance))
        bearings = bearing_of_vertical(pose, lines, CAMERA_XY) + share * sigma * rng.normal(size=3)
        rows += [(k, float(b), (i,)) for i, b in enumerate(bearings)]
    recording = Recording(
        prefixes=tuple(f"c.{k}" for k in range(steps)),
        steps=np.array(measured),
        step_covariance=np.tile(covariance, (steps, 1, 1)),
        circles=NO_DISCS,
        lines=LineRows(
            np.array([r[0] for r in rows]),
            np.array([r[1] for r in rows]),
            np.full(len(rows), sigma),
            tuple(r[2] for r in rows),
        ),
    )
    ekf = EkfSlam(camera_xy=CAMERA_XY, jacobians=jacobians)
    run = run_ekf(recording, ekf)
    assert run.count.lines == len(rows)
    # Pose and two lines come before the last, and several kept poses.
    assert max(ekf.line_slots.values()) >= 3 + 4 + 9
    from slam.motion import chain_steps, relative_pose, relative_pose_jacobians

    poses, places = chain_steps(recording.steps), lines.copy()
    unknowns = 3 * steps + 6
    for _ in range(20):
        normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        weight = np.linalg.inv(covariance)
        for k in range(steps):
            J = np.zeros((3, unknowns))
            first, second = relative_pose_jacobians(poses[k], poses[k + 1])
            if k:
                J[:, 3 * k - 3 : 3 * k] = first
            J[:, 3 * k : 3 * k + 3] = second
            normal += J.T @ weight @ J
            right += J.T @ weight @ (recording.steps[k] - relative_pose(poses[k], poses[k + 1]))
        for k, bearing, (i,) in rows:
            row = np.zeros(unknowns)
            at = 3 * steps + 2 * i
            row[3 * k : 3 * k + 3], row[at : at + 2] = bearing_jacobians(
                poses[k + 1], places[i], CAMERA_XY
            )
            error = bearing - bearing_of_vertical(poses[k + 1], places[i], CAMERA_XY)
            normal += np.outer(row, row) / sigma**2
            right += row * error / sigma**2
        change = np.linalg.solve(normal, right)
        poses[1:] += change[: 3 * steps].reshape(-1, 3)
        places += change[3 * steps :].reshape(-1, 2)
    wanted = np.arange(3 * steps - 3, unknowns)
    expected = np.linalg.inv(normal)[np.ix_(wanted, wanted)]
    order = np.concatenate(
        [[0, 1, 2], *(np.array([0, 1]) + ekf.line_slots[i] for i in range(3))]
    ).astype(np.int64)
    scale = np.sqrt(np.diag(expected))
    state = np.concatenate([poses[-1], places.ravel()])
    np.testing.assert_allclose((ekf.state[order] - state) / scale, 0.0, atol=2e-3)
    found = ekf.covariance.block(order) / np.outer(scale, scale)
    np.testing.assert_allclose(found, expected / np.outer(scale, scale), atol=5e-3)


def test_a_row_of_several_lines_measures_the_mean_of_their_bearings() -> None:
    rng = np.random.default_rng(8)
    state = np.concatenate([[0.3, -0.2, 0.4], [1.0, -3.0], [0.8, -3.2], [-1.0, -2.0]])
    innovation, jacobian, noise, index = frame_innovation(
        state,
        state,
        np.array([7]),
        rng.normal(0, 1, (1, 2)),
        spd(rng, 2, 0.1)[None],
        np.array([3, 5]),
        np.array([0, 2]),
        np.array([0.5]),
        np.array([0.01]),
        CAMERA_XY,
    )
    places = state[3:7].reshape(2, 2)
    bearings = bearing_of_vertical(state[:3], places, CAMERA_XY)
    by_pose, by_line = bearing_jacobians(state[:3], places, CAMERA_XY)
    assert innovation[2] == pytest.approx(0.5 - bearings.mean(), abs=1e-12)
    np.testing.assert_allclose(jacobian[2, :3], by_pose.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(jacobian[2, 3:], [0, 0, *(by_line.ravel() / 2)], atol=1e-12)
    np.testing.assert_array_equal(index, [0, 1, 2, 7, 8, 3, 4, 5, 6])
    assert noise[2, 2] == pytest.approx(1e-4)
    by_pose, by_disc = disc_jacobians(state[:3], state[7:])
    np.testing.assert_allclose(jacobian[:2, :3], by_pose, atol=1e-12)
    np.testing.assert_allclose(jacobian[:2, 3:5], by_disc, atol=1e-12)


def test_bearings_behind_do_not_jump() -> None:
    state = np.array([0.0, 0.0, 0.0, 0.01, 5.0])
    innovation = frame_innovation(
        state,
        state,
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.array([3]),
        np.array([0, 1]),
        np.array([-np.pi + 0.001]),
        np.array([0.01]),
        np.zeros(2),
    )[0]
    assert innovation[0] == pytest.approx(0.003, abs=1e-5)


def test_jacobians_of_two_rays() -> None:
    poses = np.array([[0.1, 0.3, 0.2], [-0.5, -0.9, 0.5]])
    line = np.array([0.7, -3.0])
    bearings = bearing_of_vertical(poses, line, CAMERA_XY)
    sigma = np.array([0.01, 0.02])
    start = start_line(poses, poses, bearings, sigma, CAMERA_XY, 1e-6 * np.eye(6))
    assert start is not None

    def meet(numbers: FloatArray) -> FloatArray:
        met = triangulate(numbers[:6].reshape(2, 3), numbers[6:], sigma, CAMERA_XY)
        assert met is not None
        return met

    at = np.concatenate([poses.ravel(), bearings])
    numeric = np.stack([(meet(at + e) - meet(at - e)) / 2e-4 for e in 1e-4 * np.eye(8)], axis=-1)
    np.testing.assert_allclose(start.by_poses, numeric[:, :6], atol=1e-4)
    noise = numeric[:, 6:] @ np.diag(sigma**2) @ numeric[:, 6:].T
    np.testing.assert_allclose(start.noise, noise, rtol=1e-4)
    np.testing.assert_allclose(start.xy, line, atol=1e-9)
    np.testing.assert_allclose(start.correction, 0.0, atol=1e-9)


@pytest.mark.parametrize("bearings", [(0.0, 0.3), (0.0, 0.0)])
def test_rays_that_do_not_meet_in_front(bearings: tuple[float, float]) -> None:
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert triangulate(poses, np.array(bearings), np.full(2, 0.01), np.zeros(2)) is None
    # Turned to each other they do.
    met = triangulate(poses, np.array([0.3, -0.3]), np.full(2, 0.01), np.zeros(2))
    assert met is not None
    np.testing.assert_allclose(met, [0.5, -0.5 / np.tan(0.3)], atol=1e-9)


def test_two_rows_of_one_new_disc_are_both_used() -> None:
    noise = 4e-4 * np.eye(2)
    ekf = EkfSlam()
    ekf.measure(rows_of([(1, np.array([0.0, -2.0]), noise), (1, np.array([0.02, -2.0]), noise)]))
    np.testing.assert_allclose(ekf.state[3:], [0.01, -2.0], atol=1e-12)
    np.testing.assert_allclose(ekf.covariance.blocks(np.array([3])), [noise / 2], atol=1e-15)
    assert ekf.count.discs == 2


def test_first_estimates_do_not_teach_the_heading() -> None:
    """Turning on the spot and looking at discs of its own tells nothing about the heading at first.

    The covariance of the heading never falls below what it was when the map began, which the
    plain filter violates.
    """

    def smallest(jacobians: JacobiansAt) -> float:
        rng = np.random.default_rng(11)
        ekf = EkfSlam(start_covariance=np.diag([0.1, 0.1, 0.1]), jacobians=jacobians)
        places = rng.uniform(-2, 2, (12, 2))
        found = np.inf
        true = np.zeros(3)
        for k in range(60):
            step = np.array([0.0, -0.2, 0.3])
            true = move(true, step) if k else true
            if k:
                noise = np.diag([4e-4, 4e-4, 4e-3])
                ekf.predict(rng.multivariate_normal(step, noise), noise)
            spread = 2e-2 * np.eye(2)
            seen = rng.multivariate_normal(np.zeros(2), spread, 12) + disc_in_robot(true, places)
            ekf.measure(rows_of([(i, xy, spread) for i, xy in enumerate(seen)]))
            found = min(found, ekf.covariance.pose()[2, 2])
        return found

    assert smallest("first") >= 0.1 - 1e-9
    assert smallest("latest") < 0.09


def test_the_start_may_be_anywhere() -> None:
    recording, _, _ = drive(np.random.default_rng(9), steps=20, discs=10)
    here, there = EkfSlam(), EkfSlam(np.array([3.0, 1.0, 2.0]))
    run_ekf(recording, here)
    run_ekf(recording, there)
    moved = disc_in_map(np.array([3.0, 1.0, 2.0]), here.landmark_map().discs.xy)
    np.testing.assert_allclose(there.landmark_map().discs.xy, moved, atol=1e-9)


def test_covariances_that_contradict_each_other_are_refused() -> None:
    covariance = JointCovariance(np.eye(3))
    with pytest.raises(SlamError, match="innovation is not positive definite"):
        covariance.measure(np.zeros((3, 2)), -np.eye(2), np.zeros(2))


def test_a_step_that_fails_is_named() -> None:
    recording, _, _ = drive(np.random.default_rng(2), steps=5, discs=5)
    recording.circles.covariance[recording.circles.frame == 3] = -1e3 * np.eye(2)
    with pytest.raises(SlamError, match=r"step 4 \(a\.0003\): the covariance of the innovation"):
        run_ekf(recording, EkfSlam())


def test_lines_can_not_be_identified_before_they_are_placed() -> None:
    lines = LineRows(np.array([0]), np.array([0.1]), np.array([0.01]), ((),))
    recording = Recording(("a",), np.zeros((1, 3)), np.eye(3)[None], NO_DISCS, lines)
    with pytest.raises(SlamError, match="expected known association"):
        run_ekf(recording, EkfSlam(), Associator("joint"))


@pytest.mark.parametrize("method", ["nearest", "joint"])
def test_discs_are_found_again_without_identifiers(method: str) -> None:
    recording, _, places = drive(np.random.default_rng(12), steps=150, discs=12, noise=0.5, sees=4)
    near = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(12)
    assert near.min() > 0.1
    ekf = EkfSlam()
    run = run_ekf(recording, ekf, Associator("joint" if method == "joint" else "nearest"))
    # One new identifier for each true one, and nearly all rows under it.
    pairs = np.stack([recording.circles.ids, run.disc_ids], axis=1)[run.disc_ids >= 0]
    kinds, rows = np.unique(pairs, axis=0, return_counts=True)
    assert rows[np.argsort(rows)][-12:].sum() > 0.95 * len(recording.circles)
    assert len(np.unique(kinds[np.argsort(rows)][-12:, 0])) == 12


def check_jacobian(of: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    return np.stack([(of(at + e) - of(at - e)) / 2e-6 for e in 1e-6 * np.eye(len(at))], axis=-1)


def test_frame_jacobian_is_the_derivative_of_the_prediction() -> None:
    rng = np.random.default_rng(13)
    state = np.concatenate([[0.3, -0.2, 0.4], rng.uniform(-3, 3, 6)])
    discs, covariance = rng.normal(0, 1, (2, 2)), np.tile(np.eye(2), (2, 1, 1))

    def innovation(x: FloatArray) -> FloatArray:
        return frame_innovation(
            x,
            x,
            np.array([3, 5]),
            discs,
            covariance,
            np.array([7]),
            np.array([0, 1]),
            np.array([0.2]),
            np.array([0.1]),
            CAMERA_XY,
        )[0]

    jacobian = frame_innovation(
        state,
        state,
        np.array([3, 5]),
        discs,
        covariance,
        np.array([7]),
        np.array([0, 1]),
        np.array([0.2]),
        np.array([0.1]),
        CAMERA_XY,
    )[1]
    np.testing.assert_allclose(jacobian, -check_jacobian(innovation, state), atol=1e-7)
