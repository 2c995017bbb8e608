"""Compiled loops that follow edges: response along verticals, starts, tracks.

A *strip* image has a pixel (v, c) for row v of the vertical that crosses the horizon at column c
(see `lut.verticals`): the building's verticals are its columns, whatever the camera's pose and
distortion.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


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
    across: NDArray[np.float32],
    lever: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: float,
    response: NDArray[np.float32],
) -> None:
    """Signed squared correlation of grey value and column, in a window along each vertical.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    column, first_row, last_row
        The table (see `lut.verticals.VerticalTable`).
    across, lever : (2r + 1,) float32
        Weights across the line, of sum 1, and the coordinate that is correlated with the grey
        value, of weighted mean 0 and variance 1.
    along : (2s + 1,) float32
        Weights along the line, of sum 1; cut off and made up for where the vertical ends.
    regulariser : float
        Added to the window's variance (grey values squared).
    response : (H, W) float32
        Result: ``cov |cov| / (variance + regulariser)``, in [-1, 1]; positive where the image is
        brighter on the right; 0 where the window leaves the image.
    """
    height, width = image.shape
    r = (len(across) - 1) // 2
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
        centre = across[r]
        for u in range(r, width - r):
            g = grey[u]
            mean[u] = centre * g
            cov[u] = np.float32(0.0)
            square[u] = centre * g * g
        for k in range(1, r + 1):
            w = across[r + k]
            h = across[r + k] * lever[r + k]
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
    noise = np.float32(regulariser)
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
            grey[c] = cov[c] * abs(cov[c]) / (abs(variance) + noise)
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
                        mean_strip, cov_strip, square_strip, along, noise, v, c, first, last
                    )


@njit(cache=True, error_model="numpy")
def find_starts(
    response: NDArray[np.float32],
    horizon_row: NDArray[np.float64],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    band_rows: int,
    spacing_rows: int,
    threshold: float,
    border_rows: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Maxima of the response across the strip, on the horizon and on rows above and below it.

    Parameters
    ----------
    response : (H, W) float32
        See `strip_response`.
    horizon_row, first_row, last_row
        The table.
    band_rows, spacing_rows : int
        Rows at the horizon and every `spacing_rows` up to `band_rows` from it are looked at.
    threshold : float
        Least absolute response.
    border_rows : int
        Rows at the image's border that are left out.

    Returns
    -------
    row, column : (N,) int32
        Strip pixels of the maxima.
    score : (N,) float32
        Absolute response there.
    """
    height, width = response.shape
    steps = band_rows // spacing_rows
    row = np.empty(width * (2 * steps + 1), np.int32)
    column = np.empty(len(row), np.int32)
    score = np.empty(len(row), np.float32)
    n = 0
    for c in range(1, width - 1):
        if first_row[c] > last_row[c]:
            continue
        horizon = math.floor(horizon_row[c] + 0.5)
        lowest = max(first_row[c], border_rows)
        highest = min(last_row[c], height - 1 - border_rows)
        for k in range(-steps, steps + 1):
            v = horizon + k * spacing_rows
            if v < lowest or v > highest:
                continue
            here = abs(response[v, c])
            if here < threshold:
                continue
            sign = 1.0 if response[v, c] > 0.0 else -1.0
            if sign * response[v, c - 1] < here and sign * response[v, c + 1] <= here:
                row[n] = v
                column[n] = c
                score[n] = here
                n += 1
    return row[:n], column[:n], score[:n]


@njit(cache=True, error_model="numpy")
def _top_of_parabola(left: float, centre: float, right: float) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return 0.5 * (left - right) / bend if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _follow(
    response: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    sign: float,
    start_row: int,
    start_column: float,
    direction: int,
    pitch: float,
    roll: float,
    threshold: float,
    max_gap: int,
    border: int,
    pull: float,
    reach: float,
    out_row: NDArray[np.int32],
    out_column: NDArray[np.float64],
    out_score: NDArray[np.float32],
) -> int:
    """Follow an edge row by row, one way; return how many points were written."""
    height, width = response.shape
    v = start_row
    here = start_column
    n = 0
    gap = 0
    while gap <= max_gap:
        v += direction
        if v < border or v > height - 1 - border:
            break
        j = math.floor(here + 0.5)
        if j < 1 or j > width - 2:
            break
        # A vertical leans by this much in the strip of a tilted camera.
        lean = pitch * math.sin(bearing[j]) - roll * math.cos(bearing[j])
        rise = elevation_tan[v, j] - elevation_tan[v - direction, j]
        if not math.isfinite(rise):
            break
        here += 2.0 * lean * rise / (bearing[j + 1] - bearing[j - 1])
        j = math.floor(here + 0.5)
        if j < 2 or j > width - 3:
            break
        left = sign * response[v, j - 1]
        centre = sign * response[v, j]
        right = sign * response[v, j + 1]
        if left > centre and left > right:
            j -= 1
            right = centre
            centre = left
            left = sign * response[v, j - 1]
        elif right > centre:
            j += 1
            left = centre
            centre = right
            right = sign * response[v, j + 1]
        seen = False
        if centre >= threshold and centre >= left and centre >= right:
            offset = j + _top_of_parabola(left, centre, right) - here
            seen = abs(offset) <= reach
            if seen:
                out_row[n] = v
                out_column[n] = here + offset
                out_score[n] = centre
                n += 1
                here += max(pull, 1.0 / (n + 1.0)) * offset
        gap = 0 if seen else gap + 1
    return n


