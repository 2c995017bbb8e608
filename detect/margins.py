"""Columns at the sides of an image in which the camera recorded nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: The grey values of a margin differ by no more than this, grey levels: noise, and what compression
#: adds. Most of the column behind it differ from it by more.
_MOST_RANGE, _LEAST_STEP, _LEAST_SHARE = 24, 8, 0.5
#: Widths of margins are multiples of this (columns), so that few tables are needed.
_COLUMNS = 8
#: Where more columns than this share of the width are blank, it is the scene that is.
_LARGEST_SHARE = 0.05
#: One row in this many is enough to see a margin.
_ROWS_APART = 4


def blank_margins(image: NDArray[np.uint8]) -> tuple[int, int]:
    """How many columns at the left and right of an image show nothing.

    Digitized video often begins late in a line: the first columns have one grey value, from which
    the image begins at a sharp edge. A disc that is cut there must not be taken for one that ends
    there.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.

    Returns
    -------
    left, right : int
        Each 0 where there is no such margin.
    """
    rows = image[::_ROWS_APART]
    return _blank(rows), _blank(rows[:, ::-1])


def _blank(image: NDArray[np.uint8]) -> int:
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
