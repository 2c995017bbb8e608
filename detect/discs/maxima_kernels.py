"""Local maxima among pixels, those of them that matter being given as a list."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


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
    above = np.empty(n, np.int64)
    below = np.empty(n, np.int64)
    plateaus = _compare_neighbours(columns, rows, quality, exceeded, level, above, below)
    if plateaus:
        visited = np.zeros(n, np.bool_)
        members = np.empty(n, np.int64)
        for i in range(n):
            if level[i] and not visited[i]:
                size, highest = _gather_plateau(
                    columns, rows, quality, exceeded, above, below, i, visited, members
                )
                # All but one of a plateau are put back.
                for k in range(size):
                    exceeded[members[k]] = True
                if highest:
                    exceeded[_middle(columns, rows, members, size)] = False
    found = np.empty(n, np.int64)
    count = _list_false(exceeded, found)
    return found[:count].copy()


@njit(cache=True, error_model="numpy", nogil=True)
def highest(
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    score: NDArray[np.float64],
    count: int,
    rank: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """The `maxima` of the score among the first `count` of some pixels: their (M, 2) u and v, and
    quality, contrast and score.

    `rank` says which rows are neighbours: those whose ranks differ by 1.
    """
    ranks = np.empty(count, np.int64)
    for i in range(count):
        ranks[i] = rank[rows[i]]
    index = maxima(columns[:count], ranks, score[:count])
    pixels = np.empty((len(index), 2), np.int64)
    own_quality = np.empty(len(index))
    own_contrast = np.empty(len(index), np.float32)
    own_score = np.empty(len(index))
    for k in range(len(index)):
        i = index[k]
        pixels[k, 0] = columns[i]
        pixels[k, 1] = rows[i]
        own_quality[k] = quality[i]
        own_contrast[k] = contrast[i]
        own_score[k] = score[i]
    return pixels, own_quality, own_contrast, own_score


@njit(cache=True, error_model="numpy", nogil=True)
def _compare_neighbours(
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    quality: NDArray[np.float64],
    exceeded: NDArray[np.bool_],
    level: NDArray[np.bool_],
    above: NDArray[np.int64],
    below: NDArray[np.int64],
) -> bool:
    """Note which pixels a neighbour exceeds, and which have one of equal quality.

    `above` and `below` become the first neighbour in the next rows, or where it would be: any pixel
    from there on that is in the right row, and not too far right, is a neighbour. The result says
    whether any are equal.
    """
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
def _list_false(flags: NDArray[np.bool_], found: NDArray[np.int64]) -> int:
    """Write down where flags are not set; the number of places."""
    count = 0
    for i in range(len(flags)):
        if not flags[i]:
            found[count] = i
            count += 1
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _gather_plateau(
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    quality: NDArray[np.float64],
    exceeded: NDArray[np.bool_],
    above: NDArray[np.int64],
    below: NDArray[np.int64],
    start: int,
    visited: NDArray[np.bool_],
    members: NDArray[np.int64],
) -> tuple[int, bool]:
    """The connected pixels of equal quality: their number, and whether nothing exceeds them."""
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
def _middle(
    columns: NDArray[np.int64], rows: NDArray[np.int64], members: NDArray[np.int64], size: int
) -> int:
    """The one of some pixels that is nearest to their centroid; the first if several are."""
    mean_v = 0.0
    mean_u = 0.0
    for k in range(size):
        mean_v += rows[members[k]] / size
        mean_u += columns[members[k]] / size
    best = members[0]
    least = np.inf
    for k in range(size):
        distance = (rows[members[k]] - mean_v) ** 2 + (columns[members[k]] - mean_u) ** 2
        if distance < least:
            least = distance
            best = members[k]
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
