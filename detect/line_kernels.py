"""Compiled loops that follow edges through the strip image: starts and tracks.

The strip image is that of `detect.line_response_kernels`. Tracks evaluate the filter where they go:
first its moments across the vertical, which are kept, then along it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: Rows that are filtered ahead of a track.
_AHEAD = 8


@njit(cache=True, error_model="numpy")
def find_starts(
    response: NDArray[np.float32], band_row: NDArray[np.int32], threshold: float
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Maxima of the response along rows parallel to the horizon.

    Parameters
    ----------
    response : (K, W) float32
        See `band_response`.
    band_row : (K, W) int32
        Image rows of these; -1 where tracks may not start.
    threshold : float
        Least absolute response.

    Returns
    -------
    row, column : (N,) int32
        Strip pixels of the maxima.
    sign : (N,) float32
        1 where the response is positive, else -1.
    score : (N,) float32
        Absolute response there.
    """
    steps, width = response.shape
    row = np.empty(steps * width, np.int32)
    column = np.empty(len(row), np.int32)
    signs = np.empty(len(row), np.float32)
    score = np.empty(len(row), np.float32)
    least = np.float32(threshold)
    n = 0
    for k in range(steps):
        for c in range(1, width - 1):
            here = abs(response[k, c])
            if here < least or band_row[k, c] < 0:
                continue
            sign = np.float32(1.0) if response[k, c] > 0.0 else np.float32(-1.0)
            if sign * response[k, c - 1] < here and sign * response[k, c + 1] <= here:
                row[n] = band_row[k, c]
                column[n] = c
                signs[n] = sign
                score[n] = here
                n += 1
    return row[:n], column[:n], signs[:n], score[:n]


