"""Table of the floor cells in which edges vote for centres of discs (`detect.discs.hough`).

The floor position of a pixel, the direction of its gradient there, and the share of a rim that it
covers depend on the calibration and the discs' radius only. Cells are a quarter of the radius wide,
and at least a pixel long in the viewing direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from camera import Camera
from lut.outlines import demand_above_floor, fingerprint, floor_positions, pixels_within, row_step_m
from redetect.array_types import ByteArray, Float32Array, FloatArray, IntArray

_CELL_RADII = 0.25  #: Width of a cell, radii.
_CELL_PX = 0.8  #: Its least length ahead, pixels.
#: Resolution of the lookup from distance ahead to row of cells, steps per radius.
_STEPS_PER_RADIUS = 16.0
#: If every disc is this wide (pixels), columns are added in pairs; if it is this high, every second
#: row votes, and so on.
_WIDE_PX, _HIGH_PX = 9.0, 6.0
#: Distance of the pixels at which the largest disc is looked for.
_SIZED_PX = 8


@dataclass(frozen=True)
class VoteShape:
    """Size of the discs, and the centres: how far from the border and how large discs are there."""

    radius_m: float = 0.10  #: Radius of the discs, metres.
    border_px: int = 6  #: Least distance from the image's border.
    #: Largest step of the floor from one image row to the next; infinite: no limit.
    far_limit_m_per_px: float = 0.12
    #: Radius of the discs in pixels, the geometric mean along both axes of the image. Smaller ones
    #: cannot be found, larger ones are searched in a reduced image.
    smallest_px: float = 0.5
    largest_px: float = 20.0


class VoteTable(NamedTuple):
    """The voting pixels, and the cells in which their votes are counted; lengths in metres."""

    #: (H, W, 2) floor position (robot X, Y) of each pixel; NaN above the horizon
    floor_xy: Float32Array
    paired: bool  # whether columns of the image are added in pairs
    image_row: IntArray  # (R,) rows of the image that vote; none without centres
    #: (R, W, 6) for each pixel (or pair) its position, cells across and steps ahead, and
    #: B / (2 pi r) row by row; all 0 where no floor is visible
    pixel: Float32Array
    row_of_step: IntArray  # (S,) row of cells at each step ahead
    ahead: FloatArray  # (M,) middle of each row of cells
    first: IntArray  # (M,) columns of cells between which each row is visible
    last: IntArray
    columns: int
    cell: float  # width of a cell
    step: float  # length of a step ahead
    left: float  # left end of column 0
    foot: FloatArray  # (2,) floor position below the camera
    turn: FloatArray  # (2, 2) the directions across and ahead
    made_for: ByteArray  # `fingerprint` of the camera and the shape


def build_vote_table(camera: Camera, shape: VoteShape) -> VoteTable:
    """Compute the cells from the nearest to the farthest centre.

    A camera that is not above the floor raises a TableError.
    """
    demand_above_floor(camera)
    floor_xy = floor_positions(camera)
    foot, radius = np.array(camera.centre[:2]), shape.radius_m
    offset = floor_xy - foot
    limits = shape.border_px, shape.far_limit_m_per_px
    usable = pixels_within(row_step_m(floor_xy), *limits) & np.isfinite(offset).all(axis=-1)
    if min(usable.shape) >= 3:
        by_row, by_column = (np.gradient(floor_xy, axis=axis) for axis in (0, 1))
        size = radius_px(radius, np.stack([by_column, by_row], axis=-1))
        usable &= (size > shape.smallest_px) & (size <= shape.largest_px)
    if min(usable.shape) < 3 or not usable.any():
        nothing = np.zeros(0, np.int64)
        return VoteTable(
            floor_xy.astype(np.float32), False, nothing, np.zeros((0, 0, 6), np.float32), nothing,
            np.zeros(0), nothing, nothing, 0, 1.0, 1.0, 0.0, foot, np.eye(2),
            fingerprint(camera, shape),
        )  # fmt: skip
    direction = offset[usable].mean(axis=0)
    distance = float(np.hypot(*direction))
    # If the camera looks straight down, any direction will do.
    direction = direction / distance if distance > 1e-6 * radius else np.array([0.0, 1.0])
    turn = np.array([[-direction[1], direction[0]], direction])
    place = offset @ turn.T
    per_row = np.linalg.norm(np.gradient(place, axis=0), axis=-1)
    per_column = np.linalg.norm(np.gradient(place, axis=1), axis=-1)
    edges = _edges_ahead(place[usable, 1], per_row[usable], radius)
    # Up to the image border, which is nearer than the first centres.
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
    inside = np.isfinite(pixel).all(axis=-1)
    inside &= (place[..., 1] > edges[0] - radius) & (place[..., 1] < edges[-1] + radius)
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
    return VoteTable(
        floor_xy=floor_xy.astype(np.float32), paired=paired,
        image_row=np.array(image_row), pixel=pixel[image_row],
        row_of_step=np.searchsorted(edges, edges[0] + step * at, side="right") - 1,
        ahead=0.5 * (edges[1:] + edges[:-1]),
        first=np.interp(np.arange(len(first)), known, first[known]).astype(np.int64),
        last=np.interp(np.arange(len(last)), known, last[known]).astype(np.int64),
        columns=int(last.max()) + 3, cell=cell, step=step, left=left, foot=foot, turn=turn,
        made_for=fingerprint(camera, shape),
    )  # fmt: skip


def largest_disc_px(camera: Camera, shape: VoteShape) -> float:
    """The largest radius of discs in the image, pixels, if their size does not matter; or 0."""
    border = shape.border_px
    u, v = (np.arange(border, size - border, _SIZED_PX) for size in (camera.width, camera.height))
    jacobian = camera.floor_jacobian(np.stack(np.meshgrid(u, v), axis=-1))
    near = np.hypot(*np.moveaxis(jacobian[..., 1], -1, 0)) <= shape.far_limit_m_per_px
    return float(radius_px(shape.radius_m, jacobian[near]).max(initial=0.0))


def radius_px(radius_m: float, floor_jacobian: FloatArray) -> FloatArray:
    """(...) radii of discs in the image, pixels: the geometric mean along both axes of the image.

    From (..., 2, 2) derivatives of the floor's (X, Y) by (u, v), as of `Camera.floor_jacobian`.
    """
    (x_u, x_v), (y_u, y_v) = np.moveaxis(floor_jacobian, (-2, -1), (0, 1))
    with np.errstate(divide="ignore"):
        return np.asarray(radius_m / np.sqrt(abs(x_u * y_v - x_v * y_u)))


def _edges_ahead(ahead: FloatArray, per_row: FloatArray, radius: float) -> FloatArray:
    """Distances of the edges between rows of cells: a cell apart, and at least a pixel."""
    order = np.argsort(ahead)[:: max(len(ahead) // 512, 1)]
    edges = [float(ahead.min()) - radius]
    while edges[-1] < ahead.max() + radius:
        pixel = float(np.interp(edges[-1], ahead[order], per_row[order]))
        edges.append(edges[-1] + max(_CELL_RADII * radius, _CELL_PX * pixel))
    return np.array(edges)
