"""What share of a disc that is seen flat a pixel sees: its blurred chords, with derivatives.

See `detect.discs.model_kernels`.
"""

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
    CHORD_X,
    CHORD_Y,
    F32,
    FAR,
    FASTMATH,
    GROWTH,
    PER_LENGTH,
    PER_STEP_ACROSS,
    PER_STEP_ALONG,
    PIXEL_VARIANCE,
    SHARE,
    normal,
)

#: Pixels that are computed, or left out, at once: two words of marks.
BLOCK = 16

#: Numba knows it as the type, the type checker as a function.
_U8: Callable[[Any], Any] = np.uint8
_0, _1, _HALF = F32(0.0), F32(1.0), F32(0.5)
# asin(x) = pi / 2 - sqrt(1 - x) * polynomial(x) for x from 0 to 1 (Abramowitz and Stegun, 4.4.45).
_A0, _A1, _A2, _A3 = F32(1.5707288), F32(-0.2121144), F32(0.0742610), F32(-0.0187293)
_HALF_PI = F32(0.5 * math.pi)
_S3, _S5, _S7, _S9 = F32(-1 / 6), F32(1 / 120), F32(-1 / 5040), F32(1 / 362880)
_C2, _C4, _C6, _C8 = F32(-1 / 2), F32(1 / 24), F32(-1 / 720), F32(1 / 40320)
_C10 = F32(-1 / 3628800)
#: The two nodes of the Gauss-Legendre quadrature, each of weight one half of the interval.
_NODE = F32(0.5 / math.sqrt(3.0))
_MOST_BEND = F32(0.7)


