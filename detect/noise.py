"""The noise of an image."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from detect.noise_kernels import median_response

#: With fewer pixels than this that are neither black nor saturated, all count for the noise.
_LEAST_COUNTABLE = 100


def estimate_noise(image: NDArray[np.uint8], most_rows: int | None = None) -> float:
    """Standard deviation of an image's noise, grey levels.

    The median absolute response to the second difference in both directions, which sees neither
    planes nor straight edges (after Immerkaer, "Fast noise variance estimation", 1996); black and
    saturated pixels do not count.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    most_rows : int, optional
        Use at most this many rows, evenly spread; by default all.

    Returns
    -------
    float
        0 for images of less than 3 rows or columns.
    """
    height, width = image.shape
    if min(height, width) < 3:
        return 0.0
    rows = _rows(height, most_rows)
    response = np.empty(len(rows) * (width - 2), np.int16)
    # The mask's coefficients have a sum of squares of 36; 0.6745 makes a median a deviation.
    return median_response(image, rows, _LEAST_COUNTABLE, response) / 0.6745 / 6.0


@lru_cache(maxsize=8)
def _rows(height: int, most_rows: int | None) -> NDArray[np.intp]:
    """The rows to use."""
    if most_rows is None:
        rows = np.arange(1, height - 1)
    else:
        rows = np.unique(np.linspace(1, height - 2, most_rows).astype(np.intp))
    return rows
