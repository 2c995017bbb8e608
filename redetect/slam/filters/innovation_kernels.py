"""Compiled measurement equations of a frame, for the filters: innovation and Jacobian in one pass.

The same models as in `redetect.slam.models.measurement`, with which the tests compare them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from redetect.array_types import FloatArray, IntArray


class MeasuredDiscs(NamedTuple):
    """Rows of d discs.

    Attributes
    ----------
    slot : (d,) int64
        Where in the state the disc of each row begins.
    xy, covariance : (d, 2), (d, 2, 2) float64
        Measured, in the robot frame (m).
    """

    slot: IntArray
    xy: FloatArray
    covariance: FloatArray


class MeasuredLines(NamedTuple):
    """Rows of l lines, each of which may be that of several of e lines of the state."""

    slot: IntArray  # (e,): where in the state the lines of the rows begin
    # (l + 1,): row i measures the mean of the bearings of lines slot[start[i] : start[i + 1]].
    start: IntArray
    # (l,): measured.
    bearing_rad: FloatArray
    sigma_rad: FloatArray


@njit(cache=True, error_model="numpy")
def frame_innovation(
    state: FloatArray,
    linearised_at: FloatArray,
    discs: MeasuredDiscs,
    lines: MeasuredLines,
    camera_xy: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Measured minus predicted, its Jacobian and its noise, for all rows of a frame.

    Takes `state` (n,), `linearised_at` (n,), `camera_xy` (2,); returns `innovation` (m,),
    `jacobian` (m, 3 + 2 d + 2 e), `noise` (m, m), `index` (3 + 2 d + 2 e,).
    """
    disc_count, line_count = len(discs.slot), len(lines.bearing_rad)
    rows = 2 * disc_count + line_count
    numbers = 3 + 2 * disc_count + 2 * len(lines.slot)
    innovation = np.zeros(rows)
    jacobian = np.zeros((rows, numbers))
    noise = np.zeros((rows, rows))
    index = np.empty(numbers, dtype=np.int64)
    index[0], index[1], index[2] = 0, 1, 2
    cos, sin = math.cos(state[2]), math.sin(state[2])
    for k in range(disc_count):
        slot, row, column = discs.slot[k], 2 * k, 3 + 2 * k
        index[column], index[column + 1] = slot, slot + 1
        dx, dy = state[slot] - state[0], state[slot + 1] - state[1]
        innovation[row] = discs.xy[k, 0] - (cos * dx + sin * dy)
        innovation[row + 1] = discs.xy[k, 1] - (-sin * dx + cos * dy)
        dx = linearised_at[slot] - linearised_at[0]
        dy = linearised_at[slot + 1] - linearised_at[1]
        jacobian[row, 0], jacobian[row, 1] = -cos, -sin
        jacobian[row + 1, 0], jacobian[row + 1, 1] = sin, -cos
        jacobian[row, 2] = -sin * dx + cos * dy
        jacobian[row + 1, 2] = -cos * dx - sin * dy
        jacobian[row, column], jacobian[row, column + 1] = cos, sin
        jacobian[row + 1, column], jacobian[row + 1, column + 1] = -sin, cos
        for i in range(2):
            for j in range(2):
                noise[row + i, row + j] = discs.covariance[k, i, j]
    for k in range(line_count):
        row = 2 * disc_count + k
        share = 1.0 / (lines.start[k + 1] - lines.start[k])
        difference = 0.0
        for entry in range(lines.start[k], lines.start[k + 1]):
            slot, column = lines.slot[entry], 3 + 2 * disc_count + 2 * entry
            index[column], index[column + 1] = slot, slot + 1
            dx, dy = state[slot] - state[0], state[slot + 1] - state[1]
            seen_x = cos * dx + sin * dy - camera_xy[0]
            seen_y = -sin * dx + cos * dy - camera_xy[1]
            angle = lines.bearing_rad[k] - math.atan2(seen_x, -seen_y)
            difference += share * ((angle + math.pi) % (2.0 * math.pi) - math.pi)
            weight = share / (seen_x**2 + seen_y**2)
            by_x = (-seen_y * cos - seen_x * sin) * weight
            by_y = (-seen_y * sin + seen_x * cos) * weight
            jacobian[row, column], jacobian[row, column + 1] = by_x, by_y
            jacobian[row, 0] -= by_x
            jacobian[row, 1] -= by_y
            dx = linearised_at[slot] - linearised_at[0]
            dy = linearised_at[slot + 1] - linearised_at[1]
            jacobian[row, 2] += by_x * dy - by_y * dx
        innovation[row] = difference
        noise[row, row] = lines.sigma_rad[k] ** 2
    return innovation, jacobian, noise, index
