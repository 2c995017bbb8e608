"""Compiled: sums of many numbers, for which additions need not wait for each other."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def sum_of(numbers: NDArray[np.float32]) -> float:
    """The sum, in double precision."""
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i]
    return total
