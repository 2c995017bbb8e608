"""Table of the outlines' pixels around the tested centres of discs.

A disc centred at the floor position of pixel (u, v) has an inner outline (inside the disc's edge)
and an outer one (outside). The pixels of their equally spaced samples depend on the calibration
only, so they are computed in advance (DLR Spatial Cognition data set report, circle detection).

A centre is usable if enough of each outline's samples are inside the image, it is not too close to
the border, and the floor there moves by no more than a given length per image row.
"""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers, project_floor_point, published_camera_numbers
from redetect.array_types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from redetect.compiled import kernel
from redetect.messages import OneLineError

#: Least share of an outline's samples inside the image.
MIN_SHARE_INSIDE = 0.5


class TableError(OneLineError, ValueError):
    """A table that cannot be computed; the message names the quantity and the expectation."""


@dataclass(frozen=True)
class DiscShape:
    """Samples around a centre, and the nearest and farthest centres.

    The bounds are those of the detector's settings (`detect.settings.CircleSettings`).
    """

    inner_radius_m: float = 0.06  #: Radius of the inner outline on the floor, metres.
    outer_radius_m: float = 0.14  #: Radius of the outer one.
    #: Equally spaced samples on each outline; the first is in the robot's +X direction.
    samples: int = 16
    border_px: int = 12  #: Least distance from the image's border.
    #: Largest step of the floor from one image row to the next; infinite: no limit.
    far_limit_m_per_px: float = 0.05
    #: Least number of pairs (inner and outer sample) inside the image; 0: samples count singly.
    least_pairs: int = 0
    #: Samples of a pair on the same pixel are moved inwards and outwards by this many rows' length.
    apart_px: float = 0.0
    #: Least distance of usable centres in a row, converted to pixels by the length of an image row
    #: on the floor and rounded up; 0: every pixel is a centre.
    stride_m: float = 0.0


@dataclass(frozen=True, eq=False)
class DiscTable:
    """The tested centres, and the pixels of their outlines; compared by identity."""

    #: (N, K, 2) index in scan order of the pixel of the inner and of the outer sample in each
    #: direction, every second direction first; H * W outside the image, or if it does not count
    samples: NDArray[np.uint32]
    pixels: NDArray[np.int32]  # (N, 2) pixel (u, v) of each centre, in scan order
    #: (H, W, 2) floor position (robot X, Y, m) of each pixel; NaN above the horizon
    floor_xy: Float32Array
    made_for: ByteArray  # `fingerprint` of the camera and the shape

    @cached_property
    def usable(self) -> BoolArray:
        """(H, W) mask of the tested centres."""
        usable = np.zeros(self.floor_xy.shape[:2], np.bool_)
        usable[self.pixels[:, 1], self.pixels[:, 0]] = True
        return usable


@lru_cache(maxsize=64)
def fingerprint(camera: Camera, *shapes: Any) -> ByteArray:
    """(32,) digest of the numbers that determine a table: of a camera, and of its shape, if any."""
    numbers = [float(value).hex() for shape in shapes for value in astuple(shape)]
    digest = hashlib.sha256(" ".join([camera.content_hash, *numbers]).encode()).digest()
    return np.array(bytearray(digest))


@lru_cache(maxsize=2)
def floor_positions(camera: Camera) -> FloatArray:
    """(H, W, 2) floor position (robot X, Y, metres) of each pixel; NaN above the horizon."""
    return camera.floor_from_pixel(camera.pixel_grid())


def demand_above_floor(camera: Camera) -> None:
    """Raise a TableError for a camera that is not above the floor."""
    if not camera.centre[2] > 0.0:
        raise TableError(
            f"the camera is {camera.centre[2]:g} m above the floor: expected more than 0; "
            "`camera floor` estimates its pose"
        )


