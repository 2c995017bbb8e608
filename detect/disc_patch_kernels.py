"""Compiled loops that gather the pixels to which a disc is fitted, with the floor that they see.

A patch is a flat array of rows of `CAPACITY` values each. Discs that are large against the blur
become a list of pixels: all of those near the edge, which tell where it is, and some of the others,
which tell the grey levels. Flat discs become a grid, line by line across the steep image axis, with
a margin at the lines' ends; pixels of the grid that are not to be fitted have the weight zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.disc_model_kernels import (
    ACROSS_X,
    ACROSS_Y,
    ALONG_X,
    ALONG_Y,
    CAPACITY,
    CHORD_X,
    CHORD_Y,
    EDGE_X,
    EDGE_XU,
    EDGE_XV,
    EDGE_Y,
    EDGE_YU,
    EDGE_YV,
    GEOMETRY,
    GROWTH,
    PER_LENGTH,
    PER_STEP_ACROSS,
    PER_STEP_ALONG,
    PIXEL_VARIANCE,
)

# Numba knows it as the type, the type checker as a function.
_F: Callable[[Any], Any] = np.float32
_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}
_SMALLEST = _F(1e-6)

#: Rows of what the fit knows of each pixel besides the geometry: the terms of the background (1, x,
#: y, x^2 - y^2, x y), the grey value, how many pixels it stands for in the explained variance (0
#: where it is too far from the disc to speak for or against it), and whether the pixel before it
#: is its neighbour. All are zero where the grid has a pixel that is not fitted.
ONE, PLANE_X, PLANE_Y, SADDLE, SADDLE_XY, GREY, NEAR, LINKED = range(8)
TERMS = 8

#: A patch's shape: a list of pixels, lines of constant v, or lines of constant u.
LIST, ROWS, COLUMNS = range(3)

#: The edge of a disc's flattest end may be this curved, in units of the blur; and its smaller half
#: axis is at least so many deviations of the blur. Else it is seen flat.
_MOST_CURVED = 0.25
_LEAST_HALF_AXIS = 4.0
#: Pixels within this many radii, or this near to the edge, count in the explained variance.
_NEAR_RADII = 1.45
_NEAR_PX = 2.0
#: What is called the edge: so many standard deviations of the blur on either side, and a bit.
_BAND = 2.5
_BAND_PX = 0.3


class FitSettings(NamedTuple):
    """What the fit is told, apart from the image and the candidates."""

    noise: float
    """Standard deviation of the noise, grey levels."""
    reach_radii: float
    """Pixels within this many radii of the candidate are fitted,"""
    reach_px: float
    """and those this near to the disc's edge, pixels,"""
    reach_blurs: float
    """or this many standard deviations of the blur."""
    radius_sigma: float
    """Standard deviation of the radius about the nominal one, relative."""
    blur_px: float
    """The blur about which the fitted one lies (along u), pixels,"""
    blur_sigma: float
    """and the standard deviation of its logarithm."""
    blur_ratio: float
    """Blur along v over blur along u, in pixels: 0.5 in single fields of interlaced frames."""


class Patch(NamedTuple):
    """The pixels of one candidate, and working space."""

    geometry: NDArray[np.float32]
    """(GEOMETRY * CAPACITY,): see `detect.disc_model_kernels`."""
    terms: NDArray[np.float32]
    """(TERMS * CAPACITY,)"""
    floor: NDArray[np.float32]
    """(2 * CAPACITY,): working space of the gathering."""
    pixels: NDArray[np.int32]
    """(2 * CAPACITY,): likewise."""


@njit(cache=True, error_model="numpy")
def new_patch() -> Patch:
    """An empty patch."""
    return Patch(
        np.zeros(GEOMETRY * CAPACITY, np.float32),
        np.zeros(TERMS * CAPACITY, np.float32),
        np.zeros(2 * CAPACITY, np.float32),
        np.zeros(2 * CAPACITY, np.int32),
    )


