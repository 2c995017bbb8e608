"""Between pixels and straight pixels, compiled: bilinear interpolation in a grid, and its inverse.

Straight pixels are those of an image without the lens's distortion: lines are straight in them.
`grid[j, i]` holds the straight position of pixel (step * i, step * j); an empty grid means no
distortion.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_NEWTON_STEPS = 12
_CLOSE_ENOUGH = 1e-7


@njit(cache=True, error_model="numpy")
def straightened(
    grid: NDArray[np.float64], step: float, u: float, v: float
) -> tuple[float, float, float, float, float, float]:
    """Straight position of a pixel and its derivatives: x, y, dx/du, dx/dv, dy/du, dy/dv.

    Beyond the grid's border its outermost cells are continued.
    """
    if grid.shape[0] == 0:
        return u, v, 1.0, 0.0, 0.0, 1.0
    fu = u / step
    fv = v / step
    i = min(max(math.floor(fu), 0), grid.shape[1] - 2)
    j = min(max(math.floor(fv), 0), grid.shape[0] - 2)
    a = fu - i
    b = fv - j
    x00, x01, x10, x11 = grid[j, i, 0], grid[j, i + 1, 0], grid[j + 1, i, 0], grid[j + 1, i + 1, 0]
    y00, y01, y10, y11 = grid[j, i, 1], grid[j, i + 1, 1], grid[j + 1, i, 1], grid[j + 1, i + 1, 1]
    x = (1.0 - b) * ((1.0 - a) * x00 + a * x01) + b * ((1.0 - a) * x10 + a * x11)
    y = (1.0 - b) * ((1.0 - a) * y00 + a * y01) + b * ((1.0 - a) * y10 + a * y11)
    xu = ((1.0 - b) * (x01 - x00) + b * (x11 - x10)) / step
    xv = ((1.0 - a) * (x10 - x00) + a * (x11 - x01)) / step
    yu = ((1.0 - b) * (y01 - y00) + b * (y11 - y10)) / step
    yv = ((1.0 - a) * (y10 - y00) + a * (y11 - y01)) / step
    return x, y, xu, xv, yu, yv


@njit(cache=True, error_model="numpy")
def bent(
    grid: NDArray[np.float64], step: float, x: float, y: float, u: float, v: float
) -> tuple[float, float]:
    """The pixel whose straight position is (x, y), from a guess (u, v); NaN if none is found."""
    if grid.shape[0] == 0:
        return x, y
    for _ in range(_NEWTON_STEPS):
        at_x, at_y, xu, xv, yu, yv = straightened(grid, step, u, v)
        determinant = xu * yv - xv * yu
        dx = x - at_x
        dy = y - at_y
        du = (yv * dx - xv * dy) / determinant
        dv = (xu * dy - yu * dx) / determinant
        u += du
        v += dv
        if abs(du) + abs(dv) < _CLOSE_ENOUGH:
            return u, v
    return math.nan, math.nan


@njit(cache=True, error_model="numpy")
def straighten_points(
    grid: NDArray[np.float64], step: float, pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 2) straight positions of (N, 2) pixels."""
    result = np.empty_like(pixels)
    for k in range(len(pixels)):
        x, y, _, _, _, _ = straightened(grid, step, pixels[k, 0], pixels[k, 1])
        result[k, 0] = x
        result[k, 1] = y
    return result


@njit(cache=True, error_model="numpy")
def bend_points(
    grid: NDArray[np.float64],
    step: float,
    straight: NDArray[np.float64],
    guess: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N, 2) pixels of (N, 2) straight positions, from one guess (2,) for all."""
    result = np.empty_like(straight)
    for k in range(len(straight)):
        u, v = bent(grid, step, straight[k, 0], straight[k, 1], guess[0], guess[1])
        result[k, 0] = u
        result[k, 1] = v
    return result
