"""Compiled: where edges may be followed from, maxima of the filter's response near the horizon."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_order_kernels import descending

#: A line's starts on neighbouring rows of the band are no more columns apart.
_SUPPORT = 2


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
    steps, width = response.shape
    row = np.empty(steps * width, np.int32)
    column = np.empty(len(row), np.int32)
    signs = np.empty(len(row), np.float32)
    score = np.empty(len(row), np.float64)
    least = np.float32(threshold)
    # Maxima are few: they are told by vectors, and looked through eight at a time.
    inner = max(width - 2, 0)
    highest = np.zeros(-(-inner // 8) * 8, np.uint8)
    eight = highest.view(np.uint64)
    sign_at = np.zeros((steps, width), np.int8)
    at = np.empty(len(row), np.int32)
    n = 0
    for k in range(steps if inner > 0 else 0):
        lefts = response[k, : width - 2]
        heres = response[k, 1 : width - 1]
        rights = response[k, 2:]
        allowed = band_row[k, 1 : width - 1]
        for i in range(inner):
            left = lefts[i]
            here = heres[i]
            right = rights[i]
            rising = (here >= least) & (left < here) & (right <= here)
            falling = (here <= -least) & (left > here) & (right >= here)
            highest[i] = (rising | falling) & (allowed[i] >= 0)
        for word in range(len(eight)):
            if eight[word] == 0:
                continue
            for i in range(8 * word, 8 * word + 8):
                if highest[i]:
                    at[n] = k
                    column[n] = i + 1
                    sign_at[k, i + 1] = 1 if heres[i] > 0.0 else -1
                    n += 1
    found = n
    n = 0
    for each in range(found):
        k = at[each]
        c = column[each]
        sign = sign_at[k, c]
        if supported:
            beside = False
            for other in range(max(k - 1, 0), min(k + 2, steps)):
                for near in range(max(c - _SUPPORT, 0), min(c + _SUPPORT + 1, width)):
                    beside |= (other != k) & (sign_at[other, near] == sign)
            if not beside:
                continue
        row[n] = band_row[k, c]
        column[n] = c
        signs[n] = sign
        score[n] = abs(response[k, c])
        n += 1
    order = descending(score[:n])
    row_of = np.empty(n, np.int32)
    column_of = np.empty(n, np.int32)
    sign_of = np.empty(n, np.float32)
    score_of = np.empty(n, np.float32)
    for k in range(n):
        row_of[k] = row[order[k]]
        column_of[k] = column[order[k]]
        sign_of[k] = signs[order[k]]
        score_of[k] = score[order[k]]
    return row_of, column_of, sign_of, score_of
