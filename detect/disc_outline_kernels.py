"""Compiled loops over a fitted disc's residuals: do they hang together, is the outline even?"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.disc_patch_kernels import FX, FY, XU, XV, YU, YV

#: Columns of what the fit keeps of each pixel: the model's share of the contrast, the model's
#: derivative by the radius, and the residual.
SHARE, PER_RADIUS, ERROR = range(3)
EDGE_COLUMNS = 3

_SECTORS = 16


@njit(cache=True, error_model="numpy")
def correlated_area(edge: NDArray[np.float64], n: int) -> float:
    """How many pixels go with one independent residual, from the correlation of neighbours.

    White noise gives 1. Where the model does not fit (texture, reflections, a disc that is none)
    the residuals hang together, and their number overstates what they tell: for a first-order
    process of correlation c by (1 + c) / (1 - c) in either direction.
    """
    product = 0.0
    square = 0.0
    for i in range(n - 1):
        # Pixels were gathered row by row: the next one is nearly always the right neighbour.
        product += edge[i, ERROR] * edge[i + 1, ERROR]
        square += edge[i, ERROR] * edge[i, ERROR]
    if not square > 0.0:
        return 1.0
    # By chance alone the correlation of n residuals scatters by 1 / sqrt(n).
    correlation = min(max(product / square - 1.5 / math.sqrt(n), 0.0), 0.8)
    return ((1.0 + correlation) / (1.0 - correlation)) ** 2


@njit(cache=True, error_model="numpy")
def outline_statistics(
    pixels: NDArray[np.float64],
    edge: NDArray[np.float64],
    n: int,
    p: NDArray[np.float64],
    sigma_u: float,
    sigma_v: float,
) -> tuple[float, float, float, float]:
    """How evenly the edge goes round: in each sector its step and how far it is from the circle.

    The step is the regression of the grey values on the model's, relative to the whole disc's; the
    distance is the Gauss-Newton step of the radius from that sector's residuals alone.
    """
    sums = np.zeros((_SECTORS, 7))
    for i in range(n):
        x = pixels[i, FX] - p[0]
        y = pixels[i, FY] - p[1]
        if x * x + y * y < 0.09 * p[2] * p[2]:
            continue
        w = edge[i, SHARE]
        # What is left of the grey value when the background is taken off.
        grey = edge[i, ERROR] + p[4] * w
        k = int((math.atan2(y, x) / (2.0 * math.pi) + 1.0) * _SECTORS) % _SECTORS
        sums[k, 0] += 1.0
        sums[k, 1] += w
        sums[k, 2] += w * w
        sums[k, 3] += grey
        sums[k, 4] += w * grey
        sums[k, 5] += edge[i, PER_RADIUS] * edge[i, ERROR]
        sums[k, 6] += edge[i, PER_RADIUS] * edge[i, PER_RADIUS]
    blurs = 0.0
    weights = 0.0
    for i in range(n):
        x = pixels[i, FX] - p[0]
        y = pixels[i, FY] - p[1]
        r = math.sqrt(x * x + y * y) + 1e-12
        gu = (pixels[i, XU] * x + pixels[i, YU] * y) / r
        gv = (pixels[i, XV] * x + pixels[i, YV] * y) / r
        weight = abs(edge[i, PER_RADIUS])
        blurs += weight * min(math.hypot(sigma_u * gu, sigma_v * gv) / p[2], 2.5)
        weights += weight
    seen = 0
    steps = 0.0
    good = 0
    deviation = 0.0
    strongest = 0.0
    for k in range(_SECTORS):
        strongest = max(strongest, sums[k, 6])
    for k in range(_SECTORS):
        if sums[k, 0] < 3.0:
            continue
        spread = sums[k, 2] - sums[k, 1] * sums[k, 1] / sums[k, 0]
        if spread < 0.15:
            continue
        seen += 1
        relative = (sums[k, 4] - sums[k, 1] * sums[k, 3] / sums[k, 0]) / spread / p[4]
        steps += min(max(relative, -1.0), 1.0)
        if relative > 0.4:
            good += 1
        # Sectors with little edge in them say little about its place.
        offset = sums[k, 5] / (sums[k, 6] + 0.1 * strongest)
        deviation += min(offset * offset, 0.25)
    relative_blur = blurs / max(weights, 1e-12)
    if seen == 0:
        return 0.0, 0.0, 0.0, relative_blur
    return steps / seen, good / seen, math.sqrt(deviation / seen), relative_blur
