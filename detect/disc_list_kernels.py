"""Compiled loops that gather single pixels round a candidate: at the edge, or here and there."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.disc_grid_kernels import (
    fill_chords,
)
from detect.disc_model_kernels import (
    CAPACITY,
    EDGE_X,
    EDGE_XU,
    EDGE_XV,
    EDGE_Y,
    EDGE_YU,
    EDGE_YV,
    F32,
    FASTMATH,
    PIXEL_VARIANCE,
)
from detect.disc_patch_kernels import (
    COLUMNS,
    GREY,
    LINKED,
    LIST,
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
)

#: What is called the edge: so many standard deviations of the blur on either side, and a bit.
_BAND = 2.5
_BAND_PX = 0.3


#: What a pixel is to a list: not within reach, too far to speak for a disc, nearby, at the edge.
_BEYOND, _FAR, _NEARBY, _AT_EDGE = F32(0.0), F32(1.0), F32(2.0), F32(3.0)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
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
    x_middle, y_middle, r_disc, r_limit = F32(x0), F32(y0), F32(radius), F32(limit)
    x_u, y_u, x_v, y_v = F32(xu), F32(yu), F32(xv), F32(yv)
    px, blurs_u, blurs_v = F32(reach_2), F32(blurs_2), F32(blurs_2 * ratio_2)
    edge_u, edge_v = F32(band_u), F32(band_v)
    near_px = F32(NEAR_PX * NEAR_PX)
    r_near = F32(NEAR_RADII * radius)
    for k in range(len(wanted)):
        x = floor[2 * k] - x_middle
        y = floor[2 * k + 1] - y_middle
        r_2 = x * x + y * y + F32(1e-12)
        per_r_2 = F32(1.0) / r_2
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


@njit(cache=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, error_model="numpy", forceinline=True)
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
    r_2_near = F32((NEAR_RADII * radius) ** 2)
    r_2_limit = F32((settings.reach_radii * radius) ** 2)
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
                near = near or off * off <= NEAR_PX * NEAR_PX * per_px
            if count >= CAPACITY:
                break
            index[count] = pixel
            index[CAPACITY + count] = every if near else 0
            count += 1
    _fill_terms(image, floor_xy, u0, v0, radius, count, patch)
    if shape == LIST:
        _fill_edges(floor_xy, radius, count, patch)
    else:
        fill_chords(floor_xy, radius, shape == COLUMNS, count, patch)
    return count


@njit(cache=True, error_model="numpy", forceinline=True)
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
    middle = F32(image[v0, u0])
    x0 = floor_xy[v0, u0, 0]
    y0 = floor_xy[v0, u0, 1]
    per_radius = F32(1.0 / radius)
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
        terms[GREY * CAPACITY + i] = F32(grey[pixel]) - middle
        terms[NEAR * CAPACITY + i] = index[CAPACITY + i]
        terms[LINKED * CAPACITY + i] = 1.0 if pixel == before + 1 else 0.0
        before = pixel


@njit(cache=True, error_model="numpy", forceinline=True)
def _fill_edges(floor_xy: NDArray[np.float32], radius: float, count: int, patch: Patch) -> None:
    """The geometry for `edge_shares` of the pixels in the patch's list."""
    index = patch.pixels
    geometry = patch.geometry
    terms = patch.terms
    floor_line = floor_xy.reshape(-1)
    next_row = 2 * floor_xy.shape[1]
    per_step = F32(0.5 / radius)
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
