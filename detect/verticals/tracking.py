"""Tracking: starts at maxima of the response near the horizon, and edges followed from there.

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
from detect.uncounted import uncounted_contracting
from detect.vector_code import LANES
from detect.verticals.response import (
    ResponseOnDemand,
    line_filter,
    padded_pixels,
    response_on_demand,
    start_response,
    strip_of,
)
from detect.verticals.response_kernels import MARGIN, STEP, respond
from detect.verticals.tilt import TiltEstimate
from lut.verticals import VerticalTable

FloatArray = NDArray[np.float64]

#: A line's starts on neighbouring rows of the band are no more columns apart.
SUPPORT = 2
#: Maxima are flagged in vectors of bytes, of which this many are scanned at a time.
_WORD = 8
#: Number of classes into which scores are sorted first, before they are sorted within each.
_CLASSES = 512
#: Rows that are filtered ahead of a track.
_AHEAD = 12


class Maxima(NamedTuple):
    """Maxima of the response along the rows of the band, row by row from the left.

    Attributes
    ----------
    level, column : (N,) int32
        Rows of the band, and columns of the strip.
    sign : (N,) float32
        1 where the response is positive, else -1.
    """

    level: NDArray[np.int32]
    column: NDArray[np.int32]
    sign: NDArray[np.float32]


class LineStarts(NamedTuple):
    """Where tracks start: maxima of the response near the horizon, the highest first.

    Attributes
    ----------
    row, column : (N,) int32
        Strip pixels.
    polarity : (N,) float32
        1 where the image is brighter on the right, -1 on the left.
    score : (N,) float32
        Absolute response there.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    polarity: NDArray[np.float32]
    score: NDArray[np.float32]


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


def line_starts(
    image: NDArray[np.uint8], table: VerticalTable, settings: LineSettings
) -> LineStarts:
    """Maxima of the response on the horizon and on rows near it.

    Parameters
    ----------
    image : (H, W) uint8
        Grey values.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Band round the horizon, threshold; the filter.

    Returns
    -------
    LineStarts
        The highest first.
    """
    response, band = start_response(image, table, settings)
    maxima = find_maxima(response, band.row, settings.threshold, band.supported)
    return ordered_starts(response, band.row, maxima)


def line_tracks(
    image: NDArray[np.uint8] | ResponseOnDemand,
    starts: LineStarts,
    table: VerticalTable,
    settings: LineSettings,
    tilt: TiltEstimate | None = None,
    enough: int = ALL_EDGES,
) -> LineTracks:
    """Follow the edges through the starts up and down.

    Parameters
    ----------
    image : (H, W) uint8 or ResponseOnDemand
        Grey values, or the response to them as far as it has been evaluated; that is extended.
    starts : LineStarts
        Where to start; those on an edge already followed are left out.
    table : VerticalTable
        Of the image's camera.
    settings : LineSettings
        Threshold, gaps, border.
    tilt : TiltEstimate, optional
        If given, edges are only followed along the verticals that it predicts; else in any
        direction.
    enough : int, optional
        No more edges are followed once this many could be lines by their length and response.

    Returns
    -------
    LineTracks
        One for each edge.
    """
    if not isinstance(image, ResponseOnDemand):
        window = line_filter(settings)
        image = response_on_demand(padded_pixels(image, window), strip_of(table), window)
    following = following_of(settings, table.row_aspect, tilt is not None, enough)
    pitch, roll = (0.0, 0.0) if tilt is None else (tilt.pitch_rad, tilt.roll_rad)
    return follow_edges(image, starts, following, float(pitch), float(roll))


