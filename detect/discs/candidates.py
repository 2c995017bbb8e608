"""Candidates: local maxima of the quality, or of the votes, and what they have nearby.

The peaks of `detect.discs.quality` are found among a list of pixels, those that reach a threshold:
all others are lower. Connected pixels of equal score (plateaus) are one maximum, at the one nearest
to their centroid. A large disc has many peaks; of those within one radius the best stays, and a fit
starts in the middle of them all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.centre_rows import CentreRows, every_row
from detect.discs.model import F32
from detect.discs.patch import padded
from detect.discs.quality import Wanted, blocks_of, find_centres, with_zeros
from detect.settings import Polarity
from lut import DiscTable

FloatArray = NDArray[np.float64]

SIGNS: dict[Polarity, float] = {"any": 0.0, "light": 1.0, "dark": -1.0}


class Votes(NamedTuple):
    """Which centres count although their quality is low: where the grey value steps all round."""

    step: int
    """Pairs of samples vote if they differ by more than this, grey levels, below 255."""
    least: int
    """Centres with at least this number of votes count; 0: none does."""


NO_VOTES = Votes(0, 0)


class Centres(NamedTuple):
    """Some centres, in scan order."""

    pixels: NDArray[np.int64]
    """(N, 2) pixels (u, v)."""
    quality: FloatArray
    """(N,)"""
    contrast: NDArray[np.float32]
    """(N,) as in `quality_of_centres`. Where votes alone count, the contrast has their sign."""
    score: FloatArray
    """(N,) the quality; where votes alone count their share of all, scaled to less than the
    threshold."""


def chosen(centres: Centres, which: NDArray[np.bool_]) -> Centres:
    """Some of the centres."""
    return Centres(
        centres.pixels[which], centres.quality[which], centres.contrast[which], centres.score[which]
    )


def best_centres(
    image: NDArray[np.uint8],
    table: DiscTable,
    threshold: float,
    polarity: Polarity = "any",
    rows: CentreRows | None = None,
    votes: Votes = NO_VOTES,
) -> Centres:
    """Local maxima of the score: the peaks of `quality_of_centres`, without the map.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    table : DiscTable
        The camera's table.
    threshold : float
        Least quality, above 0, at most 1.
    polarity : {"any", "light", "dark"}
        Centres of another polarity count as quality 0: they hide no maximum next to them.
    rows : CentreRows, optional
        Which rows of centres are evaluated, and are neighbours; by default all.
    votes : Votes
        What else counts.

    Returns
    -------
    Centres
        Pixels that none of their 8 neighbours exceeds, in scan order. Connected pixels of equal
        score are one maximum, at the one nearest to their centroid.

    Raises
    ------
    FrameError
        If the image does not belong to the table.
    """
    rows = every_row(table) if rows is None else rows
    wanted = Wanted(threshold, 0.0, SIGNS[polarity], *votes)
    found = find_centres(with_zeros(image, table), blocks_of(table), rows.blocks, wanted)
    return Centres(*highest(found, rows.rank))


class Neighbours(NamedTuple):
    """Pixels in scan order, and where those next to each begin."""

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    above: NDArray[np.int64]
    below: NDArray[np.int64]
    """The first neighbour in the row above, and below, or where it would be: any pixel from there
    on that is in the right row, and not too far right, is a neighbour."""


@njit(cache=True, error_model="numpy", nogil=True)
def maxima(
    columns: NDArray[np.int64], rows: NDArray[np.int64], quality: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Which of some pixels none of their 8 neighbours exceeds.

    Connected pixels of equal quality are one maximum, at the one nearest to their centroid: a
    plateau is neither lost nor found twice.

    Parameters
    ----------
    columns, rows : (N,) int64
        The pixels, in scan order. All others are taken to be lower than these.
    quality : (N,) float64

    Returns
    -------
    (M,) int64
        Indices of the maxima, ascending.
    """
    n = len(columns)
    exceeded = np.zeros(n, np.bool_)
    level = np.zeros(n, np.bool_)
    near = Neighbours(columns, rows, np.empty(n, np.int64), np.empty(n, np.int64))
    if _compare_neighbours(near, quality, exceeded, level):
        visited = np.zeros(n, np.bool_)
        members = np.empty(n, np.int64)
        for i in range(n):
            if level[i] and not visited[i]:
                size, highest = _gather_plateau(near, quality, exceeded, i, visited, members)
                # All but one of a plateau are put back.
                for k in range(size):
                    exceeded[members[k]] = True
                if highest:
                    exceeded[_middle(columns, rows, members[:size])] = False
    return np.flatnonzero(~exceeded)