@njit(cache=True, error_model="numpy", inline="always", fastmath=FASTMATH)
def _arcsine(x: float) -> float:
    """Arc sine of x, which is cut to [-1, 1], within 7e-5."""
    a = min(abs(x), _1)
    angle: float = _HALF_PI - math.sqrt(_1 - a) * (_A0 + a * (_A1 + a * (_A2 + a * _A3)))
    signed: float = angle if x > _0 else -angle
    return signed


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _mark_near(
    geometry: NDArray[np.float32],
    n: int,
    x0: float,
    y0: float,
    r0: float,
    per_sigma: float,
    aside_px: float,
    seen: NDArray[np.uint8],
) -> None:
    """Which pixels may see something of the disc: where nothing else than 0 is to be expected."""
    for i in range(np.uint64(n)):
        x = geometry[CHORD_X * CAPACITY + i] - x0
        y = geometry[CHORD_Y * CAPACITY + i] - y0
        across = x * geometry[ACROSS_X * CAPACITY + i] + y * geometry[ACROSS_Y * CAPACITY + i]
        along = x * geometry[ALONG_X * CAPACITY + i] + y * geometry[ALONG_Y * CAPACITY + i]
        beside = abs(across) - aside_px * abs(geometry[PER_STEP_ACROSS * CAPACITY + i])
        # Steps from the nearest end of the chords.
        d = abs(along) - aside_px * abs(geometry[PER_STEP_ALONG * CAPACITY + i])
        d = max(d - r0 * geometry[PER_LENGTH * CAPACITY + i], _0)
        bend = min(abs(geometry[GROWTH * CAPACITY + i]) * d, _MOST_BEND)
        z = d * (_1 - _HALF * bend) * per_sigma
        seen[i] = _U8(1) if (beside < r0) & (z < FAR) else _U8(0)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def chord_shares(
    geometry: NDArray[np.float32],
    n: int,
    x_centre: float,
    y_centre: float,
    radius: float,
    blur_along: float,
    width: float,
    everywhere: bool,
    fields: NDArray[np.float32],
    seen: NDArray[np.uint8],
    words: NDArray[np.uint64],
) -> tuple[int, int]:
    """W of pixels that are blurred along the steep axis and `width` pixels wide across it.

    The number of pixels, n, is a multiple of `BLOCK`. Those that may see something of the disc are
    marked in `seen`, of which `words` are the same memory; blocks without any are 0 throughout. If
    the disc is seen `everywhere` in the patch, all are computed. Returns where the blocks that are
    not 0 begin and end.

    Across, the pixel's width is integrated in the chords' angle theta (a chord at distance
    R sin(theta) from the centre has the half length R cos(theta)), in which also the disc's tips
    are smooth. What the optics blur across is left to `blur_across`, or
    to a width of the same variance.
    """
    x0, y0, r0 = F32(x_centre), F32(y_centre), F32(radius)
    per_r0 = _1 / r0
    variance = F32(blur_along * blur_along + PIXEL_VARIANCE)
    per_sigma = _1 / math.sqrt(variance)
    optics = F32(blur_along * blur_along) / variance
    pixels = F32(width)
    if everywhere:
        seen[:n] = 1
    else:
        _mark_near(geometry, n, x0, y0, r0, per_sigma, F32(0.5 * width), seen)
    for block in range(n // BLOCK):
        if words[2 * block] | words[2 * block + 1] == 0:
            begin = block * BLOCK
            for i in range(begin, begin + BLOCK):
                fields[SHARE * CAPACITY + i] = _0
                fields[BY_BLUR * CAPACITY + i] = _0
                fields[BY_RADIUS * CAPACITY + i] = _0
                fields[BY_X * CAPACITY + i] = _0
                fields[BY_Y * CAPACITY + i] = _0
    seen_begin, seen_end = n, 0
    for block in range(n // BLOCK):
        if words[2 * block] | words[2 * block + 1] == 0:
            continue
        begin = block * BLOCK
        seen_begin = min(seen_begin, begin)
        seen_end = begin + BLOCK
        for i in range(begin, begin + BLOCK):
            x = geometry[CHORD_X * CAPACITY + i] - x0
            y = geometry[CHORD_Y * CAPACITY + i] - y0
            along_x = geometry[ALONG_X * CAPACITY + i]
            along_y = geometry[ALONG_Y * CAPACITY + i]
            across_x = geometry[ACROSS_X * CAPACITY + i]
            across_y = geometry[ACROSS_Y * CAPACITY + i]
            per_length = geometry[PER_LENGTH * CAPACITY + i]
            across = x * across_x + y * across_y
            along = x * along_x + y * along_y
            step = geometry[PER_STEP_ACROSS * CAPACITY + i]
            slant = geometry[PER_STEP_ALONG * CAPACITY + i] / step
            step *= pixels
            first = _arcsine((across - _HALF * step) * per_r0)
            last = _arcsine((across + _HALF * step) * per_r0)
            middle = _HALF * (first + last)
            aside = _NODE * (last - first)
            # Of each node: half of the interval's length, over the pixel's width.
            weight = _HALF * (last - first) * r0 / step
            growth = geometry[GROWTH * CAPACITY + i]
            w = _0
            d_blur = _0
            d_along = _0
            d_across = _0
            d_radius = _0
            for node in range(2):
                theta = middle + aside if node == 1 else middle - aside
                square = theta * theta
                sine = theta * (
                    _1 + square * (_S3 + square * (_S5 + square * (_S7 + square * _S9)))
                )
                cosine = _1 + square * (
                    _C2 + square * (_C4 + square * (_C6 + square * (_C8 + square * _C10)))
                )
                half = r0 * cosine * per_length
                centre = (r0 * sine - across) * slant - along
                for end in range(2):
                    d = centre + half if end == 1 else centre - half
                    bend = min(max(growth * d, -_MOST_BEND), _MOST_BEND)
                    z = d * (_1 - _HALF * bend) * per_sigma
                    density, below = normal(z)
                    sign = _1 if end == 1 else -_1
                    w += sign * cosine * below
                    d_blur -= sign * cosine * density * z
                    # The end of the chord at distance rho moves by -rho / sqrt(R^2 - rho^2) = -tan.
                    per_d = density * (_1 - bend)
                    d_along += sign * cosine * per_d
                    d_across += sine * per_d
                    d_radius += per_d
            per_d = weight * per_sigma
            d_across *= per_d * per_length
            d_along *= per_d
            fields[SHARE * CAPACITY + i] = weight * w
            fields[BY_BLUR * CAPACITY + i] = weight * d_blur * optics
            fields[BY_RADIUS * CAPACITY + i] = per_d * per_length * d_radius
            fields[BY_X * CAPACITY + i] = d_along * along_x + d_across * across_x
            fields[BY_Y * CAPACITY + i] = d_along * along_y + d_across * across_y
    return seen_begin, seen_end
