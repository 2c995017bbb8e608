"""Response: how much a step of the grey value along a vertical explains.

A *strip* image has a pixel (v, c) for row v of the vertical that crosses the horizon at column c
(see `lut.verticals`): the building's verticals are its columns, whatever the camera's pose and
distortion. With Gaussian weights g round a pixel of the strip and h, the distance across the
vertical in units of its weighted standard deviation, the response is the sign of the covariance
times

    Cov_g(h, I)^2 / (Var_g(I) + regulariser),

the squared correlation of grey value and distance (DLR Spatial Cognition data set report, line
detection). Affine changes of brightness change it only through the regulariser.

It is evaluated on the rows round the horizon on which tracks start (`start_response`), and where
tracks go (`ResponseOnDemand`); everywhere only for drawings (`line_response`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.vector_code import LANES, WORD
from detect.verticals.band_vector_kernels import RUN, TILE
from detect.verticals.response_kernels import MARGIN, STEP, band_response, strip_response
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)

#: Each line crosses at least this many rows of the band if starts need support on other rows.
_CROSSED = 3


class LineFilter(NamedTuple):
    """Weights of the filter.

    Attributes
    ----------
    weights : (2, 2r + 1) float32
        Across the line: of sum 1; and the same times the distance in units of its standard
        deviation.
    weights_between : (4, T) float32
        For a window between two pixels, from r pixels left of the left one on: both weights if it
        is on the left one, each followed by what is to be added for a whole pixel to the right.
        There are 2r + 2 of each; behind them zeros up to a whole number of words.
    along : (2s + 1,) float32
        Along the line, of sum 1.
    regulariser : float32
        Added to the variance in the window (grey values squared).
    """

    weights: NDArray[np.float32]
    weights_between: NDArray[np.float32]
    along: NDArray[np.float32]
    regulariser: np.float32


class StartBand(NamedTuple):
    """The rows parallel to the anchor on which tracks start, and the filter's tables for them.

    The anchor is the horizon or its replacement (`lut.verticals`). Rows of the band are counted
    from its upper end; the filter is evaluated on row s (half the filter's length) and every
    `spacing` rows after it.

    Attributes
    ----------
    row : (K, W) int32
        Image row of each position at which the filter is evaluated; -1 where tracks may not start.
    pixel : (P // T, R, T) int32
        Index into the flat image of the pixel on the left of each pixel of the band; -1 beyond the
        ends of the vertical. Columns are gathered to tiles of T (`TILE`); P is W rounded up to
        whole ones.
    runs : (R * P // L, 3) int32
        The same for L (`RUN`) pixels of the band together, where these indices are up to three runs
        of neighbours: that of the first pixel of each run, as if it began at the first of all.
    lengths : (R * P // L, 2) uint8
        The number of the first pixel that is not of the first run, and not of the second.
    odd : (N,) int32
        Where there are more runs, or none: index in `pixel` of the first of `LANES` pixels.
    odd_bounds : (P // T + 1,) int32
        Those of tile t are ``odd[odd_bounds[t] : odd_bounds[t + 1]]``.
    part : (P // T, R, T) float32
        How far the pixel of the band is to the right of it.
    scale : (K, P) float32
        One over the sum of the weights that are on the vertical; 0 where there are none.
    visible : (K, W) bool
        Whether the filter's window is inside the image.
    weights : (K, 2, 2r + 1) float32
        The filter's weights across the vertical, for the strip's columns, which are a pixel apart
        on the horizon only.
    spacing : int
        See above.
    supported : bool
        Whether there are enough of these rows for each line to cross several of them: a start
        without others next to it on these rows belongs to no line.
    """

    row: NDArray[np.int32]
    pixel: NDArray[np.int32]
    runs: NDArray[np.int32]
    lengths: NDArray[np.uint8]
    odd: NDArray[np.int32]
    odd_bounds: NDArray[np.int32]
    part: NDArray[np.float32]
    scale: NDArray[np.float32]
    visible: NDArray[np.bool_]
    weights: NDArray[np.float32]
    spacing: int
    supported: bool


class Strip(NamedTuple):
    """A table of verticals as compiled code reads it: in groups of `LANES` neighbours.

    Groups begin `STEP` columns apart, `MARGIN` columns before the first that is theirs.

    Attributes
    ----------
    column : (G * H * L,) float32
        Columns at which the L verticals of a group cross rows, row by row, for one group after the
        other; NaN where they are not seen.
    ends : (G, 4) int32
        First and last row in which any of the group's verticals is seen; first and last row in
        which all are, the first after the last where there are none.
    first_row, last_row : (W,) int32
        First and last row in which each vertical is seen.
    rise : (W, H) float32
        Tangents of elevations: the table's, column by column, as tracks read them.
    lean_by_pitch, lean_by_roll : (W,) float64
        By how many columns of the strip a vertical moves for a rise of 1 in a camera of unit pitch,
        and of unit roll; NaN where there is no vertical, or none beside it.
    bearing, anchor_row, robot_from_camera, row_aspect
        See `lut.verticals.VerticalTable`.
    """

    column: NDArray[np.float32]
    ends: NDArray[np.int32]
    first_row: NDArray[np.int32]
    last_row: NDArray[np.int32]
    rise: NDArray[np.float32]
    lean_by_pitch: FloatArray
    lean_by_roll: FloatArray
    bearing: FloatArray
    anchor_row: FloatArray
    robot_from_camera: FloatArray
    row_aspect: float


class ResponseOnDemand(NamedTuple):
    """The response of one image, evaluated on demand (`response_kernels.respond`).

    Attributes
    ----------
    pixels : (N,) uint8
        Grey values in scan order; where T > 2r + 2, behind the last of them as many as that more.
    strip : Strip
        At least `LANES` columns wide.
    window : LineFilter
        The filter.
    response : (G * H * L,) float32
        Responses at L neighbouring columns of the strip, a group, row by row, for one group after
        the other; only rows that are known mean anything.
    known : (G, 2) int32
        First of these rows, and the one after the last, of each group.
    moments : (3 * H * L,) float32
        Means, covariances and mean squares across the verticals of the group evaluated last.
    moment_rows : (3,) int64
        That group, the first of the rows for which there are moments, and the one after the last.
    """

    pixels: NDArray[np.uint8]
    strip: Strip
    window: LineFilter
    response: NDArray[np.float32]
    known: NDArray[np.int32]
    moments: NDArray[np.float32]
    moment_rows: NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def response_on_demand(
    pixels: NDArray[np.uint8], strip: Strip, window: LineFilter
) -> ResponseOnDemand:
    """The response of an image, of which nothing is evaluated yet."""
    height = strip.rise.shape[1]
    return ResponseOnDemand(
        pixels,
        strip,
        window,
        np.empty(len(strip.column), np.float32),
        np.zeros((len(strip.ends), 2), np.int32),
        np.empty(3 * height * LANES, np.float32),
        np.full(3, -1, np.int64),
    )


def gaussian_window(sigma: float) -> FloatArray:
    """Weights of sum 1 at whole pixels within three standard deviations of the middle."""
    reach = math.ceil(3.0 * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(weight / weight.sum())


def _weights_across(sigma_px: float, spacing_px: float) -> FloatArray:
    """(2, 2r + 1) weights of samples that are a distance apart, and the same times the lever."""
    reach = math.ceil(3.0 * sigma_px)
    distance = spacing_px * np.arange(-reach, reach + 1)
    weight = np.exp(-0.5 * (distance / sigma_px) ** 2)
    weight /= weight.sum()
    return np.stack([weight, weight * distance / np.sqrt(weight @ distance**2)])


@lru_cache(maxsize=16)
def line_filter(settings: LineSettings) -> LineFilter:
    """The filter of some settings."""

    weights = _weights_across(settings.sigma_across_px, 1.0)
    # Moments between two pixels are those of both, interpolated; so are the weights.
    left = np.pad(weights, [(0, 0), (0, 1)])
    step = np.pad(weights, [(0, 0), (1, 0)]) - left
    between = np.stack([left[0], step[0], left[1], step[1]])
    between = np.pad(between, [(0, 0), (0, -between.shape[1] % WORD)])
    return LineFilter(
        weights=weights.astype(np.float32),
        weights_between=between.astype(np.float32),
        along=gaussian_window(settings.sigma_along_rows).astype(np.float32),
        regulariser=np.float32(settings.regulariser),
    )


@lru_cache(maxsize=16)
def start_band(table: VerticalTable, settings: LineSettings) -> StartBand:
    """The rows near the horizon on which tracks start.

    Parameters
    ----------
    table : VerticalTable
        Of the images' camera.
    settings : LineSettings
        Band, its spacing and border; the filter's widths.

    Returns
    -------
    StartBand
        Computed once for each table.
    """

    window = line_filter(settings)
    r, s = window.weights.shape[1] // 2, len(window.along) // 2
    height, width = table.column.shape
    steps = settings.start_band_rows // settings.start_spacing_rows
    reach = steps * settings.start_spacing_rows + s
    anchor = np.where(table.usable, np.floor(table.anchor_row + 0.5), 0.0).astype(np.intp)
    columns = np.arange(width)

    row = anchor + np.arange(-reach, reach + 1)[:, None]
    on_vertical = (row >= table.first_row) & (row <= table.last_row)
    x = np.where(on_vertical, table.column[np.where(on_vertical, row, 0), columns], 0.0)
    left = np.minimum(x.astype(np.int32), max(width - 2, 0))
    pixel = np.where(on_vertical, row * width + left, -1).astype(np.int32)

    evaluated = slice(s, 2 * reach + 1 - s, settings.start_spacing_rows)
    # Windows are cut off where the vertical ends.
    share = np.concatenate([[0.0], np.cumsum(window.along, dtype=np.float64)])
    middle = row[evaluated]
    below = np.clip(table.last_row - middle + s + 1, 0, 2 * s + 1)
    above = np.clip(table.first_row - middle + s, 0, 2 * s + 1)
    on_it = np.maximum(share[below] - share[above], 0.0)
    scale = np.divide(1.0, on_it, out=np.zeros_like(on_it), where=on_it > 0.0)
    visible = on_vertical[evaluated] & (x[evaluated] >= r) & (x[evaluated] < width - 1 - r)
    border = settings.border_rows
    allowed = visible & (middle >= border) & (middle <= height - 1 - border)
    spacing_px = [_typical_spacing(x[i], on_vertical[i]) for i in range(*evaluated.indices(len(x)))]
    weights = [_weights_across(settings.sigma_across_px, px) for px in spacing_px]
    beyond = [(0, 0), (0, -width % TILE)]
    # These values are not used; continuing the run makes it fast.
    further = np.minimum(pixel[:, -1:] + np.arange(1, beyond[1][1] + 1), height * width - 2)
    pixel = _in_tiles(np.concatenate([pixel, further], axis=1).astype(np.int32))
    runs, lengths, odd, odd_bounds = _runs_of_neighbours(pixel, height * width)
    return StartBand(
        row=np.where(allowed, middle, -1).astype(np.int32),
        pixel=pixel,
        runs=runs,
        lengths=lengths,
        odd=odd,
        odd_bounds=odd_bounds,
        part=_in_tiles(np.pad((x - left).astype(np.float32), beyond)),
        scale=np.pad(scale.astype(np.float32), beyond),
        visible=visible,
        weights=np.array(weights, np.float32),
        spacing=settings.start_spacing_rows,
        supported=steps > 0
        and settings.least_points(table.row_aspect) >= _CROSSED * settings.start_spacing_rows,
    )


def _in_tiles(rows: NDArray[T]) -> NDArray[T]:
    """(P // TILE, R, TILE) of (R, P)."""

    tiles = rows.reshape(len(rows), -1, TILE).transpose(1, 0, 2)
    return np.ascontiguousarray(tiles)


def _runs_of_neighbours(
    pixel: NDArray[np.int32], pixels: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32]]:
    """See `StartBand`: runs, lengths, odd, odd_bounds."""
    block = pixel.reshape(-1, RUN)
    breaks = np.diff(block, axis=1) != 1
    number = np.concatenate([np.zeros((len(block), 1), np.intp), np.cumsum(breaks, axis=1)], axis=1)
    # The first place behind 1, and behind 2 breaks.
    lengths = np.stack([(number <= 0).sum(axis=1), (number <= 1).sum(axis=1)], axis=1)
    own = np.arange(len(block))
    begins = [np.zeros_like(own), *np.minimum(lengths, RUN - 1).T]
    runs = np.stack([block[own, begin] - begin for begin in begins], axis=1)
    regular = (block >= 0).all(axis=1) & (number[:, -1] <= 2) & (runs >= 0).all(axis=1)
    regular &= runs.max(axis=1) + RUN < pixels
    runs[~regular] = 0
    odd = np.flatnonzero(np.repeat(~regular, RUN // LANES)) * LANES
    bounds = np.searchsorted(odd, np.arange(len(pixel) + 1) * pixel[0].size)
    return (
        runs.astype(np.int32), lengths.astype(np.uint8), odd.astype(np.int32),
        bounds.astype(np.int32),
    )  # fmt: skip


def _typical_spacing(x: FloatArray, shown: NDArray[np.bool_]) -> float:
    """Median distance of neighbouring verticals in a row, pixels; 1 where there are none."""
    both = shown[1:] & shown[:-1]
    return float(np.median(np.abs(np.diff(x)[both]))) if both.any() else 1.0


@lru_cache(maxsize=4)
def strip_of(table: VerticalTable) -> Strip:
    """The strip of a table; made once for each."""
    height, width = table.column.shape
    base = np.clip(np.arange(0, width, STEP) - MARGIN, 0, max(width - LANES, 0))
    member = np.minimum(base[:, None] + np.arange(LANES), width - 1)
    seen = table.usable[member]
    first, last = table.first_row[member], table.last_row[member]
    ends = np.stack(
        [
            np.where(seen, first, height).min(axis=1),
            np.where(seen, last, -1).max(axis=1),
            np.where(seen, first, height).max(axis=1),
            np.where(seen, last, -1).min(axis=1),
        ],
        axis=1,
    )
    bearing = table.bearing_rad
    per_rad = np.full(width, np.nan)
    per_rad[1:-1] = 2.0 / (bearing[2:] - bearing[:-2])
    return Strip(
        column=np.ascontiguousarray(table.column.T[member].transpose(0, 2, 1)).reshape(-1),
        ends=ends.astype(np.int32),
        first_row=table.first_row,
        last_row=table.last_row,
        rise=np.ascontiguousarray(table.elevation_tan.T),
        lean_by_pitch=np.sin(bearing) * per_rad,
        lean_by_roll=-np.cos(bearing) * per_rad,
        bearing=bearing,
        anchor_row=table.anchor_row,
        robot_from_camera=table.robot_from_camera,
        row_aspect=table.row_aspect,
    )


def line_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> NDArray[np.float32]:
    """The response at every pixel of the strip.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Widths of the filter, regulariser.

    Returns
    -------
    (H, W) float32
        In [-1, 1], positive where the image is brighter on the right; 0 where it is not defined.
    """
    column = np.ascontiguousarray(table.column)
    return strip_response(image, column, strip_of(table), line_filter(settings))


def start_response(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> tuple[NDArray[np.float32], StartBand]:
    """The response on the rows on which tracks start, as `line_response` up to a few percent.

    Returns
    -------
    response : (K, W) float32
        In the rows of the band.
    band : StartBand
        Which rows these are.
    """
    band = start_band(table, settings)
    return band_response(np.ascontiguousarray(image), band, line_filter(settings)), band


def padded_pixels(image: NDArray[np.uint8], window: LineFilter) -> NDArray[np.uint8]:
    """The image in scan order, followed by padding for the filter's weights of zero."""
    flat = image.reshape(-1)
    missing = window.weights_between.shape[1] - window.weights.shape[1] - 1
    return np.pad(flat, (0, missing)) if missing else flat
