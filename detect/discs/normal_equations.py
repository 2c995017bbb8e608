"""The linear algebra of the disc fit: normal equations of a patch, and their Cholesky factor.

The unknowns of one Gauss-Newton step are in the order of the design matrix's rows: the five terms
of the background, the contrast, and the contrast times the steps of log blur, radius, x and y. The
grey value comes last. So one factor of all sums of products gives, row by row, what is left of the
grey values' squares without a disc, with the disc where it is, and after the step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model import BY_BLUR, BY_RADIUS, BY_X, BY_Y, F32, FASTMATH, GREY, ROWS, SHARE

#: Terms of the background, and unknowns of a step.
BACKGROUND, UNKNOWNS = 5, 10

FloatArray = NDArray[np.float64]


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def background_products(patch: Any, n: int, products: FloatArray) -> None:
    """Sums of products of the background's terms with each other and the grey values."""
    design = patch.design
    for i in range(BACKGROUND + 1):
        a = GREY if i == BACKGROUND else i
        for b in range(i + 1):
            c = GREY if b == BACKGROUND else b
            total = F32(0.0)
            for k in range(n):
                total += design[a, k] * design[c, k]
            products[a, c] = total


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def disc_products(patch: Any, n: int, products: FloatArray) -> None:
    """Sums of products of the disc's rows with all rows."""
    design = patch.design
    for row in range(ROWS):
        w = blur = radius = x = y = F32(0.0)
        for k in range(n):
            other = design[row, k]
            w += other * design[SHARE, k]
            blur += other * design[BY_BLUR, k]
            radius += other * design[BY_RADIUS, k]
            x += other * design[BY_X, k]
            y += other * design[BY_Y, k]
        for column, total in enumerate((w, blur, radius, x, y)):
            # Only what is below the diagonal is used.
            products[max(row, SHARE + column), min(row, SHARE + column)] = total


@njit(cache=True, error_model="numpy", forceinline=True)
def factor_rows(products: FloatArray, begin: int, end: int, factor: FloatArray) -> bool:
    """Rows `begin` to `end` of the Cholesky factor, and the row of the grey values as far.

    The diagonal is stored inverted. Returns False where the products are not positive definite.
    """
    for i in range(begin, end):
        for j in range(i):
            s = products[i, j]
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            factor[i, j] = s * factor[j, j]
        s = products[i, i]
        for k in range(i):
            s -= factor[i, k] * factor[i, k]
        if not s > 1e-7 * products[i, i]:
            return False
        factor[i, i] = 1.0 / math.sqrt(s)
        s = products[GREY, i]
        for k in range(i):
            s -= factor[GREY, k] * factor[i, k]
        factor[GREY, i] = s * factor[i, i]
    return True


@njit(cache=True, error_model="numpy", forceinline=True)
def left_over(products: FloatArray, factor: FloatArray, unknowns: int) -> float:
    """The sum of the squared residuals with the first unknowns, however many."""
    left = products[GREY, GREY]
    for k in range(unknowns):
        left -= factor[GREY, k] * factor[GREY, k]
    return max(float(left), 0.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def solution(factor: FloatArray, begin: int, end: int, values: FloatArray) -> None:
    """Unknowns `begin` to `end` of the least-squares solution with the first `end` unknowns."""
    for i in range(end - 1, begin - 1, -1):
        s = factor[GREY, i]
        for k in range(i + 1, end):
            s -= factor[k, i] * values[k]
        values[i] = s * factor[i, i]
