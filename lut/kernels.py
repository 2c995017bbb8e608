"""Compiled loops that build tables: arrays in, arrays out.

`row_samples` projects as `camera.kernels.project_floor_point` does, operation by operation, but
without a branch, so that several pixels are processed at once; a test compares the two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.brown_kernels import straightened_point
from camera.kernels import has_brown, project_floor_point

#: Most centres in a block, and bytes from one row of gathered grey values to the next.
PITCH = 256
#: Number of centres that detectors work on at once.
LANES = 32
#: Size of the groups in which rows of grey values are summed.
GROUP = 4

#: Low bits of a copy: how far the destination advances.
ADVANCE_BITS = 9
#: Pixels of a row from which a copy takes its bytes, and so pixels behind the image's last one.
COPIED = 64
#: Number of copies carried out at once.
AT_ONCE = 4
#: Most pixels from one centre of a block to the next.
LARGEST_STRIDE = 8


class Scan(NamedTuple):
    """Which of the centres are tested, and how their samples vote.

    Attributes
    ----------
    enough : float
        Samples of each outline that must be inside the image.
    stride : float
        From one centre to the next along a row: this length in pixels of their size, rounded up,
        metres; 0 for every pixel.
    pairs : bool
        Whether samples vote in pairs: an inner and an outer one in the same direction, both in the
        image, even before they are rounded to whole pixels on its left and upper border.
    apart_px : float
        How far, in pixels of that size, the samples of a pair that fall on the same pixel are
        moved, the inner one inwards, the outer one outwards.
    """

    enough: float
    stride: float
    pairs: bool
    apart_px: float


@njit(cache=True, error_model="numpy")
def fill_floor_positions(
    pinhole: NDArray[np.float64],
    lens: NDArray[np.float64],
    undistortion: NDArray[np.float64],
    per_radius: float,
    rotation: NDArray[np.float64],
    centre: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
) -> None:
    """Where the rays of all pixels meet the floor.

    Parameters
    ----------
    pinhole : (4,) float64
        Scale x, y and offset x, y, pixels.
    lens : (11,) float64
        `camera.kernels.lens_numbers`; used if there are tangential terms.
    undistortion : (N, 6) float64
        Undistorted / distorted radius, by the radial distortion: coefficients, the lowest first, of
        polynomials in the position within an interval of the distorted radius, from -1 to 1.
    per_radius : float
        Intervals per unit of distorted radius.
    rotation : (3, 3) float64
        Camera -> robot.
    centre : (3,) float64
        The camera's centre in the robot frame, metres.
    floor_xy : (H, W, 2) float64
        Result, metres; NaN where the ray does not come down to the floor.
    """
    height, width = floor_xy.shape[0], floor_xy.shape[1]
    last = undistortion.shape[0] - 1
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    cx, cy, cz = centre[0], centre[1], centre[2]
    x_seen = np.empty(width)
    for u in range(width):
        x_seen[u] = (u - pinhole[2]) / pinhole[0]
    decentred = lens[7] != 0.0 or lens[8] != 0.0
    # A loop for lookups, and one that the compiler can vectorise.
    ratio = np.empty(width)
    x_normalised = np.empty(width)
    y_normalised = np.empty(width)
    x_robot = np.empty(width)
    y_robot = np.empty(width)
    for v in range(height):
        y_seen = (v - pinhole[3]) / pinhole[1]
        for u in range(width):
            place = math.sqrt(x_seen[u] * x_seen[u] + y_seen * y_seen) * per_radius
            interval = min(int(place), last)
            t = 2.0 * (place - interval) - 1.0
            c = undistortion[interval]
            ratio[u] = c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * (c[4] + t * c[5]))))
        for u in range(width):
            x_normalised[u] = x_seen[u] * ratio[u]
            y_normalised[u] = y_seen * ratio[u]
        if decentred:
            for u in range(width):
                x_normalised[u], y_normalised[u] = straightened_point(
                    lens, x_seen[u], y_seen, x_normalised[u], y_normalised[u]
                )
        for u in range(width):
            x = x_normalised[u]
            y = y_normalised[u]
            down = r20 * x + r21 * y + r22
            along = -cz / down if down * cz < 0.0 else math.nan
            x_robot[u] = cx + along * (r00 * x + r01 * y + r02)
            y_robot[u] = cy + along * (r10 * x + r11 * y + r12)
        for u in range(width):
            floor_xy[v, u, 0] = x_robot[u]
            floor_xy[v, u, 1] = y_robot[u]


@njit(cache=True, error_model="numpy")
def _nearest_pixels(
    numbers: NDArray[np.float64],
    brown: NDArray[np.float64] | None,
    x_robot: NDArray[np.float64],
    y_robot: NDArray[np.float64],
    offset: NDArray[np.float64],
    image_size: tuple[int, int],
    least: float,
    nearest: NDArray[np.float64],
) -> None:
    """Index in the image of the pixel nearest to one sample of centres' outlines; -1 outside.

    What lies left of or above `least` (pixels, before they are rounded) is outside, too.

    `x_robot` and `y_robot` are the centres, `offset` is the sample's from its centre, `nearest` the
    result (whole numbers). That all are contiguous is what lets the compiler work on several
    centres at once.
    """
    scale_x, scale_y, offset_x, offset_y = numbers[0], numbers[1], numbers[2], numbers[3]
    a2, a3, b1, b2, b3 = numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]
    r_max = numbers[9]
    r00, r01, r02 = numbers[10], numbers[11], numbers[12]
    r10, r11, r12 = numbers[13], numbers[14], numbers[15]
    r20, r21, r22 = numbers[16], numbers[17], numbers[18]
    cx, cy, dz = numbers[19], numbers[20], -numbers[21]
    x_offset, y_offset = offset[0], offset[1]
    height, width = image_size
    for u in range(len(x_robot)):
        dx = x_robot[u] + x_offset - cx
        dy = y_robot[u] + y_offset - cy
        z = r20 * dx + r21 * dy + r22 * dz
        x = (r00 * dx + r01 * dy + r02 * dz) / z
        y = (r10 * dx + r11 * dy + r12 * dz) / z
        r = math.sqrt(x * x + y * y)
        factor = 1.0 + r * (a2 + r * a3) / (1.0 + r * (b1 + r * (b2 + r * b3)))
        x_place = scale_x * x * factor
        y_place = scale_y * y * factor
        if brown is not None:
            squared = x * x + y * y
            along = 2.0 * (brown[3] * x + brown[2] * y)
            along += squared * (brown[0] + squared * (brown[1] + squared * brown[4]))
            x_place += scale_x * (along * x + squared * brown[3])
            y_place += scale_y * (along * y + squared * brown[2])
        x_place += offset_x
        y_place += offset_y
        column = np.floor(x_place + 0.5)
        row = np.floor(y_place + 0.5)
        # NaN fails every comparison.
        seen = (z > 0.0) & (r <= r_max) & (x_place >= least) & (y_place >= least)
        inside = (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height)
        nearest[u] = row * width + column if seen & inside else -1.0


@njit(cache=True, error_model="numpy")
def _sample_apart(
    numbers: NDArray[np.float64],
    centre: NDArray[np.float64],
    sample: NDArray[np.float64],
    farther: float,
    image_size: tuple[int, int],
) -> float:
    """As `_nearest_pixels`, of one sample that is moved away from its centre, metres."""
    height, width = image_size
    scale = 1.0 + farther / math.hypot(sample[0], sample[1])
    u, v = project_floor_point(
        numbers, centre[0] + scale * sample[0], centre[1] + scale * sample[1]
    )
    if not (u >= 0.0 and v >= 0.0):  # NaN fails this
        return -1.0
    column, row = math.floor(u + 0.5), math.floor(v + 0.5)
    return row * width + column if column < width and row < height else -1.0


@njit(cache=True, error_model="numpy")
def row_samples(
    numbers: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    size: NDArray[np.float64],
    image_size: tuple[int, int],
    scan: Scan,
) -> NDArray[np.float64]:
    """Where the samples of some centres' outlines fall in the image.

    Parameters
    ----------
    numbers : (27,) float64
        `camera.kernels.camera_numbers`.
    floor_xy : (N, 2) float64
        Floor positions of the centres, metres.
    inner, outer : (K, 2) float64
        Samples of the outlines relative to their centre, metres.
    size : (N,) float64
        How far the floor moves from each centre to the pixel below, metres.
    image_size : (int, int)
        Height and width, pixels.
    scan : Scan

    Returns
    -------
    (2 K, N) float64
        Index of the nearest pixel in scan order, of the inner and then of the outer outline; -1
        where a sample does not vote.
    """
    samples = len(inner)
    least = 0.0 if scan.pairs else -0.5
    shifted = has_brown(numbers[22:27])
    x_robot, y_robot = floor_xy[:, 0].copy(), floor_xy[:, 1].copy()
    nearest = np.empty((2 * samples, len(floor_xy)))
    for k in range(2 * samples):
        offset = inner[k] if k < samples else outer[k - samples]
        if shifted:
            _nearest_pixels(
                numbers, numbers[22:27], x_robot, y_robot, offset, image_size, least, nearest[k]
            )
        else:
            _nearest_pixels(numbers, None, x_robot, y_robot, offset, image_size, least, nearest[k])
    if not scan.pairs:
        return nearest
    for k in range(samples):
        in_row, out_row = nearest[k], nearest[samples + k]
        for u in range(len(floor_xy)):
            if in_row[u] == out_row[u] and in_row[u] >= 0.0:
                apart = scan.apart_px * size[u]
                in_row[u] = _sample_apart(numbers, floor_xy[u], inner[k], -apart, image_size)
                out_row[u] = _sample_apart(numbers, floor_xy[u], outer[k], apart, image_size)
            if in_row[u] < 0.0 or out_row[u] < 0.0:
                in_row[u] = out_row[u] = -1.0
    return nearest


@njit(cache=True, error_model="numpy")
def usable_centres(
    candidate: NDArray[np.bool_],
    votes: NDArray[np.int64],
    size: NDArray[np.float64],
    scan: Scan,
) -> NDArray[np.bool_]:
    """Which of the candidates in a row have samples enough, and keep the stride.

    Parameters
    ----------
    candidate : (N,) bool
    votes : (2, N) int64
        Samples of each outline inside the image.
    size : (N,) float64
        As in `row_samples`.
    scan : Scan
    """
    usable = np.zeros(len(candidate), np.bool_)
    following = 0
    for u in range(len(candidate)):
        if u >= following and candidate[u] and min(votes[0, u], votes[1, u]) >= scan.enough:
            usable[u] = True
            following = u + max(1, math.ceil(scan.stride / size[u]))
    return usable


@njit(cache=True, error_model="numpy")
def blocks_of_row(usable: NDArray[np.bool_], strided: bool) -> NDArray[np.int64]:
    """Part a row's usable centres into blocks of equal strides.

    Parameters
    ----------
    usable : (N,) bool
    strided : bool
        Whether centres are left out on purpose; else blocks have the stride 1.

    Returns
    -------
    (B, 3) int64
        First centre, stride and number of centres of each block, in which there may be some that
        are not usable.
    """
    columns = np.flatnonzero(usable)
    blocks = np.empty((len(columns), 3), np.int64)
    count = 0
    i = 0
    while i < len(columns):
        apart = columns[i + 1] - columns[i] if strided and i + 1 < len(columns) else 1
        stride = min(apart, LARGEST_STRIDE)
        while apart % stride != 0:
            stride -= 1
        end = columns[i] + stride * PITCH
        last = i
        while last + 1 < len(columns) and columns[last + 1] < end:
            if strided and columns[last + 1] - columns[last] != apart:
                break
            last += 1
        blocks[count, 0], blocks[count, 1] = columns[i], stride
        blocks[count, 2] = (columns[last] - columns[i]) // stride + 1
        count += 1
        i = last + 1
    return blocks[:count].copy()


@njit(cache=True, error_model="numpy")
def copies_of_block(
    nearest: NDArray[np.float64],
    usable: NDArray[np.bool_],
    block: NDArray[np.int64],
    nothing: int,
) -> NDArray[np.uint64]:
    """How the grey values of a block are gathered: `lut.DiscTable.copies`.

    Parameters
    ----------
    nearest : (2 K, N) float64
        See `row_samples`.
    usable : (N,) bool
    block : (3,) int64
        See `blocks_of_row`.
    nothing : int
        Index of the first pixel behind the image.
    """
    samples = len(nearest) // 2
    padded = -(-samples // GROUP) * GROUP
    first, stride, number = block
    span = (COPIED - 1) // stride + 1
    copies = np.empty(2 * padded * number + AT_ONCE, np.uint64)
    count = 0
    for k in range(2 * padded):
        outline, sample = k // padded, k % padded
        votes = sample < samples
        here = nearest[outline * samples + min(sample, samples - 1)]
        # Centres round which the sample has the same offset: `run` is the pixel of the sample for
        # the centre `begin`. Other centres than usable ones do not matter.
        begin = 0
        run = int(here[first]) if votes and here[first] >= 0.0 else nothing
        for j in range(1, number):
            along = min(run + stride * (j - begin), nothing) if run != nothing else nothing
            source = along
            if usable[first + stride * j]:
                pixel = here[first + stride * j]
                source = int(pixel) if votes and pixel >= 0.0 else nothing
            if source != along or j - begin == span:
                copies[count] = (run << ADVANCE_BITS) | (j - begin)
                count += 1
                begin = j
                run = source
        copies[count] = (run << ADVANCE_BITS) | (PITCH - begin)
        count += 1
    while count % AT_ONCE != 0:
        copies[count] = nothing << ADVANCE_BITS
        count += 1
    return copies[:count].copy()
