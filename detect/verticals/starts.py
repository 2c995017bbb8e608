"""Starts of tracks: maxima of the response on rows parallel to the horizon.

Every vertical crosses the horizon, or the anchor that replaces it (`lut.verticals`). On a few rows
round it the response is evaluated at all columns, with the filter applied to the strip itself:
there the strip's columns are a pixel wide, and it hardly matters whether moments are taken in the
image and interpolated, or grey values and their squares are interpolated first. The latter is
separable: first along the verticals, then across.

An edge has a maximum on each of several of these rows. One without company on a neighbouring row is
no start.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import (
    MIDDLE_GREY,
    FloatArray,
    line_filter,
    weights_across,
)
from lut.verticals import VerticalTable

#: Each line crosses at least this many rows of the band if starts need support on other rows.
_CROSSED = 3
#: A line's starts on neighbouring rows of the band are no more columns apart.
SUPPORT = 2
#: Maxima are flagged in bytes, of which this many are scanned at a time.
_WORD = 8
#: Number of classes into which scores are sorted first, before they are sorted within each.
_CLASSES = 512


class StartBand(NamedTuple):
    """The rows parallel to the anchor on which tracks start, and the filter's tables for them.

    Rows of the band are counted from its upper end; the filter is evaluated on row s (half the
    filter's length) and every `spacing` rows after it.

    Attributes
    ----------
    row : (K, W) int32
        Image row of each position at which the filter is evaluated; -1 where tracks may not start.
    pixel : (R, W) int32
        Index into the flat image of the pixel on the left of each pixel of the band.
    left, right : (R, W) float32
        Weights of this pixel and of the one on its right: of linear interpolation, and 0 beyond the
        ends of the vertical.
    scale : (K, W) float32
        One over the sum of the weights that are on the vertical; 0 where there are none.
    visible : (K, W) bool
        Whether the filter's window is inside the image.
    across : (K, 2, 2r + 1) float32
        The filter's weights across the vertical, for the strip's columns, which are a pixel apart
        on the horizon only.
    along : (2s + 1,) float32
        Those along it.
    spacing : int
        See above.
    supported : bool
        Whether there are enough of these rows for each line to cross several of them: a start
        without others next to it on these rows belongs to no line.
    """

    row: NDArray[np.int32]
    pixel: NDArray[np.int32]
    left: NDArray[np.float32]
    right: NDArray[np.float32]
    scale: NDArray[np.float32]
    visible: NDArray[np.bool_]
    across: NDArray[np.float32]
    along: NDArray[np.float32]
    spacing: int
    supported: bool


class Maxima(NamedTuple):
    """Maxima of the response along the rows of the band, row by row from the left.

    Attributes
    ----------
    level, column : (N,) int32
        Rows of the band, and columns of the strip.
    sign : (N,) float32
        1 where the response is positive, else -1.
    """

    level: NDArray[np.int32]
    column: NDArray[np.int32]
    sign: NDArray[np.float32]


class LineStarts(NamedTuple):
    """Where tracks start: maxima of the response near the horizon, the highest first.

    Attributes
    ----------
    row, column : (N,) int32
        Strip pixels.
    polarity : (N,) float32
        1 where the image is brighter on the right, -1 on the left.
    score : (N,) float32
        Absolute response there.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    polarity: NDArray[np.float32]
    score: NDArray[np.float32]


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
    r, s = window.reach, window.half_length
    along = window.along[: 2 * s + 1]
    height, width = table.column.shape
    steps = settings.start_band_rows // settings.start_spacing_rows
    reach = steps * settings.start_spacing_rows + s
    anchor = np.where(table.usable, np.floor(table.anchor_row + 0.5), 0.0).astype(np.intp)

    row = anchor + np.arange(-reach, reach + 1)[:, None]
    seen = (row >= table.first_row) & (row <= table.last_row)
    x = np.where(seen, table.column[np.where(seen, row, 0), np.arange(width)], 0.0)
    j = np.minimum(x.astype(np.int32), max(width - 2, 0))

    evaluated = slice(s, 2 * reach + 1 - s, settings.start_spacing_rows)
    # Windows are cut off where the vertical ends.
    share = np.concatenate([[0.0], np.cumsum(along, dtype=np.float64)])
    middle = row[evaluated]
    below = np.clip(table.last_row - middle + s + 1, 0, 2 * s + 1)
    above = np.clip(table.first_row - middle + s, 0, 2 * s + 1)
    on_it = np.maximum(share[below] - share[above], 0.0)
    scale = np.divide(1.0, on_it, out=np.zeros_like(on_it), where=on_it > 0.0)
    visible = seen[evaluated] & (x[evaluated] >= r) & (x[evaluated] < width - 1 - r)
    border = settings.border_rows
    allowed = visible & (middle >= border) & (middle <= height - 1 - border)
    spacing_px = [_typical_spacing(x[i], seen[i]) for i in range(*evaluated.indices(len(x)))]
    across = [weights_across(settings.sigma_across_px, px) for px in spacing_px]
    return StartBand(
        row=np.where(allowed, middle, -1).astype(np.int32),
        pixel=np.where(seen, row * width + j, 0).astype(np.int32),
        left=np.where(seen, 1.0 - (x - j), 0.0).astype(np.float32),
        right=np.where(seen, x - j, 0.0).astype(np.float32),
        scale=scale.astype(np.float32),
        visible=visible,
        across=np.array(across, np.float32),
        along=along,
        spacing=settings.start_spacing_rows,
        supported=steps > 0
        and settings.least_points(table.row_aspect) >= _CROSSED * settings.start_spacing_rows,
    )


def _typical_spacing(x: FloatArray, seen: NDArray[np.bool_]) -> float:
    """Median distance of neighbouring verticals in a row, pixels; 1 where there are none."""
    both = seen[1:] & seen[:-1]
    return float(np.median(np.abs(np.diff(x)[both]))) if both.any() else 1.0


@njit(cache=True, error_model="numpy")
def band_response(
    pixels: NDArray[np.uint8], band: StartBand, regulariser: np.float32
) -> NDArray[np.float32]:
    """(K, W) responses on the rows of the band.

    Parameters
    ----------
    pixels : (H * W,) uint8
        Grey values in scan order.
    band : StartBand
        The rows, and the filter.
    regulariser : float32
        Added to the variance.
    """
    levels, width = band.row.shape
    response = np.zeros((levels, width), np.float32)
    r = band.across.shape[2] // 2
    if width <= 2 * r or len(pixels) < 2:
        return response
    between = _interpolate(pixels, band.pixel, band.left, band.right)
    means = np.empty(2 * width, np.float32)
    sums = np.empty((3, width - 2 * r), np.float32)
    for k in range(levels):
        _average_along(between[k * band.spacing :], band.along, means)
        _correlate_across(means, band.scale[k], band.across[k], sums)
        _respond(sums, regulariser, band.visible[k, r : width - r], response[k, r : width - r])
    return response


@njit(cache=True, error_model="numpy")
def _interpolate(
    pixels: NDArray[np.uint8], pixel: NDArray[np.int32], left: NDArray[np.float32],
    right: NDArray[np.float32],
) -> NDArray[np.float32]:  # fmt: skip
    """(R, 2 W) grey values of the band, and behind those of each row their squares."""
    rows, width = pixel.shape
    between = np.empty((rows, 2 * width), np.float32)
    on_left = np.empty(width, np.uint8)
    on_right = np.empty(width, np.uint8)
    for row in range(rows):
        # Apart from what follows, which then becomes vectors.
        where = pixel[row]
        for c in range(len(where)):
            place = np.uint64(where[c])
            on_left[c] = pixels[place]
            on_right[c] = pixels[place + np.uint64(1)]
        of_left, of_right = left[row], right[row]
        grey, square = between[row, :width], between[row, width:]
        for c in range(len(grey)):
            a = np.float32(on_left[c]) - MIDDLE_GREY
            b = np.float32(on_right[c]) - MIDDLE_GREY
            grey[c] = of_left[c] * a + of_right[c] * b
            square[c] = of_left[c] * (a * a) + of_right[c] * (b * b)
    return between


@njit(cache=True, error_model="numpy")
def _average_along(
    between: NDArray[np.float32], along: NDArray[np.float32], sums: NDArray[np.float32]
) -> None:
    """Weighted sums along verticals, from the window's first row on."""
    sums[:] = np.float32(0.0)
    for k in range(len(along)):
        row, weight = between[k], along[k]
        for i in range(len(sums)):
            sums[i] += weight * row[i]


@njit(cache=True, error_model="numpy")
def _correlate_across(
    means: NDArray[np.float32], scale: NDArray[np.float32], across: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Mean, covariance and mean square in windows across verticals."""
    mean, cov, square = sums[0], sums[1], sums[2]
    sums[:] = np.float32(0.0)
    width = len(scale)
    for i in range(width):
        means[i] *= scale[i]
        means[width + i] *= scale[i]
    for k in range(across.shape[1]):
        weight, lever = across[0, k], across[1, k]
        grey, squares = means[k:], means[width + k :]
        for c in range(len(mean)):
            mean[c] += weight * grey[c]
            cov[c] += lever * grey[c]
            square[c] += weight * squares[c]


@njit(cache=True, error_model="numpy")
def _respond(
    sums: NDArray[np.float32], regulariser: np.float32, visible: NDArray[np.bool_],
    response: NDArray[np.float32],
) -> None:  # fmt: skip
    mean, cov, square = sums[0], sums[1], sums[2]
    for c in range(len(response)):
        # Rounding can make a vanishing variance negative.
        variance = abs(square[c] - mean[c] * mean[c])
        value = cov[c] * abs(cov[c]) / (variance + regulariser)
        response[c] = value if visible[c] else np.float32(0.0)


@njit(cache=True, error_model="numpy")
def find_maxima(
    response: NDArray[np.float32], band_row: NDArray[np.int32], threshold: float, supported: bool
) -> Maxima:
    """Maxima of the response along rows parallel to the horizon.

    Parameters
    ----------
    response : (K, W) float32
        See `band_response`.
    band_row : (K, W) int32
        Image rows of these; -1 where tracks may not start.
    threshold : float
        Least absolute response.
    supported : bool
        Leave out maxima beside which there is none of the same sign on either neighbouring row.
    """
    levels, width = response.shape
    least = np.float32(threshold)
    inner = max(width - 2, 0)
    # Column c of row k has its byte at [k + 1, c + SUPPORT]: 1 for positive maxima, 2 for others.
    length = -(-(width + 2 * SUPPORT) // _WORD) * _WORD
    kinds = np.zeros((levels + 2, length), np.uint8)
    for k in range(levels if inner > 0 else 0):
        lefts = response[k, :inner]
        heres = response[k, 1 : inner + 1]
        rights = response[k, 2 : inner + 2]
        allowed = band_row[k, 1 : inner + 1]
        own = kinds[k + 1, SUPPORT + 1 : SUPPORT + 1 + inner]
        for i in range(inner):
            left = lefts[i]
            here = heres[i]
            right = rights[i]
            rising = (here >= least) & (left < here) & (right <= here) & (allowed[i] >= 0)
            falling = (here <= -least) & (left > here) & (right >= here) & (allowed[i] >= 0)
            own[i] = np.uint8(rising) | (np.uint8(falling) << np.uint8(1))
    near = np.zeros((levels + 2, length), np.uint8)
    if supported:
        for k in range(1, levels + 1):
            wide = near[k, SUPPORT : SUPPORT + width]
            for shift in range(2 * SUPPORT + 1):
                beside = kinds[k, shift : shift + width]
                for i in range(width):
                    wide[i] |= beside[i]
    level = np.empty(levels * width, np.int32)
    column = np.empty(len(level), np.int32)
    sign = np.empty(len(level), np.float32)
    n = 0
    for k in range(1, levels + 1):
        if supported:
            own = kinds[k]
            above = near[k - 1]
            below = near[k + 1]
            # `near` of this row is not needed any more but by the next one.
            for i in range(length):
                own[i] &= above[i] | below[i]
        words = kinds[k].view(np.uint64)
        for word in range(len(words)):
            if words[word] == 0:
                continue
            for i in range(_WORD * word, _WORD * word + _WORD):
                kind = kinds[k, i]
                if kind:
                    level[n] = k - 1
                    column[n] = i - SUPPORT
                    sign[n] = 1.0 if kind == 1 else -1.0
                    n += 1
    return Maxima(level[:n], column[:n], sign[:n])


@njit(cache=True, error_model="numpy")
def strongest_first(score: NDArray[np.float32]) -> NDArray[np.int32]:
    """Indices of scores from 0 to 1, the largest first; of equal ones the first is first."""
    count = len(score)
    begin = np.zeros(_CLASSES + 1, np.int32)
    kind = np.empty(count, np.int32)
    for i in range(count):
        share = np.float32(1.0) - score[i]
        kind[i] = min(max(int(share * np.float32(_CLASSES)), 0), _CLASSES - 1)
        begin[kind[i] + 1] += 1
    for k in range(_CLASSES):
        begin[k + 1] += begin[k]
    order = np.empty(count, np.int32)
    filled = begin.copy()
    for i in range(count):
        at = filled[kind[i]]
        filled[kind[i]] += 1
        while at > begin[kind[i]] and score[order[at - 1]] < score[i]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
    return order


@njit(cache=True, error_model="numpy")
def ordered_starts(
    response: NDArray[np.float32], band_row: NDArray[np.int32], maxima: Maxima
) -> LineStarts:
    """Maxima, the highest first."""
    level, column, sign = maxima
    count = len(level)
    score = np.empty(count, np.float32)
    for i in range(count):
        score[i] = abs(response[level[i], column[i]])
    order = strongest_first(score)
    row_of = np.empty(count, np.int32)
    column_of = np.empty(count, np.int32)
    sign_of = np.empty(count, np.float32)
    score_of = np.empty(count, np.float32)
    for k in range(count):
        i = order[k]
        row_of[k] = band_row[level[i], column[i]]
        column_of[k] = column[i]
        sign_of[k] = sign[i]
        score_of[k] = score[i]
    return LineStarts(row_of, column_of, sign_of, score_of)
