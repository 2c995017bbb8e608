"""The pixels to which a disc is fitted, with the floor that they see and their grey values.

Pixels count if they are within some radii of the disc where a fit starts, or within some pixels or
deviations of the blur of its edge. All of them are taken; of large discs all of those at the edge,
which locate it, and some of the others, which give the grey levels. How far a pixel is from the
edge is known to first order, with the floor's steps at the candidate: ``|r - R| r / |J^T p|``
pixels for a place p on the floor, r = ``|p|``, and the steps J.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.model import (
    F32,
    FASTMATH,
    GREY,
    ONE,
    PIXEL_VARIANCE,
    PLANE_X,
    PLANE_Y,
    ROWS,
    SADDLE,
    SADDLE_XY,
    Disc,
)
from redetect.compiled import kernel

#: Most pixels of a patch.
CAPACITY = 4096
#: Loops work on this many pixels at a time, or on single ones: a patch is filled up with pixels far
#: from the disc, whose rows of the design matrix are zero.
WHOLE = 32

_VALUES = (np.float32, CAPACITY)
#: A patch. A structure, so that the compiler knows that its arrays do not overlap.
PATCH = np.dtype(
    [
        # Index of each pixel in the image.
        ("pixel", np.uint32, CAPACITY),
        # Its weight in the explained variance, in pixels: 0 too far from the disc to count.
        ("weight", *_VALUES),
        # Place on the floor relative to the candidate, in nominal radii, and how far that moves by
        # one step along the first axis and along the second: u and v, or the steeper one and the
        # other.
        *((name, *_VALUES) for name in ("x", "y", "x1", "y1", "x2", "y2")),
        # By what share steps along the first axis grow from each to the next.
        ("growth", np.float32),
        # See `detect.discs.model`: relative to the grey value of the candidate.
        ("design", np.float32, (ROWS, CAPACITY)),
        # Of the fit, grey levels.
        ("residual", *_VALUES),
        ("sector", np.int32, CAPACITY),
        # Working space, of one row of the image: weights, and places on the floor.
        *((name, *_VALUES) for name in ("row", "row_x", "row_y")),
    ]
)  # fmt: skip

#: Sectors of a disc and what is about it, and where those of a quadrant meet.
SECTORS = 16
_TAN_1, _TAN_3 = F32(math.tan(math.pi / 8.0)), F32(math.tan(3.0 * math.pi / 8.0))
#: Where pixels are sorted by sector, each is filled up to a multiple of this number.
_SECTOR_WHOLE = 8

#: By which formula discs are seen, and along which axis their chords run: see `detect.discs.model`.
EDGE, CHORDS_ALONG_V, CHORDS_ALONG_U = range(3)

#: A disc is seen flat if the edge of its flattest end is more curved than this, in units of the
#: blur, or its smaller half axis less than this number of deviations of the blur.
_MOST_CURVED = 0.25
_LEAST_HALF_AXIS = 4.0
#: Pixels within this many radii, or this near to the edge, count in the explained variance.
_NEAR_RADII = 1.45
_NEAR_PX = 2.0
#: What is called the edge: this many deviations of the blur on either side.
_EDGE_BLURS = 2.0
#: Of windows of more pixels than this, some are taken off the edge.
_DENSE_WINDOW = 2048
#: Share of the distance between pixels that are taken by which they shift from row to row: one that
#: never repeats soon.
_SHIFT = 0.381966


class FitSettings(NamedTuple):
    """Settings of a fit, apart from the image and the candidates."""

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


class Candidate(NamedTuple):
    """Where a disc may be."""

    u: int
    v: int
    radius: float
    """Nominal, metres."""
    blur: float
    """About how blurred it is (along u), pixels."""


class View(NamedTuple):
    """How a candidate is seen."""

    shape: int
    """`EDGE`, or along which axis its chords run."""
    u_per_radius: float
    v_per_radius: float
    """How many pixels one radius can be at most; 0 where no floor is seen."""
    steps: tuple[float, float, float, float]
    """By how much the floor moves from pixel to pixel: x, y by u, and by v; radii."""


@kernel(forceinline=True)
def padded(n: int) -> int:
    """A number of pixels, rounded up to what loops work on at once."""
    return (n + WHOLE - 1) // WHOLE * WHOLE


@kernel(forceinline=True)
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


@kernel(forceinline=True)
def view_of(
    floor_xy: NDArray[np.float32], candidate: Candidate, relative: float, ratio: float
) -> View:
    """How a candidate of a radius relative to the nominal one is seen.

    `ratio` is that of the blur in `FitSettings`.
    """
    per_radius = 1.0 / (candidate.radius * relative)
    xu, yu, xv, yv = floor_steps(floor_xy, candidate.u, candidate.v)
    xu, yu, xv, yv = xu * per_radius, yu * per_radius, xv * per_radius, yv * per_radius
    area = abs(xu * yv - xv * yu)
    if not area > 1e-10:
        return View(EDGE, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))
    along_u = math.hypot(xv, yv) / area
    along_v = math.hypot(xu, yu) / area
    # In the metric in which the blur is round, the ellipse has the half axes a and b.
    variance_u = candidate.blur * candidate.blur + PIXEL_VARIANCE
    variance_v = candidate.blur * candidate.blur * ratio * ratio + PIXEL_VARIANCE
    uu = variance_u * (xu * xu + yu * yu)
    vv = variance_v * (xv * xv + yv * yv)
    uv = math.sqrt(variance_u * variance_v) * (xu * xv + yu * yv)
    steepest = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
    flattest = variance_u * variance_v * area * area / steepest
    b = 1.0 / math.sqrt(steepest)
    a = 1.0 / math.sqrt(flattest)
    shape = EDGE
    if a > _MOST_CURVED * b * b or b < _LEAST_HALF_AXIS:
        shape = CHORDS_ALONG_V if along_v <= along_u else CHORDS_ALONG_U
    return View(shape, along_u, along_v, (xu, yu, xv, yv))


class Gathered(NamedTuple):
    """What became of a patch."""

    shape: int
    """`EDGE`, or along which axis chords run."""
    n: int
    """Pixels of the patch, those that only fill it up included."""
    fitted: int
    """Those of them that are fitted."""


@kernel(forceinline=True)
def gather(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    settings: FitSettings,
    start: Disc,
    patch: Any,
) -> Gathered:
    """Fill a patch with the pixels round a candidate; none where it sees no floor.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    candidate : Candidate
    settings : FitSettings
    start : Disc
        Where the fit starts.
    patch : PATCH
        The result.
    """
    shape, count = _choose(floor_xy, candidate, settings, start, patch)
    _describe(image, floor_xy, candidate, shape, count, patch)
    return Gathered(shape, padded(count), count)


@kernel()
def gather_by_sector(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    settings: FitSettings,
    start: Disc,
    between: tuple[float, float],
    patch: Any,
    ends: NDArray[np.int64],
) -> Gathered:
    """As `gather`, of the pixels between two distances, radii, and sector by sector.

    `ends` (SECTORS + 1,) is a result: where in the patch each sector begins, and the last ends.
    """
    shape, count = _choose(floor_xy, candidate, settings, start, patch)
    count = _sort_by_sector(floor_xy, candidate, start, between, count, patch, ends)
    _describe(image, floor_xy, candidate, shape, count, patch)
    return Gathered(shape, padded(count), count)


@kernel(forceinline=True)
def sector_of(x: float, y: float) -> Any:
    """(int32) In which sector a place is, relative to the disc's centre: from x to y."""
    ax, ay = abs(x), abs(y)
    k: Any = np.int32(ay > _TAN_1 * ax) + np.int32(ay > ax) + np.int32(ay > _TAN_3 * ax)
    k = np.int32(7) - k if x < F32(0.0) else k
    return np.int32(15) - k if y < F32(0.0) else k


