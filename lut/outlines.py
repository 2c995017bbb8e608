"""Which grey values vote on a disc: the outlines' pixels around every possible centre.

A disc on the floor centred where pixel (u, v) meets it has an inner outline (inside the disc's
edge) and an outer one (outside). Where their equally spaced samples fall in the image depends on
the calibration alone, so it is computed ahead of time, for every pixel (DLR Spatial Cognition data
set report, circle detection).

From one pixel to the next along a row, a sample nearly always moves by one pixel as well: its
offset from the centre stays the same for some 40 pixels. So the table stores, for each row and
sample, the *runs* of equal offset. A detector can then copy stretches of image rows instead of
gathering single pixels.

Samples outside the image do not vote: the table sends them to the row above the image, which a
detector pads with zeros. A centre is usable when at least half of each outline's
samples are inside, it keeps its distance from the border, and the floor there moves by no more
than a given length per image row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from lut.errors import TableError
from lut.kernels import count_votes, encode_runs

#: Part of an outline's samples that must lie inside the image.
MIN_SHARE_INSIDE = 0.5


@dataclass(frozen=True)
class DiscShape:
    """What is sampled around a centre, and how near and far centres may be.

    Parameters
    ----------
    inner_radius_m, outer_radius_m : float
        Radii of the two outlines on the floor, metres.
    samples : int
        Equally spaced samples on each outline; the first lies in the robot's +X direction.
    border_px : int
        Near limit: centres keep this distance from the image's border, pixels.
    far_limit_m_per_px : float
        Far limit: the floor moves at most this far from one image row to the next, metres.
    """

    inner_radius_m: float = 0.06
    outer_radius_m: float = 0.14
    samples: int = 16
    border_px: int = 12
    far_limit_m_per_px: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 < self.inner_radius_m < self.outer_radius_m < float("inf"):
            raise TableError(
                f"outlines of radius {self.inner_radius_m:g} and {self.outer_radius_m:g} m: "
                "expected 0 < inner < outer"
            )
        if not 3 <= self.samples <= 128:
            raise TableError(f"{self.samples} samples on an outline: expected 3 to 128")
        if self.border_px < 0:
            raise TableError(f"border of {self.border_px} px: expected 0 or more")
        if not self.far_limit_m_per_px > 0.0:
            raise TableError(f"far limit of {self.far_limit_m_per_px:g} m: expected more than 0")


@dataclass(frozen=True)
class DiscTable:
    """Outline pixels of every usable centre, as runs of equal offset.

    Row v's runs of sample k (inner samples first) are ``run_bounds[v, k] : run_bounds[v, k + 1]``
    of the three run arrays. A run reaches from its `run_start` to the next run's, the last one to
    `row_end[v]`.

    Attributes
    ----------
    samples : int
        Samples on each of the two outlines.
    row_begin, row_end : (H,) int32
        Columns from and up to which a row has usable centres; equal where there are none.
    usable : (H, W) bool
        The usable centres. All lie between `row_begin` and `row_end`.
    run_bounds : (H, 2 samples + 1) int32
        See above.
    run_start : (N,) int16 or int32
        First column of each run.
    run_du, run_dv : (N,) int16 or int32
        Offset of the sample from the centre, pixels. For samples outside the image it leads to row
        -1, straight above the centre.
    votes_inner, votes_outer : (H, W) uint8
        Samples of each outline inside the image, for usable centres.
    margin_px : int
        Padding that makes every offset of every run safe: 1 if samples lie outside the image, else
        0.
    floor_xy : (H, W, 2) float32
        Floor position (robot X, Y in metres) that each pixel sees; NaN above the horizon.
    """

    samples: int
    row_begin: NDArray[np.int32]
    row_end: NDArray[np.int32]
    usable: NDArray[np.bool_]
    run_bounds: NDArray[np.int32]
    run_start: NDArray[np.int32]
    run_du: NDArray[np.int32]
    run_dv: NDArray[np.int32]
    votes_inner: NDArray[np.uint8]
    votes_outer: NDArray[np.uint8]
    margin_px: int
    floor_xy: NDArray[np.float32]


def ring(radius_m: float, samples: int) -> NDArray[np.float64]:
    """(samples, 2) equally spaced points on a circle about the origin, metres."""
    angle = 2.0 * np.pi * np.arange(samples) / samples
    return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def build_disc_table(camera: Camera, shape: DiscShape) -> DiscTable:
    """Compute the outlines' pixels around every usable centre.

    Parameters
    ----------
    camera : Camera
        The calibrated camera.
    shape : DiscShape
        Outlines and limits.

    Returns
    -------
    DiscTable
        A camera that sees no usable floor (looking up, say) gets a table without usable centres.

    Raises
    ------
    TableError
        If the camera is not above the floor.
    """
    if not camera.centre[2] > 0.0:
        raise TableError(
            f"the camera is {camera.centre[2]:g} m above the floor: expected more than 0"
        )
    numbers = camera_numbers(camera)
    floor_xy = floor_positions(camera)
    candidate = _within_limits(camera, shape, floor_xy)

    inner = ring(shape.inner_radius_m, shape.samples)
    outer = ring(shape.outer_radius_m, shape.samples)
    votes_inner = np.zeros(candidate.shape, np.uint8)
    votes_outer = np.zeros(candidate.shape, np.uint8)
    count_votes(numbers, floor_xy, candidate, inner, votes_inner)
    count_votes(numbers, floor_xy, candidate, outer, votes_outer)
    enough = MIN_SHARE_INSIDE * shape.samples
    usable = candidate & (votes_inner >= enough) & (votes_outer >= enough)

    any_usable = usable.any(axis=1)
    row_begin = np.where(any_usable, usable.argmax(axis=1), 0).astype(np.int32)
    row_end = np.where(any_usable, camera.width - usable[:, ::-1].argmax(axis=1), 0)
    row_end = row_end.astype(np.int32)

    rings = np.concatenate([inner, outer])
    # A first guess at the number of runs; the encoder tells when more room is needed.
    capacity = 32 * len(rings) * camera.height
    while True:
        run_bounds, run_start, run_du, run_dv, count = encode_runs(
            numbers, floor_xy, usable, row_begin, row_end, rings, capacity
        )
        if count <= capacity:
            break
        capacity = count
    run_start, run_du, run_dv = run_start[:count], run_du[:count], run_dv[:count]
    run_row = np.repeat(np.arange(camera.height), run_bounds[:, -1] - run_bounds[:, 0])
    return DiscTable(
        samples=shape.samples,
        row_begin=row_begin,
        row_end=row_end,
        usable=usable,
        run_bounds=run_bounds,
        run_start=_narrow(run_start),
        run_du=_narrow(run_du),
        run_dv=_narrow(run_dv),
        votes_inner=np.where(usable, votes_inner, 0).astype(np.uint8),
        votes_outer=np.where(usable, votes_outer, 0).astype(np.uint8),
        margin_px=int(np.any(run_row + run_dv < 0)),
        floor_xy=floor_xy.astype(np.float32),
    )


def floor_positions(camera: Camera) -> NDArray[np.float64]:
    """(H, W, 2) floor position (robot X, Y, metres) that each pixel sees; NaN above the horizon."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    return camera.floor_from_pixel(np.stack([u, v], axis=-1).astype(np.float64))


def _within_limits(
    camera: Camera, shape: DiscShape, floor_xy: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Pixels far enough from the border and near enough on the floor."""
    height, width = camera.height, camera.width
    u, v = np.arange(width), np.arange(height)
    border = shape.border_px
    inside_u = (u >= border) & (u <= width - border)
    inside_v = (v >= border) & (v <= height - border)
    # Central differences over the neighbouring rows; one-sided at the image's first and last.
    per_row = np.gradient(floor_xy, axis=0) if height > 1 else np.full_like(floor_xy, np.nan)
    near = np.hypot(per_row[..., 0], per_row[..., 1]) <= shape.far_limit_m_per_px
    return np.asarray(near & inside_v[:, None] & inside_u[None, :])


def _narrow(values: NDArray[np.int32]) -> NDArray[np.int32]:
    """The same numbers in 16 bits where they fit: tables stay in the processor's cache."""
    if len(values) and (values.min() < -32768 or values.max() > 32767):
        return values
    return values.astype(np.int16)
