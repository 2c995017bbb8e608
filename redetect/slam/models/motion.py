"""Poses on the floor: composition, its inverse, and their Jacobians (the report's f, J1 to J4).

A pose is (x, y, theta): the robot's origin in the map (m), and the turn of its axes against the
map's (rad, counter-clockwise). An odometry step (dx, dy, dphi) is the pose after a movement in the
robot frame before it. Everything is vectorised over leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle


def rotation(theta_rad: ArrayLike) -> FloatArray:
    """Rotations of the plane, robot axes into the map's.

    Takes `theta_rad` (...); returns (..., 2, 2).
    """
    angle = np.asarray(theta_rad, dtype=np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def move(pose: ArrayLike, step: ArrayLike) -> FloatArray:
    """Motion model f: the pose after an odometry step.

    Takes `pose` (..., 3), `step` (..., 3); returns (..., 3).
    """
    before = np.asarray(pose, dtype=np.float64)
    moved = np.asarray(step, dtype=np.float64)
    cos, sin = np.cos(before[..., 2]), np.sin(before[..., 2])
    return np.stack(
        [
            before[..., 0] + cos * moved[..., 0] - sin * moved[..., 1],
            before[..., 1] + sin * moved[..., 0] + cos * moved[..., 1],
            before[..., 2] + moved[..., 2],
        ],
        axis=-1,
    )


def move_jacobians(pose: ArrayLike, step: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `move` by the pose (J1) and by the step (J2).

    Takes `pose, step` (..., 3); returns `by_pose, by_step` (..., 3, 3).
    """
    before = np.asarray(pose, dtype=np.float64)
    moved = np.asarray(step, dtype=np.float64)
    shape = np.broadcast_shapes(before.shape, moved.shape)[:-1]
    cos, sin = np.cos(before[..., 2]), np.sin(before[..., 2])
    by_pose = np.zeros((*shape, 3, 3))
    by_pose[..., 0, 0] = by_pose[..., 1, 1] = by_pose[..., 2, 2] = 1.0
    by_pose[..., 0, 2] = -sin * moved[..., 0] - cos * moved[..., 1]
    by_pose[..., 1, 2] = cos * moved[..., 0] - sin * moved[..., 1]
    by_step = np.zeros((*shape, 3, 3))
    by_step[..., 0, 0] = by_step[..., 1, 1] = cos
    by_step[..., 0, 1], by_step[..., 1, 0] = -sin, sin
    by_step[..., 2, 2] = 1.0
    return by_pose, by_step


def relative_pose(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """The second pose in the frame of the first: the step that leads from one to the other.

    Parameters
    ----------
    first, second : (..., 3) array_like
        Poses in one map.

    Returns
    -------
    (..., 3) float64
        dx, dy (m), dphi (rad, in [-pi, pi)).
    """
    before = np.asarray(first, dtype=np.float64)
    offset = np.asarray(second, dtype=np.float64) - before
    cos, sin = np.cos(before[..., 2]), np.sin(before[..., 2])
    return np.stack(
        [
            cos * offset[..., 0] + sin * offset[..., 1],
            -sin * offset[..., 0] + cos * offset[..., 1],
            wrap_angle(offset[..., 2]),
        ],
        axis=-1,
    )


def relative_pose_jacobians(first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `relative_pose` by the first (J3) and by the second pose (J4).

    Takes `first, second` (..., 3); returns `by_first, by_second` (..., 3, 3).
    """
    before = np.asarray(first, dtype=np.float64)
    step = relative_pose(first, second)
    cos, sin = np.cos(before[..., 2]), np.sin(before[..., 2])
    by_second = np.zeros((*step.shape, 3))
    by_second[..., 0, 0] = by_second[..., 1, 1] = cos
    by_second[..., 0, 1], by_second[..., 1, 0] = sin, -sin
    by_second[..., 2, 2] = 1.0
    by_first = -by_second
    by_first[..., 0, 2], by_first[..., 1, 2] = step[..., 1], -step[..., 0]
    return by_first, by_second


def chain_steps(steps: ArrayLike, start: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Poses that odometry alone leads to.

    Parameters
    ----------
    steps : (N, 3) array_like
        Odometry steps.
    start : (3,) array_like
        Pose before the first.

    Returns
    -------
    (N + 1, 3) float64
        The start and the pose after each step; theta is not wrapped.
    """
    step = np.asarray(steps, dtype=np.float64).reshape(-1, 3)
    first = np.asarray(start, dtype=np.float64)
    theta = first[2] + np.concatenate([[0.0], np.cumsum(step[:, 2])])
    offset = np.einsum("nij,nj->ni", rotation(theta[:-1]), step[:, :2])
    xy = first[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(offset, axis=0)])
    return np.concatenate([xy, theta[:, None]], axis=1)
