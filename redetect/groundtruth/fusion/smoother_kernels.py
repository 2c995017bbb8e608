"""Kalman filter over poses and Rauch-Tung-Striebel smoother, compiled.

The state is x, y (m), theta (rad, not wrapped), and what odometry is off by systematically: the
share by which turns are longer than it says, the turn that it misses per metre driven (rad/m), and
the share by which ways are longer. The control of a node is the movement since the one before
(see `redetect.groundtruth.fusion.motion_kernels`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from redetect.groundtruth.fusion.motion_kernels import POSE, STATE, move

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
KindArray = NDArray[np.int8]

#: Restart of the filter at a node: none, after many rejections, where it was lost.
NOT_ANEW, AFTER_REJECTIONS, WHERE_LOST = 0, 1, 2


@njit(cache=True, error_model="numpy")
def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, error_model="numpy")
def _invert_3x3(m: FloatArray, inverse: FloatArray) -> float:
    """Invert a symmetric 3x3 matrix by cofactors; returns its determinant."""
    a, b, c = m[0, 0], m[0, 1], m[0, 2]
    d, e, f = m[1, 1], m[1, 2], m[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    scale = 1.0 / determinant
    inverse[0, 0] = c00 * scale
    inverse[0, 1] = inverse[1, 0] = c01 * scale
    inverse[0, 2] = inverse[2, 0] = c02 * scale
    inverse[1, 1] = (a * f - c * c) * scale
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) * scale
    inverse[2, 2] = (a * d - b * b) * scale
    return float(determinant)


@njit(cache=True, error_model="numpy")
def _squared_innovation(
    p: FloatArray,
    measured_covariance: FloatArray,
    innovation: FloatArray,
    s: FloatArray,
    s_inverse: FloatArray,
) -> tuple[float, float]:
    """Normalised square of an innovation, and its covariance's determinant; fills the last two."""
    for i in range(POSE):
        for j in range(POSE):
            s[i, j] = p[i, j] + measured_covariance[i, j]
    determinant = _invert_3x3(s, s_inverse)
    squared = 0.0
    for i in range(POSE):
        for j in range(POSE):
            squared += innovation[i] * s_inverse[i, j] * innovation[j]
    return squared, determinant


@njit(cache=True, error_model="numpy")
def _update(
    x: FloatArray,
    p: FloatArray,
    innovation: FloatArray,
    s_inverse: FloatArray,
    gain: FloatArray,
    temporary: FloatArray,
) -> None:
    """Take a measured pose in; gain and temporary are work space."""
    for i in range(STATE):
        for j in range(POSE):
            total = 0.0
            for n in range(POSE):
                total += p[i, n] * s_inverse[n, j]
            gain[i, j] = total
    for i in range(STATE):
        for j in range(POSE):
            x[i] += gain[i, j] * innovation[j]
        for j in range(STATE):
            total = 0.0
            for n in range(POSE):
                total += gain[i, n] * p[n, j]
            temporary[i, j] = total
    for i in range(STATE):
        for j in range(i, STATE):
            p[i, j] -= 0.5 * (temporary[i, j] + temporary[j, i])
            p[j, i] = p[i, j]


class Odometry(NamedTuple):
    """Movements to N nodes, each from the node before; the first is not used.

    Attributes
    ----------
    controls : (N, 4) float64
        As `move` takes them.
    variances : (N, 3) float64
        Accumulated noise along the way, across it and of the turn.
    """

    controls: FloatArray
    variances: FloatArray


class MeasuredPoses(NamedTuple):
    """M poses measured at some of the nodes, in ascending order.

    Attributes
    ----------
    nodes : (M,) int64
    poses, covariances : (M, 3), (M, 3, 3) float64
    """

    nodes: IntArray
    poses: FloatArray
    covariances: FloatArray