@njit(cache=True, error_model="numpy")
def view_of(
    floor_xy: NDArray[np.float32], u0: int, v0: int, radius: float, blur: float, ratio: float
) -> tuple[int, float, float, float]:
    """How a disc at a pixel is seen if the blur is `blur`.

    Returns the shape of patch that it wants, how many pixels along u and v one radius can be at
    most, and the area of floor per pixel in squared radii (zero if the pixel sees no floor).
    """
    height, width = floor_xy.shape[:2]
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    scale = 0.5 / radius
    xu = scale * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = scale * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = scale * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = scale * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    area = abs(xu * yv - xv * yu)
    if not area > 1e-10:
        return LIST, 0.0, 0.0, 0.0
    along_u = math.hypot(xv, yv) / area
    along_v = math.hypot(xu, yu) / area
    # In the metric in which the blur is round, the ellipse has the half axes a and b = D / a.
    variance_u = blur * blur + PIXEL_VARIANCE
    variance_v = blur * blur * ratio * ratio + PIXEL_VARIANCE
    uu = variance_u * (xu * xu + yu * yu)
    vv = variance_v * (xv * xv + yv * yv)
    uv = math.sqrt(variance_u * variance_v) * (xu * xv + yu * yv)
    steepest = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
    flattest = variance_u * variance_v * area * area / steepest
    b = 1.0 / math.sqrt(steepest)
    a = 1.0 / math.sqrt(flattest)
    shape = LIST
    if a > _MOST_CURVED * b * b or b < _LEAST_HALF_AXIS:
        shape = ROWS if along_v <= along_u else COLUMNS
    return shape, along_u, along_v, area


#: What a pixel is to a list: not within reach, too far to speak for a disc, nearby, at the edge.
_BEYOND, _FAR, _NEARBY, _AT_EDGE = _F(0.0), _F(1.0), _F(2.0), _F(3.0)


@njit(cache=True, error_model="numpy", fastmath=_FASTMATH)
def _weigh_row(
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
    wanted: NDArray[np.float32],
) -> None:
    """What the pixels of a piece of a row are, from the floor x, y, x, y ... that they see."""
    x_middle, y_middle, r_disc, r_limit = _F(x0), _F(y0), _F(radius), _F(limit)
    x_u, y_u, x_v, y_v = _F(xu), _F(yu), _F(xv), _F(yv)
    px, blurs_u, blurs_v = _F(reach_2), _F(blurs_2), _F(blurs_2 * ratio_2)
    edge_u, edge_v = _F(band_u), _F(band_v)
    near_px = _F(_NEAR_PX * _NEAR_PX)
    r_near = _F(_NEAR_RADII * radius)
    for k in range(len(wanted)):
        x = floor[2 * k] - x_middle
        y = floor[2 * k + 1] - y_middle
        r_2 = x * x + y * y + _F(1e-12)
        per_r_2 = _F(1.0) / r_2
        r = math.sqrt(r_2)
        off = r - r_disc
        off_2 = off * off
        gu = x_u * x + y_u * y
        gv = x_v * x + y_v * y
        gu = gu * gu * per_r_2
        gv = gv * gv * per_r_2
        per_px = gu + gv
        reach = max(px * per_px, blurs_u * gu + blurs_v * gv)
        what = _FAR if off_2 <= reach else _BEYOND
        what = _FAR if r <= r_limit else what
        what = _NEARBY if off_2 <= near_px * per_px else what
        what = _NEARBY if r <= r_near else what
        wanted[k] = _AT_EDGE if off_2 <= edge_u * gu + edge_v * gv else what


@njit(cache=True, error_model="numpy")
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
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    limit = settings.reach_radii * radius
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
    count = 0
    # The floor's steps change little over a patch: those of the middle decide who is near the edge.
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    xu = 0.5 * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = 0.5 * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = 0.5 * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = 0.5 * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    reach_2 = settings.reach_px * settings.reach_px
    blurs_2 = settings.reach_blurs * settings.reach_blurs * blur * blur
    band = (_BAND + _BAND_PX) * (_BAND + _BAND_PX)
    wanted = patch.floor
    floor_line = floor_xy.reshape(-1)
    length = last_u - first_u + 1
    for v in range(first_v, last_v + 1):
        if count + length > CAPACITY:
            break
        # This row's sparse pixels start here.
        phase = (u0 - first_u + shift * (v - v0)) % every
        _weigh_row(
            floor_line[2 * (v * width + first_u) :], x0, y0, radius, limit, xu, yu, xv, yv,
            reach_2, blurs_2, ratio * ratio, band * variance_u, band * variance_v,
            wanted[:length],
        )  # fmt: skip
        sparse = phase
        for k in range(length):
            what = wanted[k]
            taken = k == sparse
            sparse += every if taken else 0
            if what == _AT_EDGE or (taken and what != _BEYOND):
                index[count] = v * width + first_u + k
                weight = 1 if what == _AT_EDGE else every if what == _NEARBY else 0
                index[CAPACITY + count] = weight
                count += 1
    _fill_terms(image, floor_xy, u0, v0, radius, count, patch)
    _fill_edges(floor_xy, radius, count, patch)
    return count


