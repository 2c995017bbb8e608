"""Compiled loops that follow edges through the strip image.

The strip image is that of `detect.verticals.response_kernels`. Tracks evaluate the filter where
they go, for a group of neighbouring verticals at a time (`detect.verticals.group_kernels`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.uncounted import uncounted_contracting
from detect.vector_code import LANES
from detect.verticals.group_kernels import MARGIN, STEP, respond
from detect.verticals.sum_kernels import sum_of

#: Rows that are filtered ahead of a track.
_AHEAD = 12


@njit(cache=True, error_model="numpy", forceinline=True)
def _top_of_parabola(left: np.float32, centre: np.float32, right: np.float32) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return float(0.5 * (left - right) / bend) if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy", forceinline=True)
def _index(number: int) -> np.uint64:
    """An index that the compiler need not compare with 0."""
    return np.uint64(number)


@uncounted_contracting
def _follow(
    pixels: NDArray[np.uint8],
    strip: NDArray[np.float32],
    ends: NDArray[np.int32],
    columns_per_rise: NDArray[np.float64],
    half_width: int,
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    rise: NDArray[np.float32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    moments: NDArray[np.float32],
    filtered: NDArray[np.int64],
    response: NDArray[np.float32],
    known: NDArray[np.int32],
    sign: np.float32,
    row: int,
    column: float,
    direction: int,
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

    0 if there is none in the first row. Points are written from the middle of the results on, in
    this direction.
    """
    width, height = rise.shape
    v = row
    # The expected position is j + part. Whole columns change seldom: a processor that foresees it
    # works on the next rows before it knows where in this one the edge is.
    j = math.floor(column + 0.5)
    part = column - j
    n = 0
    gap = 0
    while gap <= max_gap:
        if n > 0:
            v += direction
            if v < border or v > height - 1 - border or j < 1 or j > width - 2:
                break
            # A vertical leans in the strip of a tilted camera.
            moved = columns_per_rise[_index(j)] * (
                rise[_index(j), _index(v)] - rise[_index(j), _index(v - direction)]
            )
            if not math.isfinite(moved):
                break
            part += moved
            if part < -0.5 or part >= 0.5:
                whole = math.floor(part + 0.5)
                j += whole
                part -= whole
        if j < 2 or j > width - 3:
            break
        group = j // STEP
        if not known[_index(group), 0] <= v < known[_index(group), 1]:
            begin = max(v - (_AHEAD - 1 if direction < 0 else 0), 0)
            end = min(v + (_AHEAD - 1 if direction > 0 else 0), height - 1) + 1
            if known[group, 0] < known[group, 1]:
                if v < known[group, 0]:
                    end = known[group, 0]
                else:
                    begin = known[group, 1]
                known[group, 0] = min(begin, known[group, 0])
                known[group, 1] = max(end, known[group, 1])
            else:
                known[group, 0] = begin
                known[group, 1] = end
            respond(
                pixels, strip, ends, half_width, height, first_row, last_row, weights, along,
                regulariser, moments, filtered, group, begin, end, response,
            )  # fmt: skip
        base = min(max(group * STEP - MARGIN, 0), width - LANES)
        at = (group * height + v) * LANES + j - base
        left = sign * response[_index(at - 1)]
        centre = sign * response[_index(at)]
        right = sign * response[_index(at + 1)]
        off = -part
        # A fourth neighbour, if the highest of three is not the one in the middle.
        if left > centre and left > right:
            off -= 1.0
            right = centre
            centre = left
            left = sign * response[_index(at - 2)]
        elif right > centre:
            off += 1.0
            left = centre
            centre = right
            right = sign * response[_index(at + 2)]
        seen = False
        if centre >= threshold and centre >= left and centre >= right:
            off += _top_of_parabola(left, centre, right)
            # A start is known to a column only.
            seen = n == 0 or abs(off) <= reach
            if seen:
                place = _index(height + direction * n)
                out_row[place] = v
                out_column[place] = j + (part + off)
                out_score[place] = centre
                # The start counts as the expected position, not as a point that confirms it.
                yielding = pull if pull * (n + 1.0) >= 1.0 else 1.0 / (n + 1.0)
                part += (yielding if n > 0 else 1.0) * off
                if part < -0.5 or part >= 0.5:
                    whole = math.floor(part + 0.5)
                    j += whole
                    part -= whole
                n += 1
        if n == 0:
            break
        gap = 0 if seen else gap + 1
    return n


