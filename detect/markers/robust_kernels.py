"""Compiled robust scale of residuals, the same for a marker's edges and for the whole of it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Residuals beyond this many standard deviations lose weight.
OUTLIER = 3.0
#: Grey values are rounded: noise is never below this, grey levels.
LEAST_NOISE = 0.3

_MEDIAN_TO_SIGMA = 1.0 / 0.6745


@njit(cache=True, error_model="numpy")
def robust_sigma(residual: NDArray[np.float64], count: int, sampled: int, least: float) -> float:
    """Standard deviation of residuals by the median of their magnitudes.

    Parameters
    ----------
    residual : (N,) float64
        Residuals.
    count : int
        How many of them, from the first on.
    sampled : int
        Approximate number to use: every second, third, ... of more.
    least : float
        The result is at least that.

    Returns
    -------
    float
    """
    stride = max(1, count // sampled)
    return max(least, _MEDIAN_TO_SIGMA * float(np.median(np.abs(residual[:count:stride]))))
