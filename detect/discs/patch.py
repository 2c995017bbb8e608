"""Selects the pixels to which a disc is fitted, with their floor positions and grey values.

Pixels are used if they are within some radii of the initial disc, or within some pixels or standard
deviations of the blur of its edge. All of them are taken for small discs; for large ones, all at
the edge, which locate the disc, and a subset of the others, which give the grey levels; for huge
ones, pairs all along the edge. To first order, with the floor's steps J at the candidate, a pixel
is ``|r - R| r / |J^T p|`` pixels from the edge, for its floor position p, r = ``|p|``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from detect.discs.model import F32, FASTMATH, PIXEL_VARIANCE, Disc
from redetect.array_types import Float32Array, GreyImage, IntArray
from redetect.compiled import kernel

#: Most pixels of a patch. No power of two, so that its arrays do not compete for cache lines.
CAPACITY = 4000

_VALUES = (np.float32, CAPACITY)
#: A patch: one structure, so that the compiler knows that its arrays do not overlap.
PATCH = np.dtype(
    [
        # Index of each pixel in the image.
        ("pixel", np.uint32, CAPACITY),
        # 0 for padding of a sector, 1 for all other pixels.
        ("weight", *_VALUES),
        # Square root of each pixel's robust weight in a fit by parts.
        ("trust", *_VALUES),
        # Grey value, relative to that of the candidate.
        ("grey", *_VALUES),
        # Floor position relative to the candidate, in nominal radii, and its steps along the first
        # and the second axis: u and v, or the axis of the chords first.
        *((name, *_VALUES) for name in ("x", "y", "x1", "y1", "x2", "y2")),
        # Relative growth of steps along the first axis from one to the next.
        ("growth", np.float32),
        # See `detect.discs.model`.
        ("shares", np.float32, (6, CAPACITY)),
        ("sector", np.int32, CAPACITY),
        # Working space for one image row: how its pixels are taken, and their floor positions.
        ("taken", np.int32, CAPACITY),
        *((name, *_VALUES) for name in ("row_x", "row_y")),
    ]
)  # fmt: skip

#: Number of sectors around a disc's centre, and tangents of the angles that separate them.
SECTORS = 16
_TAN_1, _TAN_3 = F32(math.tan(math.pi / 8.0)), F32(math.tan(3.0 * math.pi / 8.0))
_SECTOR_WHOLE = 8  #: Sectors are padded to a multiple of this number of pixels.

#: Formula of the shares, and the axis of the chords: see `detect.discs.model`.
EDGE, CHORDS_ALONG_V, CHORDS_ALONG_U = range(3)

#: A disc appears flat if its edge is more curved than this at a tip, in units of the blur, or its
#: semi-minor axis is shorter than this number of standard deviations of the blur.
_MOST_CURVED = 0.25
_LEAST_HALF_AXIS = 4.0
_EDGE_BLURS = 2.0  #: Half width of the edge, standard deviations of the blur.
#: In windows of more pixels than this, those off the edge are subsampled.
_DENSE_WINDOW = 2048
#: Of this many neighbouring pixels at the edge, two are taken, so that their correlation is known:
#: all for most discs, less for one whose edge has too many.
_EDGE_SPACINGS = (1, 4, 8, 16, 32, 64)
_NEVER, _SOMETIMES, _AT_EDGE = range(3)
#: Shift of the subsampled pixels from row to row, as a share of their spacing; it repeats rarely.
_SHIFT = 0.381966


class Reach(NamedTuple):
    """Which pixels are fitted: those that any of the first three limits includes."""

    radii: float  #: Distance from the initial centre, radii.
    px: float  #: Distance from the edge, pixels.
    blurs: float  #: Distance from the edge, standard deviations of the blur.
    nearest: float  #: Lower limit of the distance from the centre, radii.
    farthest: float  #: Upper limit of that.


class Candidate(NamedTuple):
    """Possible position of a disc."""

    u: int
    v: int
    radius: float  #: Nominal, metres.
    blur: float  #: Approximate blur along u, pixels.


class View(NamedTuple):
    """The appearance of a candidate."""

    shape: int  #: `EDGE`, or the axis of its chords.
    u_per_radius: float
    v_per_radius: float  #: Largest extent of one radius, pixels; 0 if no floor is visible.
    #: Floor steps from pixel to pixel: of x, y by u, and by v; radii.
    steps: tuple[float, float, float, float]


@kernel(forceinline=True)
def floor_steps(floor_xy: Float32Array, u0: int, v0: int) -> tuple[float, float, float, float]:
    """Floor steps from pixel to pixel: of x, y by u, and by v, as central differences."""
    height, width = floor_xy.shape[:2]
    u, v = min(max(u0, 1), width - 2), min(max(v0, 1), height - 2)
    return (
        0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0]),
        0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1]),
        0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0]),
        0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1]),
    )


@kernel(forceinline=True)
def view_of(floor_xy: Float32Array, candidate: Candidate, relative: float, ratio: float) -> View:
    """The appearance of a candidate whose radius is `relative` times the nominal one.

    `ratio` is the blur along v over that along u, in pixels.
    """
    per_radius = 1.0 / (candidate.radius * relative)
    xu, yu, xv, yv = floor_steps(floor_xy, candidate.u, candidate.v)
    xu, yu, xv, yv = xu * per_radius, yu * per_radius, xv * per_radius, yv * per_radius
    area = abs(xu * yv - xv * yu)
    if not area > 1e-10:
        return View(EDGE, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))
    along_u, along_v = math.hypot(xv, yv) / area, math.hypot(xu, yu) / area
    # In the metric in which the blur is round, the ellipse has the semi-axes a and b.
    variance_u = candidate.blur * candidate.blur + PIXEL_VARIANCE
    variance_v = candidate.blur * candidate.blur * ratio * ratio + PIXEL_VARIANCE
    uu = variance_u * (xu * xu + yu * yu)
    vv = variance_v * (xv * xv + yv * yv)
    uv = math.sqrt(variance_u * variance_v) * (xu * xv + yu * yv)
    steepest = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
    flattest = variance_u * variance_v * area * area / steepest
    a, b = 1.0 / math.sqrt(flattest), 1.0 / math.sqrt(steepest)
    shape = EDGE
    if a > _MOST_CURVED * b * b or b < _LEAST_HALF_AXIS:
        shape = CHORDS_ALONG_V if along_v <= along_u else CHORDS_ALONG_U
    return View(shape, along_u, along_v, (xu, yu, xv, yv))


@kernel(forceinline=True)
def gather(
    image: GreyImage,
    floor_xy: Float32Array,
    candidate: Candidate,
    blur_ratio: float,
    reach: Reach,
    start: Disc,
    patch: Any,
) -> tuple[int, IntArray]:
    """Fill a patch (`PATCH`) with the pixels around a candidate; none if no floor is visible.

    `floor_xy` (H, W, 2) are the pixels' floor positions, metres. `blur_ratio` is the blur along v
    over that along u, in pixels: 0.5 in single fields of interlaced frames. `start` is the initial
    disc. Returns the shape (`EDGE`, or the axis of the chords), and (SECTORS + 1,) indices in the
    patch at which each sector begins, and the last ends.
    """
    ends = np.zeros(SECTORS + 1, np.int64)
    view = view_of(floor_xy, candidate, start.radius, blur_ratio)
    if view.u_per_radius > 0.0:
        count = _choose(floor_xy, candidate, blur_ratio, reach, start, view, patch)
        _sort_by_sector(floor_xy, candidate, start, reach, count, patch, ends)
    _describe(image, floor_xy, candidate, view.shape, ends[SECTORS], patch)
    return view.shape, ends


@kernel(forceinline=True)
def sector_of(x: float, y: float) -> Any:
    """(int32) Sector of a position relative to the disc's centre, counted from x towards y."""
    ax, ay = abs(x), abs(y)
    k: Any = np.int32(ay > _TAN_1 * ax) + np.int32(ay > ax) + np.int32(ay > _TAN_3 * ax)
    k = np.int32(7) - k if x < F32(0.0) else k
    return np.int32(15) - k if y < F32(0.0) else k


