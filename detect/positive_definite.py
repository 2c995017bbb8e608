"""Compiled solution of small positive definite systems, which detects indefinite ones.

With NumPy's functions, Numba looks up LAPACK at the first call, which is not safe to interrupt.
"""

from __future__ import annotations

import math

import numpy as np

from redetect.array_types import FloatArray
from redetect.compiled import kernel

#: A pivot below this share of its diagonal entry counts as zero.
_LEAST_PIVOT = 1e-13


@kernel()
def solve_positive(matrix: FloatArray, right: FloatArray, solution: FloatArray) -> bool:
    """Solve matrix @ solution = right for a positive definite matrix; False if it is not one."""
    n = matrix.shape[0]
    lower = np.empty_like(matrix)  # Cholesky's factor
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = total / lower[j, j]
            elif total > _LEAST_PIVOT * abs(matrix[i, i]):
                lower[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * solution[k]
        solution[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = solution[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * solution[k]
        solution[i] = total / lower[i, i]
        if not math.isfinite(solution[i]):
            return False
    return True


@kernel()
def invert_positive(matrix: FloatArray, inverse: FloatArray) -> bool:
    """Inverse of a positive definite matrix; False if it is not one."""
    n = matrix.shape[0]
    unit, column = np.zeros(n), np.empty(n)
    for j in range(n):
        unit[:] = 0.0
        unit[j] = 1.0
        if not solve_positive(matrix, unit, column):
            return False
        for i in range(n):  # an assignment to the slice would compile five times as long
            inverse[i, j] = column[i]
    return True
