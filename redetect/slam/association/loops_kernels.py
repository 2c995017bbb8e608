"""Compiled search for the rigid motion that aligns one constellation of landmarks with another."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from redetect.array_types import FloatArray, IntArray

# Width of the cells in which the nearest landmark is looked up.
_CELL_M = 0.05
# Landmarks are in order of first sight, so neighbours in this order are near each other.
_NEIGHBOURS = 5


@njit(cache=True, error_model="numpy", nogil=True)
def _nearest_by_cell(fixed: FloatArray, reach_m: float) -> tuple[float, float, IntArray]:
    """Low corner, and for every cell the landmark next to its centre, -1 with none in reach."""
    margin = reach_m + _CELL_M
    low_x, low_y = fixed[:, 0].min() - margin, fixed[:, 1].min() - margin
    columns = int((fixed[:, 0].max() + margin - low_x) / _CELL_M) + 1
    rows = int((fixed[:, 1].max() + margin - low_y) / _CELL_M) + 1
    nearest = np.full((columns, rows), -1, dtype=np.int64)
    distance = np.full((columns, rows), margin * margin)
    span = int(margin / _CELL_M) + 1
    for j in range(len(fixed)):
        column = int((fixed[j, 0] - low_x) / _CELL_M)
        row = int((fixed[j, 1] - low_y) / _CELL_M)
        for a in range(max(column - span, 0), min(column + span + 1, columns)):
            for b in range(max(row - span, 0), min(row + span + 1, rows)):
                off_x = low_x + (a + 0.5) * _CELL_M - fixed[j, 0]
                off_y = low_y + (b + 0.5) * _CELL_M - fixed[j, 1]
                squared = off_x * off_x + off_y * off_y
                if squared < distance[a, b]:
                    distance[a, b] = squared
                    nearest[a, b] = j
    return low_x, low_y, nearest


@njit(cache=True, error_model="numpy", nogil=True)
def best_motion(
    moved: FloatArray,
    fixed: FloatArray,
    length_tolerance_m: float,
    least_length_m: float,
    reach_m: float,
    most_turn_rad: float,
    most_shift_m: float,
    least_agreeing: int,
) -> tuple[float, float, float, int, float, int]:
    """The motion under which most landmarks of one constellation fall on those of another.

    Every pair of landmarks of the first with every pair of the second of the same length says what
    the motion would be; it is counted how many landmarks agree.

    Takes `moved` (n, 2), `fixed` (m, 2); returns `turn_rad`, `shift_x, shift_y`, `agreeing`,
    `squared`, `tried`.
    """
    n, m = len(moved), len(fixed)
    centre_x, centre_y = 0.0, 0.0
    for i in range(n):
        centre_x += moved[i, 0] / n
        centre_y += moved[i, 1] / n
    best_turn, best_x, best_y = 0.0, 0.0, 0.0
    best_count, best_squared, tried = least_agreeing - 1, 0.0, 0
    low_x, low_y, nearest = _nearest_by_cell(fixed, reach_m)
    columns, rows = nearest.shape
    squared_length = np.empty((m, m))
    for c in range(m):
        for d in range(m):
            squared_length[c, d] = (fixed[d, 0] - fixed[c, 0]) ** 2 + (
                fixed[d, 1] - fixed[c, 1]
            ) ** 2
    for a in range(n):
        for b in range(a + 1, min(a + 1 + _NEIGHBOURS, n)):
            ab_x, ab_y = moved[b, 0] - moved[a, 0], moved[b, 1] - moved[a, 1]
            length = math.hypot(ab_x, ab_y)
            if length < least_length_m:
                continue
            shortest = (length - length_tolerance_m) ** 2
            longest = (length + length_tolerance_m) ** 2
            for c in range(m):
                for d in range(m):
                    if not shortest <= squared_length[c, d] <= longest:
                        continue
                    cd_x, cd_y = fixed[d, 0] - fixed[c, 0], fixed[d, 1] - fixed[c, 1]
                    turn = math.atan2(ab_x * cd_y - ab_y * cd_x, ab_x * cd_x + ab_y * cd_y)
                    if abs(turn) > most_turn_rad:
                        continue
                    cos, sin = math.cos(turn), math.sin(turn)
                    # The middle of one pair goes to the middle of the other.
                    x = 0.5 * (moved[a, 0] + moved[b, 0]) - centre_x
                    y = 0.5 * (moved[a, 1] + moved[b, 1]) - centre_y
                    new_x = 0.5 * (fixed[c, 0] + fixed[d, 0]) - (cos * x - sin * y)
                    new_y = 0.5 * (fixed[c, 1] + fixed[d, 1]) - (sin * x + cos * y)
                    shift_x, shift_y = new_x - centre_x, new_y - centre_y
                    if math.hypot(shift_x, shift_y) > most_shift_m:
                        continue
                    tried += 1
                    count, squared = 0, 0.0
                    for i in range(n):
                        if count + n - i < best_count:
                            break
                        x, y = moved[i, 0] - centre_x, moved[i, 1] - centre_y
                        at_x, at_y = new_x + cos * x - sin * y, new_y + sin * x + cos * y
                        column = int((at_x - low_x) / _CELL_M)
                        row = int((at_y - low_y) / _CELL_M)
                        if at_x < low_x or at_y < low_y or column >= columns or row >= rows:
                            continue
                        j = nearest[column, row]
                        if j >= 0:
                            off_x, off_y = fixed[j, 0] - at_x, fixed[j, 1] - at_y
                            distance = off_x * off_x + off_y * off_y
                            if distance <= reach_m * reach_m:
                                count += 1
                                squared += distance
                    if count > best_count or (count == best_count and squared < best_squared):
                        best_turn, best_x, best_y = turn, shift_x, shift_y
                        best_count, best_squared = count, squared
    if best_count < least_agreeing:
        best_count = 0
    return best_turn, best_x, best_y, best_count, best_squared, tried