@njit(cache=True, error_model="numpy")
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
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    shift = max(1, int(0.381966 * every + 0.5))
    first_u = max(1, u0 - half_u)
    last_u = min(width - 2, u0 + half_u)
    r_2_near = _F((_NEAR_RADII * radius) ** 2)
    r_2_limit = _F((settings.reach_radii * radius) ** 2)
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    xu = 0.5 * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = 0.5 * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = 0.5 * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = 0.5 * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    reach_2 = settings.reach_px * settings.reach_px
    count = 0
    for v in range(max(1, v0 - half_v), min(height - 2, v0 + half_v) + 1):
        phase = (u0 - first_u + shift * (v - v0)) % every
        for u in range(first_u + phase, last_u + 1, every):
            pixel = v * width + u
            x = floor_line[2 * pixel] - x0
            y = floor_line[2 * pixel + 1] - y0
            r_2 = x * x + y * y
            near = r_2 <= r_2_near
            if not r_2 <= r_2_limit or not near:
                off = math.sqrt(r_2) - radius
                gu = xu * x + yu * y
                gv = xv * x + yv * y
                per_px = (gu * gu + gv * gv) / r_2
                if not (r_2 <= r_2_limit or off * off <= reach_2 * per_px):
                    continue
                near = near or off * off <= _NEAR_PX * _NEAR_PX * per_px
            if count >= CAPACITY:
                break
            index[count] = pixel
            index[CAPACITY + count] = every if near else 0
            count += 1
    _fill_terms(image, floor_xy, u0, v0, radius, count, patch)
    if shape == LIST:
        _fill_edges(floor_xy, radius, count, patch)
    else:
        _fill_chords(floor_xy, radius, shape == COLUMNS, count, patch)
    return count


