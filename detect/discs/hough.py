"""Candidates by the edges of the image: a Hough transform for discs of known size on the floor.

At the rim of a light disc the gradient of the grey value, taken on the floor, points to the centre,
one radius away. With A the derivative of the floor position X by the pixel and g the gradient in
the image, the centre is

    X + r n,  n = m / norm(m),  m = A^-T g,

and X - r n for a dark disc. Every pixel with a strong gradient votes for one centre, by the share
of the rim that it sees; so whatever hides or lights a part of a disc takes its own share of the
votes and no more. Votes are counted in cells of about a quarter of the radius, and at least a
pixel, that lie on rings about the camera; a score is that of three by three cells, relative to
the mean of its ring, where texture and distance make all scores higher.

Source: C. Kimme, D. Ballard and J. Sklansky, Finding Circles by an Array of Accumulators,
CACM 18 (1975).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera import Camera
from detect.discs.candidates import suppress_neighbours
from lut import DiscTable

FloatArray = NDArray[np.float64]

#: Width of a cell, radii, and at least, pixels.
_CELL_RADII, _CELL_PX = 0.25, 0.8
#: Cells of the raster that says in which cell a floor position lies, for each radius.
_RASTER_PER_RADIUS = 5.0
#: Added to the mean votes of a ring: where it is empty, few votes are no candidate.
_BACKGROUND = 0.3
#: Least score of a candidate, and how many an image may have.
_LEAST_SCORE, _MOST = 1.5, 100
#: Sobel's kernel multiplies a step per pixel by this.
_SOBEL_GAIN = 8.0


class Cells(NamedTuple):
    """The cells in which votes are counted; a cell without votes is before and behind each ring.

    Attributes
    ----------
    raster : (N, M) int32
        Cell of each place of a regular raster on the floor; 0 for none.
    origin : (2,) float64
        Floor position of the raster's corner, metres.
    per_metre : float
        Raster places.
    above, below : (K,) int64
        The cell in the next and in the previous ring that lies in the same direction.
    ring : (R,) int64
        First cell of each ring.
    floor_xy : (K, 2) float64
        Middle of each cell, metres.
    first_row : int
        Of the image, that sees floor.
    """

    raster: NDArray[np.int32]
    origin: FloatArray
    per_metre: float
    above: NDArray[np.int64]
    below: NDArray[np.int64]
    ring: NDArray[np.int64]
    floor_xy: FloatArray
    first_row: int


class Edges(NamedTuple):
    """Gradient of the grey value along u and v, in eighths of a grey level per pixel."""

    along_u: NDArray[np.int16]
    along_v: NDArray[np.int16]


class HoughCandidates(NamedTuple):
    """Places that may be centres of discs, the best first.

    Attributes
    ----------
    floor_xy : (N, 2) float64
        Metres.
    score : (N,) float64
    """

    floor_xy: FloatArray
    score: FloatArray


def hough_candidates(
    image: NDArray[np.uint8],
    camera: Camera,
    table: DiscTable,
    radius: float,
    sign: float,
    least_step: float,
) -> HoughCandidates:
    """Centres of discs of one radius by the votes of the edges.

    Parameters
    ----------
    image : (H, W) uint8
    camera : Camera
    table : DiscTable
        The camera's: where its pixels see the floor.
    radius : float
        Metres.
    sign : float
        1 for light discs, -1 for dark ones.
    least_step : float
        Least gradient of an edge, grey levels per pixel.
    """
    if not table.usable.any():
        return HoughCandidates(np.empty((0, 2)), np.empty(0))
    cells = _cells(camera, table, radius)
    edges = edges_of(image)
    votes = count_votes(
        edges.along_u, edges.along_v, table.floor_xy, sign * radius, _SOBEL_GAIN * least_step,
        cells.raster, cells.origin, cells.per_metre, (cells.first_row, len(cells.above)),
    )  # fmt: skip
    score = _scores(votes, cells)
    # None of the neighbours on the ring is better.
    best = score >= _LEAST_SCORE
    best[1:-1] &= (score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:])
    index = np.flatnonzero(best)
    index = index[np.argsort(-score[index], kind="stable")]
    index = index[suppress_neighbours(cells.floor_xy[index], score[index], radius)][:_MOST]
    return HoughCandidates(cells.floor_xy[index], score[index])


def edges_of(image: NDArray[np.uint8]) -> Edges:
    """The gradient of an image, smoothed over three pixels."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0)
    return Edges(
        np.asarray(cv2.Sobel(smooth, cv2.CV_16S, 1, 0), np.int16),
        np.asarray(cv2.Sobel(smooth, cv2.CV_16S, 0, 1), np.int16),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def count_votes(
    along_u: NDArray[np.int16],
    along_v: NDArray[np.int16],
    floor_xy: NDArray[np.float32],
    radius: float,
    least: float,
    raster: NDArray[np.int32],
    origin: FloatArray,
    per_metre: float,
    size: tuple[int, int],
) -> NDArray[np.float32]:
    """Votes for each cell: shares of a rim.

    Parameters
    ----------
    along_u, along_v
        See `Edges`.
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres; NaN where there is none.
    radius : float
        Metres, negative for dark discs.
    least : float
        Least length of a gradient.
    raster, origin, per_metre
        See `Cells`.
    size : (int, int)
        First row of the image that sees floor, and number of cells.
    """
    first_row, cells = size
    height, width = along_u.shape
    votes = np.zeros(cells, np.float32)
    rows, columns = raster.shape
    x0, y0 = origin[0], origin[1]
    least_squared = np.int32(math.ceil(least * least))
    whole_rim = 2.0 * math.pi * abs(radius)
    for v in range(max(first_row, 1), height - 1):
        for u in range(1, width - 1):
            gu, gv = np.int32(along_u[v, u]), np.int32(along_v[v, u])
            if gu * gu + gv * gv < least_squared:
                continue
            xu = 0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0])
            yu = 0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1])
            xv = 0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0])
            yv = 0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1])
            area = xu * yv - xv * yu
            if not abs(area) > 0.0:
                continue
            nx = (yv * gu - yu * gv) / area
            ny = (xu * gv - xv * gu) / area
            length = math.sqrt(nx * nx + ny * ny)
            nx /= length
            ny /= length
            j = int((floor_xy[v, u, 0] + radius * nx - x0) * per_metre)
            i = int((floor_xy[v, u, 1] + radius * ny - y0) * per_metre)
            if 0 <= i < rows and 0 <= j < columns:
                # Of the pixel, the extent along the rim is its area by that across it.
                across = math.hypot(xu * nx + yu * ny, xv * nx + yv * ny)
                votes[raster[i, j]] += np.float32(abs(area) / (across * whole_rim))
    return votes


