"""Tracking: follows edges up and down from the horizon.

In each row the parabola through the highest of the three responses around the predicted position of
an edge and its neighbours gives the point. From row to row the prediction moves along the vertical,
and by the lean of the edge against that. Position and lean (per row) are both corrected by a share
of the point's offset from the prediction. The gains decrease with the number n of points like those
of a straight line fitted to n points by least squares,

    2 (2 n - 1) / (n (n + 1))    and    6 / (n (n + 1)),

down to constants (alpha-beta filter: P. R. Kalata, The Tracking Index, IEEE Transactions on
Aerospace and Electronic Systems 20, 1984). So a track follows leaning verticals without knowing the
tilt, even where other edges cross. The response is evaluated in stripes along the predictions.

Where an edge ends and another one continues beside it, such a track bends. Once the tilt is known,
the lean of verticals is known, too: rejected tracks can be followed again along the verticals,
where only the position is corrected, by 1 / n.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.line_settings import LineNumbers
from detect.verticals.response import STRIPE_ROWS, LineFilter, Strip, Stripe, empty_stripe, respond
from detect.verticals.starts import LineStarts
from redetect.array_types import BoolArray, Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

#: Number of points that the prior counts for: edges lean only as verticals of a tilted camera do.
_UPRIGHT_POINTS = 5
#: Largest offset of a point from the prediction along verticals of known lean, pixels.
_VERTICAL_REACH_PX = 1.0


class LineTracks(NamedTuple):
    """Edges followed through the strip image.

    Track t's points are ``bounds[t] : bounds[t + 1]`` of the point arrays, from top to bottom.
    """

    #: (T,) 1 if the image is brighter on the right of the edge, -1 if on the left
    polarity: FloatArray
    bounds: IntArray  # (T + 1,)
    row: NDArray[np.int32]  # (P,) image row of each point
    #: (P,) strip column: the column at which the vertical through the point crosses the horizon
    column: FloatArray
    score: Float32Array  # (P,) absolute response at the point


class Before(NamedTuple):
    """Tracks of an earlier pass, and how some of them are followed again."""

    tracks: LineTracks
    again: BoolArray  # (T,) which of them are followed again
    #: Pitch and roll (rad) that give the lean of their verticals; NaN: leans are estimated
    tilt: tuple[float, float]


_NO_TRACKS = LineTracks(
    np.empty(0), np.zeros(1, np.int64), np.empty(0, np.int32), np.empty(0), np.empty(0, np.float32)
)
NOTHING_BEFORE = Before(_NO_TRACKS, np.empty(0, np.bool_), (math.nan, math.nan))


class _Path(NamedTuple):
    """The path of a stripe from row `first` on.

    At `row` it is at strip column `place`; it leans by `lean` columns per tangent of elevation,
    measured at the vertical `column`.
    """

    first: int
    row: int
    column: int
    place: float
    lean: float


class _Edge(NamedTuple):
    """Position and lean of an edge (see `_Path`), and the number of points they are based on.

    The lean of a vertical may be known beforehand.
    """

    place: float
    lean: float
    points: int
    vertical: bool


@kernel()
def follow_edges(
    image: GreyImage, strip: Strip, window: LineFilter, starts: LineStarts,
    numbers: LineNumbers, before: Before,
) -> LineTracks:  # fmt: skip
    """Follow edges up and down from starts; starts on edges already followed are skipped.

    Tracks of an earlier pass that are not followed again come first in the result.
    """
    tracks, again, tilt = before
    height, width = image.shape
    lowest, highest = height, -1
    for v in starts.row:
        lowest, highest = min(lowest, v), max(highest, v)
    # Columns that were followed, by polarity, on the rows that have starts.
    followed = np.zeros((2, max(highest - lowest + 1, 0), width), np.bool_)
    most = len(again) + len(starts.first)
    polarity, bounds = np.empty(most), np.zeros(most + 1, np.int64)
    most = len(tracks.row) + len(starts.first) * height
    found_row, found_column = np.empty(most, np.int32), np.empty(most)
    found_score = np.empty(most, np.float32)
    count = n = 0
    for t in range(len(again)):
        if again[t]:
            continue
        marks = followed[0 if tracks.polarity[t] > 0.0 else 1]
        for i in range(tracks.bounds[t], tracks.bounds[t + 1]):
            row, place = tracks.row[i], tracks.column[i]
            found_row[n], found_column[n], found_score[n] = row, place, tracks.score[i]
            n += 1
            _mark(marks, row - lowest, place)
        polarity[count] = tracks.polarity[t]
        count += 1
        bounds[count] = n
    stripe = empty_stripe(window)
    vertical = not math.isnan(tilt[0])
    # The edge being followed, by row; score 0 without a point.
    column, score = np.empty(height), np.zeros(height, np.float32)
    for start in starts.first:
        sign = np.float32(1.0) if starts.value[start] > 0.0 else np.float32(-1.0)
        marks = followed[0 if sign > 0.0 else 1]
        strongest, bottom = start, start
        k = start
        while k >= 0:
            if sign * starts.value[k] > sign * starts.value[strongest]:
                strongest = k
            k, bottom = starts.below[k], k
        c = int(starts.column[strongest] + 0.5)
        if marks[starts.row[strongest] - lowest, c]:
            continue
        if vertical:
            top = bottom = starts.row[strongest]
            column[top], score[top] = starts.column[strongest], abs(starts.value[strongest])
            lean = tilt[0] * strip.sine[c] - tilt[1] * strip.cosine[c]
            edge = _Edge(column[top], lean * strip.columns_per_rad[c], 0, True)
        else:
            top, bottom = starts.row[start], starts.row[bottom]
            lean = _take_chain(strip, starts, start, column, score)
            edge = _Edge(column[top], lean, bottom - top + 1, False)
        first, last = top, bottom
        for direction in (-1, 1):
            v = top if direction < 0 else bottom
            points = 0 if vertical else edge.points
            edge = _Edge(column[v], edge.lean, points, vertical)
            begin = v, direction, sign
            end, edge = _follow(image, strip, stripe, numbers, begin, edge, column, score)
            first, last = min(first, end), max(last, end)
        for row in range(first, last + 1):
            if score[row] > 0.0:
                found_row[n], found_column[n], found_score[n] = row, column[row], score[row]
                score[row] = 0.0
                n += 1
                _mark(marks, row - lowest, column[row])
        polarity[count] = sign
        count += 1
        bounds[count] = n
    rows, columns, scores = found_row[:n].copy(), found_column[:n].copy(), found_score[:n].copy()
    return LineTracks(polarity[:count], bounds[: count + 1], rows, columns, scores)


@kernel(inline="always")
def _mark(marks: BoolArray, row: int, column: float) -> None:
    """Mark the columns around a point as followed, if its row has starts."""
    if 0 <= row < len(marks):
        j = math.floor(column + 0.5)
        for k in range(max(0, j - 1), min(marks.shape[1], j + 2)):
            marks[row, k] = True


@kernel(inline="always")
def _take_chain(
    strip: Strip, starts: LineStarts, start: int, column: FloatArray, score: Float32Array
) -> float:
    """Points on the straight lines between the maxima of a chain; returns the chain's lean."""
    row, place, value = starts.row, starts.column, starts.value
    rise = strip.rise[int(place[start])]
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


