"""Table of the outlines' pixels around every possible centre of a disc.

A disc on the floor centred where pixel (u, v) meets it has an inner outline (inside the disc's
edge) and an outer one (outside). Where their equally spaced samples fall in the image depends on
the calibration alone, so it is computed ahead of time, for every pixel (DLR Spatial Cognition data
set report, circle detection).

From one pixel to the next along a row, a sample nearly always moves by one pixel as well: its
offset from the centre stays the same for some 50 pixels. So the table does not store an offset for
each centre and sample but a list of *copies*: up to 64 bytes of the image each, as far apart as the
centres are. Placed one after the other, they align the grey values of one sample for consecutive
centres. Excess bytes of a copy are overwritten by the next.

Samples outside the image do not count: the table takes them from behind the image's last pixel,
where a detector has zeros. A centre is usable if at least half of each outline's samples are
inside, it keeps its distance from the border, and the floor there moves by no more than a given
length per image row.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from lut.errors import TableError
from lut.floor import floor_positions
from lut.kernels import (
    ADVANCE_BITS,
    LANES,
    Scan,
    blocks_of_row,
    copies_of_block,
    row_samples,
    usable_centres,
)
from storage.bounds import ABOVE_0, LIMIT, NOT_NEGATIVE, demand, whole

#: Part of an outline's samples that must lie inside the image.
MIN_SHARE_INSIDE = 0.5


@dataclass(frozen=True)
class DiscShape:
    """Samples around a centre, and the nearest and farthest centres.

    Parameters
    ----------
    inner_radius_m, outer_radius_m : float
        Radii of the two outlines on the floor, metres.
    samples : int
        Equally spaced samples on each outline; the first lies in the robot's +X direction.
    border_px : int
        Near limit: centres keep this distance from the image's border, pixels.
    far_limit_m_per_px : float
        Far limit: the floor moves at most this far from one image row to the next, metres;
        infinite: however far.
    least_pairs : int
        Samples are counted in pairs, an inner and an outer one, at least this many of which must be
        inside the image; 0: samples are counted singly.
    apart_px : float
        How far the samples of a pair that fall on the same pixel are moved, one inwards and one
        outwards: the length on the floor of this many pixels down the image.
    stride_m : float
        After a usable centre, those nearer than this along the row are left out, metres: counted
        in pixels as long as one down the image, rounded up; 0: none.
    """

    inner_radius_m: float = 0.06
    outer_radius_m: float = 0.14
    samples: int = 16
    border_px: int = 12
    far_limit_m_per_px: float = 0.05
    least_pairs: int = 0
    apart_px: float = 0.0
    stride_m: float = 0.0

    def __post_init__(self) -> None:
        demand(
            self,
            TableError,
            inner_radius_m=ABOVE_0,
            outer_radius_m=ABOVE_0,
            samples=whole(3, 128),
            border_px=whole(0),
            far_limit_m_per_px=LIMIT,
            least_pairs=whole(0, self.samples),
            apart_px=NOT_NEGATIVE,
            stride_m=NOT_NEGATIVE,
        )
        if not self.inner_radius_m < self.outer_radius_m:
            raise TableError(
                f"inner_radius_m is {self.inner_radius_m:g}: expected less than outer_radius_m "
                f"({self.outer_radius_m:g})"
            )


@dataclass(frozen=True, eq=False)
class DiscTable:
    """Usable centres, and how the grey values of their outlines are gathered.

    Hashed and compared by identity.

    Centres are processed in *blocks*: up to 256 centres of a row, all of them or every n-th one.
    For each block ``2 R`` rows of 256 grey values are gathered, a column for each centre: R =
    `samples` rounded up to a multiple of 4 for the inner outline, then R for the outer one; rows
    that are no samples are 0.

    Copies fill these rows one after the other. Each is one number, ``source * 512 + advance``: of
    64 pixels of the image every n-th one is copied, from the pixel with index `source` in scan
    order on, and the next copy goes `advance` bytes further.

    Attributes
    ----------
    samples : int
        Samples on each of the two outlines.
    copies : (N,) uint32, or uint64 for images of more than 8 Mpixel
        See above. `source` is H * W or less: behind the image's last pixel there are 64 zeros.
    block_copies : (B + 1,) int64
        Block b has the copies ``block_copies[b] : block_copies[b + 1]``, a multiple of 4: those
        that fill up copy zeros and go no further. Blocks are in scan order.
    block_row, block_column, block_stride : (B,) int32
        First centre of each block, and pixels from one to the next, at most 8.
    block_votes : (B + 1,) int64
        The centres of block b are the columns ``block_votes[b] : block_votes[b + 1]`` of `votes`.
    votes : (2, M) uint8
        Samples of the inner and of the outer outline inside the image, for the centres of all
        blocks, of which each has a multiple of 32; 0 for those that are not usable.
    floor_xy : (H, W, 2) float32
        Floor position (robot X, Y in metres) that each pixel sees; NaN above the horizon.
    """

    samples: int
    copies: NDArray[np.uint32] | NDArray[np.uint64]
    block_copies: NDArray[np.int64]
    block_row: NDArray[np.int32]
    block_column: NDArray[np.int32]
    block_stride: NDArray[np.int32]
    block_votes: NDArray[np.int64]
    votes: NDArray[np.uint8]
    floor_xy: NDArray[np.float32]

    @cached_property
    def first_source(self) -> int:
        """The first pixel, in scan order, that is copied for any block; H * W without blocks.

        In the rows above, the camera sees no floor, or none that is near enough.
        """
        height, width = self.floor_xy.shape[:2]
        return int(self.copies.min(initial=height * width << ADVANCE_BITS)) >> ADVANCE_BITS

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """(H, W) the usable centres."""
        return np.asarray(self.votes_inner > 0)

    @cached_property
    def votes_inner(self) -> NDArray[np.uint8]:
        """(H, W) samples of the inner outline inside the image, for usable centres."""
        return self._votes(0)

    @cached_property
    def votes_outer(self) -> NDArray[np.uint8]:
        """(H, W) samples of the outer outline inside the image, for usable centres."""
        return self._votes(1)

    @cached_property
    def centres(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of the centres of `votes`; what fills blocks up may be off the image."""
        widths = np.diff(self.block_votes)
        place = np.arange(self.votes.shape[1]) - np.repeat(self.block_votes[:-1], widths)
        first, stride = np.repeat(self.block_column, widths), np.repeat(self.block_stride, widths)
        return np.repeat(self.block_row, widths).astype(np.int64), first + place * stride

    @cached_property
    def block_whole(self) -> NDArray[np.bool_]:
        """(B,) whether all samples of all usable centres of a block vote."""
        lacking = (self.votes[0] > 0) & np.any(self.votes < self.samples, axis=0)
        some = np.zeros(len(self.block_row), np.bool_)
        some[np.repeat(np.arange(len(some)), np.diff(self.block_votes))[lacking]] = True
        return ~some

    def _votes(self, outline: int) -> NDArray[np.uint8]:
        height, width = self.floor_xy.shape[:2]
        map_of_votes = np.zeros((height, width), np.uint8)
        rows, columns = self.centres
        inside = columns < width
        map_of_votes[rows[inside], columns[inside]] = self.votes[outline, inside]
        return map_of_votes


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
    floor_xy = floor_positions(camera)
    numbers = camera_numbers(camera)
    size = _size_down(floor_xy)
    if shape.least_pairs:
        # The data set's own detector turns by the transpose of a rotation that its file gives in
        # few digits; by the inverse some samples would fall on other pixels.
        numbers[10:19] = camera.rotation.T.ravel()
        size = _exact_size_down(camera)
    scan = Scan(
        enough=shape.least_pairs or MIN_SHARE_INSIDE * shape.samples,
        stride=shape.stride_m,
        pairs=shape.least_pairs > 0,
        apart_px=shape.apart_px,
    )
    inner = ring(shape.inner_radius_m, shape.samples)
    outer = ring(shape.outer_radius_m, shape.samples)
    pixels = camera.height * camera.width
    candidate = _within_limits(size, shape)
    places: list[tuple[int, int, int]] = []
    copies: list[NDArray[np.uint64]] = []
    votes: list[NDArray[np.uint8]] = []
    for row in np.flatnonzero(candidate.any(axis=1)).tolist():
        nearest = row_samples(
            numbers, floor_xy[row], inner, outer, size[row], (camera.height, camera.width), scan
        )
        inside = np.count_nonzero((nearest >= 0.0).reshape(2, shape.samples, -1), axis=1)
        usable = usable_centres(candidate[row], inside, size[row], scan)
        for block in blocks_of_row(usable, scan.stride > 0.0):
            column, stride, number = block.tolist()
            places.append((row, column, stride))
            copies.append(copies_of_block(nearest, usable, block, pixels))
            centres = column + stride * np.arange(number)
            filled = np.zeros((2, -(-number // LANES) * LANES), np.uint8)
            filled[:, :number] = np.where(usable[centres], inside[:, centres], 0)
            votes.append(filled)
    fits = (pixels + 1) << ADVANCE_BITS <= np.iinfo(np.uint32).max + 1
    every_copy = np.concatenate([np.empty(0, np.uint64), *copies])
    numbers_of = np.array(places, np.int32).reshape(-1, 3).T.copy()
    return DiscTable(
        samples=shape.samples,
        copies=every_copy.astype(np.uint32) if fits else every_copy,
        block_copies=_bounds([len(of_block) for of_block in copies]),
        block_row=numbers_of[0],
        block_column=numbers_of[1],
        block_stride=numbers_of[2],
        block_votes=_bounds([of_block.shape[1] for of_block in votes]),
        votes=np.concatenate([np.zeros((2, 0), np.uint8), *votes], axis=1),
        floor_xy=floor_xy.astype(np.float32),
    )


def _bounds(lengths: list[int]) -> NDArray[np.int64]:
    """Where each of some consecutive pieces begins, and where the last one ends."""
    return np.cumsum([0, *lengths], dtype=np.int64)


def _size_down(floor_xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) how far the floor moves per image row, metres, by differences of whole pixels."""
    # Central differences over the neighbouring rows; one-sided at the image's first and last.
    if len(floor_xy) == 1:
        return np.full(floor_xy.shape[:2], np.nan)
    per_row = np.gradient(floor_xy, axis=0)
    return np.hypot(per_row[..., 0], per_row[..., 1])


def _exact_size_down(camera: Camera) -> NDArray[np.float64]:
    """(H, W) how far the floor moves per image row, metres: its derivative."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    per_row = camera.floor_jacobian_published(np.stack([u, v], axis=-1))[..., 1]
    return np.hypot(per_row[..., 0], per_row[..., 1])


def _within_limits(size: NDArray[np.float64], shape: DiscShape) -> NDArray[np.bool_]:
    """Pixels far enough from the border and near enough on the floor."""
    height, width = size.shape
    u, v = np.arange(width), np.arange(height)
    border = shape.border_px
    inside_u = (u >= border) & (u <= width - border)
    inside_v = (v >= border) & (v <= height - border)
    near = size <= shape.far_limit_m_per_px
    return np.asarray(near & inside_v[:, None] & inside_u[None, :])