@njit(cache=True, error_model="numpy")
def _fill_terms(
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
    middle = _F(image[v0, u0])
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    per_radius = _F(1.0 / radius)
    before = -2
    for i in range(count):
        pixel = index[i]
        x = (floor_line[2 * pixel] - x0) * per_radius
        y = (floor_line[2 * pixel + 1] - y0) * per_radius
        terms[ONE * CAPACITY + i] = 1.0
        terms[PLANE_X * CAPACITY + i] = x
        terms[PLANE_Y * CAPACITY + i] = y
        terms[SADDLE * CAPACITY + i] = x * x - y * y
        terms[SADDLE_XY * CAPACITY + i] = x * y
        terms[GREY * CAPACITY + i] = _F(grey[pixel]) - middle
        terms[NEAR * CAPACITY + i] = index[CAPACITY + i]
        terms[LINKED * CAPACITY + i] = 1.0 if pixel == before + 1 else 0.0
        before = pixel


@njit(cache=True, error_model="numpy")
def _fill_edges(floor_xy: NDArray[np.float32], radius: float, count: int, patch: Patch) -> None:
    """The geometry for `edge_shares` of the pixels in the patch's list."""
    index = patch.pixels
    geometry = patch.geometry
    terms = patch.terms
    floor_line = floor_xy.reshape(-1)
    next_row = 2 * floor_xy.shape[1]
    per_step = _F(0.5 / radius)
    for i in range(count):
        at = 2 * index[i]
        geometry[EDGE_X * CAPACITY + i] = terms[PLANE_X * CAPACITY + i]
        geometry[EDGE_Y * CAPACITY + i] = terms[PLANE_Y * CAPACITY + i]
        geometry[EDGE_XU * CAPACITY + i] = per_step * (floor_line[at + 2] - floor_line[at - 2])
        geometry[EDGE_YU * CAPACITY + i] = per_step * (floor_line[at + 3] - floor_line[at - 1])
        geometry[EDGE_XV * CAPACITY + i] = per_step * (
            floor_line[at + next_row] - floor_line[at - next_row]
        )
        geometry[EDGE_YV * CAPACITY + i] = per_step * (
            floor_line[at + next_row + 1] - floor_line[at - next_row + 1]
        )


@njit(cache=True, error_model="numpy", fastmath=_FASTMATH)
def _fill_chords(
    floor_xy: NDArray[np.float32], radius: float, columns: bool, count: int, patch: Patch
) -> None:
    """The geometry for `chord_shares` of the pixels in the patch's list."""
    index = patch.pixels
    geometry = patch.geometry
    terms = patch.terms
    floor_line = floor_xy.reshape(-1)
    next_row = 2 * floor_xy.shape[1]
    steep, other = (2, next_row) if columns else (next_row, 2)
    per_radius = _F(1.0 / radius)
    half = _F(0.5)
    for i in range(count):
        at = 2 * index[i]
        x = floor_line[at]
        y = floor_line[at + 1]
        bx = (x - floor_line[at - steep]) * per_radius
        by = (y - floor_line[at - steep + 1]) * per_radius
        ax = (floor_line[at + steep] - x) * per_radius
        ay = (floor_line[at + steep + 1] - y) * per_radius
        x1 = half * (ax + bx)
        y1 = half * (ay + by)
        x2 = half * per_radius * (floor_line[at + other] - floor_line[at - other])
        y2 = half * per_radius * (floor_line[at + other + 1] - floor_line[at - other + 1])
        _store_chord(
            terms[PLANE_X * CAPACITY + i], terms[PLANE_Y * CAPACITY + i], x1, y1, x2, y2,
            math.sqrt(bx * bx + by * by), math.sqrt(ax * ax + ay * ay), i, geometry,
        )  # fmt: skip


@njit(cache=True, error_model="numpy", inline="always", fastmath=_FASTMATH)
def _store_chord(
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
    per_length = _F(1.0) / math.sqrt(x1 * x1 + y1 * y1 + _F(1e-12))
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
    geometry[GROWTH * CAPACITY + i] = _F(2.0) * (after - before) / (after + before + _F(1e-9))


@njit(cache=True, error_model="numpy")
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
    per_radius = _F(1.0 / radius)
    middle = _F(image[v0, u0])
    begin_p = first_p - margin
    # One line more on either side, for the steps from line to line.
    for line in range(lines + 2):
        q = first_q - 1 + line
        row = line * length
        for k in range(length):
            p = min(max(begin_p + k, 0), end_p - 1)
            v, u = (p, q) if columns else (q, p)
            floor[row + k] = (floor_xy[v, u, 0] - x0) * per_radius
            floor[CAPACITY + row + k] = (floor_xy[v, u, 1] - y0) * per_radius
            if 0 < line <= lines:
                terms[GREY * CAPACITY + row - length + k] = _F(image[v, u]) - middle
        # Beyond the image the floor goes on as it ends.
        for k in range(-begin_p - 1, -1, -1):
            for axis in range(0, 2 * CAPACITY, CAPACITY):
                at = axis + row + k
                floor[at] = 2.0 * floor[at + 1] - floor[at + 2]
        for k in range(end_p - begin_p, length):
            for axis in range(0, 2 * CAPACITY, CAPACITY):
                at = axis + row + k
                floor[at] = 2.0 * floor[at - 1] - floor[at - 2]
    for i in range(0, (lines + 2) * length):
        # No floor is far away.
        if not abs(floor[i]) < 1e4 or not abs(floor[CAPACITY + i]) < 1e4:
            floor[i] = 1e4
            floor[CAPACITY + i] = 1e4
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
    count = 0
    for line in range(lines):
        row = line * length
        for i in range(row, row + margin):
            terms[ONE * CAPACITY + i] = 0.0
        for i in range(row + length - margin, row + length):
            terms[ONE * CAPACITY + i] = 0.0
    for i in range(n):
        count += 1 if terms[ONE * CAPACITY + i] > _F(0.0) else 0
    _mask_terms(n, terms)
    return n, count


@njit(cache=True, error_model="numpy", fastmath=_FASTMATH)
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
    half = _F(0.5)
    one = _F(1.0)
    zero = _F(0.0)
    reach = _F(reach_radii)
    reach_2 = _F(reach_px * reach_px)
    near_2 = _F(_NEAR_PX * _NEAR_PX)
    near_radii = _F(_NEAR_RADII)
    along_p = _F(blurs_p)
    along_q = _F(blurs_q)
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
        _store_chord(x, y, x1, y1, x2, y2, before, after, i, geometry)
        r_2 = x * x + y * y + _F(1e-12)
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


@njit(cache=True, error_model="numpy", fastmath=_FASTMATH)
def _mask_terms(n: int, terms: NDArray[np.float32]) -> None:
    """Finish the terms of a grid: zero where a pixel is not to be fitted."""
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