@kernel(fastmath=FASTMATH)
def _sort_by_sector(
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    start: Disc,
    between: tuple[float, float],
    count: int,
    patch: Any,
    ends: NDArray[np.int64],
) -> int:
    """Sort pixels by sector, and leave out those that are not between the distances.

    Sectors are filled up to whole numbers of pixels with more of the same, of no weight.
    """
    floor, pixel = floor_xy.reshape(-1, 2), patch.pixel[:count].copy()
    x0 = F32(floor_xy[candidate.v, candidate.u, 0] + candidate.radius * start.x)
    y0 = F32(floor_xy[candidate.v, candidate.u, 1] + candidate.radius * start.y)
    radius = candidate.radius * start.radius
    nearest_2, farthest_2 = F32((between[0] * radius) ** 2), F32((between[1] * radius) ** 2)
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
    return int(ends[SECTORS])


@kernel(forceinline=True)
def _choose(
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    settings: FitSettings,
    start: Disc,
    patch: Any,
) -> tuple[int, int]:
    """Which pixels are taken, and the weight of each; returns the shape and their number."""
    view = view_of(floor_xy, candidate, start.radius, settings.blur_ratio)
    if view.u_per_radius == 0.0:
        return view.shape, 0
    height, width = floor_xy.shape[:2]
    u0, v0 = candidate.u, candidate.v
    most = 1.08 * settings.reach_radii
    beyond_u = max(settings.reach_px, settings.reach_blurs * candidate.blur)
    beyond_v = max(settings.reach_px, settings.reach_blurs * candidate.blur * settings.blur_ratio)
    half_u = int(max(most * view.u_per_radius, 1.08 * view.u_per_radius + beyond_u)) + 1
    half_v = int(max(most * view.v_per_radius, 1.08 * view.v_per_radius + beyond_v)) + 1
    first_u, last_u = max(1, u0 - half_u), min(width - 2, u0 + half_u)
    first_v, last_v = max(1, v0 - half_v), min(height - 2, v0 + half_v)
    window = (2 * half_u + 1) * (2 * half_v + 1)
    every = 1 + window // _DENSE_WINDOW
    shift = max(1, int(_SHIFT * every + 0.5))
    floor = floor_xy.reshape(-1, 2)
    pixel, weight, row, row_x, row_y = (
        patch.pixel,
        patch.weight,
        patch.row,
        patch.row_x,
        patch.row_y,
    )
    # Places relative to the start, in its radii.
    x0 = F32(floor_xy[v0, u0, 0] + candidate.radius * start.x)
    y0 = F32(floor_xy[v0, u0, 1] + candidate.radius * start.y)
    per_radius = F32(1.0 / (candidate.radius * start.radius))
    count = 0
    for v in range(first_v, last_v + 1):
        turn = (u0 - first_u + shift * (v - v0)) % every
        begin = v * width + first_u
        length = last_u - first_u + 1
        if count + length > CAPACITY - SECTORS * _SECTOR_WHOLE:
            break
        places = floor[begin:]
        for k in range(np.uint64(length)):
            row_x[k] = (places[k, 0] - x0) * per_radius
            row_y[k] = (places[k, 1] - y0) * per_radius
        _weigh(length, candidate, settings, view, F32(every), patch)
        for k in range(length):
            if row[k] >= F32(0.0) and (turn == 0 or row[k] == F32(1.0)):
                pixel[count] = begin + k
                weight[count] = row[k]
                count += 1
            turn = turn - 1 if turn > 0 else every - 1
    return view.shape, count