@njit(cache=True, error_model="numpy")
def find_maxima(
    response: NDArray[np.float32], band_row: NDArray[np.int32], threshold: float, supported: bool
) -> Maxima:
    """Maxima of the response along rows parallel to the horizon.

    Parameters
    ----------
    response : (K, W) float32
        See `detect.verticals.response.start_response`.
    band_row : (K, W) int32
        Image rows of these; -1 where tracks may not start.
    threshold : float
        Least absolute response.
    supported : bool
        Leave out maxima beside which there is none of the same sign on either neighbouring row.
    """
    levels, width = response.shape
    least = np.float32(threshold)
    inner = max(width - 2, 0)
    # Column c of row k has its byte at [k + 1, c + SUPPORT]: 1 for positive maxima, 2 for others.
    length = -(-(width + 2 * SUPPORT) // _WORD) * _WORD
    kinds = np.zeros((levels + 2, length), np.uint8)
    for k in range(levels if inner > 0 else 0):
        lefts = response[k, :inner]
        heres = response[k, 1 : inner + 1]
        rights = response[k, 2 : inner + 2]
        allowed = band_row[k, 1 : inner + 1]
        own = kinds[k + 1, SUPPORT + 1 : SUPPORT + 1 + inner]
        for i in range(inner):
            left = lefts[i]
            here = heres[i]
            right = rights[i]
            rising = (here >= least) & (left < here) & (right <= here) & (allowed[i] >= 0)
            falling = (here <= -least) & (left > here) & (right >= here) & (allowed[i] >= 0)
            own[i] = np.uint8(rising) | (np.uint8(falling) << np.uint8(1))
    near = np.zeros((levels + 2, length), np.uint8)
    if supported:
        for k in range(1, levels + 1):
            wide = near[k, SUPPORT : SUPPORT + width]
            for shift in range(2 * SUPPORT + 1):
                beside = kinds[k, shift : shift + width]
                for i in range(width):
                    wide[i] |= beside[i]
    level = np.empty(levels * width, np.int32)
    column = np.empty(len(level), np.int32)
    sign = np.empty(len(level), np.float32)
    n = 0
    for k in range(1, levels + 1):
        if supported:
            own = kinds[k]
            above = near[k - 1]
            below = near[k + 1]
            # `near` of this row is not needed any more but by the next one.
            for i in range(length):
                own[i] &= above[i] | below[i]
        words = kinds[k].view(np.uint64)
        for word in range(len(words)):
            if words[word] == 0:
                continue
            for i in range(_WORD * word, _WORD * word + _WORD):
                kind = kinds[k, i]
                if kind:
                    level[n] = k - 1
                    column[n] = i - SUPPORT
                    sign[n] = 1.0 if kind == 1 else -1.0
                    n += 1
    return Maxima(level[:n], column[:n], sign[:n])


@njit(cache=True, error_model="numpy")
def strongest_first(score: NDArray[np.float32]) -> NDArray[np.int32]:
    """Indices of scores from 0 to 1, the largest first; of equal ones the first is first."""
    count = len(score)
    begin = np.zeros(_CLASSES + 1, np.int32)
    kind = np.empty(count, np.int32)
    for i in range(count):
        share = np.float32(1.0) - score[i]
        kind[i] = min(max(int(share * np.float32(_CLASSES)), 0), _CLASSES - 1)
        begin[kind[i] + 1] += 1
    for k in range(_CLASSES):
        begin[k + 1] += begin[k]
    order = np.empty(count, np.int32)
    filled = begin.copy()
    for i in range(count):
        at = filled[kind[i]]
        filled[kind[i]] += 1
        while at > begin[kind[i]] and score[order[at - 1]] < score[i]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
    return order


@njit(cache=True, error_model="numpy")
def ordered_starts(
    response: NDArray[np.float32], band_row: NDArray[np.int32], maxima: Maxima
) -> LineStarts:
    """Maxima, the highest first."""
    level, column, sign = maxima
    count = len(level)
    score = np.empty(count, np.float32)
    for i in range(count):
        score[i] = abs(response[level[i], column[i]])
    order = strongest_first(score)
    row_of = np.empty(count, np.int32)
    column_of = np.empty(count, np.int32)
    sign_of = np.empty(count, np.float32)
    score_of = np.empty(count, np.float32)
    for k in range(count):
        i = order[k]
        row_of[k] = band_row[level[i], column[i]]
        column_of[k] = column[i]
        sign_of[k] = sign[i]
        score_of[k] = score[i]
    return LineStarts(row_of, column_of, sign_of, score_of)


@njit(cache=True, error_model="numpy", forceinline=True)
def _top_of_parabola(left: np.float32, centre: np.float32, right: np.float32) -> float:
    """Offset of the maximum of the parabola through three neighbours."""
    bend = left - 2.0 * centre + right
    return float(0.5 * (left - right) / bend) if bend < 0.0 else 0.0


@njit(cache=True, error_model="numpy", forceinline=True)
def _index(number: int) -> np.uint64:
    """An index that the compiler need not compare with 0."""
    return np.uint64(number)


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def sum_of(numbers: NDArray[np.float32]) -> float:
    """The sum, in double precision; additions need not wait for each other."""
    total = 0.0
    for i in range(len(numbers)):
        total += numbers[i]
    return total


@uncounted_contracting
def _follow(
    lazy: ResponseOnDemand,
    columns_per_rise: FloatArray,
    sign: np.float32,
    row: int,
    column: float,
    direction: int,
    following: Following,
    points: _Points,
) -> int:
    """Follow an edge from a row on, that one included; return how many points were written.

    0 if there is none in the first row. Points are written from the middle of the results on, in
    this direction.
    """
    rise, response, known = lazy.strip.rise, lazy.response, lazy.known
    width, height = rise.shape
    border = following.border
    pull = following.pull
    v = row
    # The expected position is j + part. Whole columns change seldom: a processor that foresees it
    # works on the next rows before it knows where in this one the edge is.
    j = math.floor(column + 0.5)
    part = column - j
    n = 0
    gap = 0
    while gap <= following.max_gap:
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
            respond(lazy, group, begin, end)
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
        if centre >= following.threshold and centre >= left and centre >= right:
            off += _top_of_parabola(left, centre, right)
            # A start is known to a column only.
            seen = n == 0 or abs(off) <= following.reach
            if seen:
                place = _index(height + direction * n)
                points.row[place] = v
                points.column[place] = j + (part + off)
                points.score[place] = centre
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
    lazy: ResponseOnDemand, starts: LineStarts, following: Following, pitch: float, roll: float
) -> LineTracks:
    """Follow edges up and down from starts; a start on an edge already followed is left out.

    Parameters
    ----------
    lazy : ResponseOnDemand
        The response.
    starts : LineStarts
        Where to start, in this order.
    following : Following
        How.
    pitch, roll : float
        Tilt that the edges are expected to show (rad); 0 for none.
    """
    strip = lazy.strip
    start_row, start_column, start_sign = starts.row, starts.column, starts.polarity
    width, height = strip.rise.shape
    columns_per_rise = pitch * strip.lean_by_pitch + roll * strip.lean_by_roll
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
    own = _Points(own_row, own_column, own_score)
    tracks = 0
    n = 0
    counting = 0
    complete = True
    for start in range(len(start_row)):
        if counting >= following.enough:
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
            count = _follow(lazy, columns_per_rise, polarity, v, near, direction, following, own)
            if count == 0:
                break
            if direction < 0:
                begin = height + 1 - count
                end = height + 1
                near = float(own_column[height])
            else:
                end = height + count
        if begin == end:
            # Starts were searched less thoroughly.
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
        # Views, so that the compiler knows that indices are not negative.
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
        counting += points >= following.least_points and sum_of(seen_score) >= following.least_score
    return LineTracks(sign[:tracks], bounds[: tracks + 1], row[:n], column[:n], score[:n], complete)
