"""Starts of tracks: maxima of the response on rows parallel to the horizon.

Every vertical crosses the horizon, or the anchor that replaces it (`lut.verticals`). On a few rows
around it the response is evaluated at all columns, with the filter applied to the strip itself:
there the strip's columns are a pixel wide, and it hardly matters whether moments are computed in
the image and then interpolated, or grey values and their squares are interpolated first. The latter
is separable: first along the verticals, then across.

An edge has a maximum on each of these rows. Such maxima, one below the other, form a *chain*.
Maxima outside chains are dropped, and long chains already are short tracks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import MIDDLE_GREY, correlate, divide, padded, weights_across
from detect.verticals.tilt import strongest_first
from lut.verticals import VerticalTable
from redetect.array_types import BoolArray, ByteArray, Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

#: Starts have to be on chains if each line crosses at least this number of rows of the band.
_CROSSED = 3
#: Largest distance of a chain's maxima on neighbouring rows of the band, columns.
_APART = 1.5
_LEAST = 2  #: Least number of maxima of a chain if starts have to be on chains.


class StartBand(NamedTuple):
    """The K rows parallel to the anchor on which tracks start, and the filter's tables for them.

    The filter is evaluated on row s (half its length) of R rows, and every `spacing` rows after it.
    """

    #: (K, W) image rows at which the filter is evaluated; -1 where no track may start
    row: NDArray[np.int32]
    #: (R, W) index into the flat image of the pixel on the left of each pixel of the band
    pixel: NDArray[np.int32]
    #: (R, W) weights of this pixel and of the one on its right: of linear interpolation, and 0
    #: beyond the ends of the vertical
    left: Float32Array
    right: Float32Array
    #: (K, W) one over the sum of the weights that are on the vertical; 0 if there are none
    scale: Float32Array
    #: (K, 2, T) the filter's weights across the vertical, for the strip's columns, which are a
    #: pixel apart on the horizon only
    across: Float32Array
    #: (L,) those along it. 2r + 1 and 2s + 1 weights are followed by zeros, as in `LineFilter`.
    along: Float32Array
    reach: int  # r, pixels
    spacing: int
    #: Whether each line crosses several of these rows, so that starts have to be on chains
    chained: bool


class LineStarts(NamedTuple):
    """Chains of maxima of the response, from which tracks start."""

    #: (N,) the uppermost maximum of each chain, the chain of the highest response first
    first: IntArray
    row: IntArray  # (M,) image row of each maximum
    #: (M,) top of the parabola through the maximum and its neighbours, columns of the strip
    column: FloatArray
    value: Float32Array  # (M,) signed response
    below: IntArray  # (M,) the next maximum of the chain; -1 for none


def start_band(table: VerticalTable, settings: LineSettings) -> StartBand:
    """The rows near the horizon on which tracks start."""
    along = weights_across(settings.sigma_along_rows)[0]
    s, spacing = len(along) // 2, settings.start_spacing_rows
    height, width = table.column.shape
    steps = settings.start_band_rows // spacing
    reach = steps * spacing + s
    anchor = np.where(table.usable, np.floor(table.anchor_row + 0.5), 0.0).astype(np.intp)

    row = anchor + np.arange(-reach, reach + 1)[:, None]
    on_vertical = (row >= table.first_row) & (row <= table.last_row)
    x = np.where(on_vertical, table.column[np.where(on_vertical, row, 0), np.arange(width)], 0.0)
    j = np.minimum(x.astype(np.int32), max(width - 2, 0))

    evaluated = slice(s, 2 * reach + 1 - s, spacing)
    # Windows are cut off where the vertical ends.
    share = np.concatenate([[0.0], np.cumsum(along)])
    middle = row[evaluated]
    below = np.clip(table.last_row - middle + s + 1, 0, 2 * s + 1)
    above = np.clip(table.first_row - middle + s, 0, 2 * s + 1)
    on_it = np.maximum(share[below] - share[above], 0.0)
    spacing_px = [_typical_spacing(x[i], on_vertical[i]) for i in range(*evaluated.indices(len(x)))]
    across = np.array([weights_across(settings.sigma_across_px, px) for px in spacing_px])
    r = across.shape[2] // 2
    visible = on_vertical[evaluated] & (x[evaluated] >= r) & (x[evaluated] < width - 1 - r)
    border = settings.border_rows
    allowed = visible & (middle >= border) & (middle <= height - 1 - border)
    long_enough = settings.least_points(table.row_aspect) >= _CROSSED * spacing
    return StartBand(
        row=np.where(allowed, middle, -1).astype(np.int32),
        pixel=np.where(on_vertical, row * width + j, 0).astype(np.int32),
        left=np.where(on_vertical, 1.0 - (x - j), 0.0).astype(np.float32),
        right=np.where(on_vertical, x - j, 0.0).astype(np.float32),
        scale=np.divide(1.0, on_it, out=np.zeros_like(on_it), where=on_it > 0.0).astype(np.float32),
        across=padded(across),
        along=padded(along),
        reach=r,
        spacing=spacing,
        chained=steps > 0 and long_enough,
    )


def _typical_spacing(x: FloatArray, on_vertical: BoolArray) -> float:
    """Median distance of neighbouring verticals in a row, pixels; 1 if there are none."""
    both = on_vertical[1:] & on_vertical[:-1]
    return float(np.median(np.abs(np.diff(x)[both]))) if both.any() else 1.0


def band_response(image: GreyImage, band: StartBand, regulariser: float) -> Float32Array:
    """(K, W) responses on the rows of the band, 0 where tracks may not start."""
    levels, width = band.row.shape
    response = np.zeros((levels, width), np.float32)
    if width > 2 * band.reach and image.size > 1:
        _filter_band(image.reshape(-1), band, np.float32(regulariser), response)
    return response


# Vectorised loops have functions of their own, which take arrays as separate arguments.


@kernel()
def _filter_band(
    pixels: ByteArray, band: StartBand, regulariser: np.float32, response: Float32Array
) -> None:
    levels, width = response.shape
    rows, taps = len(band.pixel), band.across.shape[2]
    # Grey values and their squares, followed by finite values for the padding of the weights.
    between = np.empty((rows + len(band.along), 2 * width), np.float32)
    means = np.empty(2 * width + taps, np.float32)
    between[rows:] = means[2 * width :] = np.float32(0.0)
    sides = np.empty((2, width), np.uint8)
    for k in range(rows):
        _interpolate(pixels, band.pixel[k], band.left[k], band.right[k], sides, between[k])
    inner = slice(band.reach, width - band.reach)
    moments = np.empty((3, width - 2 * band.reach), np.float32)
    for k in range(levels):
        above = between[k * band.spacing :].reshape(-1)
        correlate(above, band.along, 2 * width, means[: 2 * width])
        for m in range(2):
            _scale(means[m * width :], band.scale[k])
        for m in range(3):
            correlate(means[m // 2 * width :], band.across[k, m % 2], 1, moments[m])
        divide(moments, regulariser, response[k, inner])
        _leave_out(band.row[k], response[k])


@kernel(forceinline=True)
def _scale(means: Float32Array, scale: Float32Array) -> None:
    for c in range(len(scale)):
        means[c] *= scale[c]


@kernel(forceinline=True)
def _leave_out(row: NDArray[np.int32], response: Float32Array) -> None:
    for c in range(len(response)):
        response[c] = response[c] if row[c] >= 0 else np.float32(0.0)


@kernel()
def _interpolate(
    pixels: ByteArray, pixel: NDArray[np.int32], left: Float32Array, right: Float32Array,
    sides: ByteArray, between: Float32Array,
) -> None:  # fmt: skip
    width = len(pixel)
    on_left, on_right, grey, square = sides[0], sides[1], between[:width], between[width:]
    for c in range(width):
        place = np.uint64(pixel[c])
        on_left[c] = pixels[place]
        on_right[c] = pixels[place + np.uint64(1)]
    for c in range(width):
        a = np.float32(on_left[c]) - MIDDLE_GREY
        b = np.float32(on_right[c]) - MIDDLE_GREY
        grey[c] = left[c] * a + right[c] * b
        square[c] = left[c] * (a * a) + right[c] * (b * b)


@kernel()
def line_starts(response: Float32Array, band: StartBand, threshold: float) -> LineStarts:
    """Chains of maxima of the response (K, W) of at least a threshold on the rows of the band.

    If each line crosses several of these, a chain has at least two maxima.
    """
    rows, least = band.row, _LEAST if band.chained else 1
    levels, width = response.shape
    size = response.size
    row, column, value = np.empty(size, np.int64), np.empty(size), np.empty(size, np.float32)
    below = np.empty(size, np.int64)
    # For each maximum the first one of its chain; for that one, the chain's length and strength.
    chain, length, strength = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size)
    n = above = begin = 0
    for k in range(levels):
        # Maxima of the row above are those from `above` to before `begin`.
        above, begin = begin, n
        for c in range(1, width - 1):
            here = response[k, c]
            if abs(here) < threshold:
                continue
            left, right = response[k, c - 1], response[k, c + 1]
            if here > 0.0 and not (left < here and right <= here):
                continue
            if here < 0.0 and not (left > here and right >= here):
                continue
            place = c + 0.5 * float(left - right) / float(left - here - here + right)
            row[n], column[n], value[n], below[n] = rows[k, c], place, here, -1
            chain[n], length[n], strength[n] = n, 1, abs(here)
            # Each continues the chain of the nearest maximum above that has no successor yet.
            while above < begin and column[above] <= place - 2.0 * _APART:
                above += 1
            nearest, link = _APART, -1
            other = above
            while other < begin and column[other] < place + _APART:
                apart = abs(column[other] - place)
                if value[other] * here > 0.0 and apart < nearest and below[other] < 0:
                    nearest, link = apart, other
                other += 1
            if link >= 0:
                first = chain[link]
                chain[n], below[link] = first, n
                length[first] += 1
                strength[first] = max(strength[first], strength[n])
            n += 1
    first, count = np.empty(n, np.int64), 0
    for i in range(n):
        if chain[i] == i and length[i] >= least:
            first[count], strength[count] = i, strength[i]
            count += 1
    order = strongest_first(strength[:count])
    return LineStarts(first[order], row[:n], column[:n], value[:n], below[:n])