@kernel(forceinline=True, fastmath=FASTMATH)
def _sort_by_sector(
    floor_xy: Float32Array,
    candidate: Candidate,
    start: Disc,
    reach: Reach,
    count: int,
    patch: Any,
    ends: IntArray,
) -> None:
    """Sort pixels by sector, and drop those that are too near to the centre or too far from it.

    Sectors are padded with copies of their first pixel, of weight 0.
    """
    floor, pixel = floor_xy.reshape(-1, 2), patch.pixel[:count].copy()
    x0 = F32(floor_xy[candidate.v, candidate.u, 0] + candidate.radius * start.x)
    y0 = F32(floor_xy[candidate.v, candidate.u, 1] + candidate.radius * start.y)
    radius = candidate.radius * start.radius
    nearest_2, farthest_2 = F32((reach.nearest * radius) ** 2), F32((reach.farthest * radius) ** 2)
    for i in range(count):
        x, y = floor[np.uint64(pixel[i]), 0] - x0, floor[np.uint64(pixel[i]), 1] - y0
        r_2 = x * x + y * y
        fitted = (r_2 >= nearest_2) & (r_2 <= farthest_2)
        patch.sector[i] = sector_of(x, y) if fitted else np.int32(SECTORS)
    pixels = np.zeros(SECTORS + 1, np.int64)
    for i in range(count):
        pixels[patch.sector[i]] += 1
    ends[0] = 0
    for s in range(SECTORS):
        ends[s + 1] = ends[s] + (pixels[s] + _SECTOR_WHOLE - 1) // _SECTOR_WHOLE * _SECTOR_WHOLE
    following = ends.copy()
    for i in range(count):
        s = patch.sector[i]
        patch.pixel[following[s]] = pixel[i]
        patch.weight[following[s]] = 1.0
        following[s] += s < SECTORS
    for s in range(SECTORS):
        for i in range(following[s], ends[s + 1]):
            patch.pixel[i], patch.weight[i] = patch.pixel[ends[s]], 0.0


