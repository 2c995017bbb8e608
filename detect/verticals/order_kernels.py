"""Orders of a few numbers, compiled: Numba's own sorting takes seconds to compile."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def descending(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of numbers, the largest first; of equal ones the first is first.

    Parameters
    ----------
    values : (N,) float64
        None of them NaN.

    Returns
    -------
    (N,) int64
    """
    count = len(values)
    order = np.empty(count, np.int64)
    merged = np.empty(count, np.int64)
    for i in range(count):
        order[i] = i
    run = 1
    while run < count:
        for begin in range(0, count, 2 * run):
            middle = min(begin + run, count)
            end = min(middle + run, count)
            left = begin
            right = middle
            for to in range(begin, end):
                if left < middle and (right >= end or values[order[left]] >= values[order[right]]):
                    merged[to] = order[left]
                    left += 1
                else:
                    merged[to] = order[right]
                    right += 1
        order, merged = merged, order
        run *= 2
    return order
