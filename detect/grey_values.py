"""Grey values of an image: its form for kernels, its noise, and blank columns at its sides."""

from __future__ import annotations

import math

import numpy as np

from detect.errors import FrameError
from redetect.array_types import GreyImage, IntArray

#: If fewer pixels than this are neither black nor saturated, all are used for the noise.
_LEAST_COUNTABLE = 100
_DARK, _LIGHT = 2, 253  #: Bounds of the grey values that count.

_MOST_RANGE = 24  #: Of a margin's grey values: noise and compression artefacts.
_LEAST_STEP = 8  #: From a margin to the column next to it, grey levels.
_LEAST_SHARE = 0.5  #: Of that column's pixels, with such a step.
#: Widths of margins are multiples of this (columns), so that few tables are needed.
_COLUMNS = 8
#: If a larger share of the width is blank, it is a blank scene, not a margin.
_LARGEST_SHARE = 0.05
_ROWS_APART = 4  #: Spacing of the rows in which margins are searched for.


def plain_image(image: GreyImage, shape: tuple[int, int] | None = None) -> GreyImage:
    """The image in the form for which kernels are compiled: row by row, and writeable.

    It is copied if it is not; for a read-only one, Numba would compile every kernel once more.
    Raises `FrameError` if it is not (H, W) uint8, or not of a calibration's `shape`.
    """
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise FrameError(
            f"the image is {image.dtype} of shape {image.shape}: expected grey values, uint8 of "
            "shape (H, W); cv2.cvtColor converts colour, image >> 8 converts 16 bits (files of "
            "both are read as they are), (255 * image).astype(np.uint8) converts 0.0 to 1.0"
        )
    if shape is not None and image.shape != shape:
        raise FrameError(
            f"the image is {image.shape[1]}x{image.shape[0]} px: "
            f"the calibration is for {shape[1]}x{shape[0]}"
        )
    return np.require(image, requirements=["C", "W"])


def estimate_noise(image: GreyImage, most_rows: int | None = None) -> float:
    """Standard deviation of an image's noise, grey levels; 0 for less than 3 rows or columns.

    The median absolute response, in at most `most_rows` rows, of the second difference in both
    directions, which is zero for planes and straight edges (after Immerkaer, "Fast noise variance
    estimation", 1996); black and saturated pixels do not count.
    """
    height, width = image.shape
    if min(height, width) < 3:
        return 0.0
    rows = np.arange(1, height - 1)
    if most_rows is not None and most_rows < len(rows):
        rows = rows[np.arange(most_rows) * (len(rows) - 1) // (most_rows - 1)]
    # The mask's squared coefficients sum to 36; 0.6745 converts a median to a standard deviation.
    return _median_response(image, rows) / 0.6745 / 6.0


def _median_response(image: GreyImage, rows: IntArray) -> float:
    """Median of the absolute responses in some rows."""
    above, here, below = (image[rows + k].astype(np.int16) for k in (-1, 0, 1))
    response = np.abs(np.diff(above - 2 * here + below, 2))
    counts = (here[:, 1:-1] > _DARK) & (here[:, 1:-1] < _LIGHT)
    if np.count_nonzero(counts) >= _LEAST_COUNTABLE:
        response = response[counts]
    return float(np.median(response))


def steep_gradient(image: GreyImage, most_rows: int) -> float:
    """90 % quantile of the gradient along some rows, grey levels per pixel."""
    rows = image[:: max(len(image) // most_rows, 1)].astype(np.int16)
    # For 16 bits this is a radix sort, faster than np.quantile.
    steps = np.sort(np.abs(rows[:, 2:] - rows[:, :-2]), axis=None, kind="stable")
    return 0.5 * float(steps[math.ceil(0.9 * len(steps)) - 1]) if len(steps) else 0.0


def blank_margins(image: GreyImage) -> tuple[int, int]:
    """Number of blank columns at the left and right of an image (H, W).

    In digitized video, lines often begin late: the first columns have a constant grey value, with a
    sharp edge to the image. A disc that is cut there must not be mistaken for one that ends there.
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
    # The first of these may be partly margin and partly image.
    margin = (blank // _COLUMNS + 1) * _COLUMNS
    step = np.abs(image[:, margin] - image[:, 0].mean())
    return margin if np.mean(step > _LEAST_STEP) >= _LEAST_SHARE else 0
