"""Compiled loops that build tables: arrays in, arrays out.

`encode_outlines` projects as `camera.kernels.project_floor_point` does, operation by operation, but
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

#: Neighbouring pixels of a row that a detector works on at once; bytes of one copy.
BLOCK = 64

#: Low bits of a copy: how far the destination advances.
ADVANCE_BITS = 7

#: Size of the groups in which rows of grey values are summed and copies are made.
GROUP = 4

#: Least number of copies of a block for every two groups of its rows, one of each outline: they
#: are made while other rows are summed.
LEAST_COPIES = 16


class Scan(NamedTuple):
    """Which of the centres are tested, and how their samples vote.

    Attributes
    ----------
    size : (H, W) float64
        How far the floor moves from each pixel to the one below, metres.
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

    size: NDArray[np.float64]
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
    begin: int,
    end: int,
    height: int,
    width: int,
    least: float,
    nearest: NDArray[np.float64],
) -> None:
    """Index in the image of the pixel nearest to one sample of centres' outlines; -1 outside.

    What lies left of or above `least` (pixels, before they are rounded) is outside, too.

    `x_robot` and `y_robot` are the centres of a row, of which those from `begin` to `end` are
    worked on, `offset` is the sample's from its centre, `nearest` the result (whole numbers). That
    all are contiguous is what lets the compiler work on several centres at once.
    """
    scale_x, scale_y, offset_x, offset_y = numbers[0], numbers[1], numbers[2], numbers[3]
    a2, a3, b1, b2, b3 = numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]
    r_max = numbers[9]
    r00, r01, r02 = numbers[10], numbers[11], numbers[12]
    r10, r11, r12 = numbers[13], numbers[14], numbers[15]
    r20, r21, r22 = numbers[16], numbers[17], numbers[18]
    cx, cy, dz = numbers[19], numbers[20], -numbers[21]
    x_offset, y_offset = offset[0], offset[1]
    for u in range(begin, end):
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
    height: int,
    width: int,
) -> float:
    """As `_nearest_pixels`, of one sample that is moved away from its centre, metres."""
    scale = 1.0 + farther / math.hypot(sample[0], sample[1])
    u, v = project_floor_point(
        numbers, centre[0] + scale * sample[0], centre[1] + scale * sample[1]
    )
    if not (u >= 0.0 and v >= 0.0):  # NaN fails this
        return -1.0
    column, row = math.floor(u + 0.5), math.floor(v + 0.5)
    return row * width + column if column < width and row < height else -1.0


