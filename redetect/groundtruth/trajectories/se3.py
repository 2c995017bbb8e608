"""Rigid transforms SE(3): 4x4 matrices, their tangents, and the propagation of covariances.

A tangent xi = (v, w) is a translation (m) and a rotation vector (rad), in this order. Poses are
perturbed on the right, T exp(xi): a covariance (6, 6) of a pose `a_from_b` is that of xi, and
thus is in the axes of frame b. All functions accept stacks of any leading shape.

References
----------
T. D. Barfoot, *State Estimation for Robotics*, 2nd ed., 2024, chapter 8.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from camera.rotations import cross_matrices, left_jacobian, rotation_of
from redetect.array_types import FloatArray


def transform(rotation: ArrayLike, translation: ArrayLike) -> FloatArray:
    """(..., 4, 4) transforms of (..., 3, 3) rotations and (..., 3) translations (m)."""
    r = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation, dtype=np.float64)
    matrix = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = r, t, 1.0
    return matrix


def quaternion_xyzw(transforms: ArrayLike) -> FloatArray:
    """(..., 4) unit quaternions x, y, z, w >= 0 of the rotations of (..., 4, 4) transforms."""
    t = np.asarray(transforms, dtype=np.float64)
    q = Rotation.from_matrix(t[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(q.reshape(*t.shape[:-2], 4))


def inverse(transforms: ArrayLike) -> FloatArray:
    """Inverses of (..., 4, 4) transforms."""
    t = np.asarray(transforms, dtype=np.float64)
    back = np.swapaxes(t[..., :3, :3], -1, -2)
    return transform(back, -(back @ t[..., :3, 3:])[..., 0])


def apply(transforms: ArrayLike, points: ArrayLike) -> FloatArray:
    """(..., 3) points transformed by (..., 4, 4) transforms (leading shapes are broadcast)."""
    t = np.asarray(transforms, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    return np.asarray((t[..., :3, :3] @ p[..., None])[..., 0] + t[..., :3, 3])


def exp(tangents: ArrayLike) -> FloatArray:
    """(..., 4, 4) transforms of (..., 6) tangents (v, w)."""
    xi = np.asarray(tangents, dtype=np.float64)
    w = xi[..., 3:]
    return transform(rotation_of(w), (left_jacobian(w) @ xi[..., :3, None])[..., 0])


def log(transforms: ArrayLike) -> FloatArray:
    """(..., 6) tangents (v, w) of (..., 4, 4) transforms, with rotation angles of at most pi."""
    t = np.asarray(transforms, dtype=np.float64)
    w = Rotation.from_matrix(t[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    w = w.reshape(*t.shape[:-2], 3)
    v = np.linalg.solve(left_jacobian(w), t[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], axis=-1)


def adjoint(transforms: ArrayLike) -> FloatArray:
    """(..., 6, 6) matrices Ad of (..., 4, 4) transforms T, with T exp(xi) = exp(Ad xi) T."""
    t = np.asarray(transforms, dtype=np.float64)
    rotation = t[..., :3, :3]
    matrix = np.zeros((*t.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = rotation
    matrix[..., :3, 3:] = cross_matrices(t[..., :3, 3]) @ rotation
    return matrix


def right_jacobian(tangent: ArrayLike) -> FloatArray:
    """(6, 6) matrix J of a (6,) tangent xi, with exp(xi + d) = exp(xi) exp(J d) for small d."""
    v, w = cross_matrices(np.reshape(np.asarray(tangent, dtype=np.float64), (2, 3)))
    # The integral of exp(-s ad) over s from 0 to 1, with ad = [[w, v], [0, w]].
    block = np.zeros((12, 12))
    block[:3, :3] = block[3:6, 3:6] = -w
    block[:3, 3:6] = -v
    block[:6, 6:] = np.eye(6)
    return np.asarray(expm(block)[:6, 6:])


def heading(transforms: ArrayLike) -> FloatArray:
    """(...) headings theta (rad): angles of the x axes of (..., 4, 4) poses in the world."""
    t = np.asarray(transforms, dtype=np.float64)
    return np.asarray(np.arctan2(t[..., 1, 0], t[..., 0, 0]))


def planar_jacobian(world_from_robot: FloatArray) -> FloatArray:
    """(..., 3, 6) derivative of (x, y, theta) by the right perturbation of (..., 4, 4) poses."""
    rotation = np.asarray(world_from_robot, dtype=np.float64)[..., :3, :3]
    jacobian = np.zeros((*rotation.shape[:-2], 3, 6))
    jacobian[..., :2, :3] = rotation[..., :2, :]
    # The x axis changes by R (w x e_x) = R (0, w_z, -w_y).
    axis, to_y, to_z = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    across = axis[..., 0] ** 2 + axis[..., 1] ** 2
    jacobian[..., 2, 5] = (axis[..., 0] * to_y[..., 1] - axis[..., 1] * to_y[..., 0]) / across
    jacobian[..., 2, 4] = -(axis[..., 0] * to_z[..., 1] - axis[..., 1] * to_z[..., 0]) / across
    return jacobian


def planar_covariance(world_from_robot: FloatArray, covariance: FloatArray) -> FloatArray:
    """(..., 3, 3) covariance of (x, y, theta) (m, m, rad) of poses (..., 4, 4), from that of their
    right perturbations (..., 6, 6) (translation m, rotation rad).
    """
    jacobian = planar_jacobian(world_from_robot)
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2))


def mean_pose(
    poses: Sequence[FloatArray] | FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Weighted mean (4, 4) of close poses (N, 4, 4) on SE(3), and its covariance (6, 6), from those
    of their right perturbations (N, 6, 6), for independent errors.
    """
    stack = np.asarray(poses, dtype=np.float64)
    mean, information = stack[0], np.linalg.inv(covariances)
    covariance = np.linalg.inv(information.sum(axis=0))
    for _ in range(20):
        apart = log(inverse(mean) @ stack)
        step = covariance @ np.einsum("nij,nj->i", information, apart)
        mean = mean @ exp(step)
        if np.abs(step).max() < 1e-13:
            break
    return mean, covariance
