"""Compiled loops that evaluate the filter: everywhere, and on the rows near the horizon.

A *strip* image has a pixel (v, c) for row v of the vertical that crosses the horizon at column c
(see `lut.verticals`): the building's verticals are its columns, whatever the camera's pose and
distortion.

The response at a pixel of the strip is the signed squared correlation of grey value and distance
across the vertical in a Gaussian window, cov |cov| / (variance + regulariser). Tracks evaluate it
where they go (`detect.verticals.follow_kernels.follow_edges`).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.band_vector_kernels import (
    BLOCK,
    RUN,
    TILE,
    interpolate,
    interpolate_runs,
    response_across,
    sums_along,
)

_ZERO = np.float32(0.0)
#: Grey values about 0 keep the small variances exact in single precision.
_MIDDLE = np.float32(128.0)


@njit(cache=True, error_model="numpy")
def _cut_response(
    mean_strip: NDArray[np.float32],
    cov_strip: NDArray[np.float32],
    square_strip: NDArray[np.float32],
    along: NDArray[np.float32],
    noise: np.float32,
    v: int,
    c: int,
    first: int,
    last: int,
) -> np.float32:
    """Response in a window that is cut off at a vertical's ends."""
    s = (len(along) - 1) // 2
    share = np.float32(0.0)
    mean = np.float32(0.0)
    cov = np.float32(0.0)
    square = np.float32(0.0)
    for k in range(max(-s, first - v), min(s, last - v) + 1):
        w = along[k + s]
        share += w
        mean += w * mean_strip[v + k, c]
        cov += w * cov_strip[v + k, c]
        square += w * square_strip[v + k, c]
    mean /= share
    cov /= share
    return cov * abs(cov) / (abs(square / share - mean * mean) + noise)


@njit(cache=True, error_model="numpy")
def strip_response(
    image: NDArray[np.uint8],
    column: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    response: NDArray[np.float32],
) -> None:
    """Signed squared correlation of grey value and column, in a window along each vertical.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    column, first_row, last_row
        The table (see `lut.verticals.VerticalTable`).
    weights, along, regulariser
        The filter (see `detect.verticals.filter.LineFilter`). Along the line it is cut off, and
        made up for, where the vertical ends.
    response : (H, W) float32
        Result: ``cov |cov| / (variance + regulariser)``, in [-1, 1]; positive where the image is
        brighter on the right; 0 where the window leaves the image.
    """
    height, width = image.shape
    r = weights.shape[1] // 2
    s = (len(along) - 1) // 2
    mean_strip = np.zeros((height, width), np.float32)
    cov_strip = np.zeros((height, width), np.float32)
    square_strip = np.zeros((height, width), np.float32)
    grey = np.empty(width, np.float32)
    mean = np.zeros(width, np.float32)
    cov = np.zeros(width, np.float32)
    square = np.zeros(width, np.float32)
    leftmost = np.float32(r)
    rightmost = np.float32(width - 1 - r)
    for v in range(height):
        # Grey values about 0 keep the small variances exact in single precision.
        for u in range(width):
            grey[u] = np.float32(image[v, u]) - np.float32(128.0)
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
        first = first_row[c]
        last = last_row[c]
        for end in range(2):
            lowest = first if end == 0 else max(last - s + 1, first + s)
            highest = min(first + s - 1, last) if end == 0 else last
            for v in range(lowest, highest + 1):
                x = column[v, c]
                if x >= leftmost and x < rightmost:
                    response[v, c] = _cut_response(
                        mean_strip, cov_strip, square_strip, along, regulariser, v, c, first, last
                    )


@njit(cache=True, error_model="numpy")
def _from_cache_line(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """The numbers from where a line of the cache begins: vectors do not cross two of them."""
    return numbers[-(numbers.ctypes.data // 4) % 16 :]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def band_response(
    image: NDArray[np.uint8],
    pixel: NDArray[np.int32],
    runs: NDArray[np.int32],
    lengths: NDArray[np.uint8],
    odd: NDArray[np.int32],
    odd_bounds: NDArray[np.int32],
    part: NDArray[np.float32],
    scale: NDArray[np.float32],
    visible: NDArray[np.bool_],
    spacing: int,
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    response: NDArray[np.float32],
) -> None:
    """Responses on rows parallel to the horizon, with the window laid over the strip itself.

    Near the horizon the strip's columns are a pixel wide. There it hardly matters whether the
    moments across the vertical are taken in the image and interpolated, or the grey values and
    their squares are interpolated first; the latter is separable, and fast.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    pixel, runs, lengths, odd, odd_bounds, part
        See `detect.verticals.filter.StartBand`.
    scale : (K, P) float32
        One over the sum of the weights along the vertical that lie on it, for each row of the
        result.
    visible : (K, W) bool
        Where the result is to be other than 0.
    spacing : int
        Rows of the strip from one row of the result to the next; the first of them is row s.
    weights : (K, 2, 2r + 1) float32
        Weights across the vertical, as those of the filter, for each row of the result.
    along, regulariser
        The filter (see `detect.verticals.filter.LineFilter`).
    response : (K, W) float32
        Result: as `strip_response`.
    """
    width = image.shape[1]
    tiles, rows = pixel.shape[:2]
    padded = tiles * TILE
    levels = len(response)
    taps = weights.shape[2]
    r = taps // 2
    inner = width - 2 * r
    if inner <= 0 or image.size <= RUN:
        response[:] = _ZERO
        return
    flat = image.reshape(-1)
    flat_pixel = pixel.reshape(-1)
    flat_part = part.reshape(-1)
    flat_scale = scale.reshape(-1)
    flat_weights = weights.reshape(-1)
    # Some columns at a time: what is between the pixels stays in the innermost cache.
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
        for n in range(odd_bounds[tile], odd_bounds[tile + 1]):
            interpolate(flat, flat_pixel, flat_part, odd[n], between, plane, odd[n] - tile * plane)
        for k in range(levels):
            for own in range(0, TILE, BLOCK):
                sums_along(
                    between, plane, k * spacing * TILE + own, TILE, along, len(along), flat_scale,
                    k * padded + left + own, sums, sums_plane, k * length + left + own,
                )  # fmt: skip
    for row in range(2 * levels):
        # What is computed of it is not looked at, but may take long.
        sums[row * length + padded : (row + 1) * length] = _ZERO
    values = np.empty(length, np.float32)
    for k in range(levels):
        for c in range(0, inner, BLOCK):
            response_across(
                sums, sums_plane, k * length + c, flat_weights, 2 * k * taps, taps, regulariser,
                values, c,
            )  # fmt: skip
        response[k, :r] = _ZERO
        response[k, r + inner :] = _ZERO
        out = response[k, r : r + inner]
        shown = visible[k, r : r + inner]
        for c in range(inner):
            out[c] = values[c] if shown[c] else _ZERO
