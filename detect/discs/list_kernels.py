"""Compiled loops that gather single pixels round a candidate: at the edge, or here and there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.fill_kernels import fill_list
from detect.discs.model_kernels import CAPACITY, F32, FASTMATH, PIXEL_VARIANCE
from detect.discs.patch_kernels import (
    LIST,
    NEAR,
    NEAR_PX,
    NEAR_RADII,
    FitSettings,
    Patch,
)
from detect.discs.vector_kernels import copy_pair, lowest_bit
from detect.uncounted import uncounted

#: Numba knows them as types, the type checker as functions.
_U8: Callable[[Any], Any] = np.uint8
_U32: Callable[[Any], Any] = np.uint32
_U64: Callable[[Any], Any] = np.uint64

#: What is called the edge: so many standard deviations of the blur on either side, and a bit.
_BAND = 2.5
_BAND_PX = 0.3

#: What a pixel is to a list, in bits: within reach, near enough to speak for a disc, at the edge.
_WITHIN, _NEARBY, _AT_EDGE = 1, 2, 4
#: Those bits in each of eight marks.
_EIGHT_WITHIN, _EIGHT_AT_EDGE = _U64(0x0101010101010101), _U64(0x0404040404040404)
_0, _1, _2, _3, _8 = _U64(0), _U64(1), _U64(2), _U64(3), _U64(8)
#: Rows are marked so many pixels at a time.
_AT_ONCE = 16


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _mark_row(
    floor: NDArray[np.float32],
    x0: float,
    y0: float,
    radius: float,
    limit: float,
    xu: float,
    yu: float,
    xv: float,
    yv: float,
    reach_2: float,
    blurs_2: float,
    ratio_2: float,
    band_u: float,
    band_v: float,
    marks: NDArray[np.uint8],
) -> None:
    """What the pixels of a piece of a row are, from the floor x, y, x, y ... that they see."""
    x_middle, y_middle, r_disc, r_limit = F32(x0), F32(y0), F32(radius), F32(limit)
    x_u, y_u, x_v, y_v = F32(xu), F32(yu), F32(xv), F32(yv)
    px, blurs_u, blurs_v = F32(reach_2), F32(blurs_2), F32(blurs_2 * ratio_2)
    edge_u, edge_v = F32(band_u), F32(band_v)
    near_px = F32(NEAR_PX * NEAR_PX)
    r_near = F32(NEAR_RADII * radius)
    for k in range(_U64(len(marks))):
        x = floor[_2 * k] - x_middle
        y = floor[_2 * k + _1] - y_middle
        r_2 = x * x + y * y
        r = math.sqrt(r_2)
        # Distances from the edge, and the floor's steps across it, times the radius.
        off = r_2 - r * r_disc
        off_2 = off * off
        gu = x_u * x + y_u * y
        gv = x_v * x + y_v * y
        gu = gu * gu
        gv = gv * gv
        per_px = gu + gv
        within = (r <= r_limit) | (off_2 <= px * per_px) | (off_2 <= blurs_u * gu + blurs_v * gv)
        near = (r <= r_near) | (off_2 <= near_px * per_px)
        # At the centre, where all is zero, there is no edge.
        edge = off_2 < edge_u * gu + edge_v * gv
        mark = _U8(_WITHIN) if within else _U8(0)
        mark = _U8(_WITHIN | _NEARBY) if near else mark
        marks[k] = _U8(_WITHIN | _NEARBY | _AT_EDGE) if edge else mark


@njit(cache=True, error_model="numpy", forceinline=True)
def floor_steps(
    floor_xy: NDArray[np.float32], u0: int, v0: int
) -> tuple[float, float, float, float]:
    """By how much the floor moves from pixel to pixel: x, y by u, and by v."""
    height, width = floor_xy.shape[:2]
    u = min(max(u0, 1), width - 2)
    v = min(max(v0, 1), height - 2)
    return (
        0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0]),
        0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1]),
        0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0]),
        0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1]),
    )


@uncounted
def gather_list(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    blur: float,
    settings: FitSettings,
    half_u: int,
    half_v: int,
    every: int,
    patch: Patch,
) -> int:
    """Collect pixels round a candidate whose blur is about `blur`; returns their number.

    Of those within the settings' reach all at the edge are taken, of the others every `every`-th.
    """
    height, width = image.shape
    index = patch.pixels
    marks = patch.marks
    words = patch.mark_words
    ratio = settings.blur_ratio
    variance_u = blur * blur + PIXEL_VARIANCE
    variance_v = blur * blur * ratio * ratio + PIXEL_VARIANCE
    # Along a row the pixels taken are `every` apart; from row to row they shift by a share of that
    # which never repeats soon.
    shift = max(1, int(0.381966 * every + 0.5))
    first_u = max(1, u0 - half_u)
    last_u = min(width - 2, u0 + half_u)
    first_v = max(1, v0 - half_v)
    last_v = min(height - 2, v0 + half_v)
    # The floor's steps change little over a patch: those of the middle decide who is near the edge.
    xu, yu, xv, yv = floor_steps(floor_xy, u0, v0)
    reach_2 = settings.reach_px * settings.reach_px
    blurs_2 = settings.reach_blurs * settings.reach_blurs * blur * blur
    band = (_BAND + _BAND_PX) * (_BAND + _BAND_PX)
    floor_line = floor_xy.reshape(-1)
    length = last_u - first_u + 1
    if length > CAPACITY - _AT_ONCE:
        return 0
    at_once = (length + _AT_ONCE - 1) // _AT_ONCE * _AT_ONCE
    all_of = _EIGHT_WITHIN if every == 1 else _EIGHT_AT_EDGE
    phase = (u0 - first_u + shift * (first_v - v0)) % every
    count = _0
    for v in range(first_v, last_v + 1):
        if count + _U64(length) > _U64(CAPACITY):
            break
        first = v * width + first_u
        # Pixels beyond the piece are in the next row.
        marked = min(at_once, height * width - first)
        _mark_row(
            floor_line[2 * first :], floor_xy[v0, u0, 0], floor_xy[v0, u0, 1], radius,
            settings.reach_radii * radius, xu, yu, xv, yv,
            reach_2, blurs_2, ratio * ratio, band * variance_u, band * variance_v,
            marks[:marked],
        )  # fmt: skip
        for k in range(_U64(length), _U64(at_once)):
            marks[k] = 0
        begin = _U64(first)
        for w in range(_U64(at_once) // _8):
            word = words[w] & all_of
            while word != 0:
                k = _8 * w + (lowest_bit(word) >> _3)
                word &= word - _1
                index[count] = begin + k
                index[_U64(CAPACITY) + count] = (marks[k] >> 1) & 1
                count += _1
        if every > 1:
            for k in range(phase, length, every):
                mark = marks[_U64(k)]
                index[count] = begin + _U64(k)
                index[_U64(CAPACITY) + count] = every if mark & _NEARBY else 0
                count += _1 if (mark & (_AT_EDGE | _WITHIN)) == _WITHIN else _0
            phase = (phase + shift) % every
    n = int(np.int64(count))
    fill_list(image, floor_xy, u0, v0, radius, LIST, n, patch)
    return n


@uncounted
def gather_sparse(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    settings: FitSettings,
    half_u: int,
    half_v: int,
    every: int,
    shape: int,
    patch: Patch,
) -> int:
    """Collect every `every`-th of the pixels round a candidate; returns their number.

    The `shape` says whether they get the geometry for `edge_shares` (LIST) or for `chord_shares`.
    """
    height, width = image.shape
    index = patch.pixels
    floor_line = floor_xy.reshape(-1)
    shift = max(1, int(0.381966 * every + 0.5))
    first_u = max(1, u0 - half_u)
    last_u = min(width - 2, u0 + half_u)
    first_v = max(1, v0 - half_v)
    last_v = min(height - 2, v0 + half_v)
    most_in_row = _U64((last_u - first_u) // every + 1)
    count = _0
    phase = (u0 - first_u + shift * (first_v - v0)) % every
    seen = patch.floor
    step = _U64(every)
    for v in range(first_v, last_v + 1):
        if count + most_in_row > _U64(CAPACITY):
            break
        pixel = _U64(v * width + first_u + phase)
        last = _U64(v * width + last_u)
        # In all rows as often, which a processor foresees; what is beyond a row is overwritten.
        for _ in range(most_in_row):
            index[count] = pixel
            copy_pair(floor_line, _2 * pixel, seen, _2 * count)
            count += _1 if pixel <= last else _0
            pixel += step
        phase += shift
        phase -= every if phase >= every else 0
    wanted = patch.terms[NEAR * CAPACITY :]
    xu, yu, xv, yv = floor_steps(floor_xy, u0, v0)
    _weigh(
        seen, int(np.int64(count)), floor_xy[v0, u0, 0], floor_xy[v0, u0, 1], radius,
        settings.reach_radii * radius, xu, yu, xv, yv, settings.reach_px * settings.reach_px,
        float(every), patch.terms,
    )  # fmt: skip
    kept = _0
    for i in range(count):
        weight = wanted[i]
        index[kept] = index[i]
        index[_U64(CAPACITY) + kept] = _U32(max(weight, F32(0.0)))
        kept += _1 if weight >= F32(0.0) else _0
    n = int(np.int64(kept))
    fill_list(image, floor_xy, u0, v0, radius, shape, n, patch)
    return n


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _weigh(
    floor: NDArray[np.float32],
    n: int,
    x0: float,
    y0: float,
    radius: float,
    limit: float,
    xu: float,
    yu: float,
    xv: float,
    yv: float,
    reach_2: float,
    weight: float,
    terms: NDArray[np.float32],
) -> None:
    """What n places (x, y) on the floor stand for: -1 beyond reach, 0 too far from the disc."""
    x_middle, y_middle, r_disc, r_limit = F32(x0), F32(y0), F32(radius), F32(limit)
    x_u, y_u, x_v, y_v, px = F32(xu), F32(yu), F32(xv), F32(yv), F32(reach_2)
    near_px = F32(NEAR_PX * NEAR_PX)
    r_near, each = F32(NEAR_RADII * radius), F32(weight)
    for i in range(_U64(n)):
        x = floor[_2 * i] - x_middle
        y = floor[_2 * i + _1] - y_middle
        r_2 = x * x + y * y
        r = math.sqrt(r_2)
        off = r_2 - r * r_disc
        off_2 = off * off
        gu = x_u * x + y_u * y
        gv = x_v * x + y_v * y
        per_px = gu * gu + gv * gv
        what = F32(0.0) if (r <= r_limit) | (off_2 <= px * per_px) else F32(-1.0)
        near = (r <= r_near) | (off_2 <= near_px * per_px)
        terms[_U64(NEAR * CAPACITY) + i] = each if near else what
