"""Compiled: discs' positions turned level, with the covariances that come of it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.tilt import level_matrix

#: Over which angle the levelled positions are differenced, either way.
_STEP_RAD = 1e-6


@njit(cache=True, error_model="numpy", nogil=True)
def _level(
    rotation: NDArray[np.float64], centre: NDArray[np.float64], x: float, y: float
) -> tuple[float, float]:
    """Where the ray through a point of the tilted floor meets the level one; NaN if nowhere."""
    dx, dy, dz = x - centre[0], y - centre[1], -centre[2]
    down = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
    if not down < 0.0:
        return math.nan, math.nan
    height = rotation[2, 0] * centre[0] + rotation[2, 1] * centre[1] + rotation[2, 2] * centre[2]
    along = -height / down
    # The centre and the ray from it, both turned.
    cx, cy, cz = centre[0] + along * dx, centre[1] + along * dy, centre[2] + along * dz
    return (
        rotation[0, 0] * cx + rotation[0, 1] * cy + rotation[0, 2] * cz,
        rotation[1, 0] * cx + rotation[1, 1] * cy + rotation[1, 2] * cz,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def level_floor(
    floor_xy: NDArray[np.float64], centre: NDArray[np.float64], pitch: float, roll: float
) -> NDArray[np.float64]:
    """(N, 2) levelled positions (see `detect.levelling.level_positions`)."""
    rotation = level_matrix(pitch, roll)
    out = np.empty((len(floor_xy), 2))
    for k in range(len(floor_xy)):
        out[k, 0], out[k, 1] = _level(rotation, centre, floor_xy[k, 0], floor_xy[k, 1])
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def level_floor_covariances(
    floor_xy: NDArray[np.float64],
    covariance: NDArray[np.float64],
    centre: NDArray[np.float64],
    pitch: float,
    roll: float,
    tilt_covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N, 2, 2) covariances of levelled positions (`detect.levelling.level_covariances`)."""
    rotation = level_matrix(pitch, roll)
    ahead_p, behind_p = level_matrix(pitch + _STEP_RAD, roll), level_matrix(pitch - _STEP_RAD, roll)
    ahead_r, behind_r = level_matrix(pitch, roll + _STEP_RAD), level_matrix(pitch, roll - _STEP_RAD)
    height = rotation[2, 0] * centre[0] + rotation[2, 1] * centre[1] + rotation[2, 2] * centre[2]
    out = np.empty((len(floor_xy), 2, 2))
    by = np.empty((2, 4))  # d(levelled x, y) / d(x, y, pitch, roll)
    within = np.zeros((4, 4))
    within[2:, 2:] = tilt_covariance
    for k in range(len(floor_xy)):
        x, y = floor_xy[k, 0], floor_xy[k, 1]
        dx, dy, dz = x - centre[0], y - centre[1], -centre[2]
        down = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2] * dz
        for i in range(2):
            side = rotation[i, 0] * dx + rotation[i, 1] * dy + rotation[i, 2] * dz
            for j in range(2):
                by[i, j] = -height / down * (rotation[i, j] - side / down * rotation[2, j])
        for j in range(2):
            ahead, behind = (ahead_p, behind_p) if j == 0 else (ahead_r, behind_r)
            ahead_x, ahead_y = _level(ahead, centre, x, y)
            behind_x, behind_y = _level(behind, centre, x, y)
            by[0, 2 + j] = (ahead_x - behind_x) / (2.0 * _STEP_RAD)
            by[1, 2 + j] = (ahead_y - behind_y) / (2.0 * _STEP_RAD)
        within[:2, :2] = covariance[k]
        for i in range(2):
            for j in range(2):
                total = 0.0
                for m in range(4):
                    for n in range(4):
                        total += by[i, m] * within[m, n] * by[j, n]
                out[k, i, j] = total if down < 0.0 else math.nan
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def level_discs(
    floor_xy: NDArray[np.float64],
    covariance: NDArray[np.float64],
    centre: NDArray[np.float64],
    tilt: tuple[float, float, float, float, float],
    level_xy: NDArray[np.float64],
    level_covariance: NDArray[np.float64],
    down: NDArray[np.bool_],
) -> bool:
    """Level positions and covariances in one call.

    Parameters
    ----------
    floor_xy, covariance, centre
        (N, 2), (N, 2, 2), (3,) float64.
    tilt : tuple of float
        Pitch, roll, and their covariance's entries: both pitch, pitch and roll, both roll.
    level_xy, level_covariance : (N, 2), (N, 2, 2) float64
        Results.
    down : (N,) bool
        Result: whether the levelled ray meets the floor.

    Returns
    -------
    bool
        Whether all do.
    """
    pitch, roll, cpp, cpr, crr = tilt
    tilt_covariance = np.array([[cpp, cpr], [cpr, crr]])
    level_xy[:] = level_floor(floor_xy, centre, pitch, roll)
    level_covariance[:] = level_floor_covariances(
        floor_xy, covariance, centre, pitch, roll, tilt_covariance
    )
    all_down = True
    for k in range(len(floor_xy)):
        down[k] = np.isfinite(level_xy[k]).all() and np.isfinite(level_covariance[k]).all()
        all_down = all_down and down[k]
    return all_down
