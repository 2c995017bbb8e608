"""Tracking: edges followed up and down from where they cross the horizon.

In each row the expected position of an edge moves as verticals do in a camera of the given tilt;
the highest of the three responses round it, and the parabola through this and its neighbours, give
the point; the expected position then yields to the point's offset by the larger of `pull` and one
over the number of points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineNumbers
from detect.verticals.response import BLOCK, FloatArray, SingleArray, Strip, StripResponse, extend
from detect.verticals.starts import LineStarts

#: More edges than any image has.
ALL_EDGES = 2**31


class LineTracks(NamedTuple):
    """Edges followed through the strip image.

    Track t's points are ``bounds[t] : bounds[t + 1]`` of the point arrays, from top to bottom.

    Attributes
    ----------
    polarity : (T,) float64
        1 where the image is brighter on the right of the edge, -1 on the left.
    bounds : (T + 1,) int64
        See above.
    row : (P,) int32
        Image row of each point.
    column : (P,) float64
        Column in the strip: of the horizon, where the vertical through the point crosses it.
    score : (P,) float32
        Absolute response at the point.
    """

    polarity: FloatArray
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: FloatArray
    score: SingleArray

    @property
    def points(self) -> NDArray[np.int64]:
        """(T,) number of points of each track."""
        return self.bounds[1:] - self.bounds[:-1]

    @property
    def top_row(self) -> NDArray[np.int32]:
        """(T,) first row of each track."""
        return self.row[self.bounds[:-1]]

    @property
    def bottom_row(self) -> NDArray[np.int32]:
        """(T,) last row of each track."""
        return self.row[self.bounds[1:] - 1]

    @property
    def total_score(self) -> FloatArray:
        """(T,) sum of the scores of each track."""
        return np.add.reduceat(self.score, self.bounds[:-1], dtype=np.float64)


def follow_edges(
    response: StripResponse, strip: Strip, starts: LineStarts, numbers: LineNumbers,
    tilt_rad: tuple[float, float] | None = None, enough: int = ALL_EDGES,
) -> LineTracks:  # fmt: skip
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    response : StripResponse
        The response; it is evaluated wherever edges go.
    strip : Strip
        The table.
    starts : LineStarts
        Where to start, in this order.
    numbers : LineNumbers
        Threshold, gaps, border, and how a track is guided.
    tilt_rad : (float, float), optional
        Pitch and roll that the edges are expected to show; without, they are followed wherever
        they go.
    enough : int
        Stop once there are this many tracks that may be lines.
    """
    if tilt_rad is None:
        # Any curve, and not only verticals.
        numbers = numbers._replace(guided_pull=1.0, guided_reach_px=1.0)
    return _follow_edges(response, strip, starts, numbers, tilt_rad or (0.0, 0.0), enough)


