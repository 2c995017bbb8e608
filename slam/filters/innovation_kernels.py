"""Compiled measurement equations of a frame, for the filters: innovation and Jacobian in one pass.

The same models as in `slam.models.measurement`, with which the tests compare them.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def frame_innovation(
    state: FloatArray,
    linearised_at: FloatArray,
    disc_slot: IntArray,
    disc_xy: FloatArray,
    disc_covariance: FloatArray,
    line_slot: IntArray,
    line_start: IntArray,
    bearing_rad: FloatArray,
    sigma_rad: FloatArray,
    camera_xy: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Measured minus predicted, its Jacobian and its noise, for all rows of a frame.

    Parameters
    ----------
    state : (n,) float64
        Pose, then landmarks; predictions are made from it.
    linearised_at : (n,) float64
        Where the offset of landmarks from the robot, which the heading turns, is taken from:
        usually the same. With first estimates a frame turned as a whole is no innovation.
    disc_slot : (d,) int64
        Where in the state the disc of each row begins.
    disc_xy, disc_covariance : (d, 2), (d, 2, 2) float64
        The rows of discs.
    line_slot : (e,) int64
        Where in the state the lines of the rows begin.
    line_start : (l + 1,) int64
        Row i shows the lines line_slot[line_start[i] : line_start[i + 1]]; it is a measurement of
        the mean of their bearings.
    bearing_rad, sigma_rad : (l,) float64
        The rows of lines.
    camera_xy : (2,) float64
        The camera's centre in the robot frame (m).

    Returns
    -------
    innovation : (m,) float64
        m = 2 d + l; bearings wrapped.
    jacobian : (m, 3 + 2 d + 2 e) float64
        By the numbers of the state that `index` names.
    noise : (m, m) float64
        Covariance of the measurements.
    index : (3 + 2 d + 2 e,) int64
        Into the state. A landmark that several rows show is included several times.
    """
    discs, lines = len(disc_slot), len(bearing_rad)
    rows = 2 * discs + lines
    numbers = 3 + 2 * discs + 2 * len(line_slot)
    innovation = np.zeros(rows)
    jacobian = np.zeros((rows, numbers))
    noise = np.zeros((rows, rows))
    index = np.empty(numbers, dtype=np.int64)
    index[0], index[1], index[2] = 0, 1, 2
    cos, sin = math.cos(state[2]), math.sin(state[2])
    for k in range(discs):
        slot, row, column = disc_slot[k], 2 * k, 3 + 2 * k
        index[column], index[column + 1] = slot, slot + 1
        dx, dy = state[slot] - state[0], state[slot + 1] - state[1]
        innovation[row] = disc_xy[k, 0] - (cos * dx + sin * dy)
        innovation[row + 1] = disc_xy[k, 1] - (-sin * dx + cos * dy)
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
                noise[row + i, row + j] = disc_covariance[k, i, j]
    for k in range(lines):
        row = 2 * discs + k
        share = 1.0 / (line_start[k + 1] - line_start[k])
        difference = 0.0
        for entry in range(line_start[k], line_start[k + 1]):
            slot, column = line_slot[entry], 3 + 2 * discs + 2 * entry
            index[column], index[column + 1] = slot, slot + 1
            dx, dy = state[slot] - state[0], state[slot + 1] - state[1]
            seen_x = cos * dx + sin * dy - camera_xy[0]
            seen_y = -sin * dx + cos * dy - camera_xy[1]
            angle = bearing_rad[k] - math.atan2(seen_x, -seen_y)
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
        noise[row, row] = sigma_rad[k] ** 2
    return innovation, jacobian, noise, index
