"""Homographies between the unit square of a marker and its image.

The marker's square is (0, 0) top left, (1, 0) top right, (1, 1) bottom right, (0, 1) bottom left.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def square_homography(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) homography that takes the unit square to four corners (4, 2); its last entry is 1.

    References
    ----------
    Heckbert, "Fundamentals of Texture Mapping and Image Warping", 1989, section 2.2.3.
    """
    x0, y0 = corners[0, 0], corners[0, 1]
    x1, y1 = corners[1, 0], corners[1, 1]
    x2, y2 = corners[2, 0], corners[2, 1]
    x3, y3 = corners[3, 0], corners[3, 1]
    dx1 = x1 - x2
    dx2 = x3 - x2
    dx3 = x0 - x1 + x2 - x3
    dy1 = y1 - y2
    dy2 = y3 - y2
    dy3 = y0 - y1 + y2 - y3
    determinant = dx1 * dy2 - dx2 * dy1
    g = (dx3 * dy2 - dx2 * dy3) / determinant
    h = (dx1 * dy3 - dx3 * dy1) / determinant
    result = np.empty((3, 3))
    result[0, 0] = x1 - x0 + g * x1
    result[0, 1] = x3 - x0 + h * x3
    result[0, 2] = x0
    result[1, 0] = y1 - y0 + g * y1
    result[1, 1] = y3 - y0 + h * y3
    result[1, 2] = y0
    result[2, 0] = g
    result[2, 1] = h
    result[2, 2] = 1.0
    return result


@njit(cache=True, error_model="numpy")
def inverse_3x3(m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a 3x3 matrix up to its determinant's sign and size (enough for a homography).

    Its last row is positive where the homography's denominator is.
    """
    r = np.empty((3, 3))
    r[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    r[0, 1] = m[0, 2] * m[2, 1] - m[0, 1] * m[2, 2]
    r[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    r[1, 0] = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    r[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]
    r[1, 2] = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
    r[2, 0] = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    r[2, 1] = m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
    r[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    determinant = m[0, 0] * r[0, 0] + m[0, 1] * r[1, 0] + m[0, 2] * r[2, 0]
    return np.asarray(r / determinant)


@njit(cache=True, error_model="numpy", inline="always")
def project(h: NDArray[np.float64], x: float, y: float) -> tuple[float, float, float]:
    """Where a homography (3, 3) takes (x, y), and its denominator there."""
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    return (
        (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w,
        (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w,
        w,
    )


@njit(cache=True, error_model="numpy")
def corners_by_homography(homography: NDArray[np.float64]) -> NDArray[np.float64]:
    """(8, 8) d(x0, y0, x1 ... y3) / d(h00, h01, h02, h10, h11, h12, h20, h21)."""
    result = np.zeros((8, 8))
    for k in range(4):
        x = 1.0 if k == 1 or k == 2 else 0.0
        y = 1.0 if k >= 2 else 0.0
        u, v, w = project(homography, x, y)
        result[2 * k, 0] = x / w
        result[2 * k, 1] = y / w
        result[2 * k, 2] = 1.0 / w
        result[2 * k, 6] = -u * x / w
        result[2 * k, 7] = -u * y / w
        result[2 * k + 1, 3] = x / w
        result[2 * k + 1, 4] = y / w
        result[2 * k + 1, 5] = 1.0 / w
        result[2 * k + 1, 6] = -v * x / w
        result[2 * k + 1, 7] = -v * y / w
    return result
