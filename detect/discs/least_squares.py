"""Least squares of the disc fit: normal equations of a patch, and what the residuals say.

The unknowns of one Gauss-Newton step are in the order of the design matrix's rows: the five terms
of the background, the contrast, and the contrast times the steps of log blur, radius, x and y. The
grey value comes last. So one Cholesky factor of all sums of products gives, row by row, what is
left of the grey values' squares without a disc, with the disc where it is, and after the step.

Residuals are the grey values less the fitted model's. Where the model does not fit they are
correlated, and neighbours say less than their number: `correlated_area`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.discs.model import (
    BY_BLUR,
    BY_RADIUS,
    BY_X,
    BY_Y,
    F32,
    FASTMATH,
    GREY,
    PIXEL_VARIANCE,
    ROWS,
    SHARE,
    Blur,
    Disc,
)
from redetect.compiled import kernel

#: Terms of the background, and unknowns of a step.
BACKGROUND, UNKNOWNS = 5, 10

FloatArray = NDArray[np.float64]


@kernel(forceinline=True, fastmath=FASTMATH)
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


@kernel(forceinline=True, fastmath=FASTMATH)
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


@kernel(forceinline=True)
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


@kernel(forceinline=True)
def left_over(products: FloatArray, factor: FloatArray, unknowns: int) -> float:
    """The sum of the squared residuals with the first unknowns, however many."""
    left = products[GREY, GREY]
    for k in range(unknowns):
        left -= factor[GREY, k] * factor[GREY, k]
    return max(float(left), 0.0)


@kernel(forceinline=True)
def solution(factor: FloatArray, begin: int, end: int, values: FloatArray) -> None:
    """Unknowns `begin` to `end` of the least-squares solution with the first `end` unknowns."""
    for i in range(end - 1, begin - 1, -1):
        s = factor[GREY, i]
        for k in range(i + 1, end):
            s -= factor[k, i] * values[k]
        values[i] = s * factor[i, i]


@kernel(forceinline=True, fastmath=FASTMATH)
def residuals(
    patch: Any, n: int, values: NDArray[np.float64], bare: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Residuals of a fit of n pixels with (10,) `values`, into the patch.

    `bare` (5,) is the background where there is no disc. Returns sums of squares: of the residuals,
    of those near the disc, and of what a background alone leaves there.
    """
    design, residual, without = patch.design, patch.residual, patch.row
    for i in range(n):
        residual[i] = without[i] = design[GREY, i]
    for row in range(UNKNOWNS):
        value = F32(values[row])
        for i in range(n):
            residual[i] -= value * design[row, i]
    for row in range(BACKGROUND):
        value = F32(bare[row])
        for i in range(n):
            without[i] -= value * design[row, i]
    total = near = near_total = F32(0.0)
    for i in range(n):
        total += residual[i] * residual[i]
        near += patch.weight[i] * residual[i] * residual[i]
        near_total += patch.weight[i] * without[i] * without[i]
    return total, near, near_total


@kernel(forceinline=True, fastmath=FASTMATH)
def correlated_area(patch: Any, n: int) -> float:
    """How many pixels go with one independent residual, from the correlation of neighbours.

    White noise gives 1. Where the model does not fit (texture, reflections, a disc that is none)
    the residuals are correlated, and their number overstates their information: for a first-order
    process of correlation c by (1 + c) / (1 - c) in either direction.
    """
    product = square = pairs = F32(0.0)
    for i in range(1, n):
        linked = F32(1.0) if patch.pixel[i] == patch.pixel[i - 1] + np.uint32(1) else F32(0.0)
        here, before = patch.residual[i], patch.residual[i - 1]
        product += linked * here * before
        square += linked * (here * here + before * before)
        pairs += linked
    if not square > 0.0:
        return 1.0
    # By chance alone the correlation of n residuals scatters by 1 / sqrt(n).
    correlation = min(max(2.0 * product / square - 1.5 / math.sqrt(pairs), 0.0), 0.8)
    area: float = ((1.0 + correlation) / (1.0 - correlation)) ** 2
    return area


@kernel(forceinline=True, fastmath=FASTMATH)
def blur_width(patch: Any, n: int, disc: Disc, blur: Blur) -> float:
    """Mean width of the blur, of optics and pixel, across the edge, in nominal radii."""
    x0, y0, most = F32(disc.x), F32(disc.y), F32(2.5)
    variance_1 = F32(blur.first * blur.first + PIXEL_VARIANCE)
    variance_2 = F32(blur.second * blur.second + PIXEL_VARIANCE)
    widths = weights = F32(0.0)
    for i in range(n):
        x, y = patch.x[i] - x0, patch.y[i] - y0
        g1 = patch.x1[i] * x + patch.y1[i] * y
        g2 = patch.x2[i] * x + patch.y2[i] * y
        r_2 = x * x + y * y + F32(1e-12)
        width = math.sqrt((variance_1 * g1 * g1 + variance_2 * g2 * g2) / r_2)
        weight = abs(patch.design[BY_RADIUS, i])
        widths += weight * min(width, most)
        weights += weight
    mean: float = widths / max(weights, F32(1e-12))
    return mean
