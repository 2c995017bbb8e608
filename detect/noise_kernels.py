"""Compiled estimate of an image's noise (see `detect.noise`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

# A type to Numba, a function to the type checker.
_I: Callable[[Any], Any] = np.int16

#: Replaces responses that are ignored: above all of them.
_NONE = _I(32767)
_DARK, _LIGHT = _I(2), _I(253)

#: A median is first guessed from about `_SAMPLE` responses, at most as `_SMALL` - 1; a wrong guess
#: is corrected by one, at most `_TRIES` times.
_SAMPLE, _SMALL = 2048, 256
_TRIES = 4


@njit(cache=True, error_model="numpy")
def second_differences(
    image: NDArray[np.uint8],
    rows: NDArray[np.int64],
    countable_only: bool,
    response: NDArray[np.int16],
) -> int:
    """Absolute responses to the second difference along both axes; returns how many count.

    Parameters
    ----------
    image : (H, W) uint8
    rows : (R,) int64
        The rows to use, none of them the first or the last.
    countable_only : bool
        Leave out pixels that are nearly black or saturated.
    response : (R * (W - 2),) int16
        Result; where a pixel is left out, more than any response.
    """
    width = image.shape[1]
    along = np.empty(width, np.int16)
    left_out = 0
    for k in range(len(rows)):
        v = rows[k]
        above, here, below = image[v - 1], image[v], image[v + 1]
        for u in range(width):
            along[u] = _I(_I(above[u]) + _I(below[u])) - _I(_I(here[u]) * _I(2))
        row = response[k * (width - 2) :]
        for u in range(width - 2):
            bend = _I(_I(along[u] + along[u + 2]) - _I(along[u + 1] * _I(2)))
            row[u] = max(bend, _I(-bend))
        if countable_only:
            missing = _I(0)
            for u in range(width - 2):
                grey = _I(here[u + 1])
                out = (grey <= _DARK) | (grey >= _LIGHT)
                row[u] = _NONE if out else row[u]
                missing = _I(missing + _I(out))
            left_out += missing
    return int(len(rows) * (width - 2) - left_out)


@njit(cache=True, error_model="numpy")
def _count_up_to(response: NDArray[np.int16], most: int) -> int:
    """How many responses are not above `most`."""
    limit = _I(most)
    block = 8192
    total = 0
    for first in range(0, len(response), block):
        part = response[first : first + block]
        count = _I(0)
        for i in range(len(part)):
            count = _I(count + _I(part[i] <= limit))
        total += count
    return total


@njit(cache=True, error_model="numpy")
def _count_below_and_at(response: NDArray[np.int16], value: int) -> tuple[int, int]:
    """How many responses are below a value, and how many not above it."""
    limit = _I(value)
    block = 8192
    below = 0
    up_to = 0
    for first in range(0, len(response), block):
        part = response[first : first + block]
        less = _I(0)
        equal = _I(0)
        for i in range(len(part)):
            less = _I(less + _I(part[i] < limit))
            equal = _I(equal + _I(part[i] == limit))
        below += less
        up_to += less + equal
    return below, up_to


@njit(cache=True, error_model="numpy")
def _guess(response: NDArray[np.int16], rank: int) -> int:
    """About the response of that rank, from a sample."""
    step = max(1, len(response) // _SAMPLE)
    counts = np.zeros(_SMALL, np.int64)
    sampled = 0
    for i in range(0, len(response), step):
        counts[min(response[i], _SMALL - 1)] += 1
        sampled += 1
    left = rank * sampled // len(response)
    value = 0
    while value < _SMALL - 1 and left >= counts[value]:
        left -= counts[value]
        value += 1
    return value


@njit(cache=True, error_model="numpy")
def order_statistic(response: NDArray[np.int16], rank: int) -> tuple[int, int]:
    """The response that exactly `rank` others are before, in the sorted order (from 0).

    Returns
    -------
    response, up_to : int
        And how many are not above it.
    """
    value = _guess(response, rank)
    for _ in range(_TRIES):
        below, up_to = _count_below_and_at(response, value)
        if below <= rank < up_to:
            return value, up_to
        value += 1 if rank >= up_to else -1
    low, high = -1, 8
    while _count_up_to(response, high) <= rank:
        low = high
        high *= 2
    # More than `rank` are not above high, and at most `rank` not above low.
    while high - low > 1:
        middle = (low + high) // 2
        if _count_up_to(response, middle) > rank:
            high = middle
        else:
            low = middle
    return high, _count_up_to(response, high)


@njit(cache=True, error_model="numpy", nogil=True)
def median_response(
    image: NDArray[np.uint8],
    rows: NDArray[np.int64],
    least_countable: int,
    response: NDArray[np.int16],
) -> float:
    """Median of the countable responses; of all, where fewer than `least_countable` are."""
    count = second_differences(image, rows, True, response)
    if count < least_countable:
        count = second_differences(image, rows, False, response)
    lower, up_to = order_statistic(response, (count - 1) // 2)
    if count % 2 == 1 or up_to > count // 2:
        return float(lower)
    return 0.5 * (lower + order_statistic(response, count // 2)[0])
