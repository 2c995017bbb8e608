"""Covariances of positions on the floor.

With J = d(x, y) / d(u, v), the floor's Jacobian at a position, the covariance is that of the fit,
plus p J J^T for a systematic error in the image, plus the effect of the robot's unknown tilt: a
rotation by w_X and w_Y about the origin on the floor raises a position (x, y) by x w_Y - y w_X,
which moves it along the line of sight, by its horizontal offset from the camera over the camera's
height.
"""

from __future__ import annotations

import numpy as np

from camera import Camera
from redetect.array_types import FloatArray, IntArray

#: The published covariance: this standard deviation in every direction, and two pixels squared.
_PUBLISHED_FLOOR_M, _PUBLISHED_PIXEL_VARIANCE = 0.04, 2.0


def published_covariance(camera: Camera, pixels: IntArray) -> FloatArray:
    """(N, 2, 2) covariances of (N, 2) pixels' positions as in the data set, square metres.

    (0.04 m)^2 I + 2 px^2 J J^T, with the Jacobian J of the data set's own detector.
    """
    jacobian = camera.floor_jacobian_published(pixels)
    by_pixels = _PUBLISHED_PIXEL_VARIANCE * jacobian @ jacobian.swapaxes(-1, -2)
    return np.asarray(_PUBLISHED_FLOOR_M**2 * np.eye(2) + by_pixels)


def refined_covariance(
    camera: Camera, floor_xy: FloatArray, fitted: FloatArray, sigma_px: float, tilt_sigma_rad: float
) -> FloatArray:
    """(N, 2, 2) covariances of refined positions (N, 2), square metres.

    The covariances of the fits, plus those due to standard deviations of pixels and of the tilt.
    """
    jacobian = sigma_px * camera.floor_jacobian_at(floor_xy)
    # Raised by w = (w_X, w_Y), each position moves by the outer product of `sight` and (-y, x).
    sight = tilt_sigma_rad * (floor_xy - camera.centre[:2]) / camera.centre[2]
    moved = sight * np.hypot(*floor_xy.T)[:, None]
    by_pixels = jacobian @ jacobian.swapaxes(-1, -2)
    return np.asarray(fitted + by_pixels + moved[:, :, None] * moved[:, None])
