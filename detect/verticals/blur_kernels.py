"""Compiled: how sharp the edges of an image are."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.fit import FIT_NUMBERS
from detect.verticals.order_kernels import descending

#: Fewer edges than this tell nothing of the image.
_LEAST_EDGES = 3


@njit(cache=True, error_model="numpy")
def median_sharpness(fits: NDArray[np.float64]) -> float:
    """Median sharpness of the edges that were refined, lines or not; 1 where there are too few.

    Of an even number the lower of the two in the middle.

    Parameters
    ----------
    fits : (13 * T,) float64
        See `detect.verticals.fit.LineFits`.
    """
    count = len(fits) // FIT_NUMBERS
    sharpness = np.empty(count)
    told = 0
    for t in range(count):
        if not math.isnan(fits[11 * count + t]):
            sharpness[told] = fits[12 * count + t]
            told += 1
    if told < _LEAST_EDGES:
        return 1.0
    return float(sharpness[descending(sharpness[:told])[told // 2]])
