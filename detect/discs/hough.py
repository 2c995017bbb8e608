"""Candidates from edges: a Hough transform for discs of known size on the floor.

At the rim of a light disc the gradient of the grey value, mapped to the floor, points to the
centre, one radius away. With A the derivative of the floor position X by the pixel,
B = abs(det A) A^-T, and g the gradient in the image, the centre is

    X + r n,  n = B g / norm(B g),

and X - r n for a dark disc. Every pixel with a strong gradient votes for one centre, weighted by
the share of the rim that it covers, norm(B g) / norm(g) of 2 pi r; so an occluded or unevenly lit
part of a disc costs only its own share of the votes. Votes are counted in cells (`lut.votes`). The
score is the sum over three by three cells, relative to the mean of all cells at the same distance,
since texture and distance raise all scores.

Source: C. Kimme, D. Ballard and J. Sklansky, Finding Circles by an Array of Accumulators,
CACM 18 (1975).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detect.discs.candidates import suppress_close
from lut import VoteTable
from redetect.array_types import Float32Array, FloatArray, GreyImage, IntArray
from redetect.compiled import kernel

#: Added to the mean votes at a distance, so that a few votes among empty cells score low.
_BACKGROUND = 0.3
_LEAST_SCORE = np.float32(1.9)  #: Of a candidate.
_CLEAR_SCORE = 3.0  #: Of a clear one.
_MOST_DOUBTFUL = 300  #: Doubtful candidates of an image, of either sign.
_MOST_COMPARED = 600  #: Candidates that are compared with their neighbours, unless all are clear.
_MOST_PEAKS = 4000
#: Least distance from a better candidate, radii; less than 2, for discs may touch.
_APART = 0.6
_SOBEL_GAIN = 8.0  #: The Sobel kernel scales a gradient per pixel by this.


class HoughCandidates(NamedTuple):
    """Possible centres of discs, the best first."""

    floor_xy: FloatArray  # (N, 2) metres
    score: FloatArray  # (N,)
    sign: FloatArray  # (N,) 1 for light discs, -1 for dark ones


def hough_candidates(
    image: GreyImage, table: VoteTable, radius: float, sign: int, least_step: float
) -> HoughCandidates:
    """Find possible centres of discs of one radius (metres) from the votes of edges.

    The table is that of the image's camera for this radius; `sign` is 1 for light discs, -1 for
    dark ones, 0 for both; edges have a gradient of at least `least_step` grey levels per pixel.
    """
    signs = np.array([1.0, -1.0] if sign == 0 else [float(sign)])
    found = []
    for of_sign, votes in zip(signs, count_votes(image, table, radius * signs, least_step)):
        place, score = _peaks(votes, table)
        order = np.argsort(-score, kind="stable")
        order = order[: max(_MOST_COMPARED, np.count_nonzero(score >= _CLEAR_SCORE))]
        best = suppress_close(place, order, _APART * radius)
        best = best[: max(_MOST_DOUBTFUL, np.count_nonzero(score[best] >= _CLEAR_SCORE))]
        floor_xy = place[best] @ table.turn + table.foot
        found.append((floor_xy, score[best], np.full(len(best), of_sign)))
    return HoughCandidates._make(map(np.concatenate, zip(*found)))


class _Edges(NamedTuple):
    """The pixels of an image row whose gradient is strong; lengths in cells, and steps ahead."""

    at_x: Float32Array  # place on the floor
    at_y: Float32Array
    x: Float32Array  # unit vector on the floor along the gradient
    y: Float32Array
    share: Float32Array  # of the rim that the pixel covers


@kernel()
def count_votes(
    image: GreyImage, table: VoteTable, radius: FloatArray, least_step: float
) -> Float32Array:
    """(S, M, columns) votes of each cell, shares of a rim, for S radii (negative: dark discs)."""
    rows, columns, width = len(table.ahead), table.columns, table.pixel.shape[1]
    votes = np.zeros((len(radius), rows * columns), np.float32)
    # Without a gradient there is no direction.
    least = np.float32(max((_SOBEL_GAIN * (1.0 + table.paired) * least_step) ** 2, 1.0))
    own = np.empty((5, width), np.float32)
    edges = _Edges(own[0], own[1], own[2], own[3], own[4])
    gradient, lines = np.empty((3, width), np.float32), np.empty((3, width), np.int16)
    for k in range(len(table.image_row)):
        _gradient(image, table.image_row[k], table.paired, lines, gradient)
        count = _strong(gradient, table.pixel[k], least, edges)
        for s in range(len(radius)):
            across, ahead = np.float32(radius[s] / table.cell), np.float32(radius[s] / table.step)
            _vote(edges, count, (across, ahead), table.row_of_step, columns, votes[s])
    return votes.reshape(len(radius), rows, columns)


@kernel(forceinline=True)
def _gradient(
    image: GreyImage, v: int, paired: bool, lines: NDArray[np.int16], gradient: Float32Array
) -> None:
    """Gradient (Sobel) of an image row along u and v, and its square, for pixels or pairs."""
    width = lines.shape[1]
    for i in range(3):
        row, line = image[v + i - 1], lines[i]
        if paired:
            for j in range(width):
                line[j] = np.int16(row[2 * j]) + np.int16(row[2 * j + 1])
        else:
            for j in range(width):
                line[j] = row[j]
    upper, same, lower = lines[0], lines[1], lines[2]
    along_u, along_v, square = gradient[0], gradient[1], gradient[2]
    for j in range(1, width - 1):
        gu = (upper[j + 1] - upper[j - 1]) + 2 * (same[j + 1] - same[j - 1])
        gv = (lower[j - 1] - upper[j - 1]) + 2 * (lower[j] - upper[j])
        along_u[j] = np.int16(gu + (lower[j + 1] - lower[j - 1]))
        along_v[j] = np.int16(gv + (lower[j + 1] - upper[j + 1]))
        square[j] = along_u[j] * along_u[j] + along_v[j] * along_v[j]


@kernel(forceinline=True)
def _strong(gradient: Float32Array, pixel: Float32Array, least: np.float32, edges: _Edges) -> int:
    """Write the pixels whose squared gradient is at least `least` into `edges`; their number."""
    along_u, along_v, square = gradient[0], gradient[1], gradient[2]
    at_x, at_y, x, y, share = edges
    count = 0
    for j in range(1, gradient.shape[1] - 1):
        if square[j] >= least:
            at = pixel[j]
            at_x[count], at_y[count] = at[0], at[1]
            x[count] = at[2] * along_u[j] + at[3] * along_v[j]
            y[count] = at[4] * along_u[j] + at[5] * along_v[j]
            share[count] = square[j]
            count += 1
    for i in range(np.uint64(count)):
        length = math.sqrt(x[i] * x[i] + y[i] * y[i])
        per_length = np.float32(1.0) / length if length > np.float32(0.0) else np.float32(0.0)
        x[i], y[i] = per_length * x[i], per_length * y[i]
        share[i] = length / math.sqrt(share[i])
    return count


@kernel(forceinline=True)
def _vote(
    edges: _Edges, count: int, radius: tuple[np.float32, np.float32], row_of_step: IntArray,
    columns: int, votes: Float32Array,
) -> None:  # fmt: skip
    """Add the votes of edges for the centres one radius (cells, steps) away to the cells."""
    at_x, at_y, x, y, share = edges
    steps = len(row_of_step)
    for i in range(count):
        column = np.int32(at_x[i] + radius[0] * x[i])
        step = np.int32(at_y[i] + radius[1] * y[i])
        if 0 <= column < columns and 0 <= step < steps:
            votes[np.uint64(row_of_step[step] * columns + column)] += share[i]


@kernel(fastmath={"reassoc", "nsz"})
def _peaks(votes: Float32Array, table: VoteTable) -> tuple[FloatArray, FloatArray]:
    """Positions (across, ahead) and scores of cells that no neighbour exceeds."""
    rows, columns = votes.shape
    first, last, ahead = table.first, table.last, table.ahead
    score = np.zeros((rows, columns), np.float32)
    column = np.empty(columns, np.float32)
    for i in range(1, rows - 1):
        # One more cell on either side; sliced row by row, so that the additions are vectorised.
        left, right = first[i] - 1, last[i] + 1
        before, same = votes[i - 1, left:right], votes[i, left:right]
        after = votes[i + 1, left:right]
        around = np.float32(0.0)
        for j in range(len(same)):
            column[j] = before[j] + same[j] + after[j]
            around += column[j]
        scale = np.float32(1.0) / np.float32(_BACKGROUND + 3.0 * around / len(same))
        row = score[i, first[i] : last[i]]
        for j in range(len(row)):
            row[j] = scale * (column[j] + column[j + 1] + column[j + 2])
    place, height = np.empty((_MOST_PEAKS, 2)), np.empty(_MOST_PEAKS)
    n = 0
    for i in range(1, rows - 1):
        left, right = first[i] - 1, last[i] + 1
        before, same = score[i - 1, left:right], score[i, left:right]
        after = score[i + 1, left:right]
        for k in range(1, len(same) - 1):
            value = same[k]
            if value < _LEAST_SCORE or n == _MOST_PEAKS:
                continue
            # Of equal cells, the last one.
            highest = max(same[k - 1], before[k - 1], before[k], before[k + 1])
            if highest > value or max(same[k + 1], after[k - 1], after[k], after[k + 1]) >= value:
                continue
            j = left + k
            x = y = total = 0.0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    total += votes[a, b]
                    x += votes[a, b] * (b + 0.5)
                    y += votes[a, b] * ahead[a]
            place[n, 0], place[n, 1] = table.left + table.cell * x / total, y / total
            height[n] = value
            n += 1
    return place[:n], height[:n]
