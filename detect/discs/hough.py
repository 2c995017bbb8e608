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

from detect.discs.candidates import suppress_close
from lut import VoteTable
from redetect.array_types import Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel

#: Added to the mean votes at a distance, so that a few votes among empty cells score low.
_BACKGROUND = 0.3
_LEAST_SCORE = 1.7  #: Of a candidate.
_CLEAR_SCORE = 3.0  #: Of a clear one.
_MOST_DOUBTFUL = 150  #: Doubtful candidates of an image.
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
    """Find possible centres of discs of one radius from the votes of edges.

    Parameters
    ----------
    image : (H, W) uint8
    table : VoteTable
        The camera's, for this radius.
    radius : float
        Metres.
    sign : int
        1 for light discs, -1 for dark ones, 0 for both.
    least_step : float
        Gradient of an edge, grey levels per pixel.
    """
    signs = np.array([sign] if sign else [1.0, -1.0], np.float64)
    places, scores = [], []
    for votes in count_votes(image, table, radius * signs, least_step):
        place, score = _peaks(votes, table)
        best = np.argsort(-score, kind="stable")
        best = best[: max(_MOST_COMPARED, np.count_nonzero(score >= _CLEAR_SCORE))]
        best = suppress_close(place, best, _APART * radius)
        best = best[: max(_MOST_DOUBTFUL, np.count_nonzero(score[best] >= _CLEAR_SCORE))]
        places.append(place[best] @ table.turn + table.foot)
        scores.append(score[best])
    number = [len(score) for score in scores]
    return HoughCandidates(np.concatenate(places), np.concatenate(scores), np.repeat(signs, number))


@kernel()
def count_votes(
    image: GreyImage, table: VoteTable, radius: FloatArray, least_step: float
) -> Float32Array:
    """(S, M, columns) votes of each cell, shares of a rim, for S radii (negative: dark discs)."""
    votes = np.zeros((len(radius), len(table.ahead), table.columns), np.float32)
    width = table.pixel.shape[1]
    across, ahead = np.empty(len(radius), np.float32), np.empty(len(radius), np.float32)
    for s in range(len(radius)):
        across[s], ahead[s] = radius[s] / table.cell, radius[s] / table.step
    least = np.float32((_SOBEL_GAIN * (1.0 + table.paired) * least_step) ** 2)
    lines = np.empty((3, width), np.int16)
    along_u, along_v = np.empty(width, np.float32), np.empty(width, np.float32)
    square = np.empty(width, np.float32)
    for k in range(len(table.image_row)):
        for i in range(3):
            row, line = image[table.image_row[k] + i - 1], lines[i]
            if table.paired:
                for j in range(width):
                    line[j] = np.int16(row[2 * j]) + np.int16(row[2 * j + 1])
            else:
                for j in range(width):
                    line[j] = row[j]
        upper, same, lower = lines[0], lines[1], lines[2]
        for j in range(1, width - 1):
            gu = (upper[j + 1] - upper[j - 1]) + 2 * (same[j + 1] - same[j - 1])
            gv = (lower[j - 1] - upper[j - 1]) + 2 * (lower[j] - upper[j])
            along_u[j] = np.int16(gu + (lower[j + 1] - lower[j - 1]))
            along_v[j] = np.int16(gv + (lower[j + 1] - upper[j + 1]))
            square[j] = along_u[j] * along_u[j] + along_v[j] * along_v[j]
        for j in range(1, width - 1):
            if square[j] < least:
                continue
            pixel = table.pixel[k, j]
            x = pixel[2] * along_u[j] + pixel[3] * along_v[j]
            y = pixel[4] * along_u[j] + pixel[5] * along_v[j]
            length = math.sqrt(x * x + y * y)
            if not length > 0.0:
                continue
            x, y, share = x / length, y / length, length / math.sqrt(square[j])
            for s in range(len(radius)):
                column, step = int(pixel[0] + across[s] * x), int(pixel[1] + ahead[s] * y)
                if 0 <= column < table.columns and 0 <= step < len(table.row_of_step):
                    votes[s, table.row_of_step[step], column] += share
    return votes


@kernel(fastmath={"reassoc", "nsz"})
def _peaks(votes: Float32Array, table: VoteTable) -> tuple[FloatArray, FloatArray]:
    """Positions (across, ahead) and scores of cells that no neighbour exceeds."""
    rows, columns = votes.shape
    score = np.zeros((rows, columns), np.float32)
    column = np.empty(columns, np.float32)
    for i in range(1, rows - 1):
        # One more cell on either side; sliced row by row, so that the additions are vectorised.
        left, right = table.first[i] - 1, table.last[i] + 1
        before, same = votes[i - 1, left:right], votes[i, left:right]
        after = votes[i + 1, left:right]
        around = np.float32(0.0)
        for j in range(len(same)):
            column[j] = before[j] + same[j] + after[j]
            around += column[j]
        scale = np.float32(1.0) / np.float32(_BACKGROUND + 3.0 * around / len(same))
        row = score[i, table.first[i] : table.last[i]]
        for j in range(len(row)):
            row[j] = scale * (column[j] + column[j + 1] + column[j + 2])
    place, height = np.empty((_MOST_PEAKS, 2)), np.empty(_MOST_PEAKS)
    n = 0
    for i in range(1, rows - 1):
        for j in range(table.first[i], table.last[i]):
            value = score[i, j]
            if value < _LEAST_SCORE or n == _MOST_PEAKS:
                continue
            # Of equal cells, the last one.
            before, same, after = score[i - 1], score[i], score[i + 1]
            highest = max(same[j - 1], before[j - 1], before[j], before[j + 1])
            if highest > value or max(same[j + 1], after[j - 1], after[j], after[j + 1]) >= value:
                continue
            x = y = total = 0.0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    total += votes[a, b]
                    x += votes[a, b] * (b + 0.5)
                    y += votes[a, b] * table.ahead[a]
            place[n, 0], place[n, 1] = table.left + table.cell * x / total, y / total
            height[n] = value
            n += 1
    return place[:n], height[:n]
