"""Discs' positions turned level, with the covariances that come of it.

The robot tilts about the origin of its frame on the floor, by pitch and roll. Its
camera, at c, believes the floor where it would be on a level robot: a disc seen at p lies on the
ray c + s (p - c). Turned level by R, that ray meets the floor at

    q = R (c + s (p - c)),    s = -(R c)_z / (R (p - c))_z .

The covariance of q is J diag(C_p, C_tilt) J^T, J = dq / d(p, pitch, roll).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.tilt import level_matrix

FloatArray = NDArray[np.float64]

#: Over which angle the levelled positions are differenced, either way.
_STEP_RAD = 1e-6


@njit(cache=True, error_model="numpy", nogil=True)
def _level(rotation: FloatArray, centre: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Where the ray through a point of the tilted floor meets the level one; NaN if nowhere."""
    ray = np.array([x - centre[0], y - centre[1], -centre[2]])
    down = np.sum(rotation[2] * ray)
    if not down < 0.0:
        return math.nan, math.nan
    point = centre - np.sum(rotation[2] * centre) / down * ray
    return np.sum(rotation[0] * point), np.sum(rotation[1] * point)


@njit(cache=True, error_model="numpy", nogil=True)
def level_discs(
    floor_xy: FloatArray,
    covariance: FloatArray,
    centre: FloatArray,
    tilt: tuple[float, float, float, float, float],
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Level positions and covariances.

    Parameters
    ----------
    floor_xy, covariance : (N, 2), (N, 2, 2) float64
        As the tilted robot believes, metres, square metres.
    centre : (3,) float64
        Of the camera in the robot frame, metres.
    tilt : tuple of float
        Pitch, roll, and their covariance's entries: both pitch, pitch and roll, both roll.

    Returns
    -------
    level_xy, level_covariance : (N, 2), (N, 2, 2) float64
        NaN where the levelled ray does not meet the floor.
    down : (N,) bool
        Whether it does.
    """
    pitch, roll, cpp, cpr, crr = tilt
    h = _STEP_RAD
    rotation = level_matrix(pitch, roll)
    pitched = (level_matrix(pitch + h, roll), level_matrix(pitch - h, roll))
    rolled = (level_matrix(pitch, roll + h), level_matrix(pitch, roll - h))
    level_xy = np.empty((len(floor_xy), 2))
    level_covariance = np.empty((len(floor_xy), 2, 2))
    by = np.empty((2, 4))  # d(levelled x, y) / d(x, y, pitch, roll)
    within = np.zeros((4, 4))
    within[2, 2], within[2, 3], within[3, 2], within[3, 3] = cpp, cpr, cpr, crr
    height = np.sum(rotation[2] * centre)
    for k in range(len(floor_xy)):
        x, y = floor_xy[k, 0], floor_xy[k, 1]
        level_xy[k, 0], level_xy[k, 1] = _level(rotation, centre, x, y)
        ray = np.array([x - centre[0], y - centre[1], -centre[2]])
        down = np.sum(rotation[2] * ray)
        for i in range(2):
            side = np.sum(rotation[i] * ray)
            for j in range(2):
                by[i, j] = -height / down * (rotation[i, j] - side / down * rotation[2, j])
        for j, (ahead, behind) in enumerate((pitched, rolled)):
            ahead_x, ahead_y = _level(ahead, centre, x, y)
            behind_x, behind_y = _level(behind, centre, x, y)
            by[0, 2 + j] = (ahead_x - behind_x) / (2.0 * h)
            by[1, 2 + j] = (ahead_y - behind_y) / (2.0 * h)
        within[:2, :2] = covariance[k]
        for i in range(2):
            for j in range(2):
                total = 0.0
                for m in range(4):
                    for n in range(4):
                        total += by[i, m] * within[m, n] * by[j, n]
                level_covariance[k, i, j] = total if down < 0.0 else math.nan
    down_all = np.empty(len(floor_xy), np.bool_)
    for k in range(len(floor_xy)):
        down_all[k] = np.isfinite(level_xy[k]).all() and np.isfinite(level_covariance[k]).all()
    return level_xy, level_covariance, down_all
