"""Candidates by the edges of the image: a Hough transform for discs of known size on the floor.

At the rim of a light disc the gradient of the grey value, taken on the floor, points to the centre,
one radius away. With A the derivative of the floor position X by the pixel, B = abs(det A) A^-T,
and g the gradient in the image, the centre is

    X + r n,  n = B g / norm(B g),

and X - r n for a dark disc. Every pixel with a strong gradient votes for one centre, by the share
of the rim that it sees, norm(B g) / norm(g) of 2 pi r; so whatever hides or lights a part of a disc
takes its own share of the votes and no more. Votes are counted in cells of a quarter of the radius
across, and of at least a pixel ahead. A score is that of three by three cells, relative to the mean
of all cells as far ahead, where texture and distance make all scores higher.

Source: C. Kimme, D. Ballard and J. Sklansky, Finding Circles by an Array of Accumulators,
CACM 18 (1975).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.discs.candidates import suppress_neighbours
from lut import DiscTable
from redetect.compiled import kernel

FloatArray = NDArray[np.float64]

#: Width of a cell, radii, and at least ahead, pixels.
_CELL_RADII, _CELL_PX = 0.25, 0.8
#: Steps in which it is looked up how far ahead a cell is, for each radius.
_STEPS_PER_RADIUS = 16.0
#: Where every disc is this wide (pixels), columns are added in pairs; where it is this high, every
#: second row votes, and so on.
_WIDE_PX, _HIGH_PX = 9.0, 6.0
#: Added to the mean votes of the cells as far ahead: where these are empty, few votes are none.
_BACKGROUND = 0.45
#: Least score of a candidate, and how many an image may have, at most, and before suppression.
_LEAST_SCORE, _MOST, _MOST_PEAKS = 1.45, 80, 1000
#: Nearer to a better candidate than this is none, radii: what touches a disc may be one, too.
_APART = 0.6
#: Sobel's kernel multiplies a step per pixel by this.
_SOBEL_GAIN = 8.0


class Grid(NamedTuple):
    """Which pixels vote, and the cells in which their votes are counted; lengths in metres."""

    paired: bool  # columns of the image are added in pairs
    image_row: NDArray[np.int64]  # (R,) rows of the image that vote
    #: (R, W, 6) of each pixel (or pair) its place, cells across and steps ahead, and B / (2 pi r)
    #: by rows; all 0 where no floor is seen
    pixel: NDArray[np.float32]
    row_of_step: NDArray[np.int64]  # (S,) row of cells at each step ahead
    ahead: FloatArray  # (M,) middle of each row of cells
    first: NDArray[np.int64]  # (M,) columns of cells between which each row is in view
    last: NDArray[np.int64]
    columns: int
    cell: float  # width of cells,
    step: float  # of steps ahead,
    left: float  # and where column 0 begins
    foot: FloatArray  # (2,) of the camera
    turn: FloatArray  # (2, 2) the directions across and ahead


class HoughCandidates(NamedTuple):
    """Places that may be centres of discs, the best first."""

    floor_xy: FloatArray  # (N, 2) metres
    score: FloatArray  # (N,)


def hough_candidates(
    image: NDArray[np.uint8],
    camera: Camera,
    table: DiscTable,
    radius: float,
    sign: float,
    least_step: float,
) -> HoughCandidates:
    """Centres of discs of one radius (m) by the votes of the edges, the best first.

    The sign is 1 for light discs, -1 for dark ones; edges have gradients of at least `least_step`
    grey levels per pixel.
    """
    grid = grid_of(camera, table, radius)
    if grid is None:
        return HoughCandidates(np.empty((0, 2)), np.empty(0))
    place, score = _peaks(count_votes(image, grid, sign * radius, least_step), grid)
    alone = suppress_neighbours(place, score, _APART * radius)
    place, score = place[alone], score[alone]
    best = np.argsort(-score, kind="stable")[:_MOST]
    return HoughCandidates(place[best] @ grid.turn + grid.foot, score[best])


@kernel()
def count_votes(
    image: NDArray[np.uint8], grid: Grid, radius: float, least_step: float
) -> NDArray[np.float32]:
    """(M, columns) votes for each cell, shares of a rim; the radius is negative for dark discs."""
    votes = np.zeros((len(grid.ahead), grid.columns), np.float32)
    width = grid.pixel.shape[1]
    across, ahead = np.float32(radius / grid.cell), np.float32(radius / grid.step)
    least = np.float32((_SOBEL_GAIN * (1.0 + grid.paired) * least_step) ** 2)
    lines = np.empty((3, width), np.int16)
    along_u = np.empty(width, np.float32)
    along_v = np.empty(width, np.float32)
    square = np.empty(width, np.float32)
    for k in range(len(grid.image_row)):
        for i in range(3):
            row, line = image[grid.image_row[k] + i - 1], lines[i]
            if grid.paired:
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
            pixel = grid.pixel[k, j]
            x = pixel[2] * along_u[j] + pixel[3] * along_v[j]
            y = pixel[4] * along_u[j] + pixel[5] * along_v[j]
            length = math.sqrt(x * x + y * y)
            if not length > 0.0:
                continue
            column = int(pixel[0] + across * x / length)
            step = int(pixel[1] + ahead * y / length)
            if 0 <= column < grid.columns and 0 <= step < len(grid.row_of_step):
                votes[grid.row_of_step[step], column] += length / math.sqrt(square[j])
    return votes


@kernel(fastmath={"reassoc", "nsz"})
def _peaks(votes: NDArray[np.float32], grid: Grid) -> tuple[FloatArray, FloatArray]:
    """Places (across, ahead) and scores of cells that no neighbour exceeds."""
    rows, columns = votes.shape
    score = np.zeros((rows, columns), np.float32)
    column = np.empty(columns, np.float32)
    for i in range(1, rows - 1):
        # One cell more to either side; sliced row by row, so that several are added at a time.
        left, right = grid.first[i] - 1, grid.last[i] + 1
        before, same = votes[i - 1, left:right], votes[i, left:right]
        after = votes[i + 1, left:right]
        around = np.float32(0.0)
        for j in range(len(same)):
            column[j] = before[j] + same[j] + after[j]
            around += column[j]
        scale = np.float32(1.0) / np.float32(_BACKGROUND + 3.0 * around / len(same))
        row = score[i, grid.first[i] : grid.last[i]]
        for j in range(len(row)):
            row[j] = scale * (column[j] + column[j + 1] + column[j + 2])
    place, height = np.empty((_MOST_PEAKS, 2)), np.empty(_MOST_PEAKS)
    n = 0
    for i in range(1, rows - 1):
        for j in range(grid.first[i], grid.last[i]):
            value = score[i, j]
            if value < _LEAST_SCORE or n == _MOST_PEAKS:
                continue
            # Of equal cells the last one.
            before, same, after = score[i - 1], score[i], score[i + 1]
            highest = max(same[j - 1], before[j - 1], before[j], before[j + 1])
            if highest > value or max(same[j + 1], after[j - 1], after[j], after[j + 1]) >= value:
                continue
            x = y = total = 0.0
            for a in range(i - 1, i + 2):
                for b in range(j - 1, j + 2):
                    total += votes[a, b]
                    x += votes[a, b] * (b + 0.5)
                    y += votes[a, b] * grid.ahead[a]
            place[n, 0], place[n, 1] = grid.left + grid.cell * x / total, y / total
            height[n] = value
            n += 1
    return place[:n], height[:n]


@lru_cache(maxsize=4)
def grid_of(camera: Camera, table: DiscTable, radius: float) -> Grid | None:
    """The grid from the nearest to the farthest centre of the table; None where it has none."""
    foot = np.array(camera.centre[:2])
    offset = table.floor_xy.astype(np.float64) - foot
    usable = table.usable & np.isfinite(offset).all(axis=-1)
    if min(usable.shape) < 3 or not usable.any():
        return None
    direction = offset[usable].mean(axis=0)
    direction /= max(float(np.hypot(*direction)), 1e-9)
    turn = np.array([[-direction[1], direction[0]], direction])
    place = offset @ turn.T
    per_row = np.linalg.norm(np.gradient(place, axis=0), axis=-1)
    per_column = np.linalg.norm(np.gradient(place, axis=1), axis=-1)
    edges = _edges_ahead(place[usable, 1], per_row[usable], radius)
    # Up to the image's border, nearer than the centres of the table are.
    seen = (place[..., 1] >= edges[0]) & (place[..., 1] < edges[-1])
    across, ahead = np.moveaxis(place[seen], -1, 0)
    cell, step = _CELL_RADII * radius, radius / _STEPS_PER_RADIUS
    left = float(across.min()) - 3.0 * cell
    paired = bool(2.0 * radius >= _WIDE_PX * np.nanmax(per_column[usable]))
    if paired:
        pairs = place.shape[1] // 2
        place = 0.5 * (place[:, : 2 * pairs : 2] + place[:, 1 : 2 * pairs : 2])
    along_u, along_v = np.gradient(place, axis=1), np.gradient(place, axis=0)
    sign = np.sign(along_u[..., 0] * along_v[..., 1] - along_v[..., 0] * along_u[..., 1])
    matrix = [along_v[..., 1], -along_u[..., 1], -along_v[..., 0], along_u[..., 0]]
    pixel = np.stack(
        [(place[..., 0] - left) / cell, (place[..., 1] - edges[0]) / step]
        + [sign * entry / (2.0 * np.pi * radius) for entry in matrix],
        axis=-1,
    )
    inside = np.isfinite(pixel).all(axis=-1) & (place[..., 1] < edges[-1] + radius)
    pixel = np.where(inside[..., None], pixel, 0.0).astype(np.float32)
    image_row = []
    v = 1
    while v < len(pixel) - 1:
        every = 1
        if inside[v].any():
            every = max(int(2.0 * radius / (_HIGH_PX * np.nanmedian(per_row[v]))), 1)
            image_row.append(v)
            pixel[v, :, 2:] *= every
        v += every
    row = np.searchsorted(edges, ahead, side="right") - 1
    first, last = np.full(len(edges) - 1, np.inf), np.zeros(len(edges) - 1)
    np.minimum.at(first, row, np.floor((across - left) / cell))
    np.maximum.at(last, row, np.floor((across - left) / cell) + 1.0)
    known = np.flatnonzero(last)
    at = np.arange(math.floor((edges[-1] - edges[0]) / step)) + 0.5
    return Grid(
        paired=paired,
        image_row=np.array(image_row),
        pixel=pixel[image_row],
        row_of_step=np.searchsorted(edges, edges[0] + step * at, side="right") - 1,
        ahead=0.5 * (edges[1:] + edges[:-1]),
        first=np.interp(np.arange(len(first)), known, first[known]).astype(np.int64),
        last=np.interp(np.arange(len(last)), known, last[known]).astype(np.int64),
        columns=int(last.max()) + 3,
        cell=cell,
        step=step,
        left=left,
        foot=foot,
        turn=turn,
    )


def _edges_ahead(ahead: FloatArray, per_row: FloatArray, radius: float) -> FloatArray:
    """Distances between rows of cells: a cell of the floor apart, and at least a pixel."""
    order = np.argsort(ahead)[:: max(len(ahead) // 512, 1)]
    edges = [float(ahead.min()) - radius]
    while edges[-1] < ahead.max() + radius:
        pixel = float(np.interp(edges[-1], ahead[order], per_row[order]))
        edges.append(edges[-1] + max(_CELL_RADII * radius, _CELL_PX * pixel))
    return np.array(edges)
