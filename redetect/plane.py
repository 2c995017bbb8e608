"""Rigid motions of the plane as (x, y, theta): composition, inverse, points, fits; ellipses.

A pose `a_from_b` transforms points of frame b to frame a. Metres and radians; stacks of any leading
shape. Covariances are those of (x, y, theta) themselves, as in the streams of poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle


def rotation(theta_rad: ArrayLike) -> FloatArray:
    """(..., 2, 2) rotations by (...) angles, counter-clockwise."""
    angle = np.asarray(theta_rad, dtype=np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def with_heading(matrices: FloatArray) -> FloatArray:
    """(..., 3, 3) from (..., 2, 2) for a pose's position, with 1 for its heading."""
    whole = np.zeros((*matrices.shape[:-2], 3, 3))
    whole[..., :2, :2] = matrices
    whole[..., 2, 2] = 1.0
    return whole


def compose(a_from_b: ArrayLike, b_from_c: ArrayLike) -> FloatArray:
    """(..., 3) poses a_from_c; the heading is wrapped."""
    a, b = np.asarray(a_from_b, dtype=np.float64), np.asarray(b_from_c, dtype=np.float64)
    theta = wrap_angle(a[..., 2:] + b[..., 2:])
    return np.concatenate([apply(a, b[..., :2]), theta], axis=-1)


def invert(a_from_b: ArrayLike) -> FloatArray:
    """(..., 3) poses b_from_a."""
    return between(a_from_b, np.zeros(3))


def between(world_from_a: ArrayLike, world_from_b: ArrayLike) -> FloatArray:
    """(..., 3) poses a_from_b of two poses in one world; the heading is wrapped."""
    a, b = np.asarray(world_from_a, dtype=np.float64), np.asarray(world_from_b, dtype=np.float64)
    theta = wrap_angle(b[..., 2:] - a[..., 2:])
    return np.concatenate([apply_inverse(a, b[..., :2]), theta], axis=-1)


def pose_differences(poses: FloatArray, others: FloatArray) -> FloatArray:
    """(..., 3) poses minus others, component by component, headings wrapped."""
    difference = poses - others
    difference[..., 2] = wrap_angle(difference[..., 2])
    return difference


def chain_steps(steps: ArrayLike, start: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Poses from odometry alone: the start, and the pose after each step.

    Takes `steps` (N, 3), `start` (3,); returns (N + 1, 3), theta not wrapped.
    """
    step = np.asarray(steps, dtype=np.float64).reshape(-1, 3)
    first = np.asarray(start, dtype=np.float64)
    theta = first[2] + np.concatenate([[0.0], np.cumsum(step[:, 2])])
    offset = np.einsum("nij,nj->ni", rotation(theta[:-1]), step[:, :2])
    xy = first[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(offset, axis=0)])
    return np.concatenate([xy, theta[:, None]], axis=1)


def log_motion(a_from_b: ArrayLike) -> FloatArray:
    """(..., 3) constant rates vx, vy, turn that lead from a to b within one unit of time.

    They are rates of the moving frame, so that the path is an arc.
    """
    pose = np.asarray(a_from_b, dtype=np.float64)
    half = 0.5 * wrap_angle(pose[..., 2])
    small = np.abs(half) < 1e-3
    cotangent = np.where(small, 1.0 - half**2 / 3.0, half / np.tan(np.where(small, 1.0, half)))
    x, y = pose[..., 0], pose[..., 1]
    return np.stack([cotangent * x + half * y, cotangent * y - half * x, 2.0 * half], axis=-1)


def apply(a_from_b: ArrayLike, points: ArrayLike) -> FloatArray:
    """(..., 2) points of frame b transformed to frame a by (..., 3) poses, broadcast."""
    a, p = np.asarray(a_from_b, dtype=np.float64), np.asarray(points, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * p[..., 0] - s * p[..., 1]
    y = a[..., 1] + s * p[..., 0] + c * p[..., 1]
    return np.stack([x, y], axis=-1)


def apply_inverse(a_from_b: ArrayLike, points: ArrayLike) -> FloatArray:
    """(..., 2) points of frame a transformed to frame b by (..., 3) poses, broadcast."""
    a = np.asarray(a_from_b, dtype=np.float64)
    # Differences are rotated, not points: far from the origin this keeps more digits.
    apart = np.asarray(points, dtype=np.float64) - a[..., :2]
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = c * apart[..., 0] + s * apart[..., 1]
    y = -s * apart[..., 0] + c * apart[..., 1]
    return np.stack([x, y], axis=-1)


def fitted(points: FloatArray, target: FloatArray) -> FloatArray:
    """(3,) pose that best aligns (n, 2) points with their targets: least squares (Horn 1987)."""
    from_points, from_target = points - points.mean(axis=0), target - target.mean(axis=0)
    across = from_points[:, 0] * from_target[:, 1] - from_points[:, 1] * from_target[:, 0]
    turn = float(np.arctan2(np.sum(across), np.sum(from_points * from_target)))
    return np.array([*(target.mean(axis=0) - rotation(turn) @ points.mean(axis=0)), turn])


def ellipses(
    centres: ArrayLike, covariance: ArrayLike, sigmas: float, points: int = 64
) -> FloatArray:
    """(..., points, 2) outlines of `sigmas` standard deviations around centres (..., 2)."""
    values, axes = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    roots = axes * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    angle = 2.0 * np.pi * np.arange(points) / points
    circle = sigmas * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(np.asarray(centres)[..., None, :] + circle @ roots.swapaxes(-1, -2))