@kernel(forceinline=True)
def _choose(
    floor_xy: Float32Array,
    candidate: Candidate,
    blur_ratio: float,
    reach: Reach,
    start: Disc,
    view: View,
    patch: Any,
) -> int:
    """Write the indices of the pixels within reach into the patch; returns their number."""
    height, width = floor_xy.shape[:2]
    u0, v0 = candidate.u, candidate.v
    most = 1.08 * reach.radii
    beyond_u = max(reach.px, reach.blurs * candidate.blur)
    beyond_v = max(reach.px, reach.blurs * candidate.blur * blur_ratio)
    half_u = int(max(most * view.u_per_radius, 1.08 * view.u_per_radius + beyond_u)) + 1
    half_v = int(max(most * view.v_per_radius, 1.08 * view.v_per_radius + beyond_v)) + 1
    first_u, last_u = max(1, u0 - half_u), min(width - 2, u0 + half_u)
    first_v, last_v = max(1, v0 - half_v), min(height - 2, v0 + half_v)
    window = (2 * half_u + 1) * (2 * half_v + 1)
    floor = floor_xy.reshape(-1, 2)
    pixel, taken, row_x, row_y = patch.pixel, patch.taken, patch.row_x, patch.row_y
    # Positions relative to the start, in its radii.
    x0 = F32(floor_xy[v0, u0, 0] + candidate.radius * start.x)
    y0 = F32(floor_xy[v0, u0, 1] + candidate.radius * start.y)
    per_radius = F32(1.0 / (candidate.radius * start.radius))
    length = last_u - first_u + 1
    limit, count = CAPACITY - SECTORS * _SECTOR_WHOLE, 0
    # If the patch is full, it is filled again with fewer pixels of the edge.
    for spacing in _EDGE_SPACINGS:
        every = spacing * (1 + window // (spacing * _DENSE_WINDOW))
        shift = max(1, int(_SHIFT * every + 0.5))
        count = 0
        for v in range(first_v, last_v + 1):
            turn = (u0 - first_u + shift * (v - v0)) % every
            begin = v * width + first_u
            if count == limit or length > CAPACITY:
                break
            places = floor[begin:]
            for k in range(np.uint64(length)):
                row_x[k] = (places[k, 0] - x0) * per_radius
                row_y[k] = (places[k, 1] - y0) * per_radius
            _take(length, candidate.blur, blur_ratio, reach, view, patch)
            for k in range(length):
                wanted = taken[k] == _AT_EDGE and turn % spacing < 2
                wanted |= taken[k] == _SOMETIMES and turn == 0
                if wanted and count < limit:
                    pixel[count] = begin + k
                    count += 1
                turn = turn - 1 if turn > 0 else every - 1
        if count < limit:
            break
    return count


@kernel(forceinline=True, fastmath=FASTMATH)
def _take(length: int, blur: float, ratio: float, reach: Reach, view: View, patch: Any) -> None:
    """Decide which pixels of a row may be taken: those at the edge, and others within reach."""
    xu, yu, xv, yv = (
        F32(view.steps[0]), F32(view.steps[1]), F32(view.steps[2]), F32(view.steps[3]),
    )  # fmt: skip
    blur_u_2, blur_v_2 = blur**2, (blur * ratio) ** 2
    reach_radii, reach_px = F32(reach.radii), F32(reach.px**2)
    reach_u, reach_v = F32(reach.blurs**2 * blur_u_2), F32(reach.blurs**2 * blur_v_2)
    edge_u = F32(_EDGE_BLURS**2 * (blur_u_2 + PIXEL_VARIANCE))
    edge_v = F32(_EDGE_BLURS**2 * (blur_v_2 + PIXEL_VARIANCE))
    for k in range(length):
        x, y = patch.row_x[k], patch.row_y[k]
        r_2 = x * x + y * y
        r = math.sqrt(r_2)
        # Distance from the edge, and the floor's steps across it, times the distance.
        off_2 = (r_2 - r) * (r_2 - r)
        gu, gv = xu * x + yu * y, xv * x + yv * y
        gu, gv = gu * gu, gv * gv
        within = (
            (r <= reach_radii)
            | (off_2 <= reach_px * (gu + gv))
            | (off_2 <= reach_u * gu + reach_v * gv)
        )
        # At the candidate itself, where all terms are zero, there is no edge.
        edge = off_2 < edge_u * gu + edge_v * gv
        taken = _SOMETIMES if within else _NEVER
        patch.taken[k] = _AT_EDGE if within & edge else taken


@kernel(forceinline=True, fastmath=FASTMATH)
def _describe(
    image: GreyImage,
    floor_xy: Float32Array,
    candidate: Candidate,
    shape: int,
    count: int,
    patch: Any,
) -> None:
    """Write floor positions, steps and grey values of the chosen pixels into the patch."""
    grey, floor = image.reshape(-1), floor_xy.reshape(-1, 2)
    width = image.shape[1]
    first, second = (width, 1) if shape == CHORDS_ALONG_V else (1, width)
    x0, y0 = floor_xy[candidate.v, candidate.u, 0], floor_xy[candidate.v, candidate.u, 1]
    middle = F32(image[candidate.v, candidate.u])
    per_radius, per_two = F32(1.0 / candidate.radius), F32(0.5 / candidate.radius)
    at = min(max(candidate.v, 1), image.shape[0] - 2) * width
    at += min(max(candidate.u, 1), width - 2)
    after = math.hypot(floor[at + first, 0] - floor[at, 0], floor[at + first, 1] - floor[at, 1])
    before = math.hypot(floor[at, 0] - floor[at - first, 0], floor[at, 1] - floor[at - first, 1])
    patch.growth = F32(2.0) * (after - before) / (after + before + F32(1e-9))
    for i in range(count):
        at, one, two = np.uint64(patch.pixel[i]), np.uint64(first), np.uint64(second)
        patch.x[i] = (floor[at, 0] - x0) * per_radius
        patch.y[i] = (floor[at, 1] - y0) * per_radius
        patch.x1[i] = (floor[at + one, 0] - floor[at - one, 0]) * per_two
        patch.y1[i] = (floor[at + one, 1] - floor[at - one, 1]) * per_two
        patch.x2[i] = (floor[at + two, 0] - floor[at - two, 0]) * per_two
        patch.y2[i] = (floor[at + two, 1] - floor[at - two, 1]) * per_two
        patch.grey[i] = F32(grey[at]) - middle