def _scores(votes: NDArray[np.float32], cells: Cells) -> FloatArray:
    """Votes of three by three cells, relative to the mean of the ring."""
    votes[0] = 0.0
    row = votes.copy()
    row[1:] += votes[:-1]
    row[:-1] += votes[1:]
    around = row + row[cells.above] + row[cells.below]
    around[0] = 0.0
    sizes = np.diff(np.append(cells.ring, len(votes)))
    mean = np.add.reduceat(around, cells.ring) / sizes
    return np.asarray(around / np.repeat(_BACKGROUND + mean, sizes), np.float64)


@lru_cache(maxsize=4)
def _cells(camera: Camera, table: DiscTable, radius: float) -> Cells:
    """Rings about the camera's foot, from the nearest to the farthest centre of the table."""
    foot, height = camera.centre[:2], float(camera.centre[2])
    floor = table.floor_xy.astype(np.float64)
    offset = floor - foot
    distance = np.hypot(offset[..., 0], offset[..., 1])
    usable = table.usable & np.isfinite(distance)
    # Directions count from the middle of what is seen: where they wrap nothing is seen.
    ahead = offset[usable].mean(axis=0)
    ahead /= max(float(np.hypot(*ahead)), 1e-9)
    aside = np.array([-ahead[1], ahead[0]])
    bearing = np.arctan2(offset @ aside, offset @ ahead)
    edges = _ring_edges(distance, usable, radius)
    middle = 0.5 * (edges[1:] + edges[:-1])
    pixel = _CELL_PX * np.hypot(middle, height) / camera.scale_x
    width = np.maximum(_CELL_RADII * radius, pixel) / middle
    first, last = bearing[usable].min() - 0.1, bearing[usable].max() + 0.1
    # One cell more at either end of a ring, which stays empty.
    size = np.ceil((last - first) / width).astype(np.int64) + 2
    ring = np.cumsum(np.append(0, size))
    of_ring = np.repeat(np.arange(len(middle)), size)
    turn = (np.arange(ring[-1]) - ring[of_ring] - 0.5) * width[of_ring]

    def cell_of(other: NDArray[np.int64], along: FloatArray) -> NDArray[np.int64]:
        inside = (other >= 0) & (other < len(middle))
        other = np.clip(other, 0, len(middle) - 1)
        number = np.floor(along / width[other]).astype(np.int64) + 1
        inside &= (number >= 1) & (number < size[other] - 1)
        return np.where(inside, ring[other] + number, 0)

    low = floor[usable].min(axis=0) - 2.0 * radius
    high = floor[usable].max(axis=0) + 2.0 * radius
    per_metre = _RASTER_PER_RADIUS / radius
    places = [np.arange(math.ceil((b - a) * per_metre)) + 0.5 for a, b in zip(low, high)]
    grid = np.meshgrid(low[0] + places[0] / per_metre, low[1] + places[1] / per_metre)
    place = np.stack(grid, axis=-1) - foot
    far = np.hypot(place[..., 0], place[..., 1])
    along = np.arctan2(place @ aside, place @ ahead) - first
    angle = (turn + first)[:, None]
    return Cells(
        raster=cell_of(np.searchsorted(edges, far, side="right") - 1, along).astype(np.int32),
        origin=low,
        per_metre=per_metre,
        above=cell_of(of_ring + 1, turn),
        below=cell_of(of_ring - 1, turn),
        ring=ring[:-1],
        floor_xy=foot + middle[of_ring, None] * (np.cos(angle) * ahead + np.sin(angle) * aside),
        first_row=int(np.flatnonzero(np.isfinite(distance).any(axis=1))[0]),
    )


def _ring_edges(distance: FloatArray, usable: NDArray[np.bool_], radius: float) -> FloatArray:
    """Distances between rings: a cell of the floor apart, and at least a pixel."""
    step = np.abs(np.gradient(distance, axis=0))
    known = usable & np.isfinite(step)
    order = np.argsort(distance[known])
    every = max(len(order) // 512, 1)
    at, length = distance[known][order][::every], step[known][order][::every]
    edges = [max(float(at[0]) - radius, radius)]
    while edges[-1] < at[-1] + radius:
        pixel = float(np.interp(edges[-1], at, length))
        edges.append(edges[-1] + max(_CELL_RADII * radius, _CELL_PX * pixel))
    return np.array(edges)
