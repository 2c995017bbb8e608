"""Compiled linear algebra of the disc fit: sums of products over a patch, and what follows.

The unknowns of one Gauss-Newton step stand in this order: the five terms of the background, the
contrast, and the contrast times the steps of log blur, radius, x and y. The grey value comes last.
So one Cholesky factor of all sums of products tells, row by row, what is left of the grey values'
squares without a disc, with the disc where it is, and after the step.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model_kernels import CAPACITY, F32, FASTMATH, FIELDS
from detect.discs.patch_kernels import GREY, ONE, PLANE_X, PLANE_Y, SADDLE, SADDLE_XY

#: Rows of the sums of products.
BACKGROUND = 5
CONTRAST, LOG_BLUR, RADIUS, X, Y, GREYS = range(5, 11)
UNKNOWNS = 10
ROWS = 11


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def background_products(terms: NDArray[np.float32], n: int, products: NDArray[np.float64]) -> None:
    """Sums of products of the background's terms and the grey values, over n pixels."""
    # All in one loop: each pixel is read once, and no sum waits for itself.
    s00 = F32(0.0)
    s10 = s11 = F32(0.0)
    s20 = s21 = s22 = F32(0.0)
    s30 = s31 = s32 = s33 = F32(0.0)
    s40 = s41 = s42 = s43 = s44 = F32(0.0)
    s50 = s51 = s52 = s53 = s54 = s55 = F32(0.0)
    for i in range(n):
        t0 = terms[ONE * CAPACITY + i]
        t1 = terms[PLANE_X * CAPACITY + i]
        t2 = terms[PLANE_Y * CAPACITY + i]
        t3 = terms[SADDLE * CAPACITY + i]
        t4 = terms[SADDLE_XY * CAPACITY + i]
        t5 = terms[GREY * CAPACITY + i]
        s00 += t0 * t0
        s10 += t1 * t0
        s11 += t1 * t1
        s20 += t2 * t0
        s21 += t2 * t1
        s22 += t2 * t2
        s30 += t3 * t0
        s31 += t3 * t1
        s32 += t3 * t2
        s33 += t3 * t3
        s40 += t4 * t0
        s41 += t4 * t1
        s42 += t4 * t2
        s43 += t4 * t3
        s44 += t4 * t4
        s50 += t5 * t0
        s51 += t5 * t1
        s52 += t5 * t2
        s53 += t5 * t3
        s54 += t5 * t4
        s55 += t5 * t5
    products[0, 0] = s00
    products[1, 0] = s10
    products[1, 1] = s11
    products[2, 0] = s20
    products[2, 1] = s21
    products[2, 2] = s22
    products[3, 0] = s30
    products[3, 1] = s31
    products[3, 2] = s32
    products[3, 3] = s33
    products[4, 0] = s40
    products[4, 1] = s41
    products[4, 2] = s42
    products[4, 3] = s43
    products[4, 4] = s44
    products[GREYS, 0] = s50
    products[GREYS, 1] = s51
    products[GREYS, 2] = s52
    products[GREYS, 3] = s53
    products[GREYS, 4] = s54
    products[GREYS, GREYS] = s55


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def disc_products(
    terms: NDArray[np.float32],
    fields: NDArray[np.float32],
    n: int,
    products: NDArray[np.float64],
) -> None:
    """Sums of products of the disc's fields with each other, the terms and the grey values."""
    for field in range(FIELDS):
        row = field * CAPACITY
        s0 = F32(0.0)
        s1 = F32(0.0)
        s2 = F32(0.0)
        s3 = F32(0.0)
        s4 = F32(0.0)
        s5 = F32(0.0)
        for i in range(n):
            value = fields[row + i]
            s0 += value * terms[ONE * CAPACITY + i]
            s1 += value * terms[PLANE_X * CAPACITY + i]
            s2 += value * terms[PLANE_Y * CAPACITY + i]
            s3 += value * terms[SADDLE * CAPACITY + i]
            s4 += value * terms[SADDLE_XY * CAPACITY + i]
            s5 += value * terms[GREY * CAPACITY + i]
        at = BACKGROUND + field
        products[at, 0] = s0
        products[at, 1] = s1
        products[at, 2] = s2
        products[at, 3] = s3
        products[at, 4] = s4
        products[GREYS, at] = s5
        s0 = F32(0.0)
        s1 = F32(0.0)
        s2 = F32(0.0)
        s3 = F32(0.0)
        s4 = F32(0.0)
        for i in range(n):
            value = fields[row + i]
            s0 += value * fields[i]
            s1 += value * fields[CAPACITY + i]
            s2 += value * fields[2 * CAPACITY + i]
            s3 += value * fields[3 * CAPACITY + i]
            s4 += value * fields[4 * CAPACITY + i]
        products[at, BACKGROUND] = s0
        if field >= 1:
            products[at, BACKGROUND + 1] = s1
        if field >= 2:
            products[at, BACKGROUND + 2] = s2
        if field >= 3:
            products[at, BACKGROUND + 3] = s3
        if field >= 4:
            products[at, BACKGROUND + 4] = s4


@njit(cache=True, error_model="numpy", forceinline=True)
def factor_rows(
    products: NDArray[np.float64], begin: int, end: int, factor: NDArray[np.float64]
) -> bool:
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
        s = products[GREYS, i]
        for k in range(i):
            s -= factor[GREYS, k] * factor[i, k]
        factor[GREYS, i] = s * factor[i, i]
    return True


@njit(cache=True, error_model="numpy", forceinline=True)
def left_over(products: NDArray[np.float64], factor: NDArray[np.float64], unknowns: int) -> float:
    """The sum of the squared residuals with so many of the unknowns."""
    s = products[GREYS, GREYS]
    for k in range(unknowns):
        s -= factor[GREYS, k] * factor[GREYS, k]
    return max(float(s), 0.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def solution(
    factor: NDArray[np.float64], begin: int, end: int, values: NDArray[np.float64]
) -> None:
    """Unknowns `begin` to `end` of the least-squares solution with the first `end` unknowns."""
    for i in range(end - 1, begin - 1, -1):
        s = factor[GREYS, i]
        for k in range(i + 1, end):
            s -= factor[k, i] * values[k]
        values[i] = s * factor[i, i]
