"""Compiled access to a symmetric matrix of which only the lower triangle is kept."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def symmetric_columns(lower: FloatArray, size: int, index: IntArray, columns: FloatArray) -> None:
    """Copy columns of a symmetric matrix.

    Takes `index` (k,), `columns` (size, k).
    """
    for k in range(len(index)):
        c = index[k]
        for j in range(c):
            columns[j, k] = lower[c, j]
        for j in range(c, size):
            columns[j, k] = lower[j, c]


@njit(cache=True, error_model="numpy")
def set_symmetric_rows(lower: FloatArray, size: int, first: int, rows: FloatArray) -> None:
    """Overwrite adjacent rows (and so columns) of a symmetric matrix.

    Takes `rows` (k, size).
    """
    for k in range(len(rows)):
        r = first + k
        for j in range(r + 1):
            lower[r, j] = rows[k, j]
        for j in range(r + 1, size):
            lower[j, r] = rows[k, j]


@njit(cache=True, error_model="numpy")
def symmetric_block(lower: FloatArray, index: IntArray) -> FloatArray:
    """Rows and columns of a symmetric matrix.

    Takes `index` (k,); returns (k, k).
    """
    count = len(index)
    block = np.empty((count, count))
    for i in range(count):
        for j in range(i + 1):
            a, b = index[i], index[j]
            value = lower[a, b] if a >= b else lower[b, a]
            block[i, j] = value
            block[j, i] = value
    return block
