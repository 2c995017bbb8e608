"""Compiled loops that fetch what the table and the image say of a list's pixels.

Fetching, and computing with that, are loops of their own: only the latter work on several pixels
at a time. They take turns, so that what is fetched is still in the processor's nearest memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.grid_kernels import store_chord
from detect.discs.model_kernels import (
    CAPACITY,
    EDGE_X,
    EDGE_XU,
    EDGE_XV,
    EDGE_Y,
    EDGE_YU,
    EDGE_YV,
    F32,
    FASTMATH,
)
from detect.discs.patch_kernels import (
    COLUMNS,
    GREY,
    LINKED,
    LIST,
    NEAR,
    ONE,
    PLANE_X,
    PLANE_Y,
    SADDLE,
    SADDLE_XY,
    TERMS,
    WHOLE,
    Patch,
    padded,
)
from detect.discs.vector_kernels import copy_pair
from detect.uncounted import uncounted

#: Numba knows them as types, the type checker as functions.
_U32: Callable[[Any], Any] = np.uint32
_U64: Callable[[Any], Any] = np.uint64
_0, _1, _2 = _U64(0), _U64(1), _U64(2)
#: Where a pixel is that only fills up: far away, in nominal radii.
_NOWHERE = F32(1e3)

#: Pixels that are fetched at once, a multiple of `detect.discs.patch_kernels.WHOLE`.
_CHUNK = 256
#: Where the floor (x, y) at them is kept: at the pixels themselves, and at those before and after
#: them along two axes.
_OWN, _BEFORE_1, _AFTER_1, _BEFORE_2, _AFTER_2 = (_U64(2 * _CHUNK * k) for k in range(5))


@uncounted
def fill_list(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    shape: int,
    count: int,
    patch: Patch,
) -> None:
    """The terms and the geometry of the pixels in the patch's list.

    The `shape` says whether the geometry is that for `edge_shares` (LIST) or for `chord_shares`.
    """
    index = patch.pixels
    terms = patch.terms
    geometry = patch.geometry
    fetched = patch.floor
    grey = image.reshape(-1)
    middle = F32(image[v0, u0])
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    floor_line = floor_xy.reshape(-1)
    row = _U64(2 * floor_xy.shape[1])
    first, second = (_2, row) if shape in (LIST, COLUMNS) else (row, _2)
    if count == 0:
        return
    whole = padded(count)
    for i in range(count, whole):
        index[i] = index[count - 1]
    for begin in range(0, whole, _CHUNK):
        seen = min(whole - begin, _CHUNK)
        for k in range(_U64(seen)):
            i = _U64(begin) + k
            pixel = _U64(index[i])
            at = _2 * pixel
            to = _2 * k
            copy_pair(floor_line, at, fetched, _OWN + to)
            copy_pair(floor_line, at - first, fetched, _BEFORE_1 + to)
            copy_pair(floor_line, at + first, fetched, _AFTER_1 + to)
            copy_pair(floor_line, at - second, fetched, _BEFORE_2 + to)
            copy_pair(floor_line, at + second, fetched, _AFTER_2 + to)
            terms[_U64(GREY * CAPACITY) + i] = F32(grey[pixel])
        own = geometry[begin:]
        _finish_terms(
            seen, x0, y0, F32(1.0 / radius), middle, index[begin:], fetched, terms[begin:]
        )
        if shape == LIST:
            _edges(seen, x0, y0, radius, fetched, own)
        else:
            _chords(seen, x0, y0, radius, fetched, own)
    _link(count, index, terms)
    _take_out(whole - count, terms[whole - WHOLE :], geometry[whole - WHOLE :])


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _finish_terms(
    n: int,
    x0: float,
    y0: float,
    per_radius: float,
    middle: float,
    index: NDArray[np.uint32],
    fetched: NDArray[np.float32],
    terms: NDArray[np.float32],
) -> None:
    for i in range(_U64(n)):
        x = (fetched[_OWN + _2 * i] - x0) * per_radius
        y = (fetched[_OWN + _2 * i + _1] - y0) * per_radius
        terms[_U64(ONE * CAPACITY) + i] = F32(1.0)
        terms[_U64(PLANE_X * CAPACITY) + i] = x
        terms[_U64(PLANE_Y * CAPACITY) + i] = y
        terms[_U64(SADDLE * CAPACITY) + i] = x * x - y * y
        terms[_U64(SADDLE_XY * CAPACITY) + i] = x * y
        terms[_U64(GREY * CAPACITY) + i] -= middle
        terms[_U64(NEAR * CAPACITY) + i] = F32(index[_U64(CAPACITY) + i])


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _edges(
    n: int,
    x0: float,
    y0: float,
    radius: float,
    fetched: NDArray[np.float32],
    geometry: NDArray[np.float32],
) -> None:
    """The geometry for `edge_shares`; the first axis is u."""
    per_radius = F32(1.0 / radius)
    per_step = F32(0.5 / radius)
    for i in range(_U64(n)):
        x, y = _2 * i, _2 * i + _1
        geometry[_U64(EDGE_X * CAPACITY) + i] = (fetched[_OWN + x] - x0) * per_radius
        geometry[_U64(EDGE_Y * CAPACITY) + i] = (fetched[_OWN + y] - y0) * per_radius
        geometry[_U64(EDGE_XU * CAPACITY) + i] = per_step * (
            fetched[_AFTER_1 + x] - fetched[_BEFORE_1 + x]
        )
        geometry[_U64(EDGE_YU * CAPACITY) + i] = per_step * (
            fetched[_AFTER_1 + y] - fetched[_BEFORE_1 + y]
        )
        geometry[_U64(EDGE_XV * CAPACITY) + i] = per_step * (
            fetched[_AFTER_2 + x] - fetched[_BEFORE_2 + x]
        )
        geometry[_U64(EDGE_YV * CAPACITY) + i] = per_step * (
            fetched[_AFTER_2 + y] - fetched[_BEFORE_2 + y]
        )


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _chords(
    n: int,
    x0: float,
    y0: float,
    radius: float,
    fetched: NDArray[np.float32],
    geometry: NDArray[np.float32],
) -> None:
    """The geometry for `chord_shares`; the first axis is the steep one."""
    per_radius = F32(1.0 / radius)
    per_step = F32(0.5 / radius)
    half = F32(0.5)
    for i in range(_U64(n)):
        at_x, at_y = _2 * i, _2 * i + _1
        x = fetched[_OWN + at_x]
        y = fetched[_OWN + at_y]
        bx = (x - fetched[_BEFORE_1 + at_x]) * per_radius
        by = (y - fetched[_BEFORE_1 + at_y]) * per_radius
        ax = (fetched[_AFTER_1 + at_x] - x) * per_radius
        ay = (fetched[_AFTER_1 + at_y] - y) * per_radius
        store_chord(
            (x - x0) * per_radius, (y - y0) * per_radius, half * (ax + bx), half * (ay + by),
            per_step * (fetched[_AFTER_2 + at_x] - fetched[_BEFORE_2 + at_x]),
            per_step * (fetched[_AFTER_2 + at_y] - fetched[_BEFORE_2 + at_y]),
            math.sqrt(bx * bx + by * by), math.sqrt(ax * ax + ay * ay), i, geometry,
        )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _link(count: int, index: NDArray[np.uint32], terms: NDArray[np.float32]) -> None:
    """Which pixels are the next ones to those before them."""
    terms[LINKED * CAPACITY] = F32(0.0)
    for i in range(_1, _U64(count)):
        terms[_U64(LINKED * CAPACITY) + i] = (
            F32(1.0) if index[i] - index[i - _1] == _U32(1) else F32(0.0)
        )


@njit(cache=True, error_model="numpy", forceinline=True)
def _take_out(surplus: int, terms: NDArray[np.float32], geometry: NDArray[np.float32]) -> None:
    """The last of `WHOLE` pixels only fill up a list: they are far away, and nothing to the fit."""
    last = WHOLE - surplus
    zero = F32(0.0)
    for i in range(WHOLE):
        counts = i < last
        for term in range(TERMS):
            value = terms[term * CAPACITY + i]
            terms[term * CAPACITY + i] = value if counts else zero
        geometry[EDGE_X * CAPACITY + i] = geometry[EDGE_X * CAPACITY + i] if counts else _NOWHERE