def build_disc_table(camera: Camera, shape: DiscShape) -> DiscTable:
    """Compute the outlines' pixels around the tested centres.

    A camera that sees no usable floor (looking up, say) gets a table without centres; a camera that
    is not above the floor raises a TableError.
    """
    demand_above_floor(camera)
    floor_xy = floor_positions(camera)
    step_m, paired = row_step_m(floor_xy), shape.least_pairs > 0
    if paired:
        by_row = camera.floor_jacobian_published(camera.pixel_grid())[..., 1]
        step_m = np.hypot(by_row[..., 0], by_row[..., 1])
    numbers = published_camera_numbers(camera) if paired else camera_numbers(camera)
    angle = 2.0 * np.pi * np.arange(shape.samples) / shape.samples
    angle = np.concatenate([angle[0::2], angle[1::2]])
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    radii = shape.inner_radius_m, shape.outer_radius_m
    outlines = _Outlines(*radii, unit, paired, float(shape.apart_px))
    candidate = pixels_within(step_m, shape.border_px, shape.far_limit_m_per_px)
    step = np.fmax(np.ceil(shape.stride_m / step_m), 1.0)
    enough = shape.least_pairs or MIN_SHARE_INSIDE * shape.samples
    samples, pixels = [np.zeros((0, shape.samples, 2), np.uint32)], [np.zeros((0, 2), np.int32)]
    for row in np.flatnonzero(candidate.any(axis=1)).tolist():
        across = np.flatnonzero(candidate[row])
        centres = floor_xy[row, across], step_m[row, across]
        seen = _sample_pixels(numbers, camera.width, camera.height, *centres, outlines)
        inside = np.count_nonzero(seen < camera.height * camera.width, axis=1).min(axis=1)
        usable = np.flatnonzero(inside >= enough)
        kept = usable[_strided(across[usable], step[row, across[usable]])]
        samples.append(seen[kept])
        pixels.append(np.stack([across[kept], np.full(len(kept), row)], axis=1).astype(np.int32))
    return DiscTable(
        samples=np.concatenate(samples),
        pixels=np.concatenate(pixels),
        floor_xy=floor_xy.astype(np.float32),
        made_for=fingerprint(camera, shape),
    )


class _Outlines(NamedTuple):
    """Positions of the samples relative to a centre."""

    inner: float  # radii, metres
    outer: float
    unit: FloatArray  # (K, 2) directions, every second one first
    paired: bool  # whether samples count in pairs, which are moved apart if on the same pixel
    apart_px: float


@kernel()
def _sample_pixels(
    numbers: FloatArray, width: int, height: int, centre_xy: FloatArray, step_m: FloatArray,
    outlines: _Outlines,
) -> NDArray[np.uint32]:  # fmt: skip
    """`DiscTable.samples` of some centres, (N, 2) on the floor, with (N,) the size of a pixel."""
    outside = width * height
    samples = np.empty((len(centre_xy), len(outlines.unit), 2), np.uint32)
    least = 0.0 if outlines.paired else -0.5
    radius = np.empty(2)
    pixel = np.empty(2, np.int64)
    for i in range(len(centre_xy)):
        for k in range(len(outlines.unit)):
            radius[0], radius[1] = outlines.inner, outlines.outer
            for _ in range(2):
                for j in range(2):
                    x = centre_xy[i, 0] + radius[j] * outlines.unit[k, 0]
                    y = centre_xy[i, 1] + radius[j] * outlines.unit[k, 1]
                    u, v = project_floor_point(numbers, x, y)
                    inside = u >= least and v >= least and u + 0.5 < width and v + 0.5 < height
                    pixel[j] = int(v + 0.5) * width + int(u + 0.5) if inside else outside
                if not (outlines.paired and pixel[0] == pixel[1] and pixel[0] < outside):
                    break
                radius[0] -= outlines.apart_px * step_m[i]
                radius[1] += outlines.apart_px * step_m[i]
            if outlines.paired and (pixel[0] == outside or pixel[1] == outside):
                pixel[:] = outside
            samples[i, k, 0], samples[i, k, 1] = pixel[0], pixel[1]
    return samples


def row_step_m(floor_xy: FloatArray) -> FloatArray:
    """(H, W) step of the floor per image row, metres, from (H, W, 2) positions."""
    if len(floor_xy) == 1:
        return np.full(floor_xy.shape[:2], np.nan)
    by_row = np.gradient(floor_xy, axis=0)
    return np.hypot(by_row[..., 0], by_row[..., 1])


def pixels_within(step_m: FloatArray, border: int, far_limit_m_per_px: float) -> BoolArray:
    """(H, W) pixels far enough from the border and near enough on the floor (`row_step_m`)."""
    height, width = step_m.shape
    u, v = np.arange(width), np.arange(height)
    inside_u = (u >= border) & (u <= width - border)
    inside_v = (v >= border) & (v <= height - border)
    return np.asarray((step_m <= far_limit_m_per_px) & inside_v[:, None] & inside_u[None, :])


def _strided(columns: IntArray, step: FloatArray) -> list[int]:
    """Indices of columns that are at least the previous one's step apart.

    If steps grow fast along a row, with a very wide lens, twice a column's own step is sufficient.
    """
    kept: list[int] = []
    last, following = 0, 0
    for k, (column, apart) in enumerate(zip(columns.tolist(), step.tolist())):
        if column >= following or column - last > 2 * apart:
            kept.append(k)
            last, following = column, column + apart
    return kept
