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

from detect.discs.model_kernels import (
    BY_BLUR,
    BY_RADIUS,
    BY_X,
    BY_Y,
    CAPACITY,
    F32,
    FASTMATH,
    SHARE,
)
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
    # In each loop as many sums as a processor has registers for: what is read is read for many.
    s00 = s01 = s02 = F32(0.0)
    s10 = s11 = s12 = F32(0.0)
    s20 = s21 = s22 = F32(0.0)
    s30 = s31 = s32 = F32(0.0)
    s40 = s41 = s42 = F32(0.0)
    for i in range(n):
        f0 = fields[SHARE * CAPACITY + i]
        f1 = fields[BY_BLUR * CAPACITY + i]
        f2 = fields[BY_RADIUS * CAPACITY + i]
        f3 = fields[BY_X * CAPACITY + i]
        f4 = fields[BY_Y * CAPACITY + i]
        t0 = terms[ONE * CAPACITY + i]
        t1 = terms[PLANE_X * CAPACITY + i]
        t2 = terms[PLANE_Y * CAPACITY + i]
        s00 += f0 * t0
        s01 += f0 * t1
        s02 += f0 * t2
        s10 += f1 * t0
        s11 += f1 * t1
        s12 += f1 * t2
        s20 += f2 * t0
        s21 += f2 * t1
        s22 += f2 * t2
        s30 += f3 * t0
        s31 += f3 * t1
        s32 += f3 * t2
        s40 += f4 * t0
        s41 += f4 * t1
        s42 += f4 * t2
    products[CONTRAST, 0] = s00
    products[CONTRAST, 1] = s01
    products[CONTRAST, 2] = s02
    products[LOG_BLUR, 0] = s10
    products[LOG_BLUR, 1] = s11
    products[LOG_BLUR, 2] = s12
    products[RADIUS, 0] = s20
    products[RADIUS, 1] = s21
    products[RADIUS, 2] = s22
    products[X, 0] = s30
    products[X, 1] = s31
    products[X, 2] = s32
    products[Y, 0] = s40
    products[Y, 1] = s41
    products[Y, 2] = s42
    s03 = s04 = s05 = F32(0.0)
    s13 = s14 = s15 = F32(0.0)
    s23 = s24 = s25 = F32(0.0)
    s33 = s34 = s35 = F32(0.0)
    s43 = s44 = s45 = F32(0.0)
    for i in range(n):
        f0 = fields[SHARE * CAPACITY + i]
        f1 = fields[BY_BLUR * CAPACITY + i]
        f2 = fields[BY_RADIUS * CAPACITY + i]
        f3 = fields[BY_X * CAPACITY + i]
        f4 = fields[BY_Y * CAPACITY + i]
        t3 = terms[SADDLE * CAPACITY + i]
        t4 = terms[SADDLE_XY * CAPACITY + i]
        t5 = terms[GREY * CAPACITY + i]
        s03 += f0 * t3
        s04 += f0 * t4
        s05 += f0 * t5
        s13 += f1 * t3
        s14 += f1 * t4
        s15 += f1 * t5
        s23 += f2 * t3
        s24 += f2 * t4
        s25 += f2 * t5
        s33 += f3 * t3
        s34 += f3 * t4
        s35 += f3 * t5
        s43 += f4 * t3
        s44 += f4 * t4
        s45 += f4 * t5
    products[CONTRAST, 3] = s03
    products[CONTRAST, 4] = s04
    products[GREYS, CONTRAST] = s05
    products[LOG_BLUR, 3] = s13
    products[LOG_BLUR, 4] = s14
    products[GREYS, LOG_BLUR] = s15
    products[RADIUS, 3] = s23
    products[RADIUS, 4] = s24
    products[GREYS, RADIUS] = s25
    products[X, 3] = s33
    products[X, 4] = s34
    products[GREYS, X] = s35
    products[Y, 3] = s43
    products[Y, 4] = s44
    products[GREYS, Y] = s45
    q00 = F32(0.0)
    q10 = q11 = F32(0.0)
    q20 = q21 = q22 = F32(0.0)
    q30 = q31 = q32 = q33 = F32(0.0)
    q40 = q41 = q42 = q43 = q44 = F32(0.0)
    for i in range(n):
        f0 = fields[SHARE * CAPACITY + i]
        f1 = fields[BY_BLUR * CAPACITY + i]
        f2 = fields[BY_RADIUS * CAPACITY + i]
        f3 = fields[BY_X * CAPACITY + i]
        f4 = fields[BY_Y * CAPACITY + i]
        q00 += f0 * f0
        q10 += f1 * f0
        q11 += f1 * f1
        q20 += f2 * f0
        q21 += f2 * f1
        q22 += f2 * f2
        q30 += f3 * f0
        q31 += f3 * f1
        q32 += f3 * f2
        q33 += f3 * f3
        q40 += f4 * f0
        q41 += f4 * f1
        q42 += f4 * f2
        q43 += f4 * f3
        q44 += f4 * f4
    products[CONTRAST, CONTRAST] = q00
    products[LOG_BLUR, CONTRAST] = q10
    products[LOG_BLUR, LOG_BLUR] = q11
    products[RADIUS, CONTRAST] = q20
    products[RADIUS, LOG_BLUR] = q21
    products[RADIUS, RADIUS] = q22
    products[X, CONTRAST] = q30
    products[X, LOG_BLUR] = q31
    products[X, RADIUS] = q32
    products[X, X] = q33
    products[Y, CONTRAST] = q40
    products[Y, LOG_BLUR] = q41
    products[Y, RADIUS] = q42
    products[Y, X] = q43
    products[Y, Y] = q44


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