@njit(cache=True, error_model="numpy")
def follow_edges(
    pixels: NDArray[np.uint8],
    strip: NDArray[np.float32],
    ends: NDArray[np.int32],
    lean_by_pitch: NDArray[np.float64],
    lean_by_roll: NDArray[np.float64],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    rise: NDArray[np.float32],
    weights: NDArray[np.float32],
    half_width: int,
    along: NDArray[np.float32],
    regulariser: np.float32,
    response: NDArray[np.float32],
    known: NDArray[np.int32],
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
    enough: int,
    least_points: int,
    least_score: float,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int32],
    NDArray[np.float64],
    NDArray[np.float32],
    bool,
]:
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    pixels : (N,) uint8
        Grey values in scan order; where T > 2r + 2, behind the last of them as many as that more.
    strip, ends, rise, lean_by_pitch, lean_by_roll
        See `detect.verticals.strip.Strip`; the image is at least `LANES` wide.
    first_row, last_row
        The table (see `lut.verticals.VerticalTable`).
    weights : (4, T) float32
        See `detect.verticals.filter.LineFilter.weights_between`.
    half_width : int
        r: half the width of the window on whole pixels.
    along, regulariser
        The filter.
    response, known
        See `detect.verticals.filter.FilteredColumns`.
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
    enough : int
        No more edges are followed once there are so many tracks
    least_points, least_score : int, float
        of at least so many points and such a sum of scores.

    Returns
    -------
    sign : (T,) float64
        Polarity of each track: 1 where the image is brighter on the right, -1 on the left.
    bounds : (T + 1,) int64
        Track t's points are ``bounds[t] : bounds[t + 1]``, from top to bottom.
    row, column, score : (P,) int32, float64, float32
        The points: row and sub-pixel column in the strip, absolute response.
    complete : bool
        Whether all edges were followed.
    """
    width, height = rise.shape
    columns_per_rise = pitch * lean_by_pitch + roll * lean_by_roll
    # Means, covariances and mean squares.
    moments = np.empty(3 * height * LANES, np.float32)
    filtered = np.full(3, -1, np.int64)
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
    # One track; its start is in the middle.
    own_row = np.empty(2 * height + 1, np.int32)
    own_column = np.empty(2 * height + 1, np.float64)
    own_score = np.empty(2 * height + 1, np.float32)
    tracks = 0
    n = 0
    counting = 0
    complete = True
    for start in range(len(start_row)):
        if counting >= enough:
            complete = False
            break
        v = start_row[start]
        polarity = start_sign[start]
        layer = 0 if polarity > 0.0 else 1
        if followed[layer, v - lowest, start_column[start]]:
            continue
        begin = height
        end = height
        near = float(start_column[start])
        for direction in range(-1, 2, 2):
            count = _follow(
                pixels, strip, ends, columns_per_rise, half_width, first_row, last_row,
                rise, weights, along, regulariser, moments, filtered, response, known,
                polarity, v, near, direction, threshold, max_gap, border, pull, reach,
                own_row, own_column, own_score,
            )  # fmt: skip
            if count == 0:
                break
            if direction < 0:
                begin = height + 1 - count
                end = height + 1
                near = float(own_column[height])
            else:
                end = height + count
        if begin == end:
            # Starts were looked for with less care.
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
        # Views: that no index of theirs is negative the compiler knows.
        points = end - begin
        seen_row = own_row[begin:end]
        seen_column = own_column[begin:end]
        seen_score = own_score[begin:end]
        to_row = row[n : n + points]
        to_column = column[n : n + points]
        to_score = score[n : n + points]
        for i in range(points):
            to_row[i] = seen_row[i]
            to_column[i] = seen_column[i]
            to_score[i] = seen_score[i]
        n += points
        for i in range(points):
            if lowest <= seen_row[i] <= highest:
                j = math.floor(seen_column[i] + 0.5)
                for k in range(max(0, j - 1), min(width, j + 2)):
                    followed[layer, _index(seen_row[i] - lowest), _index(k)] = True
        sign[tracks] = polarity
        tracks += 1
        bounds[tracks] = n
        counting += points >= least_points and sum_of(seen_score) >= least_score
    return sign[:tracks], bounds[: tracks + 1], row[:n], column[:n], score[:n], complete
