"""The filter of tracks in a group of neighbouring verticals, compiled.

Groups begin `STEP` columns apart and overlap: whoever follows an edge finds the columns round it in
one of them. What the vectors do not reach, windows that are cut off, is done number by number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.uncounted import uncounted_contracting
from detect.vector_code import LANES, WORD
from detect.verticals.filter_vector_kernels import (
    moments_across,
    moments_across_two,
    response_along,
    response_along_two,
)

#: Groups of verticals begin so many columns apart, and so many before the first that is theirs:
#: whoever asks for a column may ask for two more on either side.
STEP = 4
MARGIN = 2


@uncounted_contracting
def _cut_responses(
    strip: NDArray[np.float32],
    first_row: NDArray[np.int32],
    last_row: NDArray[np.int32],
    along: NDArray[np.float32],
    regulariser: np.float32,
    leftmost: np.float32,
    rightmost: np.float32,
    moments: NDArray[np.float32],
    plane: int,
    base: int,
    v: int,
    response: NDArray[np.float32],
    to: int,
) -> None:
    """As `response_along`, where windows are cut off at each vertical's own ends."""
    s = len(along) // 2
    for lane in range(LANES):
        c = base + lane
        response[to + lane] = np.float32(0.0)
        x = strip[to + lane]
        if not (x >= leftmost and x < rightmost):
            continue
        share = np.float32(0.0)
        mean = np.float32(0.0)
        cov = np.float32(0.0)
        square = np.float32(0.0)
        for y in range(max(first_row[c], v - s), min(last_row[c], v + s) + 1):
            w = along[y - v + s]
            at = LANES * y + lane
            share += w
            mean += w * moments[at]
            cov += w * moments[at + plane]
            square += w * moments[at + 2 * plane]
        mean /= share
        cov /= share
        variance = abs(square / share - mean * mean)
        response[to + lane] = cov * abs(cov) / (variance + regulariser)


@uncounted_contracting
def _moments_of_rows(
    pixels: NDArray[np.uint8],
    strip: NDArray[np.float32],
    width: int,
    half_width: int,
    leftmost: np.float32,
    rightmost: np.float32,
    weights: NDArray[np.float32],
    moments: NDArray[np.float32],
    plane: int,
    at_group: int,
    first: int,
    after: int,
) -> None:
    words = weights.shape[1] // WORD
    y = first
    while y + 1 < after:
        moments_across_two(
            pixels, y * width - half_width, width, strip, at_group + y * LANES, leftmost, rightmost,
            weights, words, moments, plane, y * LANES,
        )  # fmt: skip
        y += 2
    if y < after:
        moments_across(
            pixels, y * width - half_width, width, strip, at_group + y * LANES, leftmost, rightmost,
            weights, words, moments, plane, y * LANES,
        )  # fmt: skip


@uncounted_contracting
def respond(
    pixels: NDArray[np.uint8],
    strip: NDArray[np.float32],
    ends: NDArray[np.int32],
    half_width: int,
    height: int,
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
    width = len(first_row)
    plane = height * LANES
    s = len(along) // 2
    base = min(max(group * STEP - MARGIN, 0), width - LANES)
    leftmost = np.float32(half_width)
    rightmost = np.float32(width - 1 - half_width)
    top = ends[group, 0]
    bottom = ends[group, 1]
    full_top = ends[group, 2]
    full_bottom = ends[group, 3]
    first = max(begin - s, top)
    after = min(end - 1 + s, bottom) + 1
    if filtered[0] != group or first > filtered[2] or after < filtered[1]:
        filtered[0] = group
        filtered[1] = first
        filtered[2] = first
    at_group = group * plane
    _moments_of_rows(
        pixels, strip, width, half_width, leftmost, rightmost, weights, moments, plane, at_group,
        first, min(after, filtered[1]),
    )  # fmt: skip
    _moments_of_rows(
        pixels, strip, width, half_width, leftmost, rightmost, weights, moments, plane, at_group,
        max(first, filtered[2]), after,
    )  # fmt: skip
    filtered[1] = min(filtered[1], first)
    filtered[2] = max(filtered[2], after)
    alike = top == full_top and bottom == full_bottom
    one = np.float32(1.0)
    v = begin
    while v < end:
        at = at_group + v * LANES
        if v - s >= full_top and v + s <= full_bottom:
            if v + 1 < end and v + 1 + s <= full_bottom:
                response_along_two(
                    moments, plane, (v - s) * LANES, along, 0, len(along), one, regulariser, strip,
                    at, leftmost, rightmost, response, at,
                )  # fmt: skip
                v += 1
            else:
                response_along(
                    moments, plane, (v - s) * LANES, along, 0, len(along), one, regulariser, strip,
                    at, leftmost, rightmost, response, at,
                )  # fmt: skip
        elif alike:
            highest = max(v - s, top)
            share = np.float32(0.0)
            for k in range(highest - v + s, min(v + s, bottom) - v + s + 1):
                share += along[k]
            response_along(
                moments, plane, highest * LANES, along, highest - v + s,
                min(v + s, bottom) - highest + 1, one / share, regulariser, strip, at, leftmost,
                rightmost, response, at,
            )  # fmt: skip
        else:
            _cut_responses(
                strip, first_row, last_row, along, regulariser, leftmost, rightmost, moments, plane,
                base, v, response, at,
            )  # fmt: skip
        v += 1
