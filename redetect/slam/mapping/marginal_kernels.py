"""Those entries of a sparse matrix's inverse that lie in its Cholesky factor's pattern."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def filled_pattern(indptr: IntArray, indices: IntArray) -> tuple[IntArray, IntArray]:
    """Pattern of the Cholesky factor of a symmetric matrix.

    Parameters
    ----------
    indptr, indices : int64 arrays
        The matrix by columns (or rows: it is symmetric).

    Returns
    -------
    indptr, indices : int64 arrays
        Strictly lower triangle by columns, rows ascending.
    """
    n = len(indptr) - 1
    first_child = np.full(n, -1, dtype=np.int64)
    next_child = np.full(n, -1, dtype=np.int64)
    mark = np.full(n, -1, dtype=np.int64)
    start = np.zeros(n + 1, dtype=np.int64)
    rows = np.empty(4 * len(indices) + n, dtype=np.int64)
    for j in range(n):
        count = start[j]
        if count + n > len(rows):
            larger = np.empty(2 * len(rows) + n, dtype=np.int64)
            larger[:count] = rows[:count]
            rows = larger
        mark[j] = j
        for at in range(indptr[j], indptr[j + 1]):
            i = indices[at]
            if i > j and mark[i] != j:
                mark[i] = j
                rows[count] = i
                count += 1
        child = first_child[j]
        while child >= 0:
            for at in range(start[child], start[child + 1]):
                i = rows[at]
                if mark[i] != j:
                    mark[i] = j
                    rows[count] = i
                    count += 1
            child = next_child[child]
        start[j + 1] = count
        rows[start[j] : count].sort()
        if count > start[j]:
            parent = rows[start[j]]
            next_child[j] = first_child[parent]
            first_child[parent] = j
    return start, rows[: start[n]].copy()


@njit(cache=True, error_model="numpy")
def selected_inverse(
    indptr: IntArray, indices: IntArray, lower: FloatArray, diagonal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Entries of the inverse of ``L D L^T`` in the pattern of L (Takahashi's equations).

    Parameters
    ----------
    indptr, indices : int64 arrays
        Pattern of L below its diagonal, see `filled_pattern`.
    lower : float64 array
        Values of L there; its diagonal is 1.
    diagonal : (n,) float64
        D.

    Returns
    -------
    below : float64 array
        The inverse's entries in the same pattern.
    on_diagonal : (n,) float64

    Notes
    -----
    K. Takahashi, J. Fagan, M.-S. Chin, Formation of a sparse bus impedance matrix and its
    application to short circuit study, PICA 1973.
    """
    n = len(diagonal)
    below = np.zeros(len(lower))
    on_diagonal = np.zeros(n)
    place = np.full(n, -1, dtype=np.int64)
    sums = np.zeros(n)
    for j in range(n - 1, -1, -1):
        first, last = indptr[j], indptr[j + 1]
        for at in range(first, last):
            place[indices[at]] = at
            sums[at - first] = 0.0
        for at in range(first, last):
            k = indices[at]
            sums[at - first] += on_diagonal[k] * lower[at]
            for other in range(indptr[k], indptr[k + 1]):
                here = place[indices[other]]
                if here >= 0:
                    sums[here - first] += below[other] * lower[at]
                    sums[at - first] += below[other] * lower[here]
        variance = 1.0 / diagonal[j]
        for at in range(first, last):
            below[at] = -sums[at - first]
            variance -= lower[at] * below[at]
            place[indices[at]] = -1
        on_diagonal[j] = variance
    return below, on_diagonal
