"""Covariances of fitted positions on the floor.

With J = d(x, y) / d(u, v), the floor's Jacobian at a position (the inverse of the projection's, by
central differences), the covariance is that of the fit, plus p J J^T for a systematic error in the
image, plus the effect of the robot's unknown tilt: a rotation by w_X and w_Y about the origin on
the floor raises a position (x, y) by x w_Y - y w_X, which moves it along the line of sight, by its
horizontal offset from the camera over the camera's height.
"""

from __future__ import annotations

import numpy as np

from camera.kernels import project_floor_point
from redetect.array_types import FloatArray, IntArray
from redetect.compiled import kernel

_STEP_M = 1e-5  #: Step of the central differences of the projection, metres.
#: The published covariance: this standard deviation in every direction, and two pixels squared.
PUBLISHED_FLOOR_M, PUBLISHED_PIXEL_VARIANCE = 0.04, 2.0


@kernel()
def _add_pixels(
    numbers: FloatArray, x: float, y: float, pixel_variance: float, covariance: FloatArray
) -> None:
    """Add the covariance of a pixel, mapped to the floor at (x, y), to a covariance: p J J^T."""
    h = _STEP_M
    u1, v1 = project_floor_point(numbers, x + h, y)
    u0, v0 = project_floor_point(numbers, x - h, y)
    u3, v3 = project_floor_point(numbers, x, y + h)
    u2, v2 = project_floor_point(numbers, x, y - h)
    ux, vx, uy, vy = u1 - u0, v1 - v0, u3 - u2, v3 - v2
    scale = pixel_variance * (2.0 * h / (ux * vy - uy * vx)) ** 2
    covariance[0, 0] += scale * (uy * uy + vy * vy)
    covariance[0, 1] -= scale * (ux * uy + vx * vy)
    covariance[1, 0] -= scale * (ux * uy + vx * vy)
    covariance[1, 1] += scale * (ux * ux + vx * vx)


@kernel()
def published_positions(
    camera_numbers: FloatArray, floor_xy: FloatArray, pixels: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Floor positions (N, 2) of (N, 2) pixels (u, v), and their covariances, as in the data set.

    These are (N, 2, 2), square metres: (0.04 m)^2 I + 2 px^2 J J^T, where J is the Jacobian of the
    position (`Camera.floor_jacobian_published`). `camera_numbers` as in `camera.kernels`;
    `floor_xy` (H, W, 2): floor position of each pixel, NaN if it does not see the floor.
    """
    position, covariance = np.empty((len(pixels), 2)), np.zeros((len(pixels), 2, 2))
    for k in range(len(pixels)):
        x, y = floor_xy[pixels[k, 1], pixels[k, 0]]
        position[k, 0], position[k, 1] = x, y
        covariance[k, 0, 0] = covariance[k, 1, 1] = PUBLISHED_FLOOR_M**2
        _add_pixels(camera_numbers, x, y, PUBLISHED_PIXEL_VARIANCE, covariance[k])
    return position, covariance


@kernel()
def refined_covariances(
    camera_numbers: FloatArray,
    centre: FloatArray,
    floor_xy: FloatArray,
    fitted: FloatArray,
    pixel_variance: float,
    tilt_variance: float,
) -> FloatArray:
    """(N, 2, 2) covariances of the fits, plus a systematic error in pixels and the camera's tilt.

    `camera_numbers` as in `camera.kernels`; variances per axis, square pixels, square radians.
    """
    result = fitted.copy()
    for k in range(len(floor_xy)):
        x, y = floor_xy[k, 0], floor_xy[k, 1]
        _add_pixels(camera_numbers, x, y, pixel_variance, result[k])
        # An outer product of a column and a row (-y, x), whose square is x^2 + y^2.
        sight = np.array([(x - centre[0]) / centre[2], (y - centre[1]) / centre[2]])
        for i in range(2):
            for j in range(2):
                result[k, i, j] += tilt_variance * (x * x + y * y) * sight[i] * sight[j]
    return result
