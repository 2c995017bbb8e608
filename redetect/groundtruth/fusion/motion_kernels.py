"""One movement by odometry, compiled: where it leads, derivatives, what its errors sum up to.

Between two nodes the robot is taken to go forward, sideways and round at constant rates, which is
an arc. All along it, white noise is added to the three rates: along the way, across it, and to the
turn. Its effect at the arc's end is integrated in closed form: a heading that errs early
leads aside for the rest of the way. So an arc that is cut in two, and its halves one after the
other, come to the same. In complex numbers, with the arc's length s, its turn w and the directions
of its chord and across it as axes, a wrong heading at the share t - 1/2 of the way moves the end by

    s (cos h - cos wt + i (sin h - sin wt)) / w,        h = w / 2,

of which `arc_integrals` gives means and variances over t from -1/2 to 1/2. (The covariance of both
parts is zero, one being odd and the other even.)
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Length of the state, and of the pose at its beginning.
STATE = 6
POSE = 3
# Below this half turn (rad) differences cancel, and series are right to ten digits.
_SERIES_BELOW = 0.1


@njit(cache=True, error_model="numpy")
def arc_integrals(half_turn: float) -> tuple[float, float, float, float, float]:
    """Effect of errors along an arc of length 1.

    Parameters
    ----------
    half_turn : float
        Half the angle between its tangents at both ends (rad).

    Returns
    -------
    chord : float
        Length of the chord, sin(h) / h.
    mean_along : float
        Mean of (cos h - cos 2ht) / 2h over t from -1/2 to 1/2. The mean of (sin h - sin 2ht) / 2h
        is half the chord.
    variance_along, variance_across : float
        Variances of the two over t.
    mean_cosine : float
        Mean of cos(4ht), sin(2h) / 2h: how much of the difference between errors along the way and
        across it is left in the directions of the chord.
    """
    h = half_turn
    q = h * h
    if abs(h) < _SERIES_BELOW:
        chord = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0)))
        mean_along = h * (-1.0 / 6.0 + q * (1.0 / 60.0 + q * (-1.0 / 1680.0 + q / 90720.0)))
        variance_along = q * (1.0 / 180.0 + q * (-1.0 / 1260.0 + q / 18900.0))
        variance_across = 1.0 / 12.0 + q * (-1.0 / 60.0 + q * (1.0 / 630.0 - q / 11340.0))
        p = 4.0 * q
        mean_cosine = 1.0 - p / 6.0 * (1.0 - p / 20.0 * (1.0 - p / 42.0 * (1.0 - p / 72.0)))
        return chord, mean_along, variance_along, variance_across, mean_cosine
    chord = math.sin(h) / h
    mean_cosine = math.sin(2.0 * h) / (2.0 * h)
    mean_along = (math.cos(h) - chord) / (2.0 * h)
    variance_along = (0.5 + 0.5 * mean_cosine - chord * chord) / (4.0 * q)
    variance_across = (0.5 - 0.5 * mean_cosine) / (4.0 * q)
    return chord, mean_along, variance_along, variance_across, mean_cosine


@njit(cache=True, error_model="numpy")
def move(
    x: FloatArray,
    p: FloatArray,
    f: FloatArray,
    control: FloatArray,
    variances: FloatArray,
    point: FloatArray,
) -> None:
    """Move a state and its covariance on by a movement of odometry, in place.

    Parameters
    ----------
    x, p : (6,), (6, 6) arrays
        State (see `redetect.groundtruth.fusion.smoother_kernels`) and covariance; replaced.
    f : (6, 6) array
        Identity on the first call; becomes the derivative of the new state by the old one.
    control : (4,) array
        Way forward, way to the left (m) and turn (rad), summed up over the movement in the robot's
        own, turning frame; and the part of the turn that a share of turns is a share of.
    variances : (3,) array
        What noise along the way, across it (m^2) and of the turn (rad^2) sum up to.
    point : (6,) array
        The state at which the movement is linearised.
    """
    way = math.sqrt(control[0] * control[0] + control[1] * control[1])
    turn, distinct = control[2], control[3]
    length = (1.0 + point[5]) * way
    half = 0.5 * (turn + point[3] * distinct + point[4] * way)
    chord, along, variance_along, variance_across, mean_cosine = arc_integrals(half)
    # The chord's direction in the world.
    cos, sin = math.cos(point[2] + half), math.sin(point[2] + half)
    east, north = cos, sin
    if way > 0.0:
        east = (cos * control[0] - sin * control[1]) / way
        north = (sin * control[0] + cos * control[1]) / way
    # By the turn of the whole arc.
    by_turn_x = length * (along * east - 0.5 * chord * north)
    by_turn_y = length * (along * north + 0.5 * chord * east)
    f[0, 2] = -length * chord * north
    f[1, 2] = length * chord * east
    f[0, 3], f[0, 4], f[0, 5] = distinct * by_turn_x, way * by_turn_x, way * chord * east
    f[1, 3], f[1, 4], f[1, 5] = distinct * by_turn_y, way * by_turn_y, way * chord * north
    f[2, 3], f[2, 4] = distinct, way
    x[0] += length * chord * east
    x[1] += length * chord * north
    for n in range(2, STATE):
        off = x[n] - point[n]
        x[0] += f[0, n] * off
        x[1] += f[1, n] * off
    x[2] += turn + x[3] * distinct + x[4] * way
    # f is the identity but for rows 0 to 2: p becomes f p f' row by row, then column by column.
    for j in range(STATE):
        p[0, j] += f[0, 2] * p[2, j] + f[0, 3] * p[3, j] + f[0, 4] * p[4, j] + f[0, 5] * p[5, j]
        p[1, j] += f[1, 2] * p[2, j] + f[1, 3] * p[3, j] + f[1, 4] * p[4, j] + f[1, 5] * p[5, j]
        p[2, j] += f[2, 3] * p[3, j] + f[2, 4] * p[4, j]
    for i in range(STATE):
        p[i, 0] += p[i, 2] * f[0, 2] + p[i, 3] * f[0, 3] + p[i, 4] * f[0, 4] + p[i, 5] * f[0, 5]
        p[i, 1] += p[i, 2] * f[1, 2] + p[i, 3] * f[1, 3] + p[i, 4] * f[1, 4] + p[i, 5] * f[1, 5]
        p[i, 2] += p[i, 3] * f[2, 3] + p[i, 4] * f[2, 4]
    of_turn = variances[2]
    middle = 0.5 * (variances[0] + variances[1])
    apart = 0.5 * (variances[0] - variances[1]) * mean_cosine
    lever = length * length * of_turn
    qa = middle + apart + lever * variance_along
    qc = middle - apart + lever * variance_across
    cross = east * north * (qa - qc) + of_turn * by_turn_x * by_turn_y
    p[0, 0] += east * east * qa + north * north * qc + of_turn * by_turn_x * by_turn_x
    p[0, 1] += cross
    p[1, 0] += cross
    p[1, 1] += north * north * qa + east * east * qc + of_turn * by_turn_y * by_turn_y
    p[0, 2] += of_turn * by_turn_x
    p[2, 0] += of_turn * by_turn_x
    p[1, 2] += of_turn * by_turn_y
    p[2, 1] += of_turn * by_turn_y
    p[2, 2] += of_turn
