"""Tracking: edges followed up and down from where they cross the horizon.

In each row the highest of the three responses round the expected place of an edge, and the parabola
through this and its neighbours, give the point. From row to row the expected place moves like a
vertical, and by the lean of the edge against that; both yield to the point's offset, the place by a
share of it and the lean, per row, by another one. The shares fall with the number n of points as
those of a straight line through n points fitted by least squares do,

    2 (2 n - 1) / (n (n + 1))    and    6 / (n (n + 1)),

down to constants (alpha-beta filter: P. R. Kalata, The Tracking Index, IEEE Transactions on
Aerospace and Electronic Systems 20, 1984). So a track needs no tilt to follow leaning verticals,
and does not leave them where other edges cross. The response is evaluated in stripes along the
places expected.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_settings import LineNumbers
from detect.verticals.response import (
    STRIPE_ROWS,
    FloatArray,
    LineFilter,
    SingleArray,
    Strip,
    Stripe,
    empty_stripe,
    respond,
)
from detect.verticals.starts import LineStarts

#: That an edge leans no more than verticals of a tilted camera counts like so many points.
_UPRIGHT_POINTS = 4


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


class _Path(NamedTuple):
    """The path of a stripe from row `first` on.

    At `row` it is at column `place` of the strip; it leans by `lean` columns per tangent of
    elevation, as measured at the vertical `column`.
    """

    first: int
    row: int
    column: int
    place: float
    lean: float


class _Edge(NamedTuple):
    """Where an edge is, how it leans (as a path does), and from how many points that is known."""

    place: float
    lean: float
    points: int


@njit(cache=True, error_model="numpy")
def follow_edges(
    image: NDArray[np.uint8], strip: Strip, window: LineFilter, starts: LineStarts,
    numbers: LineNumbers,
) -> LineTracks:  # fmt: skip
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    strip, window
        The table, the filter.
    starts : LineStarts
        Where to start, in this order.
    numbers : LineNumbers
        Threshold, gaps, border, and how a track is guided.
    """
    height, width = image.shape
    lowest, highest = height, -1
    for v in starts.row:
        lowest, highest = min(lowest, v), max(highest, v)
    # Columns that were followed, by polarity, on the rows that have starts.
    followed = np.zeros((2, max(highest - lowest + 1, 0), width), np.bool_)
    count = len(starts.first)
    polarity, bounds = np.empty(count), np.zeros(count + 1, np.int64)
    found_row, found_column = np.empty(count * height, np.int32), np.empty(count * height)
    found_score = np.empty(count * height, np.float32)
    stripe = empty_stripe(window)
    # Of the edge that is followed, by row; no score where there is no point.
    column, score = np.empty(height), np.zeros(height, np.float32)
    tracks = n = 0
    for start in starts.first:
        sign = np.float32(1.0) if starts.value[start] > 0.0 else np.float32(-1.0)
        marks = followed[0 if sign > 0.0 else 1]
        strongest, bottom = start, start
        k = start
        while k >= 0:
            if sign * starts.value[k] > sign * starts.value[strongest]:
                strongest = k
            k, bottom = starts.below[k], k
        if marks[starts.row[strongest] - lowest, int(starts.column[strongest] + 0.5)]:
            continue
        top, bottom = starts.row[start], starts.row[bottom]
        lean = _take_chain(strip, starts, start, column, score)
        edge = _Edge(column[top], lean, bottom - top + 1)
        first, last = top, bottom
        for direction in (-1, 1):
            v = top if direction < 0 else bottom
            edge = _Edge(column[v], edge.lean, edge.points)
            end, edge = _follow(
                image, strip, stripe, numbers, (v, direction, sign), edge, column, score
            )
            first, last = min(first, end), max(last, end)
        for row in range(first, last + 1):
            if score[row] > 0.0:
                found_row[n], found_column[n], found_score[n] = row, column[row], score[row]
                score[row] = 0.0
                n += 1
                if 0 <= row - lowest < len(marks):
                    j = math.floor(column[row] + 0.5)
                    for k in range(max(0, j - 1), min(width, j + 2)):
                        marks[row - lowest, k] = True
        polarity[tracks] = sign
        tracks += 1
        bounds[tracks] = n
    return LineTracks(
        polarity[:tracks],
        bounds[: tracks + 1],
        found_row[:n].copy(),
        found_column[:n].copy(),
        found_score[:n].copy(),
    )


