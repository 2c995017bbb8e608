"""Compiled loops that fetch what the table and the image say of a list's pixels.

Fetching, and computing with that, are loops of their own: only the latter work on several pixels
at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.grid_kernels import finish_chords
from detect.discs.model_kernels import (
    ACROSS_X,
    ACROSS_Y,
    ALONG_X,
    ALONG_Y,
    CAPACITY,
    EDGE_X,
    EDGE_XU,
    EDGE_XV,
    EDGE_Y,
    EDGE_YU,
    EDGE_YV,
    F32,
    FASTMATH,
    GEOMETRY,
    PER_LENGTH,
    PER_STEP_ACROSS,
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
    TERMS,
    Patch,
    padded,
)
from detect.uncounted import uncounted

#: Numba knows them as types, the type checker as functions.
_U32: Callable[[Any], Any] = np.uint32
_U64: Callable[[Any], Any] = np.uint64
_1, _2, _3 = _U64(1), _U64(2), _U64(3)
#: Where a pixel is that only fills up: far away, in nominal radii.
_NOWHERE = F32(1e3)


@uncounted
def fill_terms(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    count: int,
    patch: Patch,
) -> None:
    """The terms of the pixels in the patch's list."""
    index = patch.pixels
    terms = patch.terms
    floor_line = floor_xy.reshape(-1)
    grey = image.reshape(-1)
    middle = F32(image[v0, u0])
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    per_radius = F32(1.0 / radius)
    before = _U32(0xFFFFFFF0)
    for i in range(_U64(count)):
        pixel = index[i]
        at = _U64(pixel)
        terms[_U64(PLANE_X * CAPACITY) + i] = (floor_line[_2 * at] - x0) * per_radius
        terms[_U64(PLANE_Y * CAPACITY) + i] = (floor_line[_2 * at + _1] - y0) * per_radius
        terms[_U64(GREY * CAPACITY) + i] = F32(grey[at]) - middle
        terms[_U64(NEAR * CAPACITY) + i] = F32(index[_U64(CAPACITY) + i])
        terms[_U64(LINKED * CAPACITY) + i] = F32(1.0) if at == _U64(before) + _1 else F32(0.0)
        before = pixel
    _finish_terms(count, padded(count), terms)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _finish_terms(count: int, n: int, terms: NDArray[np.float32]) -> None:
    for term in range(TERMS):
        for i in range(count, n):
            terms[term * CAPACITY + i] = F32(0.0)
    for i in range(_U64(n)):
        x = terms[_U64(PLANE_X * CAPACITY) + i]
        y = terms[_U64(PLANE_Y * CAPACITY) + i]
        terms[_U64(ONE * CAPACITY) + i] = F32(1.0)
        terms[_U64(SADDLE * CAPACITY) + i] = x * x - y * y
        terms[_U64(SADDLE_XY * CAPACITY) + i] = x * y
    for i in range(count, n):
        terms[ONE * CAPACITY + i] = F32(0.0)


@uncounted
def fill_edges(floor_xy: NDArray[np.float32], radius: float, count: int, patch: Patch) -> None:
    """The geometry for `edge_shares` of the pixels in the patch's list."""
    index = patch.pixels
    geometry = patch.geometry
    terms = patch.terms
    floor_line = floor_xy.reshape(-1)
    next_row = _U64(2 * floor_xy.shape[1])
    per_step = F32(0.5 / radius)
    for i in range(_U64(count)):
        at = _2 * _U64(index[i])
        geometry[_U64(EDGE_XU * CAPACITY) + i] = per_step * (
            floor_line[at + _2] - floor_line[at - _2]
        )
        geometry[_U64(EDGE_YU * CAPACITY) + i] = per_step * (
            floor_line[at + _3] - floor_line[at - _1]
        )
        geometry[_U64(EDGE_XV * CAPACITY) + i] = per_step * (
            floor_line[at + next_row] - floor_line[at - next_row]
        )
        geometry[_U64(EDGE_YV * CAPACITY) + i] = per_step * (
            floor_line[at + next_row + _1] - floor_line[at - next_row + _1]
        )
    for i in range(_U64(count)):
        geometry[_U64(EDGE_X * CAPACITY) + i] = terms[_U64(PLANE_X * CAPACITY) + i]
        geometry[_U64(EDGE_Y * CAPACITY) + i] = terms[_U64(PLANE_Y * CAPACITY) + i]
    _fill_up(count, geometry)


@uncounted
def fill_chords(
    floor_xy: NDArray[np.float32], radius: float, columns: bool, count: int, patch: Patch
) -> None:
    """The geometry for `chord_shares` of the pixels in the patch's list."""
    index = patch.pixels
    geometry = patch.geometry
    floor_line = floor_xy.reshape(-1)
    row = _U64(2 * floor_xy.shape[1])
    steep, other = (_2, row) if columns else (row, _2)
    per_radius = F32(1.0 / radius)
    half = F32(0.5 / radius)
    # Where `finish_chords` expects the steps.
    for i in range(_U64(count)):
        at = _2 * _U64(index[i])
        x = floor_line[at]
        y = floor_line[at + _1]
        geometry[_U64(ALONG_X * CAPACITY) + i] = (x - floor_line[at - steep]) * per_radius
        geometry[_U64(ALONG_Y * CAPACITY) + i] = (y - floor_line[at - steep + _1]) * per_radius
        geometry[_U64(ACROSS_X * CAPACITY) + i] = (floor_line[at + steep] - x) * per_radius
        geometry[_U64(ACROSS_Y * CAPACITY) + i] = (floor_line[at + steep + _1] - y) * per_radius
        geometry[_U64(PER_STEP_ACROSS * CAPACITY) + i] = half * (
            floor_line[at + other] - floor_line[at - other]
        )
        geometry[_U64(PER_LENGTH * CAPACITY) + i] = half * (
            floor_line[at + other + _1] - floor_line[at - other + _1]
        )
    finish_chords(count, patch.terms, geometry)
    _fill_up(count, geometry)


@njit(cache=True, error_model="numpy", forceinline=True)
def _fill_up(count: int, geometry: NDArray[np.float32]) -> None:
    """Pixels that only fill up a list: as the last one, but far away."""
    n = padded(count)
    for row in range(GEOMETRY):
        for i in range(count, n):
            geometry[row * CAPACITY + i] = (
                _NOWHERE if row == EDGE_X else geometry[row * CAPACITY + count - 1]
            )