@njit(cache=True, error_model="numpy")
def follow_edges(
    response: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    start_row: NDArray[np.int32],
    start_column: NDArray[np.int32],
    pitch: float,
    roll: float,
    threshold: float,
    max_gap: int,
    border: int,
    pull: float,
    reach: float,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.float32],
]:
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    response : (H, W) float32
        See `strip_response`.
    bearing, elevation_tan
        The table.
    start_row, start_column : (N,) int32
        Strip pixels to start from, in this order.
    pitch, roll : float
        Tilt that the edges are expected to show (rad); 0 for none.
    threshold : float
        Least absolute response of a point.
    max_gap : int
        Rows without a point that are bridged.
    border : int
        Rows at the image's border that are left out.
    pull : float
        Part of a point's offset by which the expected position of the next one moves; more for the
        first points, whose mean it is. 1 follows any curve, small values only verticals.
    reach : float
        Largest offset of a point from its expected position, columns.

    Returns
    -------
    sign : (T,) float64
        Polarity of each track: 1 where the image is brighter on the right, -1 on the left.
    bounds : (T + 1,) int64
        Track t's points are ``bounds[t] : bounds[t + 1]``, from top to bottom.
    row, column, score : (P,) int32, float64, float32
        The points: row and sub-pixel column in the strip, absolute response.
    """
    height, width = response.shape
    followed = np.zeros((2, height, width), np.bool_)
    capacity = 64 * height
    row = np.empty(capacity, np.int32)
    column = np.empty(capacity, np.float64)
    score = np.empty(capacity, np.float32)
    sign = np.empty(len(start_row), np.float64)
    bounds = np.zeros(len(start_row) + 1, np.int64)
    up_row = np.empty(height, np.int32)
    up_column = np.empty(height, np.float64)
    up_score = np.empty(height, np.float32)
    tracks = 0
    n = 0
    for start in range(len(start_row)):
        v = start_row[start]
        c = start_column[start]
        polarity = 1.0 if response[v, c] > 0.0 else -1.0
        layer = 0 if polarity > 0.0 else 1
        if followed[layer, v, c]:
            continue
        if n + height > capacity:
            capacity *= 2
            grown_row = np.empty(capacity, np.int32)
            grown_row[:n] = row[:n]
            row = grown_row
            grown_column = np.empty(capacity, np.float64)
            grown_column[:n] = column[:n]
            column = grown_column
            grown_score = np.empty(capacity, np.float32)
            grown_score[:n] = score[:n]
            score = grown_score
        centre = polarity * response[v, c]
        at = c + _top_of_parabola(
            polarity * response[v, c - 1], centre, polarity * response[v, c + 1]
        )
        above = _follow(
            response, bearing, elevation_tan, polarity, v, at, -1, pitch, roll,
            threshold, max_gap, border, pull, reach, up_row, up_column, up_score,
        )  # fmt: skip
        for i in range(above):
            row[n + i] = up_row[above - 1 - i]
            column[n + i] = up_column[above - 1 - i]
            score[n + i] = up_score[above - 1 - i]
        n += above
        row[n] = v
        column[n] = at
        score[n] = centre
        n += 1
        n += _follow(
            response, bearing, elevation_tan, polarity, v, at, 1, pitch, roll,
            threshold, max_gap, border, pull, reach, row[n:], column[n:], score[n:],
        )  # fmt: skip
        for i in range(bounds[tracks], n):
            j = math.floor(column[i] + 0.5)
            for k in range(max(0, j - 1), min(width, j + 2)):
                followed[layer, row[i], k] = True
        sign[tracks] = polarity
        tracks += 1
        bounds[tracks] = n
    return sign[:tracks], bounds[: tracks + 1], row[:n], column[:n], score[:n]
