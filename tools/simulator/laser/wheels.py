"""Odometry of a robot that always drives forward: what its wheels say, summed up.

Systematic errors are factors on way and turn and a turn per metre (wheels of unequal size); random
ones walk: their variance grows with the way and the turn. Sideways slip, which wheels cannot tell,
is what odometry misses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tools.simulator.laser.settings import WheelErrors

FloatArray = NDArray[np.float64]


def measured_path(poses: FloatArray, errors: WheelErrors, rng: np.random.Generator) -> FloatArray:
    """What odometry says, beginning at 0, 0, 0.

    Parameters
    ----------
    poses : (N, 3) float64
        True poses; theta continuous.
    errors : WheelErrors
    rng : numpy Generator

    Returns
    -------
    (N, 3) float64
        x, y (m), theta (rad, continuous).
    """
    turn = np.diff(poses[:, 2])
    step = np.diff(poses[:, :2], axis=0)
    middle = poses[:-1, 2] + 0.5 * turn
    way = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    noise = rng.standard_normal((4, len(way)))
    way_m = errors.scale * way + errors.sigma_m * np.sqrt(np.abs(way)) * noise[0]
    turn_rad = errors.turn_scale * turn + errors.turn_per_m * way
    turn_rad += errors.sigma_turn * np.sqrt(np.abs(turn)) * noise[1]
    turn_rad += errors.sigma_turn_per_m * np.sqrt(np.abs(way)) * noise[2]
    theta = np.concatenate([[0.0], np.cumsum(turn_rad)])
    middle = 0.5 * (theta[1:] + theta[:-1])
    ahead = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    aside = np.stack([-np.sin(middle), np.cos(middle)], axis=-1)
    side_m = errors.sigma_side_m * np.sqrt(np.abs(way)) * noise[3]
    xy = np.cumsum(way_m[:, None] * ahead + side_m[:, None] * aside, axis=0)
    return np.column_stack([np.vstack([np.zeros((1, 2)), xy]), theta])
