"""The filter of tracks in a group of neighbouring verticals, compiled.

Groups begin `STEP` columns apart and overlap: whoever follows an edge finds the columns round it in
one of them. What the vectors do not reach, windows that are cut off, is done number by number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.line_vector_kernels import LANES, ROW_NUMBERS, WORD, moments_across, response_along

#: Groups of verticals begin so many columns apart, and so many before the first that is theirs:
#: whoever asks for a column may ask for two more on either side.
STEP = 4
MARGIN = 2

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])


def uncounted(kernel: _Kernel) -> _Kernel:
    """Compile a kernel that makes no arrays, as a part of those that call it.

    Else Numba counts references to each array in each call, even of a function that is inlined,
    which takes longer than filtering a row.
    """
    options: Any = {
        "cache": True,
        "error_model": "numpy",
        "fastmath": {"contract"},
        "forceinline": True,
        "_nrt": False,
    }
    compiled: _Kernel = njit(**options)(kernel)
    return compiled


@uncounted
def _cut_responses(
    strip: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    leftmost: np.float32,
    rightmost: np.float32,
    moments: NDArray[np.float32],
    base: int,
    v: int,
    response: NDArray[np.float32],
    to: int,
) -> None:
    """As `response_along`, where windows are cut off at verticals' ends, and made up for."""
    s = len(along) // 2
    for lane in range(LANES):
        c = base + lane
        response[to + lane] = np.float32(0.0)
        x = strip[v, c]
        if not (x >= leftmost and x < rightmost):
            continue
        share = np.float32(0.0)
        mean = np.float32(0.0)
        cov = np.float32(0.0)
        square = np.float32(0.0)
        for y in range(max(first_row[c], v - s), min(last_row[c], v + s) + 1):
            w = along[y - v + s]
            at = ROW_NUMBERS * y + lane
            share += w
            mean += w * moments[at]
            cov += w * moments[at + LANES]
            square += w * moments[at + 2 * LANES]
        mean /= share
        cov /= share
        variance = abs(square / share - mean * mean)
        response[to + lane] = cov * abs(cov) / (variance + regulariser)


@uncounted
def respond(
    pixels: NDArray[np.uint8],
    strip: NDArray[np.float32],
    flat_strip: NDArray[np.float32],
    half_width: int,
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    moments: NDArray[np.float32],
    filtered: NDArray[np.int64],
    group: int,
    begin: int,
    end: int,
    response: NDArray[np.float32],
) -> None:
    """Evaluate the filter in some rows of a group of verticals.

    `moments` holds those of the group and the rows that `filtered` tells: number, first, last + 1.
    """
    height, width = strip.shape
    taps = weights.shape[1]
    s = len(along) // 2
    base = min(max(group * STEP - MARGIN, 0), width - LANES)
    leftmost = np.float32(half_width)
    rightmost = np.float32(width - 1 - half_width)
    # Rows in which any of the verticals is seen, and in which all are.
    top = height
    bottom = -1
    full_top = 0
    full_bottom = height - 1
    for c in range(base, base + LANES):
        full_top = max(full_top, first_row[c])
        full_bottom = min(full_bottom, last_row[c])
        if first_row[c] <= last_row[c]:
            top = min(top, first_row[c])
            bottom = max(bottom, last_row[c])
    if full_top > full_bottom:
        full_top = height
    first = max(begin - s, top)
    after = min(end - 1 + s, bottom) + 1
    if filtered[0] != group or first > filtered[2] or after < filtered[1]:
        filtered[0] = group
        filtered[1] = first
        filtered[2] = first
    for y in range(first, after):
        if not filtered[1] <= y < filtered[2]:
            moments_across(
                pixels, y * width - half_width, flat_strip, y * width + base, leftmost, rightmost,
                weights, taps // WORD, moments, y * ROW_NUMBERS,
            )  # fmt: skip
    filtered[1] = min(filtered[1], first)
    filtered[2] = max(filtered[2], after)
    for v in range(begin, end):
        to = (group * height + v) * LANES
        if v - s >= full_top and v + s <= full_bottom:
            response_along(
                moments, (v - s) * ROW_NUMBERS, along, len(along), regulariser, flat_strip,
                v * width + base, leftmost, rightmost, response, to,
            )  # fmt: skip
        else:
            _cut_responses(
                strip, first_row, last_row, along, regulariser, leftmost, rightmost, moments,
                base, v, response, to,
            )  # fmt: skip