class Gating(NamedTuple):
    """When a measurement is rejected, and when the filter restarts from one.

    Attributes
    ----------
    largest_squared : float
        Largest squared normalised innovation.
    restart_after : int
        After this number of rejections in a row the pose becomes the measured one, with
        `restart_variances`, however far off the filter was.
    restart_variances : (3,) float64
    lost_variance : float
        The same at once where the heading's variance (rad^2) is greater.
    cuts : (N,) bool
        The same at these nodes, at their first measurement.
    """

    largest_squared: float
    restart_after: int
    restart_variances: FloatArray
    lost_variance: float
    cuts: BoolArray


class FilterHistory(NamedTuple):
    """States (N, 6) and covariances (N, 6, 6) at all nodes, for the smoother.

    Attributes
    ----------
    predicted, predicted_covariance, filtered, filtered_covariance : float64
    transitions : (N, 6, 6) float64
        Derivatives of each node's prediction with respect to the node before.
    """

    predicted: FloatArray
    predicted_covariance: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    transitions: FloatArray


def empty_history(nodes: int) -> FilterHistory:
    """A history to be filled; of no nodes where none is wanted."""
    states, spreads = (nodes, STATE), (nodes, STATE, STATE)
    return FilterHistory(
        np.empty(states), np.empty(spreads), np.empty(states), np.empty(spreads), np.empty(spreads)
    )


@njit(cache=True, error_model="numpy")
def filter_forward(
    odometry: Odometry,
    start: FloatArray,
    start_covariance: FloatArray,
    measured: MeasuredPoses,
    gating: Gating,
    points: FloatArray,
    history: FilterHistory,
) -> tuple[FloatArray, BoolArray, KindArray, float]:
    """Filter N nodes forward.

    Parameters
    ----------
    odometry : Odometry
    start, start_covariance : (6,), (6, 6) float64
        Before the measurements at the first node.
    measured : MeasuredPoses
    gating : Gating
    points : (N, 6) float64
        States at which each movement away from a node is linearised, with headings that go on
        without jumps; measured headings are assumed to be within half a turn of them. Of length 1:
        at the filter's own.
    history : FilterHistory
        Filled, unless it is of no nodes.

    Returns
    -------
    squared_innovations : (M,) float64
        Normalised.
    accepted : (M,) bool
    restarted : (N,) int8
        Whether the filter began anew at a node, and why.
    surprise : float
        Minus twice the logarithm of the likelihood of the accepted innovations.
    """
    controls, nodes = odometry.controls, measured.nodes
    keep = len(history.predicted) > 0
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
    gain = np.empty((STATE, POSE))
    temporary = np.empty((STATE, STATE))
    m = 0
    rejections = 0
    surprise = 0.0
    for k in range(controls.shape[0]):
        restarted[k] = NOT_ANEW
        cut = gating.cuts[k]
        if k > 0:
            if points.shape[0] > 1:
                move(x, p, f, controls[k], odometry.variances[k], points[k - 1])
            else:
                move(x, p, f, controls[k], odometry.variances[k], x.copy())
            if keep:
                transitions[k] = f
        if keep:
            predicted[k] = x
            predicted_covariance[k] = p
        while m < nodes.shape[0] and nodes[m] == k:
            for i in range(POSE):
                innovation[i] = measured.poses[m, i] - x[i]
            if points.shape[0] > 1:
                ahead = points[k, 2] - x[2]
                innovation[2] = ahead + _wrap(innovation[2] - ahead)
            else:
                innovation[2] = _wrap(innovation[2])
            lost = m > 0 and (cut or p[2, 2] > gating.lost_variance)
            if lost or rejections >= gating.restart_after:
                for i in range(POSE):
                    for j in range(STATE):
                        p[i, j] = 0.0
                        p[j, i] = 0.0
                for i in range(POSE):
                    p[i, i] = gating.restart_variances[i]
                    x[i] += innovation[i]
                    innovation[i] = 0.0
                rejections = 0
                cut = False
                restarted[k] = WHERE_LOST if lost else AFTER_REJECTIONS
                if keep:
                    predicted[k] = x
                    predicted_covariance[k] = p
                    transitions[k, :POSE] = 0.0
            squared, determinant = _squared_innovation(
                p, measured.covariances[m], innovation, s, s_inverse
            )
            squared_innovations[m] = squared
            accepted[m] = squared <= gating.largest_squared
            if accepted[m]:
                rejections = 0
                surprise += squared + math.log(determinant)
                _update(x, p, innovation, s_inverse, gain, temporary)
            else:
                rejections += 1
                surprise += gating.largest_squared + math.log(determinant)
            m += 1
        if keep:
            filtered[k] = x
            filtered_covariance[k] = p
    return squared_innovations, accepted, restarted, surprise


