"""Odometry's part of what a run's rows and steps are explained by.

What a tilted, differently mounted camera makes of discs is `redetect.slam.models.mounted_discs`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.slam.models.mounted_discs import (
    Geometry,
    PixelJacobians,
    predict_pixels,
    rotation_exp,
    skew,
)

__all__ = [
    "Geometry",
    "PixelJacobians",
    "chain_odometry",
    "nominal_geometry",
    "odometry_residuals",
    "predict_pixels",
    "rotation_exp",
    "skew",
]

FloatArray = NDArray[np.float64]


def nominal_geometry(camera: Camera, poses: FloatArray, disc_xy: FloatArray) -> Geometry:
    """The geometry with the camera mounted as calibrated and the robot upright."""
    return Geometry(
        poses=poses,
        disc_xy=disc_xy,
        rotation=np.array(camera.rotation),
        centre=np.array(camera.centre),
        tilt=np.zeros((len(poses), 2)),
    )


def odometry_residuals(
    poses: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Differences between the poses' relative motion and the odometry's.

    Parameters
    ----------
    poses : (N, 3) float array
        Poses after each step; before the first stands (0, 0, 0).
    steps : (N, 3) float array
        dx, dy, dphi in the robot frame before the step.

    Returns
    -------
    residuals : (N, 3) float array
        Relative motion minus step; the angle wrapped to [-pi, pi].
    by_before, by_after : (N, 3, 3) float arrays
        Derivatives by the pose before and after the step.
    """
    before = np.concatenate([np.zeros((1, 3)), poses[:-1]])
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    moved = poses - before
    dx = cos * moved[:, 0] + sin * moved[:, 1]
    dy = -sin * moved[:, 0] + cos * moved[:, 1]
    residuals = np.stack([dx, dy, moved[:, 2]], axis=1) - steps
    residuals[:, 2] = np.remainder(residuals[:, 2] + np.pi, 2.0 * np.pi) - np.pi

    by_after = np.zeros((len(poses), 3, 3))
    by_after[:, 0, 0] = by_after[:, 1, 1] = cos
    by_after[:, 0, 1], by_after[:, 1, 0] = sin, -sin
    by_after[:, 2, 2] = 1.0
    by_before = -by_after
    by_before[:, 0, 2], by_before[:, 1, 2] = dy, -dx
    return residuals, by_before, by_after


def chain_odometry(steps: FloatArray) -> FloatArray:
    """(N, 3) poses that (N, 3) odometry steps lead to from (0, 0, 0)."""
    theta = np.cumsum(steps[:, 2])
    before = theta - steps[:, 2]
    cos, sin = np.cos(before), np.sin(before)
    x = np.cumsum(cos * steps[:, 0] - sin * steps[:, 1])
    y = np.cumsum(sin * steps[:, 0] + cos * steps[:, 1])
    return np.stack([x, y, theta], axis=1)
