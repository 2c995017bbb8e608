"""The noise of an image."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: With fewer pixels than this that are neither black nor saturated, all count for the noise.
_LEAST_COUNTABLE = 100
#: Grey values that count lie between these.
_DARK, _LIGHT = 2, 253
#: The mask's absolute coefficients add up to 16, so no response is larger.
_MOST_RESPONSE = 16 * 255


def estimate_noise(image: NDArray[np.uint8], most_rows: int | None = None) -> float:
    """Standard deviation of an image's noise, grey levels; 0 for less than 3 rows or columns.

    The median absolute response, in at most `most_rows` rows, to the second difference in both
    directions, which sees neither planes nor straight edges (after Immerkaer, "Fast noise variance
    estimation", 1996); black and saturated pixels do not count.
    """
    height, width = image.shape
    if min(height, width) < 3:
        return 0.0
    rows = np.arange(1, height - 1)
    if most_rows is not None and most_rows < len(rows):
        rows = rows[np.arange(most_rows) * (len(rows) - 1) // (most_rows - 1)]
    # The mask's coefficients have a sum of squares of 36; 0.6745 makes a median a deviation.
    return _median_response(image, rows) / 0.6745 / 6.0


@njit(cache=True, error_model="numpy", nogil=True)
def _median_response(image: NDArray[np.uint8], rows: NDArray[np.int64]) -> float:
    """Median of the absolute responses in some rows, by their histogram."""
    width = image.shape[1]
    bend, response = np.empty(width, np.int32), np.empty(width, np.int32)
    # Of the pixels that count, and then of the others.
    histogram = np.zeros(2 * (_MOST_RESPONSE + 1), np.int32)
    for v in rows:
        above, here, below = image[v - 1], image[v], image[v + 1]
        for u in range(width):
            bend[u] = np.int32(above[u]) + np.int32(below[u]) - 2 * np.int32(here[u])
        for u in range(1, width - 1):
            counts = (here[u] > _DARK) & (here[u] < _LIGHT)
            response[u] = abs(bend[u - 1] - 2 * bend[u] + bend[u + 1])
            response[u] += 0 if counts else _MOST_RESPONSE + 1
        for u in range(1, width - 1):
            histogram[response[u]] += 1
    count = 0
    for k in range(_MOST_RESPONSE + 1):
        count += histogram[k]
    if count < _LEAST_COUNTABLE:
        for k in range(_MOST_RESPONSE + 1):
            histogram[k] += histogram[k + _MOST_RESPONSE + 1]
            count += histogram[k + _MOST_RESPONSE + 1]
    # The two in the middle, or twice the one.
    total = 0.0
    for rank in ((count - 1) // 2, count // 2):
        k, seen = 0, histogram[0]
        while seen <= rank:
            k += 1
            seen += histogram[k]
        total += 0.5 * k
    return total
