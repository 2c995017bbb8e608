"""Lines in EKF-SLAM: when they join, by which bearings, and what is waited for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from redetect.array_types import FloatArray
from redetect.plane import apply
from redetect.slam.errors import SlamError
from redetect.slam.filters.delayed_lines import MOST_KEPT_POSES, start_line, triangulate
from redetect.slam.filters.ekf_slam import EkfSlam, JacobiansAt, run_ekf
from redetect.slam.filters.frames import Associator, FrameRows, innovation_of
from redetect.slam.models import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_robot,
    disc_jacobians,
    move,
)
from redetect.slam.recording import CircleRows, LineRows, Recording
from tests.slam.ekf_rows import CAMERA_XY, bearings_of, localizer, rows_of, spd


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
        origins.append(apply(samples, CAMERA_XY))
    rays = np.stack(normals, axis=1)
    places = np.linalg.solve(rays, np.sum(rays * np.stack(origins, axis=1), -1)[..., None])[..., 0]
    joint = np.cov(np.column_stack([poses, places]).T)
    index = np.array([0, 1, 2, slot, slot + 1])
    found = ekf.block(index)
    scale = np.outer(np.sqrt(np.diag(found)), np.sqrt(np.diag(found)))
    np.testing.assert_allclose(joint / scale, found / scale, atol=0.01)


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
    np.testing.assert_allclose(ekf.block(np.arange(3, 6)), ekf.pose_covariance, atol=1e-15)


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
        rows += [(k, float(b), sigma, (i,)) for i, b in enumerate(bearings)]
    recording = Recording(
        prefixes=tuple(f"c.{k}" for k in range(steps)),
        steps=np.array(measured),
        step_covariance=np.tile(covariance, (steps, 1, 1)),
        circles=CircleRows.of(),
        lines=LineRows.of(rows),
    )
    ekf = EkfSlam(camera_xy=CAMERA_XY, jacobians=jacobians)
    run = run_ekf(recording, ekf)
    assert run.count.lines == len(rows)
    # Pose and two lines come before the last, and several kept poses.
    assert max(ekf.line_slots.values()) >= 3 + 4 + 9
    from redetect.plane import between
    from redetect.slam.models import between_jacobians, chain_steps

    poses, places = chain_steps(recording.steps), lines.copy()
    unknowns = 3 * steps + 6
    for _ in range(20):
        normal, right = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        weight = np.linalg.inv(covariance)
        for k in range(steps):
            J = np.zeros((3, unknowns))
            first, second = between_jacobians(poses[k], poses[k + 1])
            if k:
                J[:, 3 * k - 3 : 3 * k] = first
            J[:, 3 * k : 3 * k + 3] = second
            normal += J.T @ weight @ J
            right += J.T @ weight @ (recording.steps[k] - between(poses[k], poses[k + 1]))
        for k, bearing, _, (i,) in rows:
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
    found = ekf.block(order) / np.outer(scale, scale)
    np.testing.assert_allclose(found, expected / np.outer(scale, scale), atol=5e-3)


def test_a_row_of_several_lines_measures_the_mean_of_their_bearings() -> None:
    noise_xy = spd(np.random.default_rng(8), 2, 0.1)
    robot = localizer([0.3, -0.2, 0.4], [[-1.0, -2.0]], [[1.0, -3.0], [0.8, -3.2]])
    discs, lines = rows_of([(0, np.zeros(2), noise_xy)]), bearings_of([((0, 1), 0.5, 0.01)])
    rows = FrameRows(discs.circles, lines.lines)
    error, jacobian, index, noise = innovation_of(rows, robot, robot.state)
    pose, disc, places = robot.state[:3], robot.state[3:5], robot.state[5:].reshape(2, 2)
    bearings = bearing_of_vertical(pose, places, CAMERA_XY)
    by_pose, by_line = bearing_jacobians(pose, places, CAMERA_XY)
    assert error[2] == pytest.approx(0.5 - bearings.mean(), abs=1e-12)
    np.testing.assert_allclose(jacobian[2, :3], by_pose.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(jacobian[2, 3:], [0, 0, *(by_line.ravel() / 2)], atol=1e-12)
    np.testing.assert_array_equal(index, np.arange(9))
    by_pose, by_disc = disc_jacobians(pose, disc)
    np.testing.assert_allclose(error[:2], -disc_in_robot(pose, disc), atol=1e-12)
    np.testing.assert_allclose(jacobian[:2, :3], by_pose, atol=1e-12)
    np.testing.assert_allclose(jacobian[:2, 3:5], by_disc, atol=1e-12)
    np.testing.assert_allclose(noise, block_diag(noise_xy, 1e-4))


def test_bearings_behind_do_not_jump() -> None:
    robot = localizer([0.0, 0.0, 0.0], [], [[CAMERA_XY[0] + 0.01, CAMERA_XY[1] + 5.0]])
    rows = bearings_of([((0,), -np.pi + 0.001, 0.01)])
    assert innovation_of(rows, robot, robot.state).error[0] == pytest.approx(0.003, abs=1e-5)


def test_jacobians_of_two_rays() -> None:
    poses = np.array([[0.1, 0.3, 0.2], [-0.5, -0.9, 0.5]])
    line = np.array([0.7, -3.0])
    bearings = bearing_of_vertical(poses, line, CAMERA_XY)
    sigma = np.array([0.01, 0.02])
    start = start_line(poses, poses, bearings, sigma, CAMERA_XY, 1e-6 * np.eye(6))
    assert start is not None

    def meet(numbers: FloatArray) -> FloatArray:
        met = triangulate(
            numbers[:6].reshape(2, 3), numbers[6:], sigma, CAMERA_XY, np.zeros((6, 6))
        )
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
    assert (
        triangulate(poses, np.array(bearings), np.full(2, 0.01), np.zeros(2), np.zeros((6, 6)))
        is None
    )
    # Turned to each other they do.
    met = triangulate(poses, np.array([0.3, -0.3]), np.full(2, 0.01), np.zeros(2), np.zeros((6, 6)))
    assert met is not None
    np.testing.assert_allclose(met, [0.5, -0.5 / np.tan(0.3)], atol=1e-9)


def test_lines_can_not_be_identified_before_they_are_placed() -> None:
    lines = LineRows.of([(0, 0.1, 0.01, ())])
    recording = Recording(("a",), np.zeros((1, 3)), np.eye(3)[None], CircleRows.of(), lines)
    with pytest.raises(SlamError, match="expected known association"):
        run_ekf(recording, EkfSlam(), Associator("joint"))
