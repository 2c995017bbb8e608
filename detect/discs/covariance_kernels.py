"""Compiled: covariances of refined disc positions."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import project_floor_point

#: Step of the central differences of the projection, metres: their error is some 1e-8 of it.
_STEP_M = 1e-4


@njit(cache=True, error_model="numpy")
def refined_covariances(
    camera_numbers: NDArray[np.float64],
    centre: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    fitted: NDArray[np.float64],
    pixel_variance: float,
    tilt_variance: float,
) -> NDArray[np.float64]:
    """The fits' covariances, plus a systematic error in pixels and the camera's tilt.

    Parameters
    ----------
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    centre : (3,) float64
        Of the camera in the robot frame, metres.
    floor_xy : (N, 2) float64
        Positions, metres.
    fitted : (N, 2, 2) float64
        Covariances of the fits.
    pixel_variance, tilt_variance : float
        Square pixels, square radians: in either direction.

    Returns
    -------
    (N, 2, 2) float64
        Square metres.
    """
    result = fitted.copy()
    for k in range(len(floor_xy)):
        x, y = floor_xy[k, 0], floor_xy[k, 1]
        u1, v1 = project_floor_point(camera_numbers, x + _STEP_M, y)
        u0, v0 = project_floor_point(camera_numbers, x - _STEP_M, y)
        ux, vx = (u1 - u0) / (2.0 * _STEP_M), (v1 - v0) / (2.0 * _STEP_M)
        u1, v1 = project_floor_point(camera_numbers, x, y + _STEP_M)
        u0, v0 = project_floor_point(camera_numbers, x, y - _STEP_M)
        uy, vy = (u1 - u0) / (2.0 * _STEP_M), (v1 - v0) / (2.0 * _STEP_M)
        # With P = d(u, v) / d(x, y), P^-1 (P^-1)^T.
        scale = pixel_variance / (ux * vy - uy * vx) ** 2
        result[k, 0, 0] += scale * (uy * uy + vy * vy)
        result[k, 0, 1] -= scale * (ux * uy + vx * vy)
        result[k, 1, 0] -= scale * (ux * uy + vx * vy)
        result[k, 1, 1] += scale * (ux * ux + vx * vx)
        # See `detect.circles.tilt_jacobian`: a product of a column and a row.
        px = (x - centre[0]) / centre[2]
        py = (y - centre[1]) / centre[2]
        scale = tilt_variance * (x * x + y * y)
        result[k, 0, 0] += scale * px * px
        result[k, 0, 1] += scale * px * py
        result[k, 1, 0] += scale * px * py
        result[k, 1, 1] += scale * py * py
    return result
