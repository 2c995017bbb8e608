"""Measures of the residuals of a marker's fit: each cell's own whiteness, correlation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.pattern_model import (
    BLACK_AT,
    WHITE_AT,
    Pattern,
    cell_profile,
    light_level,
    place_on_marker,
)
from detect.markers.pattern_pixels import Samples

FloatArray = NDArray[np.float64]


class MarkerFrame(NamedTuple):
    """Where the marker is taken to be.

    Attributes
    ----------
    homography, inverse : (3, 3) float64
        From the unit square to straight pixels about the centre, and back.
    centre_x, centre_y : float
        Straight pixels.
    size : float
        Distance of the farthest corner from the centre, pixels: the unit of the light's slopes.
    """

    homography: FloatArray
    inverse: FloatArray
    centre_x: float
    centre_y: float
    size: float


class Residuals(NamedTuple):
    """What a fit leaves over at N pixels, with working memory.

    Attributes
    ----------
    residual, weight : (N,) float64
        Grey value less the model's; weights of robust least squares.
    rows : (N, PARAMETERS + 1) float64
        Weighted derivatives of the model, and the weighted residual.
    profiles : (7, L) float64
        Working memory of `blurred_blackness`.
    """

    residual: FloatArray
    weight: FloatArray
    rows: FloatArray
    profiles: FloatArray


@njit(cache=True, error_model="numpy")
def cell_values(
    samples: Samples,
    pattern: Pattern,
    frame: MarkerFrame,
    p: FloatArray,
    left: Residuals,
    variance: float,
) -> tuple[FloatArray, FloatArray]:
    """Whiteness of each cell by a matched filter on the residuals: all the others as fitted.

    Unlike the geometry's, these sums do not spare outliers: a cell that is not what it should be
    must show.

    Returns
    -------
    cells, sigma : (L - 1, L - 1) float64
        0 black, 1 white; standard deviation due to noise.
    """
    n = len(pattern.lines) - 1
    top = np.zeros((n, n))
    bottom = np.zeros((n, n))
    cells = np.empty((n, n))
    sigma = np.empty((n, n))
    work = left.profiles
    for k in range(len(samples.grey)):
        x = samples.straight[k, 0] - frame.centre_x
        y = samples.straight[k, 1] - frame.centre_y
        at = place_on_marker(frame.inverse, x, y, p)
        x0, x1 = cell_profile(at.x, at.sigma_x, pattern.lines, work[0], work[1], work[2])
        y0, y1 = cell_profile(at.y, at.sigma_y, pattern.lines, work[3], work[4], work[5])
        white = light_level(p, WHITE_AT, x / frame.size, y / frame.size)
        dark = light_level(p, BLACK_AT, x / frame.size, y / frame.size)
        for j in range(y0, y1):
            wy = (work[4, j + 1] - work[4, j]) * (white - dark)
            for i in range(x0, x1):
                share = wy * (work[1, i + 1] - work[1, i])
                top[j, i] += share * left.residual[k]
                bottom[j, i] += share * share
    for j in range(n):
        for i in range(n):
            if bottom[j, i] > 0.0:
                cells[j, i] = 1.0 - pattern.black[j, i] + top[j, i] / bottom[j, i]
                sigma[j, i] = math.sqrt(variance / bottom[j, i])
            else:
                cells[j, i] = 0.5
                sigma[j, i] = math.inf
    return cells, sigma


@njit(cache=True, error_model="numpy")
def inflation_of(pixels: NDArray[np.int32], left: Residuals) -> float:
    """Factor of the covariance for residuals that are correlated between neighbouring pixels.

    A pixel's residual that is correlated with its neighbours' by rho along a row (geometrically
    falling off) counts as (1 - rho) / (1 + rho) of an independent one; rows and columns alike. Only
    significant correlation is considered.
    """
    first_u = pixels[0, 0]
    last_u = pixels[0, 0]
    for k in range(len(pixels)):
        first_u = min(first_u, pixels[k, 0])
        last_u = max(last_u, pixels[k, 0])
    width = last_u - first_u + 1
    above = np.zeros(width)
    above_row = np.full(width, -10)
    along, along_n, down, down_n = 0.0, 0, 0.0, 0
    energy, energy_n = 0.0, 0
    for k in range(len(pixels)):
        u = pixels[k, 0] - first_u
        v = pixels[k, 1]
        r = left.residual[k] * math.sqrt(left.weight[k])
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