@kernel(inline="always")
def _follow(
    image: GreyImage, strip: Strip, stripe: Stripe, numbers: LineNumbers,
    start: tuple[int, int, np.float32], edge: _Edge, column: FloatArray, score: Float32Array,
) -> tuple[int, _Edge]:  # fmt: skip
    """Follow an edge of some polarity from a row on in one direction; also returns the last row."""
    # Unpacked once, since Numba counts references at every access to an array in a tuple.
    at, rise, response, middle = strip.column, strip.rise, stripe.response, stripe.middle
    width, height = rise.shape
    pull, reach, threshold = numbers.guided_pull, numbers.guided_reach_px, numbers.threshold
    border, max_gap = numbers.border_rows, numbers.gap_rows
    rightmost = response.shape[1] - 2 * stripe.window.reach - 3
    v, direction, sign = start
    place, lean, points, vertical = edge
    if vertical:
        reach = _VERTICAL_REACH_PX
    path = _Path(height, v, int(place), place, lean)
    end, gap = v, 0
    while gap <= max_gap:
        v += direction
        if v < border or v > height - 1 - border:
            break
        climb = rise[path.column, v] - rise[path.column, v - direction]
        place += lean * climb
        # Beyond the first and the last vertical, or where this one is not visible, it ends.
        if not 0.0 <= place <= width - 1.0:
            break
        per_column = _pixels_per_column(at, path.column, v)
        near, beside = -1, np.float64(0.0)
        if path.first <= v < path.first + STRIPE_ROWS:
            beside = (place - _place_on(path, rise, v)) * per_column
            if math.isfinite(beside):
                near = middle + math.floor(beside + 0.5)
        if not 2 <= near <= rightmost:
            # The edge leaves the stripe.
            j = int(place)
            per_column = _pixels_per_column(at, j, v)
            if not math.isfinite(per_column):
                break
            path = _Path(v if direction > 0 else v - STRIPE_ROWS + 1, v, j, place, lean)
            for i in range(len(stripe.path)):
                row = path.first - stripe.window.half_length + i
                stripe.path[i] = np.nan
                if 0 <= row < height:
                    part = _place_on(path, rise, row) - j
                    stripe.path[i] = at[j, row] + part * _pixels_per_column(at, j, row)
            respond(image, path.first, stripe)
            near, beside = middle, np.float64(0.0)
        # One column to the side if the highest of the three is not the one in the middle.
        left, here, right = _three(response, v - path.first, near, sign)
        if left > here or right > here:
            near += -1 if left > right else 1
            left, here, right = _three(response, v - path.first, near, sign)
        off = near - middle - beside
        bend = left - here - here + right
        # The top of the parabola through the three.
        off += 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        # The start of a vertical is known only to a column.
        expected = abs(off) <= reach or points == 0
        if here >= threshold and here >= left and here >= right and expected:
            points += 1
            off /= per_column
            column[v], score[v] = min(max(place + off, 0.0), width - 1.0), here
            share = 1.0 / points
            if not vertical:
                share *= (4.0 * points - 2.0) / (points + 1.0)
                if pull < 1.0:
                    alike = points + _UPRIGHT_POINTS
                    turn = max(pull * pull / (2.0 - pull), 6.0 / (alike * (alike + 1.0)))
                    lean += turn * off / climb
            place += off * max(pull, share)
            gap = 0
            end = v
        else:
            gap += 1
    return end, _Edge(place, lean, points, vertical)


@kernel(inline="always")
def _pixels_per_column(at: Float32Array, j: int, v: int) -> float:
    """Spacing of verticals in a row, on the side on which there are more of them."""
    if 2 * j < len(at):
        return float(at[j + 1, v] - at[j, v])
    return float(at[j, v] - at[j - 1, v])


@kernel(inline="always")
def _place_on(path: _Path, rise: Float32Array, v: int) -> float:
    """Strip column at which a path crosses a row."""
    return path.place + path.lean * float(rise[path.column, v] - rise[path.column, path.row])


@kernel(inline="always")
def _three(
    response: Float32Array, b: int, c: int, sign: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    return sign * response[b, c - 1], sign * response[b, c], sign * response[b, c + 1]
