"""Compiled motion model of odometry: prediction, derivatives, accumulated noise.

Between two nodes the robot is assumed to move forward and sideways and to turn at constant rates,
which gives an arc. Along it, white noise is added to the three rates. Its effect at the arc's end
is integrated in closed form: an early heading error causes a lateral error over the remaining arc.
So cutting an arc in two does not change the result. In complex numbers, with the arc's length s,
its turn w and the directions of its chord and across it as axes, a heading error at the share
t - 1/2 of the arc moves the end by

    s (cos h - cos wt + i (sin h - sin wt)) / w,        h = w / 2,

of which `arc_integrals` gives means and variances over t from -1/2 to 1/2. (The covariance of both
parts is zero, one being odd and the other even.)

The state: x, y (m) and heading (rad); of odometry the relative excess of true turns, the turn that
it misses per metre (rad), and the relative excess of true distances.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from redetect.angles import wrapped
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel

#: Size of the state, and of the pose at its beginning.
STATE = 6
POSE = 3
#: Restart of the filter at a node: none, after many rejections, because it was lost.
NO_RESTART, AFTER_REJECTIONS, WHERE_LOST = 0, 1, 2
# Below this half turn (rad) differences cancel, and series are accurate to ten digits.
_SERIES_BELOW = 0.1


@kernel()
def arc_integrals(half_turn: float) -> tuple[float, float, float, float, float]:
    """Effect of errors along an arc of length 1.

    `half_turn`: half the angle between its tangents at both ends (rad). Returns `chord`: length of
    the chord, sin(h) / h. `mean_along`: mean of (cos h - cos 2ht) / 2h over t from -1/2 to 1/2. The
    mean of (sin h - sin 2ht) / 2h is half the chord. `variance_along`, `variance_across`: variances
    of the two over t. `mean_cosine`: mean of cos(4ht), sin(2h) / 2h: the share of the difference
    between errors along the arc and across it that remains in the directions of the chord.
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


@kernel()
def predict(
    x: FloatArray,
    p: FloatArray,
    f: FloatArray,
    control: FloatArray,
    variances: FloatArray,
    point: FloatArray,
) -> None:
    """Propagate a state and its covariance by a movement of odometry, in place.

    `x`, `p` (6,), (6, 6): state and covariance; replaced. `f` (6, 6): identity on the first
    call; becomes the derivative of the new state by the old one. `control` (4,): distance forward,
    distance to the left (m) and turn (rad), accumulated over the movement in the robot's own,
    turning frame; and the part of the turn to which the turn scale applies.
    `variances` (3,): accumulated noise along the path, across it (m^2) and of the turn (rad^2).
    `point` (6,): the state at which the movement is linearised.
    """
    distance = math.sqrt(control[0] * control[0] + control[1] * control[1])
    turn, distinct = control[2], control[3]
    length = (1.0 + point[5]) * distance
    half = 0.5 * (turn + point[3] * distinct + point[4] * distance)
    chord, along, variance_along, variance_across, mean_cosine = arc_integrals(half)
    # The chord's direction in the world.
    cos, sin = math.cos(point[2] + half), math.sin(point[2] + half)
    east, north = cos, sin
    if distance > 0.0:
        east = (cos * control[0] - sin * control[1]) / distance
        north = (sin * control[0] + cos * control[1]) / distance
    # By the turn of the whole arc.
    by_turn_x = length * (along * east - 0.5 * chord * north)
    by_turn_y = length * (along * north + 0.5 * chord * east)
    f[0, 2] = -length * chord * north
    f[1, 2] = length * chord * east
    f[0, 3], f[0, 4], f[0, 5] = distinct * by_turn_x, distance * by_turn_x, distance * chord * east
    f[1, 3], f[1, 4], f[1, 5] = distinct * by_turn_y, distance * by_turn_y, distance * chord * north
    f[2, 3], f[2, 4] = distinct, distance
    x[0] += length * chord * east
    x[1] += length * chord * north
    for n in range(2, STATE):
        off = x[n] - point[n]
        x[0] += f[0, n] * off
        x[1] += f[1, n] * off
    x[2] += turn + x[3] * distinct + x[4] * distance
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
    p[1, 1] += north * north * qa + east * east * qc + of_turn * by_turn_y * by_turn_y
    p[2, 2] += of_turn
    for i, j, value in ((0, 1, cross), (0, 2, of_turn * by_turn_x), (1, 2, of_turn * by_turn_y)):
        p[i, j] += value
        p[j, i] += value


