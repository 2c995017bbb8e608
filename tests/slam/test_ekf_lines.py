"""Lines in the filters: how bearings place them, and what they say of the pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from redetect.array_types import FloatArray
from redetect.slam.errors import SlamError
from redetect.slam.filters.base import FrameRows
from redetect.slam.filters.ekf_slam import EkfSlam, run_ekf
from redetect.slam.filters.run import Associator
from redetect.slam.models import (
    bearing_jacobians,
    bearing_of_vertical,
    disc_in_robot,
    disc_jacobians,
    move,
)
from redetect.slam.recording import LineRows, Recording
from tests.slam.ekf_rows import CAMERA_XY, bearings_of, circle_rows, localizer, rows_of, spd


def test_a_line_is_placed_when_there_is_parallax() -> None:
    ekf = EkfSlam(camera_xy=CAMERA_XY)
    line = np.array([0.2, -9.0])
    for metres, steps in ((0.01, 100), (0.3, 20)):
        assert not len(ekf.landmark_map().lines)
        for _ in range(steps):
            ekf.predict(np.array([0.0, -metres, 0.0]), 1e-8 * np.eye(3))
            bearing = float(bearing_of_vertical(ekf.state[:3], line, CAMERA_XY))
            ekf.measure(bearings_of([((3,), bearing, 2e-3)]))
    found = ekf.landmark_map().lines
    assert found.rows.tolist() == [120]
    assert ekf.count.lines == 120
    error = found.xy[0] - line
    assert error @ np.linalg.solve(found.covariance[0], error) < 1.0
    np.testing.assert_allclose(found.xy[0], line, atol=0.01)


def test_derivatives_of_bearings_by_rays() -> None:
    ekf = EkfSlam([0.3, -0.2, 0.4], camera_xy=CAMERA_XY)
    ekf.measure(bearings_of([((1,), 0.5, 0.01), ((2,), -0.3, 0.01)]))
    ekf.predict(np.array([0.1, -0.5, 0.2]), np.eye(3))
    at = ekf.state.copy()

    def seen(state: FloatArray) -> FloatArray:
        ekf.state[:] = state
        return ekf.predicted([], list(ekf.line_slots.values())).seen

    numeric = np.stack([(seen(at + e) - seen(at - e)) / 2e-6 for e in 1e-6 * np.eye(11)], axis=-1)
    ekf.state[:] = at
    found = ekf.predicted([], list(ekf.line_slots.values()))
    np.testing.assert_array_equal(found.components, np.arange(11))
    np.testing.assert_allclose(found.jacobian, numeric, atol=1e-8)


def test_landmarks_that_are_forgotten_leave_the_others_as_they_are() -> None:
    rng, ekf = np.random.default_rng(5), EkfSlam(start_covariance=0.01 * np.eye(3))
    discs = [(i, rng.uniform(-2, 2, 2), spd(rng, 2, 0.1)) for i in range(4)]
    ekf.measure(FrameRows(rows_of(discs).circles, bearings_of([((7,), 0.2, 0.01)]).lines))
    ekf.measure(bearings_of([((8,), 0.3, 0.01)]))
    slots = [0, *(ekf.disc_slots[i] for i in (0, 3)), ekf.line_slots[8]]
    index = np.concatenate([at + np.arange(n) for at, n in zip(slots, (3, 2, 2, 4))])
    state, covariance = ekf.state[index], ekf.block(index)
    ekf.forget({1, 2}, {7})
    assert (ekf.disc_slots, ekf.line_slots) == ({0: 3, 3: 5}, {8: 7})
    np.testing.assert_array_equal(ekf.state, state)
    np.testing.assert_array_equal(ekf.block(np.arange(11)), covariance)


def test_lines_are_batch_least_squares() -> None:
    """Each bearing counts once; what is expected of a distance at first counts for little."""
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
        circles=circle_rows(),
        lines=LineRows.of(rows),
    )
    ekf = EkfSlam(camera_xy=CAMERA_XY)
    run = run_ekf(recording, ekf)
    assert run.count.lines == len(rows)
    from redetect.plane import between, chain_steps
    from redetect.slam.models import between_jacobians

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
    scale = np.sqrt(np.diag(expected))
    found = ekf.landmark_map()
    assert found.joint_covariance is not None
    state = np.append(ekf.state[:3], found.lines.xy)
    np.testing.assert_allclose((state - np.append(poses[-1], places)) / scale, 0.0, atol=0.05)
    for own, some in ((ekf.pose_covariance, slice(3)), (found.joint_covariance, slice(3, None))):
        over = np.outer(scale[some], scale[some])
        np.testing.assert_allclose(own / over, expected[some, some] / over, atol=0.03)


def test_a_row_of_several_lines_measures_the_mean_of_their_bearings() -> None:
    noise_xy = spd(np.random.default_rng(8), 2, 0.1)
    robot = localizer([0.3, -0.2, 0.4], [[-1.0, -2.0]], [[1.0, -3.0], [0.8, -3.2]])
    discs, lines = rows_of([(0, np.zeros(2), noise_xy)]), bearings_of([((0, 1), 0.5, 0.01)])
    rows = FrameRows(discs.circles, lines.lines)
    error, jacobian, index, noise = robot.innovation_of(rows)
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
    assert robot.innovation_of(rows).error[0] == pytest.approx(0.003, abs=1e-5)


def test_lines_can_not_be_identified_before_they_are_placed() -> None:
    lines = LineRows.of([(0, 0.1, 0.01, ())])
    recording = Recording(("a",), np.zeros((1, 3)), np.eye(3)[None], circle_rows(), lines)
    with pytest.raises(SlamError, match="expected known association"):
        run_ekf(recording, EkfSlam(), Associator("joint"))
