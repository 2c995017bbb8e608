"""Compiled loops over a fitted disc's residuals: do they hang together, is the outline even?"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model_kernels import (
    ACROSS_X,
    ACROSS_Y,
    ALONG_X,
    ALONG_Y,
    BY_BLUR,
    BY_RADIUS,
    BY_X,
    BY_Y,
    CAPACITY,
    EDGE_XU,
    EDGE_XV,
    EDGE_YU,
    EDGE_YV,
    F32,
    FASTMATH,
    PER_LENGTH,
    PER_STEP_ACROSS,
    PER_STEP_ALONG,
    SHARE,
)
from detect.discs.patch_kernels import (
    GREY,
    LINKED,
    NEAR,
    ONE,
    PLANE_X,
    PLANE_Y,
    SADDLE,
    SADDLE_XY,
)
from detect.discs.sector_code import COPIES, PIXELS, SUMS, add_by_sector

_SECTORS = 16
#: Pixels that the middle of a disc must have to be looked at.
_LEAST_MIDDLE = 2.0
#: Sums of the sectors, of what is in none, and of what only fills up.
_ROWS = _SECTORS + 2
_FILLING = _SECTORS + 1
SECTOR_SUMS = COPIES * _ROWS * SUMS
#: Numba knows it as the type, the type checker as a function.
_I32: Callable[[Any], Any] = np.int32
# Where the sectors of a quadrant meet.
_TAN_1 = math.tan(math.pi / 8.0)
_TAN_3 = math.tan(3.0 * math.pi / 8.0)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def residuals(
    terms: NDArray[np.float32],
    fields: NDArray[np.float32],
    n: int,
    values: NDArray[np.float64],
    bare: NDArray[np.float64],
    errors: NDArray[np.float32],
) -> tuple[float, float, float]:
    """Residuals of a fit, into `errors`.

    Parameters
    ----------
    values : (10,) float64
        The unknowns of `detect.discs.normal_kernels`.
    bare : (5,) float64
        The terms of the background where there is no disc.

    Returns
    -------
    residual, near_residual, near_total : float
        Sums of squares: of the residuals, of those near the disc, and of what a background alone
        leaves there.
    """
    b0, b1, b2, b3, b4 = (
        F32(values[0]),
        F32(values[1]),
        F32(values[2]),
        F32(values[3]),
        F32(values[4]),
    )
    a0, a1, a2, a3, a4 = F32(bare[0]), F32(bare[1]), F32(bare[2]), F32(bare[3]), F32(bare[4])
    c, d_blur, d_radius = F32(values[5]), F32(values[6]), F32(values[7])
    d_x, d_y = F32(values[8]), F32(values[9])
    # The sums have a loop of their own: a loop that stores, too, exists twice in the machine code,
    # and where the arrays lie in memory would decide in which order it adds.
    for i in range(n):
        errors[i] = (
            terms[GREY * CAPACITY + i]
            - (
                c * fields[SHARE * CAPACITY + i]
                + d_blur * fields[BY_BLUR * CAPACITY + i]
                + d_radius * fields[BY_RADIUS * CAPACITY + i]
                + d_x * fields[BY_X * CAPACITY + i]
                + d_y * fields[BY_Y * CAPACITY + i]
            )
            - (
                b0 * terms[ONE * CAPACITY + i]
                + b1 * terms[PLANE_X * CAPACITY + i]
                + b2 * terms[PLANE_Y * CAPACITY + i]
                + b3 * terms[SADDLE * CAPACITY + i]
                + b4 * terms[SADDLE_XY * CAPACITY + i]
            )
        )
    total = F32(0.0)
    near = F32(0.0)
    near_total = F32(0.0)
    for i in range(n):
        without = terms[GREY * CAPACITY + i] - (
            a0 * terms[ONE * CAPACITY + i]
            + a1 * terms[PLANE_X * CAPACITY + i]
            + a2 * terms[PLANE_Y * CAPACITY + i]
            + a3 * terms[SADDLE * CAPACITY + i]
            + a4 * terms[SADDLE_XY * CAPACITY + i]
        )
        weight = terms[NEAR * CAPACITY + i]
        total += errors[i] * errors[i]
        near += weight * errors[i] * errors[i]
        near_total += weight * without * without
    return total, near, near_total


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def correlated_area(terms: NDArray[np.float32], errors: NDArray[np.float32], n: int) -> float:
    """How many pixels go with one independent residual, from the correlation of neighbours.

    White noise gives 1. Where the model does not fit (texture, reflections, a disc that is none)
    the residuals hang together, and their number overstates what they tell: for a first-order
    process of correlation c by (1 + c) / (1 - c) in either direction.
    """
    product = F32(0.0)
    square = F32(0.0)
    pairs = F32(0.0)
    for i in range(1, n):
        linked = terms[LINKED * CAPACITY + i]
        here = errors[i]
        before = errors[i - 1]
        product += linked * here * before
        square += linked * (here * here + before * before)
        pairs += linked
    if not square > 0.0:
        return 1.0
    # By chance alone the correlation of n residuals scatters by 1 / sqrt(n).
    correlation = min(max(2.0 * product / square - 1.5 / math.sqrt(pairs), 0.0), 0.8)
    area: float = ((1.0 + correlation) / (1.0 - correlation)) ** 2
    return area


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def blur_widths(
    geometry: NDArray[np.float32],
    terms: NDArray[np.float32],
    fields: NDArray[np.float32],
    is_list: bool,
    n: int,
    x0: float,
    y0: float,
    sigma_1: float,
    sigma_2: float,
    widths: NDArray[np.float32],
) -> float:
    """Mean width of the blur across the edge, in nominal radii.

    `sigma_1` and `sigma_2` are the blur's deviations in pixels, along u and v for a list, along the
    lines and across them for a grid. `widths` is working space.
    """
    cx, cy = F32(x0), F32(y0)
    s1, s2 = F32(sigma_1 * sigma_1), F32(sigma_2 * sigma_2)
    if is_list:
        for i in range(n):
            x = terms[PLANE_X * CAPACITY + i] - cx
            y = terms[PLANE_Y * CAPACITY + i] - cy
            gu = geometry[EDGE_XU * CAPACITY + i] * x + geometry[EDGE_YU * CAPACITY + i] * y
            gv = geometry[EDGE_XV * CAPACITY + i] * x + geometry[EDGE_YV * CAPACITY + i] * y
            r_2 = x * x + y * y + F32(1e-12)
            widths[i] = math.sqrt((s1 * gu * gu + s2 * gv * gv) / r_2)
    else:
        for i in range(n):
            x = terms[PLANE_X * CAPACITY + i] - cx
            y = terms[PLANE_Y * CAPACITY + i] - cy
            per_length = geometry[PER_LENGTH * CAPACITY + i]
            steep_x = geometry[ALONG_X * CAPACITY + i] / (per_length * per_length)
            steep_y = geometry[ALONG_Y * CAPACITY + i] / (per_length * per_length)
            across = geometry[PER_STEP_ACROSS * CAPACITY + i]
            along = -geometry[PER_STEP_ALONG * CAPACITY + i]
            other_x = across * geometry[ACROSS_X * CAPACITY + i] + along * steep_x
            other_y = across * geometry[ACROSS_Y * CAPACITY + i] + along * steep_y
            g1 = other_x * x + other_y * y
            g2 = steep_x * x + steep_y * y
            r_2 = x * x + y * y + F32(1e-12)
            widths[i] = math.sqrt((s1 * g1 * g1 + s2 * g2 * g2) / r_2)
    blurs = F32(0.0)
    weights = F32(0.0)
    most = F32(2.5)
    for i in range(n):
        weight = abs(fields[BY_RADIUS * CAPACITY + i])
        blurs += weight * min(widths[i], most)
        weights += weight
    width: float = blurs / max(weights, F32(1e-12))
    return width


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _sectors(
    terms: NDArray[np.float32], n: int, x0: float, y0: float, inner: float, sector: NDArray[Any]
) -> None:
    """Which sector pixels are in; `_SECTORS` for those in the middle, and those not fitted."""
    cx, cy, r_2 = F32(x0), F32(y0), F32(inner)
    tan_1, tan_3 = F32(_TAN_1), F32(_TAN_3)
    for i in range(np.uint64(n)):
        x = terms[PLANE_X * CAPACITY + i] - cx
        y = terms[PLANE_Y * CAPACITY + i] - cy
        ax = abs(x)
        ay = abs(y)
        k = (
            (_I32(1) if ay > tan_1 * ax else _I32(0))
            + (_I32(1) if ay > ax else _I32(0))
            + (_I32(1) if ay > tan_3 * ax else _I32(0))
        )
        k = _I32(7) - k if x < F32(0.0) else k
        k = _I32(15) - k if y < F32(0.0) else k
        counts = (terms[ONE * CAPACITY + i] > F32(0.0)) & (x * x + y * y >= r_2)
        sector[i] = k if counts else _I32(_SECTORS)
    for i in range(n, (n + PIXELS - 1) // PIXELS * PIXELS):
        sector[i] = _FILLING


@njit(cache=True, error_model="numpy", forceinline=True)
def outline_statistics(
    terms: NDArray[np.float32],
    fields: NDArray[np.float32],
    errors: NDArray[np.float32],
    n: int,
    x0: float,
    y0: float,
    radius: float,
    contrast: float,
    sector: NDArray[np.uint32],
    sums: NDArray[np.float32],
) -> tuple[float, float, float, float]:
    """How evenly the edge goes round: in each sector its step and how far it is from the circle.

    The step is the regression of the grey values on the model's, relative to the whole disc's; the
    distance is the Gauss-Newton step of the radius from that sector's residuals alone. `sector`
    and `sums` are working space for `n` pixels, rounded up, and for `SECTOR_SUMS`.

    Returns
    -------
    step, good, deviation, middle : float
        Mean relative step, share of sectors whose step has the sign and 0.4 of the size of the
        disc's, root mean square distance in radii, and the step of the middle (the inner 0.3 of the
        radius) from the background, relative to the disc's: 1 where it has not two pixels.
    """
    _sectors(terms, n, x0, y0, 0.09 * radius * radius, sector)
    sums[:SECTOR_SUMS] = 0.0
    whole = (n + PIXELS - 1) // PIXELS * PIXELS
    add_by_sector(
        fields, SHARE * CAPACITY, BY_RADIUS * CAPACITY, errors, sector, whole, F32(contrast), sums,
        _ROWS,
    )  # fmt: skip
    for copy in range(_ROWS * SUMS, SECTOR_SUMS, _ROWS * SUMS):
        for k in range(_ROWS * SUMS):
            sums[k] += sums[copy + k]
    seen = 0
    steps = 0.0
    good = 0
    deviation = 0.0
    strongest = 0.0
    for k in range(_SECTORS):
        strongest = max(strongest, sums[SUMS * k + 6])
    for k in range(_SECTORS):
        first = SUMS * k
        pixels, shares, greys = float(sums[first]), float(sums[first + 1]), float(sums[first + 3])
        if pixels < 3.0:
            continue
        spread = sums[first + 2] - shares * shares / pixels
        if spread < 0.15:
            continue
        seen += 1
        relative = (sums[first + 4] - shares * greys / pixels) / spread / contrast
        steps += min(max(relative, -1.0), 1.0)
        if relative > 0.4:
            good += 1
        # Sectors with little edge in them say little about its place.
        offset = sums[first + 5] / (sums[first + 6] + 0.1 * strongest)
        deviation += min(offset * offset, 0.25)
    # Pixels that are not fitted are in there, too, with shares and grey values of nothing.
    middle = 1.0
    if sums[SUMS * _SECTORS + 1] >= _LEAST_MIDDLE:
        middle = float(sums[SUMS * _SECTORS + 3]) / float(sums[SUMS * _SECTORS + 1]) / contrast
    if seen == 0:
        return 0.0, 0.0, 0.0, middle
    return steps / seen, good / seen, math.sqrt(deviation / seen), middle
