"""The filter that finds edges along the verticals, and where it is evaluated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]
T = TypeVar("T", bound=np.generic)

#: So many rows of the band are crossed by each line if starts need company on them.
_CROSSED = 3


@dataclass(frozen=True, slots=True, eq=False)
class LineFilter:
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


@dataclass(frozen=True, slots=True, eq=False)
class StartBand:
    """The rows parallel to the anchor on which tracks start, and what the filter needs there.

    The anchor is the horizon, or what stands for it (`lut.verticals`). Rows of the band are counted
    from there: row i is `first_offset` + i rows below it. The filter is evaluated on its row s
    (half the filter's length) and every `spacing` from there.

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
        How far the pixel of the band lies to the right of it.
    scale : (K, P) float32
        One over the sum of the weights that lie on the vertical; 0 where there are none.
    visible : (K, W) bool
        Whether the filter's window lies inside the image.
    weights : (K, 2, 2r + 1) float32
        The filter's weights across the vertical, for the strip's columns, which are a pixel apart
        on the horizon only.
    spacing : int
        See above.
    supported : bool
        Whether there are so many of these rows that each line crosses several of them: a start that
        has no company on them is none of a line.
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


@dataclass(frozen=True, slots=True, eq=False)
class FilteredColumns:
    """Where an image has been filtered so far, and the responses there; tracks extend it.

    Attributes
    ----------
    response : (G * H * L,) float32
        Responses at L neighbouring columns of the strip, a group, row by row, for one group after
        the other; only rows that are known mean anything.
    known : (G, 2) int32
        First of these rows, and the one after the last, of each group.
    """

    response: NDArray[np.float32]
    known: NDArray[np.int32]

    @classmethod
    def none_yet(cls, table: VerticalTable) -> FilteredColumns:
        """Nothing has been filtered."""
        from detect.vector_code import LANES
        from detect.verticals.group_kernels import STEP

        height, width = table.column.shape
        groups = -(-width // STEP)
        return cls(np.empty(groups * height * LANES, np.float32), np.zeros((groups, 2), np.int32))


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
    """The filter that settings ask for."""
    from detect.vector_code import WORD

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
    from detect.verticals.band_vector_kernels import TILE

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
    # What is there counts nowhere; that it goes on like this makes it fast.
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
    from detect.verticals.band_vector_kernels import TILE

    tiles = rows.reshape(len(rows), -1, TILE).transpose(1, 0, 2)
    return np.ascontiguousarray(tiles)


def _runs_of_neighbours(
    pixel: NDArray[np.int32], pixels: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32]]:
    """See `StartBand`: runs, lengths, odd, odd_bounds."""
    from detect.vector_code import LANES
    from detect.verticals.band_vector_kernels import RUN

    block = pixel.reshape(-1, RUN)
    breaks = np.diff(block, axis=1) != 1
    number = np.concatenate([np.zeros((len(block), 1), np.intp), np.cumsum(breaks, axis=1)], axis=1)
    # Which place is the first behind so many breaks.
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
