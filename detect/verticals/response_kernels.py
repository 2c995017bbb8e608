"""Compiled: the filter everywhere, on the rows near the horizon, and where tracks go.

Groups of `LANES` neighbouring verticals begin `STEP` columns apart and overlap, so that the columns
round an edge are all in one of them. Windows that are cut off, which the vectors do not reach, are
computed number by number.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.uncounted import uncounted_contracting
from detect.vector_code import LANES, WORD
from detect.verticals.band_vector_kernels import (
    BLOCK,
    RUN,
    TILE,
    interpolate,
    interpolate_runs,
    response_across,
    sums_along,
)
from detect.verticals.filter_vector_kernels import (
    moments_across,
    moments_across_two,
    response_along,
    response_along_two,
)

if TYPE_CHECKING:
    from detect.verticals.response import LineFilter, ResponseOnDemand, StartBand, Strip

#: Groups of verticals begin `STEP` columns apart, and `MARGIN` columns before the first of their
#: own, so that a column's two neighbours on either side are in the same group.
STEP = 4
MARGIN = 2

_ZERO = np.float32(0.0)
#: Grey values about 0 keep the small variances exact in single precision.
_MIDDLE = np.float32(128.0)


@njit(cache=True, error_model="numpy")
def _cut_response(
    moments: NDArray[np.float32], along: NDArray[np.float32], noise: np.float32, v: int,
    first: int, last: int,
) -> np.float32:  # fmt: skip
    """Response in a window that is cut off at a vertical's ends, from its (3, H) moments."""
    s = (len(along) - 1) // 2
    share = np.float32(0.0)
    mean = np.float32(0.0)
    cov = np.float32(0.0)
    square = np.float32(0.0)
    for k in range(max(-s, first - v), min(s, last - v) + 1):
        w = along[k + s]
        share += w
        mean += w * moments[0, v + k]
        cov += w * moments[1, v + k]
        square += w * moments[2, v + k]
    mean /= share
    cov /= share
    return cov * abs(cov) / (abs(square / share - mean * mean) + noise)


@njit(cache=True, error_model="numpy")
def strip_response(
    image: NDArray[np.uint8], column: NDArray[np.float32], strip: Strip, window: LineFilter
) -> NDArray[np.float32]:
    """The response at each pixel of the strip.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    column : (H, W) float32
        Column at which each vertical crosses each row (see `lut.verticals.VerticalTable`).
    strip, window
        Ends of the verticals; the filter. Along the line it is cut off, and made up for, where the
        vertical ends.

    Returns
    -------
    (H, W) float32
        ``cov |cov| / (variance + regulariser)``, in [-1, 1]; positive where the image is brighter
        on the right; 0 where the window leaves the image.
    """
    height, width = image.shape
    weights, along, regulariser = window.weights, window.along, window.regulariser
    r = weights.shape[1] // 2
    s = (len(along) - 1) // 2
    response = np.empty((height, width), np.float32)
    # Means, covariances and mean squares.
    moments = np.zeros((3, height, width), np.float32)
    mean_strip, cov_strip, square_strip = moments[0], moments[1], moments[2]
    grey = np.empty(width, np.float32)
    mean = np.zeros(width, np.float32)
    cov = np.zeros(width, np.float32)
    square = np.zeros(width, np.float32)
    leftmost = np.float32(r)
    rightmost = np.float32(width - 1 - r)
    for v in range(height):
        for u in range(width):
            grey[u] = np.float32(image[v, u]) - _MIDDLE
        centre = weights[0, r]
        for u in range(r, width - r):
            g = grey[u]
            mean[u] = centre * g
            cov[u] = np.float32(0.0)
            square[u] = centre * g * g
        for k in range(1, r + 1):
            w = weights[0, r + k]
            h = weights[1, r + k]
            for u in range(r, width - r):
                left = grey[u - k]
                right = grey[u + k]
                mean[u] += w * (left + right)
                cov[u] += h * (right - left)
                square[u] += w * (left * left + right * right)
        for c in range(width):
            x = column[v, c]
            if x >= leftmost and x < rightmost:
                j = int(x)
                f = x - np.float32(j)
                mean_strip[v, c] = mean[j] + f * (mean[j + 1] - mean[j])
                cov_strip[v, c] = cov[j] + f * (cov[j + 1] - cov[j])
                square_strip[v, c] = square[j] + f * (square[j + 1] - square[j])
    for v in range(height):
        mean[:] = 0.0
        cov[:] = 0.0
        square[:] = 0.0
        for k in range(max(-s, -v), min(s, height - 1 - v) + 1):
            w = along[k + s]
            for c in range(width):
                mean[c] += w * mean_strip[v + k, c]
            for c in range(width):
                cov[c] += w * cov_strip[v + k, c]
            for c in range(width):
                square[c] += w * square_strip[v + k, c]
        for c in range(width):
            # Rounding can make a vanishing variance negative.
            variance = square[c] - mean[c] * mean[c]
            grey[c] = cov[c] * abs(cov[c]) / (abs(variance) + regulariser)
        for c in range(width):
            x = column[v, c]
            response[v, c] = grey[c] if (x >= leftmost) & (x < rightmost) else np.float32(0.0)
    # Near a vertical's ends the window is cut off.
    for c in range(width):
        first = strip.first_row[c]
        last = strip.last_row[c]
        for end in range(2):
            lowest = first if end == 0 else max(last - s + 1, first + s)
            highest = min(first + s - 1, last) if end == 0 else last
            for v in range(lowest, highest + 1):
                x = column[v, c]
                if x >= leftmost and x < rightmost:
                    response[v, c] = _cut_response(
                        moments[:, :, c], along, regulariser, v, first, last
                    )
    return response


