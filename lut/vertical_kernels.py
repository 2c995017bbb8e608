"""Compiled loop that traces verticals through a camera: arrays in, arrays out."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import has_brown

_NEWTON_STEPS = 12
_TOLERANCE_PX = 1e-9


@njit(cache=True, error_model="numpy")
def trace_verticals(
    numbers: NDArray[np.float64],
    bearing: NDArray[np.float64],
    anchor_row: NDArray[np.float64],
    anchor_elevation: float,
    column: NDArray[np.float64],
    elevation: NDArray[np.float64],
) -> None:
    """Follow verticals from the anchor up and down, row by row.

    In each row the elevation at which it shows the vertical is found by Newton's method, from where
    the row before showed it.

    Parameters
    ----------
    numbers : (27,) float64
        `camera.kernels.camera_numbers`.
    bearing : (N,) float64
        Bearings of the verticals (rad); NaN for none.
    anchor_row : (N,) float64
        Rows at which they cross the anchor.
    anchor_elevation : float
        Its elevation above the horizon (rad).
    column : (H, N) float64
        Result: column of each vertical at each row; NaN where the vertical is not seen, or not
        without a break from the anchor on.
    elevation : (H, N) float64
        Result: elevation above the horizon of that point (rad); NaN as above.
    """
    height = column.shape[0]
    scale_x, scale_y, offset_x, offset_y = numbers[0], numbers[1], numbers[2], numbers[3]
    a2, a3, b1, b2, b3 = numbers[4], numbers[5], numbers[6], numbers[7], numbers[8]
    farthest = numbers[9]
    k1, k2, p1, p2, k3 = numbers[22], numbers[23], numbers[24], numbers[25], numbers[26]
    shifted = has_brown(numbers[22:27])
    for n in range(len(bearing)):
        for v in range(height):
            column[v, n] = math.nan
            elevation[v, n] = math.nan
        if not (math.isfinite(bearing[n]) and math.isfinite(anchor_row[n])):
            continue
        sine = math.sin(bearing[n])
        cosine = math.cos(bearing[n])
        # In the camera frame: the level direction at this bearing, and up.
        level_x = numbers[10] * sine - numbers[11] * cosine
        level_y = numbers[13] * sine - numbers[14] * cosine
        level_z = numbers[16] * sine - numbers[17] * cosine
        for direction in (-1, 1):
            angle = anchor_elevation
            first = math.floor(anchor_row[n])
            v = first if direction < 0 else first + 1
            orientation = 0.0
            while 0 <= v < height:
                u = math.nan
                found = False
                slope = 0.0
                for _ in range(_NEWTON_STEPS):
                    up = math.sin(angle)
                    ahead = math.cos(angle)
                    depth = ahead * level_z + up * numbers[18]
                    if not depth > 0.0:
                        break
                    x = (ahead * level_x + up * numbers[12]) / depth
                    y = (ahead * level_y + up * numbers[15]) / depth
                    r = math.sqrt(x * x + y * y)
                    if not r <= farthest:
                        break
                    by_depth = ahead * numbers[18] - up * level_z
                    dx = (ahead * numbers[12] - up * level_x - x * by_depth) / depth
                    dy = (ahead * numbers[15] - up * level_y - y * by_depth) / depth
                    numerator = r * (a2 + r * a3)
                    denominator = 1.0 + r * (b1 + r * (b2 + r * b3))
                    factor = 1.0 + numerator / denominator
                    d_factor = (
                        (a2 + 2.0 * a3 * r) * denominator
                        - numerator * (b1 + r * (2.0 * b2 + 3.0 * b3 * r))
                    ) / (denominator * denominator)
                    dr = (x * dx + y * dy) / r if r > 0.0 else 0.0
                    slope = scale_y * (dy * factor + y * d_factor * dr)
                    u = scale_x * x * factor + offset_x
                    row = scale_y * y * factor + offset_y
                    if shifted:
                        squared = r * r
                        by_squared = k1 + squared * (k2 + squared * k3)
                        d_by_r = 2.0 * k1 + squared * (4.0 * k2 + squared * (6.0 * k3))
                        along = 2.0 * (p2 * x + p1 * y) + squared * by_squared
                        d_along = 2.0 * (p2 * dx + p1 * dy) + r * dr * d_by_r
                        u += scale_x * (along * x + r * r * p2)
                        row += scale_y * (along * y + r * r * p1)
                        slope += scale_y * (d_along * y + along * dy + 2.0 * r * dr * p1)
                    off = v - row
                    if abs(off) < _TOLERANCE_PX:
                        found = True
                        break
                    angle += off / slope
                # A vertical that turns back would show a row twice.
                if not found or (orientation != 0.0 and orientation * slope <= 0.0):
                    break
                orientation = slope
                column[v, n] = u
                elevation[v, n] = angle
                v += direction
                angle += direction / slope
