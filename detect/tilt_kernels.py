"""The vote of verticals for a tilt, compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def vote_for_tilt(
    normal: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    weight: NDArray[np.float64],
    proposer: NDArray[np.int64],
    limit: float,
    prior: float,
) -> tuple[float, float]:
    """Pitch and roll that the largest weight of lines agrees with.

    Each pair of proposers gives the tilt that makes both vertical; a line votes for it with its
    weight, less the farther it is from vertical.

    Parameters
    ----------
    normal : (N, 3) float64
        Unit normals of the lines' planes, robot frame.
    tolerance : (N,) float64
        Largest inclination after compensation (rad).
    weight : (N,) float64
        Votes of a line that is exactly vertical.
    proposer : (M,) int64
        Lines whose pairs are tried; no tilt is tried as well.
    limit : float
        Largest absolute pitch and roll (rad).
    prior : float
        Standard deviation of the tilt (rad): a tilt t loses t^2 / (2 prior^2) votes.

    Returns
    -------
    pitch, roll : float
        The tilt (rad); the first of those with the most votes.
    """
    best_pitch = 0.0
    best_roll = 0.0
    best = -math.inf
    for i in range(-1, len(proposer)):
        for k in range(i + 1, len(proposer) if i >= 0 else 1):
            pitch = 0.0
            roll = 0.0
            if i >= 0:
                m = proposer[i]
                n = proposer[k]
                # n_z + pitch n_y - roll n_x = 0 for both.
                determinant = normal[m, 0] * normal[n, 1] - normal[m, 1] * normal[n, 0]
                if determinant == 0.0:
                    continue
                pitch = (normal[m, 2] * normal[n, 0] - normal[m, 0] * normal[n, 2]) / determinant
                roll = (normal[m, 2] * normal[n, 1] - normal[m, 1] * normal[n, 2]) / determinant
                if not (abs(pitch) <= limit and abs(roll) <= limit):
                    continue
            votes = -0.5 * (pitch * pitch + roll * roll) / (prior * prior)
            for line in range(len(weight)):
                off = normal[line, 2] + pitch * normal[line, 1] - roll * normal[line, 0]
                off /= tolerance[line]
                if off * off < 1.0:
                    votes += weight[line] * (1.0 - off * off)
            if votes > best:
                best = votes
                best_pitch = pitch
                best_roll = roll
    return best_pitch, best_roll
