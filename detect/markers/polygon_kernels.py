"""Compiled questions about quadrangles and other polygons."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def signed_area(polygon: NDArray[np.float64]) -> float:
    """Area of a polygon (N, 2); positive if it is clockwise as seen in the image (v down)."""
    total = 0.0
    n = len(polygon)
    for k in range(n):
        j = k + 1 if k + 1 < n else 0
        total += polygon[k, 0] * polygon[j, 1] - polygon[j, 0] * polygon[k, 1]
    return 0.5 * total


@njit(cache=True, error_model="numpy")
def is_convex(corners: NDArray[np.float64]) -> bool:
    """Whether a clockwise quadrangle (4, 2) is strictly convex."""
    for k in range(4):
        a, b, c = corners[k], corners[(k + 1) % 4], corners[(k + 2) % 4]
        if not (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0]) > 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def same_corners(
    first: NDArray[np.float64], second: NDArray[np.float64], apart_px: float, apart_widths: float
) -> bool:
    """Whether each corner of a quadrangle is near some corner of another."""
    limit = apart_px + apart_widths * math.sqrt(abs(signed_area(second)))
    for k in range(4):
        least = math.inf
        for j in range(4):
            apart = max(abs(first[k, 0] - second[j, 0]), abs(first[k, 1] - second[j, 1]))
            least = min(least, apart)
        if least > limit:
            return False
    return True


@njit(cache=True, error_model="numpy")
def count_same(
    first: NDArray[np.float64],
    others: NDArray[np.float64],
    count: int,
    apart_px: float,
    apart_widths: float,
) -> int:
    """How many of the first `count` of (N, 4, 2) quadrangles have the same corners as one."""
    total = 0
    for n in range(count):
        if same_corners(first, others[n], apart_px, apart_widths):
            total += 1
    return total


@njit(cache=True, error_model="numpy")
def is_inside(x: float, y: float, corners: NDArray[np.float64]) -> bool:
    """Whether a point is inside a clockwise convex quadrangle."""
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        if not (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def pixel_area(polygon: NDArray[np.int32]) -> float:
    """Pixels inside a polygon through pixel centres, those on it included (Pick's theorem).

    Sides between the grid's directions count as the digital lines that they represent.
    """
    total = 0.0
    boundary = 0
    n = len(polygon)
    for k in range(n):
        j = k + 1 if k + 1 < n else 0
        total += polygon[k, 0] * polygon[j, 1] - polygon[j, 0] * polygon[k, 1]
        boundary += max(abs(polygon[k, 0] - polygon[j, 0]), abs(polygon[k, 1] - polygon[j, 1]))
    return 0.5 * abs(total) + 0.5 * boundary + 1.0