@njit(cache=True, error_model="numpy")
def _top_of_parabola(left: np.float32, centre: np.float32, right: np.float32) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return float(0.5 * (left - right) / bend) if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def _follow(
    image: NDArray[np.uint8],
    table_column: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    moments: NDArray[np.float32],
    known: NDArray[np.int32],
    used: NDArray[np.int32],
    sign: np.float32,
    row: int,
    column: float,
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
    """Follow an edge from a row on, that one included; return how many points were written.

    0 if there is none in the first row. All in one piece: Numba counts references to each array in
    each call, which would take longer than evaluating the filter.
    """
    height, width = table_column.shape
    taps = weights.shape[1]
    w_left = weights[0]
    w_step = weights[1]
    h_left = weights[2]
    h_step = weights[3]
    grey_values = image.reshape(-1)
    r = taps // 2 - 1
    s = len(along) // 2
    leftmost = np.float32(r)
    rightmost = np.float32(width - 1 - r)
    zero = np.float32(0.0)
    middle = np.float32(128.0)
    unknown = np.float32(np.nan)
    v = row
    here = column
    n = 0
    gap = 0
    lean_column = -1
    columns_per_rise = 0.0
    while gap <= max_gap:
        if n > 0:
            v += direction
            if v < border or v > height - 1 - border:
                break
            j = math.floor(here + 0.5)
            if j < 1 or j > width - 2:
                break
            rise = elevation_tan[v, j] - elevation_tan[v - direction, j]
            if not math.isfinite(rise):
                break
            if j != lean_column:
                # A vertical leans by this much in the strip of a tilted camera.
                lean = pitch * math.sin(bearing[j]) - roll * math.cos(bearing[j])
                columns_per_rise = 2.0 * lean / (bearing[j + 1] - bearing[j - 1])
                lean_column = j
            here += columns_per_rise * rise
        j = math.floor(here + 0.5)
        if j < 2 or j > width - 3:
            break
        left = zero
        centre = zero
        right = zero
        # Three neighbours, and a fourth if the highest of them is not the one in the middle.
        for k in range(4):
            c = j - 1 + k
            if k == 3:
                if left > centre and left > right:
                    c = j - 2
                elif not right > centre:
                    break
            begin = known[c, 0]
            end = known[c, 1]
            column_moments = np.uint64(4 * known[c, 2] * height)
            kept = column_moments + np.uint64(3 * height + v)
            response = moments[kept] if begin <= v < end else unknown
            if math.isnan(response):
                response = zero
                x = table_column[v, c]
                if x >= leftmost and x < rightmost:
                    top = max(first_row[c], v - s)
                    bottom = min(last_row[c], v + s)
                    if begin >= end:
                        begin = top
                        end = top
                        known[c, 0] = top
                        known[c, 2] = used[0]
                        used[0] += 1
                        column_moments = np.uint64(4 * known[c, 2] * height)
                        kept = column_moments + np.uint64(3 * height + v)
                    if top < begin or bottom >= end:
                        # Some rows more than needed: the next ones will be.
                        if top < begin:
                            known[c, 0] = max(first_row[c], top - _AHEAD)
                        if bottom >= end:
                            known[c, 1] = min(last_row[c], bottom + _AHEAD) + 1
                        for y in range(known[c, 0], known[c, 1]):
                            if begin <= y < end:
                                continue
                            mean = zero
                            cov = zero
                            square = zero
                            x = table_column[y, c]
                            if x >= leftmost and x < rightmost:
                                f = x - np.float32(int(x))
                                at_pixel = np.uint64(y * width + int(x) - r)
                                for i in range(taps):
                                    tap = np.uint64(i)
                                    grey = np.float32(grey_values[at_pixel + tap]) - middle
                                    weighted = (w_left[tap] + f * w_step[tap]) * grey
                                    mean += weighted
                                    square += weighted * grey
                                    cov += (h_left[tap] + f * h_step[tap]) * grey
                            place = column_moments + np.uint64(y)
                            moments[place] = mean
                            moments[place + np.uint64(height)] = cov
                            moments[place + np.uint64(2 * height)] = square
                            moments[place + np.uint64(3 * height)] = unknown
                    mean = zero
                    cov = zero
                    square = zero
                    if bottom - top == 2 * s:
                        place = column_moments + np.uint64(top)
                        for i in range(2 * s + 1):
                            tap = np.uint64(i)
                            w = along[tap]
                            at = place + tap
                            mean += w * moments[at]
                            cov += w * moments[at + np.uint64(height)]
                            square += w * moments[at + np.uint64(2 * height)]
                    else:
                        share = zero
                        for y in range(top, bottom + 1):
                            w = along[y - v + s]
                            at = column_moments + np.uint64(y)
                            share += w
                            mean += w * moments[at]
                            cov += w * moments[at + np.uint64(height)]
                            square += w * moments[at + np.uint64(2 * height)]
                        mean /= share
                        cov /= share
                        square /= share
                    # Rounding can make a vanishing variance negative.
                    variance = abs(square - mean * mean)
                    response = cov * abs(cov) / (variance + regulariser)
                    moments[kept] = response
            response *= sign
            if c == j - 2:
                right = centre
                centre = left
                left = response
                j -= 1
                break
            if k == 3:
                j += 1
            left = centre
            centre = right
            right = response
        seen = False
        if centre >= threshold and centre >= left and centre >= right:
            offset = j + _top_of_parabola(left, centre, right) - here
            # A start is known to a column only.
            seen = n == 0 or abs(offset) <= reach
            if seen:
                out_row[n] = v
                out_column[n] = here + offset
                out_score[n] = centre
                # The start counts as the expected position, not as a point that confirms it.
                here += (max(pull, 1.0 / (n + 1.0)) if n > 0 else 1.0) * offset
                n += 1
        if n == 0:
            break
        gap = 0 if seen else gap + 1
    return n


@njit(cache=True, error_model="numpy")
def follow_edges(
    image: NDArray[np.uint8],
    table_column: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    bearing: NDArray[np.float64],
    elevation_tan: NDArray[np.float32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    moments: NDArray[np.float32],
    known: NDArray[np.int32],
    used: NDArray[np.int32],
    start_row: NDArray[np.int32],
    start_column: NDArray[np.int32],
    start_sign: NDArray[np.float32],
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
    image : (H, W) uint8
        Grey values.
    table_column, first_row, last_row, bearing, elevation_tan
        The table (see `lut.verticals.VerticalTable`).
    weights, along, regulariser
        The filter (see `detect.line_filter.LineFilter`): `weights_between`, `along`.
    moments : (4 * W * H,) float32
        Mean, covariance and mean square across the vertical and the response (NaN where it is not
        known yet), in the rows that are known: H of each for one column after the other, in the
        order in which they came to be needed.
    known : (W, 3) int32
        First of the known rows and the one after the last, of each column; its place in `moments`.
    used : (1,) int32
        How many places are taken.
    start_row, start_column : (N,) int32
        Strip pixels to start from, in this order.
    start_sign : (N,) float32
        Polarity of the edges there.
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
    height, width = table_column.shape
    lowest = height
    highest = 0
    for v in start_row:
        lowest = min(lowest, v)
        highest = max(highest, v)
    # Only rows on which there are starts matter.
    followed = np.zeros((2, max(highest - lowest + 1, 0), width), np.bool_)
    capacity = 16 * height
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
        polarity = start_sign[start]
        layer = 0 if polarity > 0.0 else 1
        if followed[layer, v - lowest, start_column[start]]:
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
        above = _follow(
            image, table_column, first_row, last_row, bearing, elevation_tan, weights, along,
            regulariser, moments, known, used, polarity, v,
            float(start_column[start]), -1, pitch, roll, threshold, max_gap, border, pull, reach,
            up_row, up_column, up_score,
        )  # fmt: skip
        if above == 0:
            # Starts were looked for with less care.
            continue
        for i in range(above):
            row[n + i] = up_row[above - 1 - i]
            column[n + i] = up_column[above - 1 - i]
            score[n + i] = up_score[above - 1 - i]
        n += above - 1
        n += _follow(
            image, table_column, first_row, last_row, bearing, elevation_tan, weights, along,
            regulariser, moments, known, used, polarity, v, up_column[0], 1,
            pitch, roll, threshold, max_gap, border, pull, reach, row[n:], column[n:], score[n:],
        )  # fmt: skip
        for i in range(bounds[tracks], n):
            if lowest <= row[i] <= highest:
                j = math.floor(column[i] + 0.5)
                for k in range(max(0, j - 1), min(width, j + 2)):
                    followed[layer, row[i] - lowest, k] = True
        sign[tracks] = polarity
        tracks += 1
        bounds[tracks] = n
    return sign[:tracks], bounds[: tracks + 1], row[:n], column[:n], score[:n]
