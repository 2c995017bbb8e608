"""Where every pixel of a camera sees the floor.

A radial lens matters only through one function of the distance from the principal point: the factor
that undoes the distortion. So it is computed by the camera at some hundred distances, and between
them by polynomials that reproduce it to the last digits. With tangential terms that is where each
pixel's inverse is searched.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.distortion import radial_factor, undistorted_radius
from camera.kernels import lens_numbers
from lut.kernels import fill_floor_positions

FloatArray = NDArray[np.float64]

_INTERVALS = 256
_DEGREE = 5
#: Polynomials that are farther than this from the camera's own factor, relatively, are not used.
_LARGEST_ERROR = 1e-14


def floor_positions(camera: Camera) -> FloatArray:
    """(H, W, 2) floor position (robot X, Y, metres) that each pixel sees; NaN above the horizon."""
    floor_xy = np.empty((camera.height, camera.width, 2))
    polynomials = _undistortion(camera)
    if polynomials is None:
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        return camera.floor_from_pixel(np.stack([u, v], axis=-1).astype(np.float64))
    pinhole = np.array([camera.scale_x, camera.scale_y, camera.offset_x, camera.offset_y])
    per_radius = _INTERVALS / _farthest_corner(camera)
    fill_floor_positions(
        pinhole, lens_numbers(camera), polynomials, per_radius,
        # A camera that came from another process has arrays of another kind.
        np.array(camera.rotation), np.array(camera.centre), floor_xy,
    )  # fmt: skip
    return floor_xy


def _undistortion(camera: Camera) -> FloatArray | None:
    """Undistorted / distorted radius over equal intervals of the distorted one, up to the corner.

    Returns
    -------
    (intervals, degree + 1) float64 or None
        Coefficients, the lowest first, of polynomials in the position within an interval, from -1
        to 1. None where they do not reproduce the camera's own numbers: close to a fold.
    """
    farthest = _farthest_corner(camera)
    if not farthest > 0.0:
        return None
    nodes = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    between = np.linspace(-1.0, 1.0, 2 * _DEGREE)

    def ratio(position: FloatArray) -> FloatArray:
        interval = np.arange(_INTERVALS)[:, None]
        distorted = (interval + 0.5 * (position + 1.0)) * (farthest / _INTERVALS)
        distorted = np.minimum(distorted, farthest)
        radius = undistorted_radius(distorted, camera.coef, camera.polynomial)
        return 1.0 / radial_factor(radius, camera.coef, camera.polynomial)

    solve = np.linalg.inv(np.vander(nodes, increasing=True))
    polynomials = ratio(nodes) @ solve.T
    expected = ratio(between)
    error = polynomials @ np.vander(between, _DEGREE + 1, increasing=True).T - expected
    if not np.all(np.abs(error) <= _LARGEST_ERROR * expected):
        return None
    return np.ascontiguousarray(polynomials)


def _farthest_corner(camera: Camera) -> float:
    """Distorted radius of the pixel farthest from the principal point."""
    x = max(abs(camera.offset_x), abs(camera.width - 1 - camera.offset_x)) / camera.scale_x
    y = max(abs(camera.offset_y), abs(camera.height - 1 - camera.offset_y)) / camera.scale_y
    return math.hypot(x, y)
