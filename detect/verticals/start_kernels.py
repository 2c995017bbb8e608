"""Compiled: where edges may be followed from, maxima of the filter's response near the horizon."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

#: A line's starts on neighbouring rows of the band are no more columns apart.
SUPPORT = 2
#: Maxima are told by vectors of bytes, and looked through so many at a time.
_WORD = 8
#: Scores are put in order by so many classes first, then within each.
_CLASSES = 512


@njit(cache=True, error_model="numpy")
def find_maxima(
    response: NDArray[np.float32], band_row: NDArray[np.int32], threshold: float, supported: bool
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Maxima of the response along rows parallel to the horizon, row by row from the left.

    Parameters
    ----------
    response, band_row, threshold, supported
        As for `find_starts`.

    Returns
    -------
    level, column : (N,) int32
        Rows of the band, and columns of the strip.
    sign : (N,) float32
        1 where the response is positive, else -1.
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
    return level[:n], column[:n], sign[:n]


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
    response: NDArray[np.float32],
    band_row: NDArray[np.int32],
    level: NDArray[np.int32],
    column: NDArray[np.int32],
    sign: NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Maxima as `find_maxima` tells them, in the order and form of `find_starts`."""
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
    return row_of, column_of, sign_of, score_of


@njit(cache=True, error_model="numpy")
def find_starts(
    response: NDArray[np.float32], band_row: NDArray[np.int32], threshold: float, supported: bool
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Maxima of the response along rows parallel to the horizon, the highest first.

    Parameters
    ----------
    response : (K, W) float32
        See `band_response`.
    band_row : (K, W) int32
        Image rows of these; -1 where tracks may not start.
    threshold : float
        Least absolute response.
    supported : bool
        Leave out maxima beside which there is none of the same sign on either neighbouring row.

    Returns
    -------
    row, column : (N,) int32
        Strip pixels of the maxima.
    sign : (N,) float32
        1 where the response is positive, else -1.
    score : (N,) float32
        Absolute response there.
    """
    level, column, sign = find_maxima(response, band_row, threshold, supported)
    return ordered_starts(response, band_row, level, column, sign)
