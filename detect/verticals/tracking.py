"""Tracking: edges followed up and down from where they cross the horizon.

In each row the expected position of an edge moves as verticals do in a camera of the given tilt;
the highest of the three responses round it, and the parabola through this and its neighbours, give
the point; the expected position then yields to the point's offset by the larger of `pull` and one
over the number of points.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineSettings
from detect.verticals.response import FloatArray, Strip, StripResponse, extend
from detect.verticals.starts import LineStarts

#: Rows that are filtered ahead of a track.
_AHEAD = 8


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
    complete : bool
        Whether all edges were followed.
    """

    polarity: FloatArray
    bounds: NDArray[np.int64]
    row: NDArray[np.int32]
    column: FloatArray
    score: NDArray[np.float32]
    complete: bool

    @property
    def points(self) -> NDArray[np.int64]:
        """(T,) number of points of each track."""
        return np.diff(self.bounds)

    @property
    def top_row(self) -> NDArray[np.int32]:
        """(T,) first row of each track."""
        return self.row[self.bounds[:-1]]

    @property
    def bottom_row(self) -> NDArray[np.int32]:
        """(T,) last row of each track."""
        return self.row[self.bounds[1:] - 1]


class Following(NamedTuple):
    """How edges are followed.

    Attributes
    ----------
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
        No more edges are followed once there are this many tracks
    least_points, least_score : int, float
        with at least this number of points and this sum of scores.
    """

    threshold: float
    max_gap: int
    border: int
    pull: float
    reach: float
    enough: int
    least_points: int
    least_score: float


class _Points(NamedTuple):
    """Points of one track."""

    row: NDArray[np.int32]
    column: FloatArray
    score: NDArray[np.float32]


#: More edges than any image has.
ALL_EDGES = 2**31


@lru_cache(maxsize=32)
def following_of(
    settings: LineSettings, row_aspect: float, guided: bool, enough: int = ALL_EDGES
) -> Following:
    """How edges are followed with some settings: along the verticals of a tilt, or without one."""
    return Following(
        threshold=float(settings.threshold),
        max_gap=settings.gap_rows,
        border=settings.border_rows,
        pull=float(settings.guided_pull) if guided else 1.0,
        reach=float(settings.guided_reach_px) if guided else 1.0,
        enough=enough,
        least_points=settings.least_points(row_aspect),
        least_score=float(settings.least_evidence / row_aspect),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _top_of_parabola(left: np.float32, centre: np.float32, right: np.float32) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return float(0.5 * (left - right) / bend) if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def sum_of(numbers: NDArray[np.float32]) -> float:
    """The sum, in double precision."""
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i]
    return total


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
def _evaluate(response: StripResponse, c: int, v: int, direction: int) -> None:
    """Evaluate the response of verticals c - 1 to c + 1 at row v and at some rows further on."""
    height = response.value.shape[1]
    if direction > 0:
        extend(response, (c - 1, c + 2), (v, min(v + _AHEAD, height)))
    else:
        extend(response, (c - 1, c + 2), (max(v - _AHEAD + 1, 0), v + 1))


@njit(cache=True, error_model="numpy", forceinline=True)
def _is_known(known: NDArray[np.int32], c: int, v: int) -> bool:
    return bool(known[c, 0] <= v and v < known[c, 1])


@njit(cache=True, error_model="numpy", forceinline=True)
def _follow(
    response: StripResponse, rise: NDArray[np.float32], columns_per_rise: FloatArray,
    sign: np.float32, start: tuple[int, float], direction: int, following: Following,
    points: _Points,
) -> int:  # fmt: skip
    """Follow an edge from a row and column on, and return how many points there are.

    0 if there is none in the first row. Points are written from the middle of the results on, in
    this direction.
    """
    # Numba counts references to arrays in tuples wherever they are taken out of these.
    value, known = response.value, response.known
    point_row, point_column, point_score = points.row, points.column, points.score
    width, height = rise.shape
    border, pull, threshold = following.border, following.pull, following.threshold
    v = start[0]
    j, part = _place(0, start[1])
    n = 0
    gap = 0
    while gap <= following.max_gap:
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
            if not (
                _is_known(known, near - 1, v)
                and _is_known(known, near, v)
                and _is_known(known, near + 1, v)
            ):
                _evaluate(response, near, v, direction)
            left = sign * value[near - 1, v]
            centre = sign * value[near, v]
            right = sign * value[near + 1, v]
            # Once to the side if the highest of the three is not the one in the middle.
            if near != j or not (left > centre or right > centre):
                break
            near += -1 if left > centre and left > right else 1
        off = near - j - part
        seen = centre >= threshold and centre >= left and centre >= right
        if seen:
            off += _top_of_parabola(left, centre, right)
        # A start is known to a column only.
        if seen and (n == 0 or abs(off) <= following.reach):
            at = height + direction * n
            point_row[at] = v
            point_column[at] = j + (part + off)
            point_score[at] = centre
            # The start counts as the expected position, not as a point that confirms it.
            yielding = max(pull, 1.0 / (n + 1.0)) if n > 0 else 1.0
            j, part = _place(j, part + yielding * off)
            n += 1
            gap = 0
        elif n == 0:
            break
        else:
            gap += 1
    return n