@njit(cache=True, error_model="numpy")
def _factor(p: FloatArray, lower: FloatArray) -> None:
    """Cholesky factor of a covariance; directions without any variance are left out."""
    for i in range(STATE):
        for j in range(i + 1):
            total = p[i, j]
            for n in range(j):
                total -= lower[i, n] * lower[j, n]
            if i == j:
                lower[i, i] = math.sqrt(total) if total > 1e-15 * p[i, i] else 0.0
            else:
                lower[i, j] = total / lower[j, j] if lower[j, j] > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _solve(lower: FloatArray, right: FloatArray) -> None:
    """Replace a vector by the covariance's inverse times it, given the factor."""
    for i in range(STATE):
        total = right[i]
        for n in range(i):
            total -= lower[i, n] * right[n]
        right[i] = total / lower[i, i] if lower[i, i] > 0.0 else 0.0
    for i in range(STATE - 1, -1, -1):
        total = right[i]
        for n in range(i + 1, STATE):
            total -= lower[n, i] * right[n]
        right[i] = total / lower[i, i] if lower[i, i] > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def smooth_backward(history: FilterHistory) -> tuple[FloatArray, FloatArray]:
    """Smooth what `filter_forward` left, from the last node to the first.

    Where the filter began anew, poses before learn from what came after only what it says of
    odometry's systematic errors.

    Returns
    -------
    states, covariances : (N, 6), (N, 6, 6) float64
    """
    predicted, predicted_covariance = history.predicted, history.predicted_covariance
    filtered, filtered_covariance = history.filtered, history.filtered_covariance
    transitions = history.transitions
    smoothed, smoothed_covariance = np.empty_like(filtered), np.empty_like(filtered_covariance)
    last = predicted.shape[0] - 1
    smoothed[last] = filtered[last]
    smoothed_covariance[last] = filtered_covariance[last]
    lower = np.zeros((STATE, STATE))
    temporary = np.empty((STATE, STATE))
    gain = np.empty((STATE, STATE))
    difference = np.empty(STATE)
    for k in range(last - 1, -1, -1):
        p, f = filtered_covariance[k], transitions[k + 1]
        _factor(predicted_covariance[k + 1], lower)
        # gain = p f' (predicted covariance)^-1, row by row.
        for i in range(STATE):
            for j in range(POSE):
                total = 0.0
                for n in range(STATE):
                    total += p[i, n] * f[j, n]
                gain[i, j] = total
            for j in range(POSE, STATE):
                gain[i, j] = p[i, j]
            _solve(lower, gain[i])
        for i in range(STATE):
            difference[i] = smoothed[k + 1, i] - predicted[k + 1, i]
        for i in range(STATE):
            total = filtered[k, i]
            for j in range(STATE):
                total += gain[i, j] * difference[j]
            smoothed[k, i] = total
        for i in range(STATE):
            for j in range(STATE):
                total = 0.0
                for n in range(STATE):
                    total += gain[i, n] * (
                        smoothed_covariance[k + 1, n, j] - predicted_covariance[k + 1, n, j]
                    )
                temporary[i, j] = total
        for i in range(STATE):
            for j in range(i, STATE):
                total = p[i, j]
                for n in range(STATE):
                    total += temporary[i, n] * gain[j, n]
                smoothed_covariance[k, i, j] = total
                smoothed_covariance[k, j, i] = total
    return smoothed, smoothed_covariance