@njit(cache=True, error_model="numpy")
def _follow_edges(
    response: StripResponse,
    strip: Strip,
    starts: LineStarts,
    numbers: LineNumbers,
    tilt: tuple[float, float],
    enough: int,
) -> LineTracks:
    rise = strip.rise
    width, height = rise.shape
    # By how many columns an edge is expected to move for a rise of 1.
    columns_per_rise = np.empty(width)
    for c in range(width):
        lean = tilt[0] * strip.sine[c] - tilt[1] * strip.cosine[c]
        columns_per_rise[c] = lean * strip.columns_per_rad[c]
    count, least_score = len(starts.row), numbers.least_evidence / strip.row_aspect
    lowest, highest = height, -1
    for v in starts.row:
        lowest, highest = min(lowest, v), max(highest, v)
    # Columns that were followed, by polarity, on the rows that have starts.
    followed = np.zeros((2, max(highest - lowest + 1, 0), width), np.bool_)
    polarity, bounds = np.empty(count), np.zeros(count + 1, np.int64)
    found_row, found_column = np.empty(count * height, np.int32), np.empty(count * height)
    found_score = np.empty(count * height, np.float32)
    # Numba counts references to arrays in tuples wherever they are taken out of these.
    start_row, start_column, start_value = starts.row, starts.column, starts.value
    # Of the edge that is followed, by row; no score where there is no point.
    column, score = np.empty(height), np.zeros(height, np.float32)
    tracks = n = counting = 0
    for start in range(len(start_row)):
        if counting >= enough:
            break
        v, c = start_row[start], start_column[start]
        sign = np.float32(1.0) if start_value[start] > 0.0 else np.float32(-1.0)
        marks = followed[0 if sign > 0.0 else 1]
        if marks[v - lowest, c]:
            continue
        column[v] = c
        top = bottom = v
        for direction in (-1, 1):
            # Upward from the start, then downward from the point that was found there.
            begin = v, column[v], direction
            end = _follow(response, rise, columns_per_rise, numbers, sign, begin, column, score)
            top, bottom = min(top, end), max(bottom, end)
            if score[v] == 0.0:
                break
        first, total = n, 0.0
        for row in range(top, bottom + 1):
            if score[row] > 0.0:
                found_row[n], found_column[n], found_score[n] = row, column[row], score[row]
                total += score[row]
                score[row] = 0.0
                n += 1
                if 0 <= row - lowest < len(marks):
                    j = math.floor(column[row] + 0.5)
                    for k in range(max(0, j - 1), min(width, j + 2)):
                        marks[row - lowest, k] = True
        if n > first:
            polarity[tracks] = sign
            tracks += 1
            bounds[tracks] = n
            if n - first >= numbers.least_points and total >= least_score:
                counting += 1
    return LineTracks(
        polarity[:tracks],
        bounds[: tracks + 1],
        found_row[:n].copy(),
        found_column[:n].copy(),
        found_score[:n].copy(),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _place(column: int, part: float) -> tuple[int, float]:
    """Whole columns, and what is left, in [-0.5, 0.5).

    Whole columns change seldom: a processor that foresees them works on the next rows before it
    knows where in this one the edge is.
    """
    if part < -0.5 or part >= 0.5:
        whole = math.floor(part + 0.5)
        return column + whole, part - whole
    return column, part


@njit(cache=True, error_model="numpy", forceinline=True)
def _follow(
    response: StripResponse, rise: SingleArray, columns_per_rise: FloatArray,
    numbers: LineNumbers, sign: np.float32, start: tuple[int, float, int], column: FloatArray,
    score: SingleArray,
) -> int:  # fmt: skip
    """Follow an edge from a row and column on in a direction; return the last row.

    Nothing is found if there is no point in the first row.
    """
    # Numba counts references to arrays in tuples wherever they are taken out of these.
    value, known = response.value, response.known
    pull, reach, threshold = numbers.guided_pull, numbers.guided_reach_px, numbers.threshold
    border, max_gap = numbers.border_rows, numbers.gap_rows
    width, height = rise.shape
    v, place, direction = start
    j, part = _place(0, place)
    n = gap = 0
    end = v
    while gap <= max_gap:
        if n > 0:
            v += direction
            if v < border or v > height - 1 - border or j < 1 or j > width - 2:
                break
            # A vertical leans in the strip of a tilted camera.
            moved = columns_per_rise[j] * (rise[j, v] - rise[j, v - direction])
            if not math.isfinite(moved):
                break
            j, part = _place(j, part + moved)
        if j < 2 or j > width - 3:
            break
        near = j
        while True:
            block = v // BLOCK
            for c in range(near - 1, near + 2):
                if not known[c, block]:
                    extend(response, c, block)
            left, here, right = (
                sign * value[near - 1, v], sign * value[near, v], sign * value[near + 1, v]
            )  # fmt: skip
            # Once to the side if the highest of the three is not the one in the middle.
            if near != j or (left <= here and right <= here):
                break
            near += -1 if left > right else 1
        seen = here >= threshold and here >= left and here >= right
        off = near - j - part
        if seen:
            bend = left - here - here + right
            # The top of the parabola through the three.
            off += 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        # A start is known to a column only.
        if seen and (n == 0 or abs(off) <= reach):
            column[v], score[v] = j + (part + off), here
            # The start counts as the expected position, not as a point that confirms it.
            yielding = max(pull, 1.0 / (n + 1.0)) if n > 0 else 1.0
            j, part = _place(j, part + yielding * off)
            n += 1
            gap = 0
            end = v
        elif n == 0:
            break
        else:
            gap += 1
    return end