@njit(cache=True, error_model="numpy")
def _from_cache_line(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """The numbers from where a line of the cache begins: vectors do not cross two of them."""
    return numbers[-(numbers.ctypes.data // 4) % 16 :]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def band_response(
    image: NDArray[np.uint8], band: StartBand, window: LineFilter
) -> NDArray[np.float32]:
    """Responses on rows parallel to the horizon, with the window applied to the strip itself.

    Near the horizon the strip's columns are a pixel wide. There it hardly matters whether the
    moments across the vertical are taken in the image and interpolated, or the grey values and
    their squares are interpolated first; the latter is separable, and fast.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    band, window
        The rows; the filter.

    Returns
    -------
    (K, W) float32
        As `strip_response`.
    """
    along = window.along
    width = image.shape[1]
    tiles, rows = band.pixel.shape[:2]
    padded = tiles * TILE
    response = np.empty(band.row.shape, np.float32)
    levels = len(response)
    taps = band.weights.shape[2]
    r = taps // 2
    inner = width - 2 * r
    if inner <= 0 or image.size <= RUN:
        response[:] = _ZERO
        return response
    flat = image.reshape(-1)
    flat_pixel = band.pixel.reshape(-1)
    flat_part = band.part.reshape(-1)
    flat_scale = band.scale.reshape(-1)
    flat_weights = band.weights.reshape(-1)
    runs, lengths, odd = band.runs, band.lengths, band.odd
    # Some columns at a time, so that interpolated values stay in the innermost cache.
    plane = rows * TILE
    between = _from_cache_line(np.empty(2 * plane + 16, np.float32))
    length = padded + (BLOCK + taps + 15) // 16 * 16
    sums_plane = levels * length
    sums = _from_cache_line(np.empty(2 * sums_plane + 16, np.float32))
    for tile in range(tiles):
        left = tile * TILE
        for row in range(rows):
            interpolate_runs(
                flat, runs, lengths, flat_part, (tile * rows + row) * (TILE // RUN), between, plane,
                row * TILE,
            )  # fmt: skip
        for n in range(band.odd_bounds[tile], band.odd_bounds[tile + 1]):
            interpolate(flat, flat_pixel, flat_part, odd[n], between, plane, odd[n] - tile * plane)
        for k in range(levels):
            for own in range(0, TILE, BLOCK):
                sums_along(
                    between, plane, k * band.spacing * TILE + own, TILE, along, len(along),
                    flat_scale, k * padded + left + own, sums, sums_plane, k * length + left + own,
                )  # fmt: skip
    for row in range(2 * levels):
        # Results for the padding are not used, but arbitrary values in it may take long.
        sums[row * length + padded : (row + 1) * length] = _ZERO
    values = np.empty(length, np.float32)
    for k in range(levels):
        for c in range(0, inner, BLOCK):
            response_across(
                sums, sums_plane, k * length + c, flat_weights, 2 * k * taps, taps,
                window.regulariser, values, c,
            )  # fmt: skip
        response[k, :r] = _ZERO
        response[k, r + inner :] = _ZERO
        out = response[k, r : r + inner]
        shown = band.visible[k, r : r + inner]
        for c in range(inner):
            out[c] = values[c] if shown[c] else _ZERO
    return response


@uncounted_contracting
def _cut_responses(lazy: ResponseOnDemand, group: int, v: int) -> None:
    """Responses of a group in a row where windows are cut off at each vertical's own ends."""
    strip, window, moments = lazy.strip, lazy.window, lazy.moments
    along = window.along
    width, height = strip.rise.shape
    plane = height * LANES
    half_width = window.weights.shape[1] // 2
    leftmost = np.float32(half_width)
    rightmost = np.float32(width - 1 - half_width)
    s = len(along) // 2
    to = group * plane + v * LANES
    base = min(max(group * STEP - MARGIN, 0), width - LANES)
    for lane in range(LANES):
        c = base + lane
        lazy.response[to + lane] = np.float32(0.0)
        x = strip.column[to + lane]
        if not (x >= leftmost and x < rightmost):
            continue
        share = np.float32(0.0)
        mean = np.float32(0.0)
        cov = np.float32(0.0)
        square = np.float32(0.0)
        for y in range(max(strip.first_row[c], v - s), min(strip.last_row[c], v + s) + 1):
            w = along[y - v + s]
            at = LANES * y + lane
            share += w
            mean += w * moments[at]
            cov += w * moments[at + plane]
            square += w * moments[at + 2 * plane]
        mean /= share
        cov /= share
        variance = abs(square / share - mean * mean)
        lazy.response[to + lane] = cov * abs(cov) / (variance + window.regulariser)


@uncounted_contracting
def _moments_of_rows(lazy: ResponseOnDemand, group: int, first: int, after: int) -> None:
    """Moments across the verticals of a group in some rows."""
    column, weights = lazy.strip.column, lazy.window.weights_between
    width, height = lazy.strip.rise.shape
    plane = height * LANES
    half_width = lazy.window.weights.shape[1] // 2
    leftmost = np.float32(half_width)
    rightmost = np.float32(width - 1 - half_width)
    words = weights.shape[1] // WORD
    at_group = group * plane
    y = first
    while y + 1 < after:
        moments_across_two(
            lazy.pixels, y * width - half_width, width, column, at_group + y * LANES, leftmost,
            rightmost, weights, words, lazy.moments, plane, y * LANES,
        )  # fmt: skip
        y += 2
    if y < after:
        moments_across(
            lazy.pixels, y * width - half_width, width, column, at_group + y * LANES, leftmost,
            rightmost, weights, words, lazy.moments, plane, y * LANES,
        )  # fmt: skip


@uncounted_contracting
def respond(lazy: ResponseOnDemand, group: int, begin: int, end: int) -> None:
    """Evaluate the filter in some rows of a group of verticals."""
    strip, along, moments, rows = lazy.strip, lazy.window.along, lazy.moments, lazy.moment_rows
    response, regulariser = lazy.response, lazy.window.regulariser
    width, height = strip.rise.shape
    half_width = lazy.window.weights.shape[1] // 2
    plane = height * LANES
    s = len(along) // 2
    leftmost = np.float32(half_width)
    rightmost = np.float32(width - 1 - half_width)
    top = strip.ends[group, 0]
    bottom = strip.ends[group, 1]
    full_top = strip.ends[group, 2]
    full_bottom = strip.ends[group, 3]
    first = max(begin - s, top)
    after = min(end - 1 + s, bottom) + 1
    if rows[0] != group or first > rows[2] or after < rows[1]:
        rows[0] = group
        rows[1] = first
        rows[2] = first
    _moments_of_rows(lazy, group, first, min(after, rows[1]))
    _moments_of_rows(lazy, group, max(first, rows[2]), after)
    rows[1] = min(rows[1], first)
    rows[2] = max(rows[2], after)
    alike = top == full_top and bottom == full_bottom
    one = np.float32(1.0)
    v = begin
    while v < end:
        at = group * plane + v * LANES
        if v - s >= full_top and v + s <= full_bottom:
            if v + 1 < end and v + 1 + s <= full_bottom:
                response_along_two(
                    moments, plane, (v - s) * LANES, along, 0, len(along), one, regulariser,
                    strip.column, at, leftmost, rightmost, response, at,
                )  # fmt: skip
                v += 1
            else:
                response_along(
                    moments, plane, (v - s) * LANES, along, 0, len(along), one, regulariser,
                    strip.column, at, leftmost, rightmost, response, at,
                )  # fmt: skip
        elif alike:
            highest = max(v - s, top)
            share = np.float32(0.0)
            for k in range(highest - v + s, min(v + s, bottom) - v + s + 1):
                share += along[k]
            response_along(
                moments, plane, highest * LANES, along, highest - v + s,
                min(v + s, bottom) - highest + 1, one / share, regulariser, strip.column, at,
                leftmost, rightmost, response, at,
            )  # fmt: skip
        else:
            _cut_responses(lazy, group, v)
        v += 1