@njit(cache=True, error_model="numpy")
def encode_outlines(
    numbers: NDArray[np.float64],
    floor_xy: NDArray[np.float64],
    candidate: NDArray[np.bool_],
    inner: NDArray[np.float64],
    outer: NDArray[np.float64],
    enough: float,
    scan: Scan,
) -> tuple[
    NDArray[np.uint64],
    NDArray[np.int64],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.int32],
    NDArray[np.uint8],
]:
    """Find the usable centres, and write down how the grey values around them are gathered.

    Parameters
    ----------
    numbers : (27,) float64
        `camera.kernels.camera_numbers`.
    floor_xy : (H, W, 2) float64
        Floor position of each pixel, metres.
    candidate : (H, W) bool
        Centres to evaluate.
    inner, outer : (K, 2) float64
        Samples of the outlines relative to their centre, metres.
    enough : float
        Samples of each outline that must be inside the image.
    scan : Scan
        Which centres are left out, and whether samples vote in pairs.

    Returns
    -------
    copies, block_copies, block_row, block_column, block_pattern, patterns
        As in `lut.DiscTable`; copies as uint64.
    """
    height, width = candidate.shape
    samples = inner.shape[0]
    border = 0.0 if scan.pairs else -0.5
    padded = -(-samples // GROUP) * GROUP
    shifted = has_brown(numbers[22:27])
    nothing = height * width
    most_blocks = height * (-(-width // BLOCK))

    block_copies = np.zeros(most_blocks + 1, np.int64)
    block_row = np.empty(most_blocks, np.int32)
    block_column = np.empty(most_blocks, np.int32)
    block_pattern = np.empty(most_blocks, np.int32)
    patterns = np.zeros((most_blocks + 1, 2, BLOCK), np.uint8)
    for i in range(BLOCK):
        patterns[0, 0, i] = patterns[0, 1, i] = samples
    copies = np.empty(1 << 17, np.uint64)
    blocks = 0
    pattern = 1
    count = 0

    x_robot = np.empty(width)
    y_robot = np.empty(width)
    nearest = np.empty((2 * samples, width))
    votes = np.zeros((2, width), np.int32)
    usable = np.zeros(width, np.bool_)
    for v in range(height):
        begin = width
        end = 0
        for u in range(width):
            if candidate[v, u]:
                begin = min(begin, u)
                end = u + 1
        for u in range(begin, end):
            x_robot[u] = floor_xy[v, u, 0]
            y_robot[u] = floor_xy[v, u, 1]
        for k in range(2 * samples):
            offset = inner[k] if k < samples else outer[k - samples]
            if shifted:
                _nearest_pixels(
                    numbers, numbers[22:27], x_robot, y_robot, offset,
                    begin, end, height, width, border, nearest[k],
                )  # fmt: skip
            else:
                _nearest_pixels(
                    numbers, None, x_robot, y_robot, offset,
                    begin, end, height, width, border, nearest[k],
                )  # fmt: skip
        if scan.pairs:
            for k in range(samples):
                for u in range(begin, end):
                    if nearest[k, u] == nearest[samples + k, u] and nearest[k, u] >= 0.0:
                        apart = scan.apart_px * scan.size[v, u]
                        nearest[k, u] = _sample_apart(
                            numbers, floor_xy[v, u], inner[k], -apart, height, width
                        )
                        nearest[samples + k, u] = _sample_apart(
                            numbers, floor_xy[v, u], outer[k], apart, height, width
                        )
                    if nearest[k, u] < 0.0 or nearest[samples + k, u] < 0.0:
                        nearest[k, u] = nearest[samples + k, u] = -1.0
        for u in range(begin, end):
            votes[0, u] = votes[1, u] = 0
        for k in range(2 * samples):
            outline = k // samples
            for u in range(begin, end):
                votes[outline, u] += 1 if nearest[k, u] >= 0.0 else 0
        first = width
        last = 0
        following = begin
        for u in range(begin, end):
            usable[u] = (
                u >= following
                and candidate[v, u]
                and votes[0, u] >= enough
                and votes[1, u] >= enough
            )
            if usable[u]:
                first = min(first, u)
                last = u + 1
                following = u + max(1, math.ceil(scan.stride / scan.size[v, u]))

        needed = count + (2 * padded + LEAST_COPIES) * (width + BLOCK)
        if needed > len(copies):
            more = np.empty(2 * needed, np.uint64)
            for i in range(count):
                more[i] = copies[i]
            copies = more
        for from_u in range(first, last, BLOCK):
            to_u = min(last, from_u + BLOCK)
            all_vote = True
            for i in range(BLOCK):
                counts = from_u + i < to_u and usable[from_u + i]
                patterns[pattern, 0, i] = votes[0, from_u + i] if counts else 0
                patterns[pattern, 1, i] = votes[1, from_u + i] if counts else 0
                all_vote &= patterns[pattern, 0, i] + patterns[pattern, 1, i] == 2 * samples
            block_row[blocks] = v
            block_column[blocks] = from_u
            # The place of a pattern that is not needed is taken by the next one.
            block_pattern[blocks] = 0 if all_vote else pattern
            pattern += 0 if all_vote else 1
            for k in range(2 * padded):
                outline = k // padded
                sample = k - outline * padded
                if sample >= samples:
                    copies[count] = (nothing << ADVANCE_BITS) | BLOCK
                    count += 1
                    continue
                here = nearest[outline * samples + sample]
                # Centres around which the sample has the same offset: `run_source` is the pixel
                # of the sample for the centre in column `run_u`. Unusable centres change nothing.
                run_u = from_u
                run_source = int(here[from_u]) if here[from_u] >= 0.0 else nothing
                for u in range(from_u + 1, to_u):
                    along = run_source
                    if run_source != nothing:
                        along += u - run_u
                    if usable[u]:
                        source = int(here[u]) if here[u] >= 0.0 else nothing
                        if source != along:
                            copies[count] = (run_source << ADVANCE_BITS) | (u - run_u)
                            count += 1
                            run_u = u
                            run_source = source
                copies[count] = (run_source << ADVANCE_BITS) | (from_u + BLOCK - run_u)
                count += 1
            least = block_copies[blocks] + padded // GROUP * LEAST_COPIES
            while count < least or count % GROUP != 0:
                copies[count] = nothing << ADVANCE_BITS
                count += 1
            blocks += 1
            block_copies[blocks] = count
    return (
        copies[:count].copy(),
        block_copies[: blocks + 1].copy(),
        block_row[:blocks].copy(),
        block_column[:blocks].copy(),
        block_pattern[:blocks].copy(),
        patterns[:pattern].copy(),
    )