@njit(cache=True, error_model="numpy")
def _with_points(points: _Points, n: int, capacity: int) -> _Points:
    """The first n points, and capacity for more."""
    row = np.empty(capacity, np.int32)
    column = np.empty(capacity, np.float64)
    score = np.empty(capacity, np.float32)
    row[:n] = points.row[:n]
    column[:n] = points.column[:n]
    score[:n] = points.score[:n]
    return _Points(row, column, score)


@njit(cache=True, error_model="numpy", forceinline=True)
def _follow_both_ways(
    response: StripResponse, rise: NDArray[np.float32], columns_per_rise: FloatArray,
    sign: np.float32, start: tuple[int, int], following: Following, points: _Points,
) -> tuple[int, int]:  # fmt: skip
    """Follow an edge up and down; its points are from the first place to before the second."""
    middle = rise.shape[1]
    begin = end = middle
    column = float(start[1])
    for direction in (-1, 1):
        n = _follow(
            response, rise, columns_per_rise, sign, (start[0], column), direction, following, points
        )
        # Starts were searched less thoroughly.
        if n == 0:
            break
        if direction < 0:
            begin, end = middle + 1 - n, middle + 1
            column = float(points.column[middle])
        else:
            end = middle + n
    return begin, end


@njit(cache=True, error_model="numpy")
def _mark(
    followed: NDArray[np.bool_], lowest: int, row: NDArray[np.int32], column: FloatArray
) -> None:
    """Mark the three columns round points as followed, on rows on which there are starts."""
    rows, width = followed.shape
    for i in range(len(row)):
        if 0 <= row[i] - lowest < rows:
            j = math.floor(column[i] + 0.5)
            for k in range(max(0, j - 1), min(width, j + 2)):
                followed[row[i] - lowest, k] = True


@njit(cache=True, error_model="numpy", forceinline=True)
def follow_edges(
    response: StripResponse, strip: Strip, starts: LineStarts, following: Following,
    tilt_rad: tuple[float, float],
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
    following : Following
        How.
    tilt_rad : (float, float)
        Pitch and roll that the edges are expected to show; 0 for none.
    """
    width, height = strip.rise.shape
    columns_per_rise = tilt_rad[0] * strip.lean_by_pitch + tilt_rad[1] * strip.lean_by_roll
    count = len(starts.row)
    lowest = starts.row.min() if count > 0 else 0
    highest = starts.row.max() if count > 0 else -1
    # By polarity; only rows on which there are starts matter.
    followed = np.zeros((2, highest - lowest + 1, width), np.bool_)
    empty = _Points(np.empty(0, np.int32), np.empty(0), np.empty(0, np.float32))
    own = _with_points(empty, 0, 2 * height + 1)
    found = _with_points(empty, 0, 16 * height)
    sign = np.empty(count)
    bounds = np.zeros(count + 1, np.int64)
    tracks = 0
    counting = 0
    complete = True
    for start in range(count):
        if counting >= following.enough:
            complete = False
            break
        v, c, polarity = starts.row[start], starts.column[start], starts.polarity[start]
        marks = followed[0 if polarity > 0.0 else 1]
        if marks[v - lowest, c]:
            continue
        begin, end = _follow_both_ways(
            response, strip.rise, columns_per_rise, polarity, (v, c), following, own
        )
        if begin == end:
            continue
        n, after = bounds[tracks], bounds[tracks] + end - begin
        if after > len(found.row):
            found = _with_points(found, n, 2 * len(found.row) + height)
        found.row[n:after] = own.row[begin:end]
        found.column[n:after] = own.column[begin:end]
        found.score[n:after] = own.score[begin:end]
        _mark(marks, lowest, own.row[begin:end], own.column[begin:end])
        sign[tracks] = polarity
        tracks += 1
        bounds[tracks] = after
        score = sum_of(own.score[begin:end])
        counting += end - begin >= following.least_points and score >= following.least_score
    n = bounds[tracks]
    return LineTracks(
        sign[:tracks], bounds[: tracks + 1], found.row[:n], found.column[:n], found.score[:n],
        complete,
    )  # fmt: skip
