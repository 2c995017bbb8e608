"""Kalman filter over poses and Rauch-Tung-Striebel smoother, compiled.

State x, y (m), theta (rad, not wrapped); the control of a node is the movement since the one before
in the robot's frame there.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@njit(cache=True, error_model="numpy", inline="never")
def _wrap(angle: float) -> float:
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, error_model="numpy")
def invert_3x3(m: FloatArray, inverse: FloatArray) -> float:
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
def filter_forward(
    controls: FloatArray,
    control_variances: FloatArray,
    start: FloatArray,
    start_covariance: FloatArray,
    nodes: IntArray,
    measured: FloatArray,
    measured_covariances: FloatArray,
    gate: float,
    restart_after: int,
    restart_covariance: FloatArray,
    predicted: FloatArray,
    predicted_covariance: FloatArray,
    filtered: FloatArray,
    filtered_covariance: FloatArray,
    transitions: FloatArray,
    squared_innovations: FloatArray,
    accepted: BoolArray,
    restarted: BoolArray,
) -> None:
    """Filter N nodes forward, with M measured poses at some of them.

    Parameters
    ----------
    controls : (N, 3) array
        Movement to each node in the robot's frame of the node before; the first is not used.
    control_variances : (N, 3) array
        Of the movements, along the robot's axes and of the turn.
    start, start_covariance : (3,), (3, 3) arrays
        Before the measurements at the first node.
    nodes : (M,) int array
        Ascending.
    measured, measured_covariances : (M, 3), (M, 3, 3) arrays
    gate : float
        Largest squared normalised innovation.
    restart_after : int
        So many rejections in a row, and the filter takes `restart_covariance` for its own and
        believes the measurements again.
    restart_covariance : (3, 3) array
    predicted, predicted_covariance, filtered, filtered_covariance : (N, 3), (N, 3, 3) arrays
        Filled.
    transitions : (N, 3, 3) array
        Filled with the derivatives of each node's prediction by the node before.
    squared_innovations, accepted : (M,) arrays
        Filled.
    restarted : (N,) array
        Filled: whether the filter began anew at a node.
    """
    x = start.copy()
    p = start_covariance.copy()
    s = np.empty((3, 3))
    s_inverse = np.empty((3, 3))
    gain = np.empty((3, 3))
    innovation = np.empty(3)
    f = np.eye(3)
    joseph = np.empty((3, 3))
    temporary = np.empty((3, 3))
    m = 0
    rejections = 0
    for k in range(controls.shape[0]):
        restarted[k] = False
        if k > 0:
            dx, dy, turn = controls[k, 0], controls[k, 1], controls[k, 2]
            cos, sin = math.cos(x[2]), math.sin(x[2])
            moved_x, moved_y = cos * dx - sin * dy, sin * dx + cos * dy
            x[0] += moved_x
            x[1] += moved_y
            x[2] += turn
            f[0, 2] = -moved_y
            f[1, 2] = moved_x
            transitions[k] = f
            _sandwich(f, p, temporary)
            vx, vy = control_variances[k, 0], control_variances[k, 1]
            p[0, 0] += cos * cos * vx + sin * sin * vy
            p[0, 1] += cos * sin * (vx - vy)
            p[1, 0] = p[0, 1]
            p[1, 1] += sin * sin * vx + cos * cos * vy
            p[2, 2] += control_variances[k, 2]
        predicted[k] = x
        predicted_covariance[k] = p
        while m < nodes.shape[0] and nodes[m] == k:
            for i in range(3):
                innovation[i] = measured[m, i] - x[i]
            innovation[2] = _wrap(innovation[2])
            if rejections >= restart_after:
                for i in range(3):
                    for j in range(3):
                        p[i, j] += restart_covariance[i, j]
                rejections = 0
                restarted[k] = True
                predicted_covariance[k] = p
            for i in range(3):
                for j in range(3):
                    s[i, j] = p[i, j] + measured_covariances[m, i, j]
            invert_3x3(s, s_inverse)
            squared = 0.0
            for i in range(3):
                for j in range(3):
                    squared += innovation[i] * s_inverse[i, j] * innovation[j]
            squared_innovations[m] = squared
            accepted[m] = squared <= gate
            if accepted[m]:
                rejections = 0
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for n in range(3):
                            total += p[i, n] * s_inverse[n, j]
                        gain[i, j] = total
                for i in range(3):
                    for j in range(3):
                        x[i] += gain[i, j] * innovation[j]
                        joseph[i, j] = (1.0 if i == j else 0.0) - gain[i, j]
                _sandwich(joseph, p, temporary)
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for n in range(3):
                            for o in range(3):
                                total += gain[i, n] * measured_covariances[m, n, o] * gain[j, o]
                        p[i, j] += total
            else:
                rejections += 1
            m += 1
        filtered[k] = x
        filtered_covariance[k] = p


@njit(cache=True, error_model="numpy")
def _sandwich(a: FloatArray, p: FloatArray, temporary: FloatArray) -> None:
    """Replace p by a p a', kept symmetric."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for n in range(3):
                total += a[i, n] * p[n, j]
            temporary[i, j] = total
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for n in range(3):
                total += temporary[i, n] * a[j, n]
            p[i, j] = total
            p[j, i] = total


@njit(cache=True, error_model="numpy")
def smooth_backward(
    predicted: FloatArray,
    predicted_covariance: FloatArray,
    filtered: FloatArray,
    filtered_covariance: FloatArray,
    transitions: FloatArray,
    restarted: BoolArray,
    smoothed: FloatArray,
    smoothed_covariance: FloatArray,
) -> None:
    """Smooth what `filter_forward` left, from the last node to the first.

    Where the filter began anew, what came before learns nothing from what came after.
    """
    last = predicted.shape[0] - 1
    smoothed[last] = filtered[last]
    smoothed_covariance[last] = filtered_covariance[last]
    inverse = np.empty((3, 3))
    temporary = np.empty((3, 3))
    gain = np.empty((3, 3))
    difference = np.empty(3)
    for k in range(last - 1, -1, -1):
        smoothed[k] = filtered[k]
        smoothed_covariance[k] = filtered_covariance[k]
        if restarted[k + 1]:
            continue
        invert_3x3(predicted_covariance[k + 1], inverse)
        p, f = filtered_covariance[k], transitions[k + 1]
        for i in range(3):
            for j in range(3):
                total = 0.0
                for n in range(3):
                    total += p[i, n] * f[j, n]
                temporary[i, j] = total
        for i in range(3):
            for j in range(3):
                total = 0.0
                for n in range(3):
                    total += temporary[i, n] * inverse[n, j]
                gain[i, j] = total
        for i in range(3):
            difference[i] = smoothed[k + 1, i] - predicted[k + 1, i]
        difference[2] = _wrap(difference[2])
        for i in range(3):
            for j in range(3):
                smoothed[k, i] += gain[i, j] * difference[j]
                temporary[i, j] = (
                    smoothed_covariance[k + 1, i, j] - predicted_covariance[k + 1, i, j]
                )
        for i in range(3):
            for j in range(3):
                total = 0.0
                for n in range(3):
                    for o in range(3):
                        total += gain[i, n] * temporary[n, o] * gain[j, o]
                smoothed_covariance[k, i, j] += total
