"""What grey values alone say about an image: its noise, and blank columns at its sides."""

from __future__ import annotations

import numpy as np

from redetect.array_types import GreyImage, IntArray
from redetect.compiled import kernel

#: With fewer pixels than this that are neither black nor saturated, all count for the noise.
_LEAST_COUNTABLE = 100
#: Grey values that count lie between these.
_DARK, _LIGHT = 2, 253
#: The mask's absolute coefficients add up to 16, so no response is larger.
_MOST_RESPONSE = 16 * 255


def estimate_noise(image: GreyImage, most_rows: int | None = None) -> float:
    """Standard deviation of an image's noise, grey levels; 0 for less than 3 rows or columns.

    The median absolute response, in at most `most_rows` rows, to the second difference in both
    directions, which sees neither planes nor straight edges (after Immerkaer, "Fast noise variance
    estimation", 1996); black and saturated pixels do not count.
    """
    height, width = image.shape
    if min(height, width) < 3:
        return 0.0
    rows = np.arange(1, height - 1)
    if most_rows is not None and most_rows < len(rows):
        rows = rows[np.arange(most_rows) * (len(rows) - 1) // (most_rows - 1)]
    # The mask's coefficients have a sum of squares of 36; 0.6745 makes a median a deviation.
    return _median_response(image, rows) / 0.6745 / 6.0


@kernel()
def _median_response(image: GreyImage, rows: IntArray) -> float:
    """Median of the absolute responses in some rows, by their histogram."""
    width = image.shape[1]
    bend, response = np.empty(width, np.int32), np.empty(width, np.int32)
    # Of the pixels that count, and then of the others.
    histogram = np.zeros(2 * (_MOST_RESPONSE + 1), np.int32)
    for v in rows:
        above, here, below = image[v - 1], image[v], image[v + 1]
        for u in range(width):
            bend[u] = np.int32(above[u]) + np.int32(below[u]) - 2 * np.int32(here[u])
        for u in range(1, width - 1):
            counts = (here[u] > _DARK) & (here[u] < _LIGHT)
            response[u] = abs(bend[u - 1] - 2 * bend[u] + bend[u + 1])
            response[u] += 0 if counts else _MOST_RESPONSE + 1
        for u in range(1, width - 1):
            histogram[response[u]] += 1
    count = 0
    for k in range(_MOST_RESPONSE + 1):
        count += histogram[k]
    if count < _LEAST_COUNTABLE:
        for k in range(_MOST_RESPONSE + 1):
            histogram[k] += histogram[k + _MOST_RESPONSE + 1]
            count += histogram[k + _MOST_RESPONSE + 1]
    # The two in the middle, or twice the one.
    total = 0.0
    for rank in ((count - 1) // 2, count // 2):
        k, seen = 0, histogram[0]
        while seen <= rank:
            k += 1
            seen += histogram[k]
        total += 0.5 * k
    return total


#: The grey values of a margin differ by no more than this, grey levels: noise, and what compression
#: adds. Most of the column behind it differ from it by more.
_MOST_RANGE, _LEAST_STEP, _LEAST_SHARE = 24, 8, 0.5
#: Widths of margins are multiples of this (columns), so that few tables are needed.
_COLUMNS = 8
#: Where more columns than this share of the width are blank, it is the scene that is.
_LARGEST_SHARE = 0.05
#: One row in this many is enough to see a margin.
_ROWS_APART = 4


def steep_gradient(image: GreyImage, most_rows: int) -> float:
    """Gradient along some rows that a tenth of their pixels exceeds, grey levels per pixel."""
    rows = image[:: max(len(image) // most_rows, 1)].astype(np.int64)
    steps = np.abs(rows[:, 2:] - rows[:, :-2]).ravel()
    below = np.cumsum(np.bincount(steps, minlength=256))
    return 0.5 * float(np.searchsorted(below, 0.9 * len(steps)))


def blank_margins(image: GreyImage) -> tuple[int, int]:
    """How many columns at the left and right of an image (H, W) show nothing; 0 for no margin.

    Digitized video often begins late in a line: the first columns have one grey value, from which
    the image begins at a sharp edge. A disc that is cut there must not be taken for one that ends
    there.
    """
    rows = image[::_ROWS_APART]
    return _blank(rows), _blank(rows[:, ::-1])


def _blank(image: GreyImage) -> int:
    if np.ptp(image[:, 0]) > _MOST_RANGE:
        return 0
    side = image[:, : int(_LARGEST_SHARE * image.shape[1]) + 1]
    varied = np.flatnonzero(np.ptp(side, axis=0) > _MOST_RANGE)
    if len(varied) == 0:
        return 0
    blank = int(varied[0])
    # The first of these may be half a margin's, and half the image's.
    margin = (blank // _COLUMNS + 1) * _COLUMNS
    step = np.abs(image[:, margin] - image[:, 0].mean())
    is_edge = np.mean(step > _LEAST_STEP) >= _LEAST_SHARE
    return margin if is_edge else 0
