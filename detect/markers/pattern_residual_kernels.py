"""Compiled measures of the residuals of a marker's fit: each cell's own whiteness, correlation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.pattern_model_kernels import (
    BLACK_AT,
    WHITE_AT,
    cell_profile,
    light_level,
    place_on_marker,
)


@njit(cache=True, error_model="numpy")
def cell_values(
    straight: NDArray[np.float64],
    count: int,
    centre_x: float,
    centre_y: float,
    size: float,
    inverse: NDArray[np.float64],
    p: NDArray[np.float64],
    lines: NDArray[np.float64],
    black: NDArray[np.float64],
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    variance: float,
    work: NDArray[np.float64],
    cells: NDArray[np.float64],
    cell_sigma: NDArray[np.float64],
) -> None:
    """Whiteness of each cell by a matched filter on the residuals: all the others as fitted.

    Unlike the geometry's, these sums do not spare outliers: a cell that is not what it should be
    must show.
    """
    n = len(lines) - 1
    top = np.zeros((n, n))
    bottom = np.zeros((n, n))
    for k in range(count):
        x = straight[k, 0] - centre_x
        y = straight[k, 1] - centre_y
        mx, my, _, _, _, _, sx, sy, _ = place_on_marker(inverse, x, y, p)
        x0, x1 = cell_profile(mx, sx, lines, work[0], work[1], work[2])
        y0, y1 = cell_profile(my, sy, lines, work[3], work[4], work[5])
        white = light_level(p, WHITE_AT, x / size, y / size)
        dark = light_level(p, BLACK_AT, x / size, y / size)
        for j in range(y0, y1):
            wy = (work[4, j + 1] - work[4, j]) * (white - dark)
            for i in range(x0, x1):
                share = wy * (work[1, i + 1] - work[1, i])
                top[j, i] += share * residual[k]
                bottom[j, i] += share * share
    for j in range(n):
        for i in range(n):
            if bottom[j, i] > 0.0:
                cells[j, i] = 1.0 - black[j, i] + top[j, i] / bottom[j, i]
                cell_sigma[j, i] = math.sqrt(variance / bottom[j, i])
            else:
                cells[j, i] = 0.5
                cell_sigma[j, i] = math.inf


@njit(cache=True, error_model="numpy")
def inflation_of(
    pixels: NDArray[np.int32],
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    count: int,
) -> float:
    """Share of information that a pixel keeps when residuals of neighbours are correlated.

    A pixel's residual that is correlated with its neighbours' by rho along a row (geometrically
    falling off) counts as (1 - rho) / (1 + rho) of an independent one; rows and columns alike. Only
    significant correlation is considered.
    """
    first_u = pixels[0, 0]
    last_u = pixels[0, 0]
    for k in range(count):
        first_u = min(first_u, pixels[k, 0])
        last_u = max(last_u, pixels[k, 0])
    width = last_u - first_u + 1
    above = np.zeros(width)
    above_row = np.full(width, -10)
    along, along_n, down, down_n = 0.0, 0, 0.0, 0
    energy, energy_n = 0.0, 0
    for k in range(count):
        u = pixels[k, 0] - first_u
        v = pixels[k, 1]
        r = residual[k] * math.sqrt(weights[k])
        energy += r * r
        energy_n += 1
        if u > 0 and above_row[u - 1] == v:
            along += r * above[u - 1]
            along_n += 1
        if above_row[u] == v - 1:
            down += r * above[u]
            down_n += 1
        above[u] = r
        above_row[u] = v
    if energy <= 0.0:
        return 1.0
    mean_energy = energy / energy_n
    factor = 1.0
    for total, n in ((along, along_n), (down, down_n)):
        if n > 20:
            rho = total / n / mean_energy - 2.0 / math.sqrt(n)
            rho = min(max(rho, 0.0), 0.8)
            factor *= (1.0 + rho) / (1.0 - rho)
    return factor