@njit(cache=True, error_model="numpy")
def _take_chain(
    strip: Strip, starts: LineStarts, start: int, column: FloatArray, score: SingleArray
) -> float:
    """Points on the straight lines between the maxima of a chain; returns the chain's lean."""
    row, place, value, rise = (
        starts.row,
        starts.column,
        starts.value,
        strip.rise[int(starts.column[start])],
    )
    v, k = row[start], start
    column[v], score[v] = place[k], abs(value[k])
    n, x, y, xx, xy = 1.0, 0.0, 0.0, 0.0, 0.0
    while starts.below[k] >= 0:
        other = starts.below[k]
        rows = row[other] - row[k]
        for i in range(1, rows + 1):
            share = i / rows
            column[row[k] + i] = (1.0 - share) * place[k] + share * place[other]
            score[row[k] + i] = abs((1.0 - share) * value[k] + share * value[other])
        above, beside = rise[row[other]] - rise[v], place[other] - place[start]
        n, x, y = n + 1.0, x + above, y + beside
        xx, xy = xx + above * above, xy + above * beside
        k = other
    return (n * xy - x * y) / (n * xx - x * x) if n >= 3.0 else 0.0


@njit(cache=True, error_model="numpy", forceinline=True)
def _follow(
    image: NDArray[np.uint8], strip: Strip, stripe: Stripe, numbers: LineNumbers,
    start: tuple[int, int, np.float32], edge: _Edge, column: FloatArray, score: SingleArray,
) -> tuple[int, _Edge]:  # fmt: skip
    """Follow an edge of some polarity from a row on in a direction; the last row as well."""
    # Numba counts references to arrays in tuples wherever they are taken out of these.
    at, rise, response, middle = strip.column, strip.rise, stripe.response, stripe.middle
    width, height = rise.shape
    pull, reach, threshold = numbers.guided_pull, numbers.guided_reach_px, numbers.threshold
    border, max_gap = numbers.border_rows, numbers.gap_rows
    rightmost = response.shape[1] - 2 * stripe.window.reach - 3
    v, direction, sign = start
    place, lean, points = edge.place, edge.lean, edge.points
    path = _Path(height, v, int(place), place, lean)
    end, gap = v, 0
    while gap <= max_gap:
        v += direction
        if v < border or v > height - 1 - border:
            break
        climb = rise[path.column, v] - rise[path.column, v - direction]
        place += lean * climb
        per_column = at[path.column + 1, v] - at[path.column, v]
        near, beside = -1, np.float64(0.0)
        if path.first <= v < path.first + STRIPE_ROWS:
            beside = (place - _place_on(path, rise, v)) * per_column
            if math.isfinite(beside):
                near = middle + math.floor(beside + 0.5)
        if not 2 <= near <= rightmost:
            # The edge leaves the stripe.
            j = int(place) if 1.5 <= place < width - 2.5 else 0
            per_column = at[j + 1, v] - at[j, v]
            if j == 0 or not math.isfinite(per_column):
                break
            path = _Path(v if direction > 0 else v - STRIPE_ROWS + 1, v, j, place, lean)
            for i in range(len(stripe.path)):
                row = path.first - stripe.window.half_length + i
                stripe.path[i] = np.nan
                if 0 <= row < height:
                    part = _place_on(path, rise, row) - j
                    stripe.path[i] = at[j, row] + part * (at[j + 1, row] - at[j, row])
            respond(image, path.first, stripe)
            near, beside = middle, np.float64(0.0)
        # Once to the side if the highest of the three is not the one in the middle.
        left, here, right = _three(response, v - path.first, near, sign)
        if left > here or right > here:
            near += -1 if left > right else 1
            left, here, right = _three(response, v - path.first, near, sign)
        off = near - middle - beside
        bend = left - here - here + right
        # The top of the parabola through the three.
        off += 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        if here >= threshold and here >= left and here >= right and abs(off) <= reach:
            points += 1
            off /= per_column
            column[v], score[v] = place + off, here
            place += off * max(pull, (4.0 * points - 2.0) / (points * (points + 1.0)))
            if pull < 1.0:
                alike = points + _UPRIGHT_POINTS
                share = max(pull * pull / (2.0 - pull), 6.0 / (alike * (alike + 1.0)))
                lean += share * off / climb
            gap = 0
            end = v
        else:
            gap += 1
    return end, _Edge(place, lean, points)


@njit(cache=True, error_model="numpy", forceinline=True)
def _place_on(path: _Path, rise: SingleArray, v: int) -> float:
    """Where a path crosses a row, as a column of the strip."""
    return path.place + path.lean * float(rise[path.column, v] - rise[path.column, path.row])


@njit(cache=True, error_model="numpy", forceinline=True)
def _three(
    response: SingleArray, b: int, c: int, sign: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    return sign * response[b, c - 1], sign * response[b, c], sign * response[b, c + 1]