@kernel()
def squared_innovation(
    innovation: FloatArray, s: FloatArray, s_inverse: FloatArray
) -> tuple[float, float]:
    """Normalised square of an innovation with covariance `s`, whose inverse, by cofactors, is
    filled in; and the determinant of `s`.
    """
    a, b, c = s[0, 0], s[0, 1], s[0, 2]
    d, e, f = s[1, 1], s[1, 2], s[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    scale = 1.0 / determinant
    s_inverse[0, 0] = c00 * scale
    s_inverse[0, 1] = s_inverse[1, 0] = c01 * scale
    s_inverse[0, 2] = s_inverse[2, 0] = c02 * scale
    s_inverse[1, 1] = (a * f - c * c) * scale
    s_inverse[1, 2] = s_inverse[2, 1] = (b * c - a * e) * scale
    s_inverse[2, 2] = (a * d - b * b) * scale
    squared = 0.0
    for i in range(POSE):
        for j in range(POSE):
            squared += innovation[i] * s_inverse[i, j] * innovation[j]
    return squared, determinant


@kernel()
def update(
    x: FloatArray,
    p: FloatArray,
    common: FloatArray,
    innovation: FloatArray,
    s_inverse: FloatArray,
    gain: FloatArray,
) -> None:
    """Update a state and its covariance with a measured pose, in place.

    `x`, `p` (d,), (d, d). `common` (d, 3): cross-covariance of the state and its measured part.
    `s_inverse` (3, 3): of the innovation's covariance. `gain` (d, 3): work space.
    """
    for i in range(len(x)):
        for j in range(POSE):
            total = 0.0
            for n in range(POSE):
                total += common[i, n] * s_inverse[n, j]
            gain[i, j] = total
            x[i] += total * innovation[j]
        for j in range(i + 1):
            total = 0.0
            for n in range(POSE):
                total += gain[i, n] * common[j, n]
            p[i, j] -= total
            p[j, i] = p[i, j]


class Odometry(NamedTuple):
    """Movements to N nodes, each from the node before; the first is not used."""

    controls: FloatArray  # (N, 4): as for `predict`
    variances: FloatArray  # (N, 3): accumulated noise along the path, across it and of the turn


class MeasuredPoses(NamedTuple):
    """M poses measured at some of the nodes, in ascending order."""

    nodes: IntArray  # (M,)
    poses: FloatArray  # (M, 3)
    covariances: FloatArray  # (M, 3, 3)


class Gating(NamedTuple):
    """Conditions for rejecting a measurement, and for restarting the filter from one."""

    largest_squared: float  # Largest squared normalised innovation
    restart_after: int  # Consecutive rejections after which the pose is set to the measured one
    restart_variances: FloatArray  # (3,): with these variances
    lost_variance: float  # The same immediately if the heading's variance (rad^2) is larger
    cuts: BoolArray  # (N,): the same at these nodes, at their first measurement


class FilterHistory(NamedTuple):
    """States (N, d) and covariances (N, d, d) at all nodes, for the smoother."""

    predicted: FloatArray
    predicted_covariance: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    transitions: FloatArray  # (N, d, d): derivatives of predictions by the node before


class Innovations(NamedTuple):
    """How a filter used M measurements at N nodes."""

    squared: FloatArray  # (M,): squared normalised innovations
    accepted: BoolArray  # (M,)
    restarted: NDArray[np.int8]  # (N,): whether the filter restarted at a node, and why
    #: Minus twice the log-likelihood, in which gross errors may be anywhere; so whether there are
    #: any does not change what it says of odometry's noise.
    deviance: float


def empty_history(nodes: int) -> FilterHistory:
    """A history to be filled; with zero nodes if none is needed."""
    states, spreads = (nodes, STATE), (nodes, STATE, STATE)
    return FilterHistory(*map(np.empty, (states, spreads, states, spreads, spreads)))


# Element by element, since an assignment of arrays takes seconds to compile.
@kernel()
def store(
    states: FloatArray, covariances: FloatArray, k: int, x: FloatArray, p: FloatArray
) -> None:
    """Store a state and its covariance as those of a node."""
    for i in range(len(x)):
        states[k, i] = x[i]
        for j in range(len(x)):
            covariances[k, i, j] = p[i, j]


@kernel()
def _restart(x: FloatArray, p: FloatArray, innovation: FloatArray, variances: FloatArray) -> None:
    """Set a state's pose to the measured one, with `variances` (3,), in place."""
    p[:POSE] = 0.0
    p[:, :POSE] = 0.0
    for i in range(POSE):
        p[i, i] = variances[i]
        x[i] += innovation[i]
        innovation[i] = 0.0


@kernel()
def filter_forward(
    odometry: Odometry,
    start: FloatArray,
    start_covariance: FloatArray,
    measured: MeasuredPoses,
    gating: Gating,
    points: FloatArray,
    history: FilterHistory,
) -> Innovations:
    """Filter N nodes forward.

    `start`, `start_covariance` (6,), (6, 6): before the measurements at the first node. `points`
    (N, 6): states at which each movement away from a node is linearised, with continuous headings;
    measured headings are assumed to be within half a turn of them. With length 1, the filter's own
    states are used. `history`: filled, unless it has zero nodes.
    """
    controls, nodes = odometry.controls, measured.nodes
    kept = len(history.predicted) > 0
    predicted, predicted_covariance = history.predicted, history.predicted_covariance
    filtered, filtered_covariance = history.filtered, history.filtered_covariance
    transitions = history.transitions
    squared_innovations = np.zeros(len(nodes))
    accepted = np.zeros(len(nodes), np.bool_)
    restarted = np.empty(len(controls), np.int8)
    x = start.copy()
    p = start_covariance.copy()
    f = np.eye(STATE)
    s = np.empty((POSE, POSE))
    s_inverse = np.empty((POSE, POSE))
    innovation = np.empty(POSE)
    common = np.empty((STATE, POSE))
    gain = np.empty((STATE, POSE))
    m = 0
    rejections = 0
    deviance = 0.0
    for k in range(controls.shape[0]):
        restarted[k] = NO_RESTART
        cut = gating.cuts[k]
        if k > 0:
            if points.shape[0] > 1:
                predict(x, p, f, controls[k], odometry.variances[k], points[k - 1])
            else:
                predict(x, p, f, controls[k], odometry.variances[k], x.copy())
            if kept:
                for i in range(STATE):
                    for j in range(STATE):
                        transitions[k, i, j] = f[i, j]
        if kept:
            store(predicted, predicted_covariance, k, x, p)
        while m < nodes.shape[0] and nodes[m] == k:
            for i in range(POSE):
                innovation[i] = measured.poses[m, i] - x[i]
            if points.shape[0] > 1:
                ahead = points[k, 2] - x[2]
                innovation[2] = ahead + wrapped(innovation[2] - ahead)
            else:
                innovation[2] = wrapped(innovation[2])
            lost = m > 0 and (cut or p[2, 2] > gating.lost_variance)
            if lost or rejections >= gating.restart_after:
                _restart(x, p, innovation, gating.restart_variances)
                rejections = 0
                cut = False
                restarted[k] = WHERE_LOST if lost else AFTER_REJECTIONS
                if kept:
                    store(predicted, predicted_covariance, k, x, p)
                    transitions[k, :POSE] = 0.0
            for j in range(POSE):
                for i in range(STATE):
                    common[i, j] = p[i, j]
                for i in range(POSE):
                    s[i, j] = p[i, j] + measured.covariances[m, i, j]
            squared, determinant = squared_innovation(innovation, s, s_inverse)
            squared_innovations[m] = squared
            anywhere = float(POSE)
            for i in range(POSE):
                anywhere += math.log(gating.restart_variances[i] + measured.covariances[m, i, i])
            deviance += min(squared + math.log(determinant), anywhere)
            accepted[m] = squared <= gating.largest_squared
            if accepted[m]:
                rejections = 0
                update(x, p, common, innovation, s_inverse, gain)
            else:
                rejections += 1
            m += 1
        if kept:
            store(filtered, filtered_covariance, k, x, p)
    return Innovations(squared_innovations, accepted, restarted, deviance)


def smooth_backward(history: FilterHistory) -> tuple[FloatArray, FloatArray]:
    """States (N, d) and covariances (N, d, d) of a filter's history smoothed from the last node to
    the first (Rauch, Tung, Striebel).

    Across a restart of the filter, only odometry's systematic errors are propagated backward.
    """
    expected = history.predicted_covariance[1:].copy()
    # States without variance do not change.
    variances = np.einsum("kii->ki", expected)
    variances[variances == 0.0] = 1.0
    reached = history.transitions[1:] @ history.filtered_covariance[:-1]
    gains = np.linalg.solve(expected, reached).swapaxes(1, 2)
    states, covariances = history.filtered.copy(), history.filtered_covariance.copy()
    _smooth_in_place(states, covariances, np.ascontiguousarray(gains), history)
    return states, covariances


@kernel()
def _smooth_in_place(
    states: FloatArray, covariances: FloatArray, gains: FloatArray, history: FilterHistory
) -> None:
    """Replace filtered states and covariances by smoothed ones, in place; `gains` (N - 1, d, d)."""
    for k in range(len(gains) - 1, -1, -1):
        state, covariance, gain = states[k], covariances[k], gains[k]
        state += gain @ (states[k + 1] - history.predicted[k + 1])
        change = covariances[k + 1] - history.predicted_covariance[k + 1]
        covariance += gain @ change @ gain.T
