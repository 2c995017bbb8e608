"""Compiled loops that gather the pixels of a disc that is seen flat, and their geometry."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model_kernels import (
    ACROSS_X,
    ACROSS_Y,
    ALONG_X,
    ALONG_Y,
    CAPACITY,
    CHORD_X,
    CHORD_Y,
    F32,
    FASTMATH,
    GEOMETRY,
    GROWTH,
    PER_LENGTH,
    PER_STEP_ACROSS,
    PER_STEP_ALONG,
)
from detect.discs.patch_kernels import (
    GREY,
    LINKED,
    NEAR,
    NEAR_PX,
    NEAR_RADII,
    ONE,
    PLANE_X,
    PLANE_Y,
    SADDLE,
    SADDLE_XY,
    FitSettings,
    Patch,
    padded,
)
from detect.uncounted import uncounted

_SMALLEST = F32(1e-6)
_ONE, _TWO = np.uint64(1), np.uint64(2)


@njit(cache=True, error_model="numpy", inline="always", fastmath=FASTMATH)
def store_chord(
    x: float,
    y: float,
    x1: float,
    y1: float,
    x2: float,
    y2: float,
    before: float,
    after: float,
    i: int,
    geometry: NDArray[np.float32],
) -> None:
    """Geometry of pixel i from its place and the floor's steps along (1) and across (2) the axis.

    `before` and `after` are the lengths of the two steps along it.
    """
    per_length = F32(1.0) / math.sqrt(x1 * x1 + y1 * y1 + F32(1e-12))
    across_x = -y1 * per_length
    across_y = x1 * per_length
    across = x2 * across_x + y2 * across_y
    geometry[CHORD_X * CAPACITY + i] = x
    geometry[CHORD_Y * CAPACITY + i] = y
    geometry[ALONG_X * CAPACITY + i] = x1 * per_length * per_length
    geometry[ALONG_Y * CAPACITY + i] = y1 * per_length * per_length
    geometry[ACROSS_X * CAPACITY + i] = across_x
    geometry[ACROSS_Y * CAPACITY + i] = across_y
    geometry[PER_STEP_ACROSS * CAPACITY + i] = across if abs(across) > _SMALLEST else _SMALLEST
    geometry[PER_STEP_ALONG * CAPACITY + i] = -(x1 * x2 + y1 * y2) * per_length * per_length
    geometry[PER_LENGTH * CAPACITY + i] = per_length
    geometry[GROWTH * CAPACITY + i] = F32(2.0) * (after - before) / (after + before + F32(1e-9))


@uncounted
def gather_grid(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    blur: float,
    settings: FitSettings,
    half_u: int,
    half_v: int,
    margin: int,
    columns: bool,
    patch: Patch,
) -> tuple[int, int]:
    """Collect a grid of pixels round a candidate whose blur is about `blur`.

    Returns the number of pixels in the grid, and of those that are to be fitted. `columns` says
    that the lines are columns of the image; else they are rows.
    """
    height, width = image.shape
    # In the lines' terms: position p along a line, number q of the line.
    if columns:
        p0, q0, half_p, half_q, end_p, end_q = v0, u0, half_v, half_u, height, width
    else:
        p0, q0, half_p, half_q, end_p, end_q = u0, v0, half_u, half_v, width, height
    first_p = max(1, p0 - half_p)
    last_p = min(end_p - 2, p0 + half_p)
    first_q = max(1, q0 - half_q)
    last_q = min(end_q - 2, q0 + half_q)
    length = last_p - first_p + 1 + 2 * margin
    lines = last_q - first_q + 1
    n = length * lines
    if n + 2 * length > CAPACITY or lines < 1:
        return 0, 0
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    floor = patch.floor
    terms = patch.terms
    per_radius = F32(1.0 / radius)
    middle = F32(image[v0, u0])
    begin_p = first_p - margin
    # Where the lines are in the image: from its first to its last pixel.
    seen_begin = max(-begin_p, 0)
    seen_end = min(length, end_p - begin_p)
    floor_line = floor_xy.reshape(-1)
    grey = image.reshape(-1)
    # One line more on either side, for the steps from line to line.
    for line in range(lines + 2):
        q = first_q - 1 + line
        row = line * length
        at = row + seen_begin
        p = begin_p + seen_begin
        first = p * width + q if columns else q * width + p
        seen = seen_end - seen_begin
        _copy_floor(
            floor_line[2 * first :], 2 * width if columns else 2, x0, y0, per_radius,
            floor[at : at + seen], floor[CAPACITY + at : CAPACITY + at + seen],
        )  # fmt: skip
        if 0 < line <= lines:
            to = GREY * CAPACITY + row - length
            _copy_grey(
                grey[first:],
                width if columns else 1,
                middle,
                terms[to + seen_begin : to + seen_end],
            )
            for k in range(seen_begin):
                terms[to + k] = F32(0.0)
            for k in range(seen_end, length):
                terms[to + k] = F32(0.0)
        # Beyond the image the floor goes on as it ends.
        for k in range(-begin_p - 1, -1, -1):
            for axis in range(0, 2 * CAPACITY, CAPACITY):
                at = axis + row + k
                floor[at] = 2.0 * floor[at + 1] - floor[at + 2]
        for k in range(end_p - begin_p, length):
            for axis in range(0, 2 * CAPACITY, CAPACITY):
                at = axis + row + k
                floor[at] = 2.0 * floor[at - 1] - floor[at - 2]
    _far_away(floor[: (lines + 2) * length], floor[CAPACITY : CAPACITY + (lines + 2) * length])
    ratio_2 = settings.blur_ratio * settings.blur_ratio
    if columns:
        per_p, per_q = ratio_2, 1.0
    else:
        per_p, per_q = 1.0, ratio_2
    blurs_2 = settings.reach_blurs * settings.reach_blurs * blur * blur
    _chord_geometry(
        floor, n, length, settings.reach_radii, settings.reach_px, blurs_2 * per_p,
        blurs_2 * per_q, patch.geometry, terms,
    )  # fmt: skip
    for line in range(lines):
        row = line * length
        for i in range(row, row + margin):
            terms[ONE * CAPACITY + i] = 0.0
        for i in range(row + length - margin, row + length):
            terms[ONE * CAPACITY + i] = 0.0
    # Shares are computed for whole numbers of pixels.
    for field in range(GEOMETRY):
        for i in range(n, padded(n)):
            patch.geometry[field * CAPACITY + i] = patch.geometry[field * CAPACITY + n - 1]
    return n, _mask_terms(n, terms)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _copy_floor(
    floor: NDArray[np.float32],
    step: int,
    x0: float,
    y0: float,
    per_radius: float,
    xs: NDArray[np.float32],
    ys: NDArray[np.float32],
) -> None:
    """A line of the floor x, y, x, y ..., pixels being `step` apart, in nominal radii."""
    if step == 2:
        for k in range(np.uint64(len(xs))):
            xs[k] = (floor[_TWO * k] - x0) * per_radius
            ys[k] = (floor[_TWO * k + _ONE] - y0) * per_radius
    else:
        for k in range(np.uint64(len(xs))):
            xs[k] = (floor[np.uint64(step) * k] - x0) * per_radius
            ys[k] = (floor[np.uint64(step) * k + _ONE] - y0) * per_radius


@njit(cache=True, error_model="numpy", forceinline=True)
def _copy_grey(
    grey: NDArray[np.uint8], step: int, middle: float, result: NDArray[np.float32]
) -> None:
    """A line of grey values, pixels being `step` apart, relative to one."""
    for k in range(np.uint64(len(result))):
        result[k] = F32(grey[np.uint64(step) * k]) - middle


@njit(cache=True, error_model="numpy", forceinline=True)
def _far_away(xs: NDArray[np.float32], ys: NDArray[np.float32]) -> None:
    """Where there is no floor, it is far away."""
    most = F32(1e4)
    for i in range(np.uint64(len(xs))):
        seen = (abs(xs[i]) < most) & (abs(ys[i]) < most)
        xs[i] = xs[i] if seen else most
        ys[i] = ys[i] if seen else most


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _chord_geometry(
    floor: NDArray[np.float32],
    n: int,
    length: int,
    reach_radii: float,
    reach_px: float,
    blurs_p: float,
    blurs_q: float,
    geometry: NDArray[np.float32],
    terms: NDArray[np.float32],
) -> None:
    """The geometry of a grid's pixels, and which of them are within reach."""
    half = F32(0.5)
    one = F32(1.0)
    zero = F32(0.0)
    reach = F32(reach_radii)
    reach_2 = F32(reach_px * reach_px)
    near_2 = F32(NEAR_PX * NEAR_PX)
    near_radii = F32(NEAR_RADII)
    along_p = F32(blurs_p)
    along_q = F32(blurs_q)
    for i in range(n):
        at = i + length
        x = floor[at]
        y = floor[CAPACITY + at]
        bx = x - floor[at - length]
        by = y - floor[CAPACITY + at - length]
        ax = floor[at + length] - x
        ay = floor[CAPACITY + at + length] - y
        x1 = half * (ax + bx)
        y1 = half * (ay + by)
        x2 = half * (floor[at + 1] - floor[at - 1])
        y2 = half * (floor[CAPACITY + at + 1] - floor[CAPACITY + at - 1])
        before = math.sqrt(bx * bx + by * by)
        after = math.sqrt(ax * ax + ay * ay)
        store_chord(x, y, x1, y1, x2, y2, before, after, i, geometry)
        r_2 = x * x + y * y + F32(1e-12)
        r = math.sqrt(r_2)
        off = r - one
        off_2 = off * off
        gp = x2 * x + y2 * y
        gq = x1 * x + y1 * y
        gp = gp * gp / r_2
        gq = gq * gq / r_2
        within = (
            (one if r <= reach else zero)
            + (one if off_2 <= reach_2 * (gp + gq) else zero)
            + (one if off_2 <= along_p * gp + along_q * gq else zero)
        )
        near = (one if r <= near_radii else zero) + (one if off_2 <= near_2 * (gp + gq) else zero)
        terms[ONE * CAPACITY + i] = one if within > zero else zero
        terms[NEAR * CAPACITY + i] = one if near > zero else zero
        terms[PLANE_X * CAPACITY + i] = x
        terms[PLANE_Y * CAPACITY + i] = y


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _mask_terms(n: int, terms: NDArray[np.float32]) -> int:
    """Finish the terms of a grid: zero where a pixel is not to be fitted. How many are."""
    terms[LINKED * CAPACITY] = 0.0
    for i in range(n - 1):
        terms[LINKED * CAPACITY + 1 + i] = terms[ONE * CAPACITY + i] * terms[ONE * CAPACITY + 1 + i]
    for i in range(n):
        one = terms[ONE * CAPACITY + i]
        x = terms[PLANE_X * CAPACITY + i] * one
        y = terms[PLANE_Y * CAPACITY + i] * one
        terms[PLANE_X * CAPACITY + i] = x
        terms[PLANE_Y * CAPACITY + i] = y
        terms[SADDLE * CAPACITY + i] = x * x - y * y
        terms[SADDLE_XY * CAPACITY + i] = x * y
        terms[GREY * CAPACITY + i] *= one
        terms[NEAR * CAPACITY + i] *= one
    total = F32(0.0)
    for i in range(n):
        total += terms[ONE * CAPACITY + i]
    return int(np.int64(total))