@kernel(forceinline=True, fastmath=FASTMATH)
def _weigh(
    length: int,
    candidate: Candidate,
    settings: FitSettings,
    view: View,
    stands_for: float,
    patch: Any,
) -> None:
    """Weights of the pixels of a row: -1 beyond reach, 0 too far from the disc."""
    xu, yu, xv, yv = (
        F32(view.steps[0]), F32(view.steps[1]), F32(view.steps[2]), F32(view.steps[3]),
    )  # fmt: skip
    ratio_2 = settings.blur_ratio**2
    blur_2 = candidate.blur**2
    reach_px = F32(settings.reach_px**2)
    reach_u = F32(settings.reach_blurs**2 * blur_2)
    reach_v = F32(settings.reach_blurs**2 * blur_2 * ratio_2)
    edge_u = F32(_EDGE_BLURS**2 * (blur_2 + PIXEL_VARIANCE))
    edge_v = F32(_EDGE_BLURS**2 * (blur_2 * ratio_2 + PIXEL_VARIANCE))
    reach_radii, near_radii = F32(settings.reach_radii), F32(_NEAR_RADII)
    near_px = F32(_NEAR_PX**2)
    for k in range(length):
        x, y = patch.row_x[k], patch.row_y[k]
        r_2 = x * x + y * y
        r = math.sqrt(r_2)
        # Distance from the edge, and the floor's steps across it, times the distance.
        off_2 = (r_2 - r) * (r_2 - r)
        gu = xu * x + yu * y
        gv = xv * x + yv * y
        gu = gu * gu
        gv = gv * gv
        within = (
            (r <= reach_radii)
            | (off_2 <= reach_px * (gu + gv))
            | (off_2 <= reach_u * gu + reach_v * gv)
        )
        near = (r <= near_radii) | (off_2 <= near_px * (gu + gv))
        # At the candidate itself, where all is zero, there is no edge.
        edge = off_2 < edge_u * gu + edge_v * gv
        weight = F32(0.0) if within else F32(-1.0)
        weight = stands_for if near else weight
        patch.row[k] = F32(1.0) if near & edge else weight


@kernel(forceinline=True, fastmath=FASTMATH)
def _describe(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    candidate: Candidate,
    shape: int,
    count: int,
    patch: Any,
) -> None:
    """The floor at the pixels chosen, and the design matrix but for the disc's rows."""
    grey, floor = image.reshape(-1), floor_xy.reshape(-1, 2)
    design, pixel = patch.design, patch.pixel
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
        at, one, two = np.uint64(pixel[i]), np.uint64(first), np.uint64(second)
        patch.x[i] = (floor[at, 0] - x0) * per_radius
        patch.y[i] = (floor[at, 1] - y0) * per_radius
        patch.x1[i] = (floor[at + one, 0] - floor[at - one, 0]) * per_two
        patch.y1[i] = (floor[at + one, 1] - floor[at - one, 1]) * per_two
        patch.x2[i] = (floor[at + two, 0] - floor[at - two, 0]) * per_two
        patch.y2[i] = (floor[at + two, 1] - floor[at - two, 1]) * per_two
        design[GREY, i] = F32(grey[at]) - middle
    nowhere, zero = F32(1e3), F32(0.0)
    for i in range(count, padded(count)):
        patch.x[i] = patch.y[i] = nowhere
        patch.x1[i] = patch.y2[i] = F32(1.0)
        patch.y1[i] = patch.x2[i] = patch.weight[i] = design[GREY, i] = zero
        pixel[i] = pixel[count - 1]
    for i in range(padded(count)):
        x = patch.x[i] if patch.x[i] < nowhere else zero
        y = patch.y[i] if patch.x[i] < nowhere else zero
        design[ONE, i] = F32(1.0) if patch.x[i] < nowhere else zero
        design[PLANE_X, i] = x
        design[PLANE_Y, i] = y
        design[SADDLE, i] = x * x - y * y
        design[SADDLE_XY, i] = x * y
