"""Motion and measurement models: Jacobians against finite differences, and their laws."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.plane import apply, between, chain_steps, rotation
from redetect.slam.models import (
    bearing_jacobians,
    bearing_of_vertical,
    between_jacobians,
    disc_in_robot,
    disc_jacobians,
    move,
    move_jacobians,
)

CAMERA_XY = np.array([0.0179777, -0.0808609])


def derivative(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float = 1e-6
) -> FloatArray:
    """Central differences of a vectorised function by the last axis of its argument."""
    columns = []
    for i in range(at.shape[-1]):
        offset = np.zeros(at.shape[-1])
        offset[i] = step
        difference = np.asarray(function(at + offset) - function(at - offset))
        columns.append(difference / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.fixture
def some() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(5)
    poses = np.column_stack([rng.normal(0, 5, (200, 2)), rng.uniform(-4, 4, 200)])
    others = np.column_stack([rng.normal(0, 5, (200, 2)), rng.uniform(-2.9, 2.9, 200)])
    steps = rng.normal(0, 0.5, (200, 3))
    return poses, others, steps, rng.normal(0, 5, (200, 2))


def test_motion_jacobians(some: tuple[FloatArray, ...]) -> None:
    poses, _, steps, _ = some
    by_pose, by_step = move_jacobians(poses, steps)
    np.testing.assert_allclose(by_pose, derivative(lambda p: move(p, steps), poses), atol=1e-8)
    np.testing.assert_allclose(by_step, derivative(lambda s: move(poses, s), steps), atol=1e-8)


def test_relative_pose_jacobians(some: tuple[FloatArray, ...]) -> None:
    poses, others, _, _ = some
    # Away from the wrap, where a difference of angles would jump.
    others = others.copy()
    others[:, 2] = poses[:, 2] + np.clip(others[:, 2], -3.0, 3.0)
    by_first, by_second = between_jacobians(poses, others)
    first = derivative(lambda p: between(p, others), poses)
    second = derivative(lambda p: between(poses, p), others)
    np.testing.assert_allclose(by_first, first, atol=1e-8)
    np.testing.assert_allclose(by_second, second, atol=1e-8)


def test_relative_pose_undoes_a_move(some: tuple[FloatArray, ...]) -> None:
    poses, _, steps, _ = some
    again = between(poses, move(poses, steps))
    np.testing.assert_allclose(again[:, :2], steps[:, :2], atol=1e-12)
    np.testing.assert_allclose(wrap_angle(again[:, 2] - steps[:, 2]), 0.0, atol=1e-12)


def test_chain_is_repeated_moves(some: tuple[FloatArray, ...]) -> None:
    steps = some[2]
    pose = np.array([1.0, -2.0, 0.3])
    chained = chain_steps(steps, pose)
    np.testing.assert_array_equal(chained[0], pose)
    for k, step in enumerate(steps):
        pose = move(pose, step)
        np.testing.assert_allclose(chained[k + 1], pose, atol=1e-10)


def test_disc_jacobians(some: tuple[FloatArray, ...]) -> None:
    poses, _, _, discs = some
    by_pose, by_disc = disc_jacobians(poses, discs)
    numeric = derivative(lambda p: disc_in_robot(p, discs), poses)
    np.testing.assert_allclose(by_pose, numeric, atol=1e-8)
    numeric = derivative(lambda d: disc_in_robot(poses, d), discs)
    np.testing.assert_allclose(by_disc, numeric, atol=1e-8)


def test_inverse_disc_model(some: tuple[FloatArray, ...]) -> None:
    poses, _, _, seen = some
    np.testing.assert_allclose(disc_in_robot(poses, apply(poses, seen)), seen, atol=1e-12)


def test_bearing_jacobians(some: tuple[FloatArray, ...]) -> None:
    poses, _, _, lines = some
    seen = disc_in_robot(poses, lines) - CAMERA_XY
    bearing = bearing_of_vertical(poses, lines, CAMERA_XY)
    keep = (np.linalg.norm(seen, axis=1) > 0.3) & (np.abs(bearing) < 3.1)
    assert keep.sum() > 150
    poses, lines = poses[keep], lines[keep]
    by_pose, by_line = bearing_jacobians(poses, lines, CAMERA_XY)
    numeric = derivative(lambda p: bearing_of_vertical(p, lines, CAMERA_XY), poses)
    np.testing.assert_allclose(by_pose, numeric, atol=1e-7)
    numeric = derivative(lambda m: bearing_of_vertical(poses, m, CAMERA_XY), lines)
    np.testing.assert_allclose(by_line, numeric, atol=1e-7)


def test_bearings_are_zero_forward_and_positive_to_the_left() -> None:
    here = np.array([0.0, 0.0, 0.0])
    forward = CAMERA_XY + np.array([0.0, -3.0])
    left = CAMERA_XY + np.array([2.0, 0.0])
    assert bearing_of_vertical(here, forward, CAMERA_XY) == pytest.approx(0.0, abs=1e-15)
    assert bearing_of_vertical(here, left, CAMERA_XY) == pytest.approx(np.pi / 2)


def test_rotation_takes_the_robots_axes_to_the_maps() -> None:
    np.testing.assert_allclose(rotation(np.pi / 2) @ [1.0, 0.0], [0.0, 1.0], atol=1e-15)
    offset = apply(np.array([0.0, 0.0, np.pi / 2]), np.array([1.0, 0.0]))
    np.testing.assert_allclose(offset, [0.0, 1.0], atol=1e-15)
