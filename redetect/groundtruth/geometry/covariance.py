"""Covariances of poses: from frame to frame, through chains, and down to the floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.geometry.transforms import adjoint, exp_se3, inverse, log_se3

FloatArray = NDArray[np.float64]


def planar_jacobian(world_from_robot: FloatArray) -> FloatArray:
    """(..., 3, 6) derivative of (x, y, theta) by the right perturbation of (..., 4, 4) poses."""
    rotation = np.asarray(world_from_robot, dtype=np.float64)[..., :3, :3]
    jacobian = np.zeros((*rotation.shape[:-2], 3, 6))
    jacobian[..., :2, :3] = rotation[..., :2, :]
    # The x axis turns by R (w x e_x) = R (0, w_z, -w_y).
    axis, to_y, to_z = rotation[..., 0], rotation[..., 1], rotation[..., 2]
    across = axis[..., 0] ** 2 + axis[..., 1] ** 2
    jacobian[..., 2, 5] = (axis[..., 0] * to_y[..., 1] - axis[..., 1] * to_y[..., 0]) / across
    jacobian[..., 2, 4] = -(axis[..., 0] * to_z[..., 1] - axis[..., 1] * to_z[..., 0]) / across
    return jacobian


def planar_covariance(world_from_robot: FloatArray, covariance: FloatArray) -> FloatArray:
    """(..., 3, 3) covariance of (x, y, theta) (m, m, rad).

    Parameters
    ----------
    world_from_robot : (..., 4, 4) array
    covariance : (..., 6, 6) array
        Of the right perturbation (translation m, rotation rad).
    """
    jacobian = planar_jacobian(world_from_robot)
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2))


def composed_covariance(
    a_covariance: FloatArray, b_from_c: FloatArray, b_covariance: FloatArray
) -> FloatArray:
    """(6, 6) covariance of a_from_b @ b_from_c, whose errors are independent."""
    moved = adjoint(inverse(b_from_c))
    return np.asarray(
        moved @ a_covariance @ np.swapaxes(moved, -1, -2) + b_covariance, dtype=np.float64
    )


def inverse_covariance(a_from_b: FloatArray, covariance: FloatArray) -> FloatArray:
    """(6, 6) covariance of b_from_a, from that of a_from_b."""
    moved = adjoint(a_from_b)
    return np.asarray(moved @ covariance @ np.swapaxes(moved, -1, -2), dtype=np.float64)


def mean_pose(
    poses: Sequence[FloatArray] | FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Weighted mean of poses on SE(3).

    Parameters
    ----------
    poses : (N, 4, 4) array
        Close to each other.
    covariances : (N, 6, 6) array
        Of their right perturbations.

    Returns
    -------
    (4, 4) array
        The mean.
    (6, 6) array
        Its covariance, if the poses' errors are independent.
    float
        Squared normalised deviations over degrees of freedom; 1 for a single pose.
    """
    stack = np.asarray(poses, dtype=np.float64)
    mean, information = stack[0], np.linalg.inv(covariances)
    covariance = np.linalg.inv(information.sum(axis=0))
    for _ in range(20):
        apart = log_se3(inverse(mean) @ stack)
        step = covariance @ np.einsum("nij,nj->i", information, apart)
        mean = mean @ exp_se3(step)
        if np.abs(step).max() < 1e-13:
            break
    apart = log_se3(inverse(mean) @ stack)
    squares = float(np.einsum("ni,nij,nj->", apart, information, apart))
    return mean, covariance, squares / (6 * (len(stack) - 1)) if len(stack) > 1 else 1.0
