"""One compiled kernel, for the tests of where kernels are kept."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True)
def doubled(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the numbers."""
    result = np.empty_like(numbers)
    for i in range(len(numbers)):
        result[i] = 2.0 * numbers[i]
    return result