@njit(cache=True, error_model="numpy", nogil=True)
def highest(
    found: NDArray[Any], rank: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """The fields of `Centres` of those of some (N,) CENTRE, in scan order, that are `maxima`.

    `rank` says which rows are neighbours: those whose ranks differ by 1.
    """
    columns, rows = found["u"].copy(), rank[found["v"]]
    best = found[maxima(columns, rows, found["score"].copy())]
    pixels = np.empty((len(best), 2), np.int64)
    pixels[:, 0], pixels[:, 1] = best["u"], best["v"]
    return pixels, best["quality"].copy(), best["contrast"].copy(), best["score"].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def _compare_neighbours(
    near: Neighbours,
    quality: NDArray[np.float64],
    exceeded: NDArray[np.bool_],
    level: NDArray[np.bool_],
) -> bool:
    """Note which pixels a neighbour exceeds, and which have one of equal quality.

    `near.above` and `near.below` are filled in. The result says whether any are equal.
    """
    columns, rows, above, below = near
    n = np.uint64(len(columns))
    one = np.uint64(1)
    row_begin = np.uint64(0)
    candidate = np.uint64(0)
    equal = False
    i = np.uint64(0)
    while i < n:
        u, v, here = columns[i], rows[i], quality[i]
        below[i] = n
        if v != rows[row_begin]:
            # From `candidate` to `row_begin` lies the row above, if there is one.
            candidate = row_begin if rows[row_begin] == v - 1 else i
            row_begin = i
        if i > row_begin and columns[i - one] == u - 1:
            other = quality[i - one]
            exceeded[i - one] |= here > other
            exceeded[i] |= here < other
            if here == other:
                level[i] = level[i - one] = equal = True
        while candidate < row_begin and columns[candidate] < u - 1:
            candidate += one
        above[i] = candidate
        j = candidate
        while j < row_begin and columns[j] <= u + 1:
            other = quality[j]
            exceeded[j] |= here > other
            exceeded[i] |= here < other
            if here == other:
                level[i] = level[j] = equal = True
            below[j] = min(below[j], np.int64(i))
            j += one
        i += one
    return equal


@njit(cache=True, error_model="numpy", nogil=True)
def _gather_plateau(
    near: Neighbours,
    quality: NDArray[np.float64],
    exceeded: NDArray[np.bool_],
    start: int,
    visited: NDArray[np.bool_],
    members: NDArray[np.int64],
) -> tuple[int, bool]:
    """The connected pixels of equal quality: their number, and whether nothing exceeds them."""
    columns, rows, above, below = near
    members[0] = start
    visited[start] = True
    size = 1
    highest = True
    k = 0
    while k < size:
        p = members[k]
        k += 1
        highest &= not exceeded[p]
        beside = p > 0 and rows[p - 1] == rows[p] and columns[p - 1] == columns[p] - 1
        left = p - 1 if beside else p
        for step in range(-1, 2):
            j = left if step == 0 else above[p] if step < 0 else below[p]
            while j < len(rows) and rows[j] == rows[p] + step and columns[j] <= columns[p] + 1:
                if quality[j] == quality[start] and not visited[j]:
                    visited[j] = True
                    members[size] = j
                    size += 1
                j += 1
    return size, highest


@njit(cache=True, error_model="numpy", nogil=True)
def _middle(columns: NDArray[np.int64], rows: NDArray[np.int64], members: NDArray[np.int64]) -> int:
    """The one of some pixels that is nearest to their centroid; the first if several are."""
    mean_v = 0.0
    mean_u = 0.0
    for i in members:
        mean_v += rows[i] / len(members)
        mean_u += columns[i] / len(members)
    best = members[0]
    least = np.inf
    for i in members:
        distance = (rows[i] - mean_v) ** 2 + (columns[i] - mean_u) ** 2
        if distance < least:
            least = distance
            best = i
    return int(best)


def local_maxima(
    quality: NDArray[np.float64], threshold: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixels of a map of at least `threshold` that none of their 8 neighbours exceeds.

    Plateaus as in `maxima`.

    Returns
    -------
    columns, rows : (N,) int64
        In scan order.
    """
    rows, columns = np.nonzero((quality >= threshold) & (quality > 0.0))
    index = maxima(columns, rows, quality[rows, columns])
    return columns[index], rows[index]


@njit(cache=True, error_model="numpy")
def suppress_neighbours(
    floor_xy: NDArray[np.float64], score: NDArray[np.float64], separation: float
) -> NDArray[np.bool_]:
    """Which of some floor positions to keep so that no two are closer than `separation`.

    The best by score stay; of equal ones the first.

    Parameters
    ----------
    floor_xy : (N, 2) float64
        Positions, metres.
    score : (N,) float64
    separation : float
        Metres.

    Returns
    -------
    (N,) bool
    """
    order = np.argsort(-score, kind="mergesort")
    kept = np.zeros(len(score), np.bool_)
    # Those chosen; what fills up is near to nothing.
    x = np.full(padded(len(score)), np.inf)
    y = np.full(padded(len(score)), np.inf)
    count = 0
    for i in order:
        x0, y0 = floor_xy[i, 0], floor_xy[i, 1]
        if not _near_any(x, y, padded(count), x0, y0, separation * separation):
            kept[i] = True
            x[count], y[count] = x0, y0
            count += 1
    return kept


@njit(cache=True, error_model="numpy", nogil=True)
def _near_any(
    x: NDArray[np.float64], y: NDArray[np.float64], count: int, x0: float, y0: float, near: float
) -> bool:
    """Whether a place is nearer than the root of `near` to one of the first `count`."""
    found = 0
    # All alike, without branches: so several are worked on at a time.
    for k in range(count):
        dx = x[k] - x0
        dy = y[k] - y0
        found |= 1 if dx * dx + dy * dy < near else 0
    return found != 0


@njit(cache=True, error_model="numpy", nogil=True)
def strong_and_alone(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
) -> NDArray[np.int64]:
    """Which of the best centres have at least the contrast `weakest`, and no better one nearby.

    Parameters
    ----------
    pixels, quality, contrast : (N, 2) int64, (N,) float64, (N,) float32
        See `Centres`.
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    weakest : float
        Grey levels.
    separation : float
        Of centres closer than this on the floor the one of the highest quality stays, metres.

    Returns
    -------
    (M,) int64
        Indices, ascending.
    """
    index = np.flatnonzero(np.abs(contrast) >= weakest)
    place = np.empty((len(index), 2))
    for k in range(len(index)):
        i = index[k]
        u, v = pixels[i, 0], pixels[i, 1]
        place[k, 0] = floor_xy[v, u, 0]
        place[k, 1] = floor_xy[v, u, 1]
    return index[suppress_neighbours(place, quality[index], separation)]


@njit(cache=True, error_model="numpy", nogil=True)
def middles(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
    keep: NDArray[np.int64],
) -> NDArray[np.int64]:
    """In the middle of which pixels of the same disc each best centre lies.

    A large disc has many best centres, and which of them is the very best is up to the noise: a fit
    that starts beside the disc's middle may be given up.

    Parameters
    ----------
    pixels, quality, contrast, floor_xy, weakest, separation
        As in `strong_and_alone`.
    keep : (M,) int64
        What that returned.

    Returns
    -------
    (M, 2) int64
        Pixels (u, v): the means of the centres of at least the contrast `weakest`, and of the same
        sign, within the separation, weighed by quality squared and contrast.
    """
    strong = np.flatnonzero(np.abs(contrast) >= weakest)
    # Looked up once: there are as many pairs as centres, squared.
    centres = np.zeros((5, padded(len(strong))), np.float32)
    for m in range(len(strong)):
        i = strong[m]
        u, v = pixels[i, 0], pixels[i, 1]
        centres[0, m] = floor_xy[v, u, 0]
        centres[1, m] = floor_xy[v, u, 1]
        centres[2, m] = quality[i] * quality[i] * contrast[i]
        centres[3, m] = u
        centres[4, m] = v
    middle = np.empty((len(keep), 2), np.int64)
    near = F32(separation * separation)
    for k in range(len(keep)):
        u, v = pixels[keep[k], 0], pixels[keep[k], 1]
        along_u, along_v = _mean_offset(
            centres, floor_xy[v, u, 0], floor_xy[v, u, 1], contrast[keep[k]], F32(u), F32(v), near
        )
        middle[k, 0] = u + round(along_u)
        middle[k, 1] = v + round(along_v)
    return middle


@njit(cache=True, error_model="numpy", nogil=True)
def _mean_offset(
    centres: NDArray[np.float32],
    x0: float,
    y0: float,
    sign: float,
    u0: float,
    v0: float,
    near: float,
) -> tuple[float, float]:
    """By how much the weighed mean of the pixels near a place is off one; 0 where there are none.

    Rows of `centres` are their x, y, weight, u and v. `near` is a distance squared. Weights of
    another sign than `sign` do not count.
    """
    zero = F32(0.0)
    total = zero
    sum_u = zero
    sum_v = zero
    # All pairs alike, without branches: so several are worked on at a time.
    for m in range(centres.shape[1]):
        dx = centres[0, m] - x0
        dy = centres[1, m] - y0
        weight = centres[2, m]
        counts = (dx * dx + dy * dy < near) & (weight * sign >= zero)
        share = abs(weight) if counts else zero
        total += share
        sum_u += share * (centres[3, m] - u0)
        sum_v += share * (centres[4, m] - v0)
    if total > zero:
        return sum_u / total, sum_v / total
    return zero, zero
