"""Compiled search for four corners: arrays in, arrays out."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_PERTURBATIONS = 12
_DECAY = 0.75
_LCG_FACTOR = 1103515245
_LCG_STEP = 12345
_LCG_MODULUS = 1 << 31


@njit(cache=True, error_model="numpy")
def _twice_area(points: NDArray[np.float64], index: NDArray[np.int64]) -> float:
    total = 0.0
    for k in range(4):
        a = index[k]
        b = index[(k + 1) % 4]
        total += points[a, 0] * points[b, 1] - points[b, 0] * points[a, 1]
    return abs(total)


@njit(cache=True, error_model="numpy")
def _ascend(points: NDArray[np.float64], index: NDArray[np.int64]) -> float:
    """Move one corner at a time to the best place between its neighbours until none gains."""
    n = len(points)
    best = _twice_area(points, index)
    for _ in range(4 * n):
        gained = False
        for k in range(4):
            before = index[(k + 3) % 4]
            after = index[(k + 1) % 4]
            span = (after - before) % n
            # The triangle over the chord between the neighbours.
            cx = points[after, 0] - points[before, 0]
            cy = points[after, 1] - points[before, 1]
            largest = -1.0
            at = index[k]
            for step in range(1, span):
                j = (before + step) % n
                height = abs(
                    cx * (points[j, 1] - points[before, 1])
                    - cy * (points[j, 0] - points[before, 0])
                )
                if height > largest:
                    largest = height
                    at = j
            if at != index[k]:
                old = index[k]
                index[k] = at
                area = _twice_area(points, index)
                if area > best * (1.0 + 1e-12):
                    best = area
                    gained = True
                else:
                    index[k] = old
        if not gained:
            break
    return best


@njit(cache=True, error_model="numpy")
def largest_quadrangle(points: NDArray[np.float64], seed: int) -> NDArray[np.int64]:
    """Indices of the quadrangle of largest area in a closed chain of points.

    Algorithm B: coordinate ascent, started anew from the best one with its indices perturbed at
    random, ever less.

    Parameters
    ----------
    points : (N, 2) float64
        The chain, N >= 4.
    seed : int
        Of the perturbations.

    Returns
    -------
    (4,) int64
        In the order of the chain.
    """
    n = len(points)
    best = np.empty(4, np.int64)
    for k in range(4):
        best[k] = k * n // 4
    area = _ascend(points, best)
    amplitude = n / 4.0
    state = seed % _LCG_MODULUS
    trial = np.empty(4, np.int64)
    for _ in range(_PERTURBATIONS):
        for k in range(4):
            state = (_LCG_FACTOR * state + _LCG_STEP) % _LCG_MODULUS
            shift = (2.0 * state / _LCG_MODULUS - 1.0) * amplitude
            trial[k] = (best[k] + round(shift)) % n
        trial.sort()
        distinct = True
        for k in range(3):
            if trial[k] == trial[k + 1]:
                distinct = False
        if distinct:
            found = _ascend(points, trial)
            if found > area * (1.0 + 1e-12):
                area = found
                best[:] = trial
        amplitude *= _DECAY
    best.sort()
    return best


@njit(cache=True, error_model="numpy")
def farthest_corners(points: NDArray[np.float64], spacing: float) -> NDArray[np.int64]:
    """Indices of the local maxima of the distance from the barycentre of a closed chain.

    Algorithm A. A maximum is the farthest point of all whose direction from the barycentre differs
    by less than `spacing` radians.

    Parameters
    ----------
    points : (N, 2) float64
        The chain, so dense that its mean is the barycentre of the outline.
    spacing : float
        Radians.

    Returns
    -------
    (M,) int64
        In the order of the chain; M need not be 4.
    """
    n = len(points)
    cx = points[:, 0].mean()
    cy = points[:, 1].mean()
    distance = np.empty(n)
    angle = np.empty(n)
    for k in range(n):
        distance[k] = math.hypot(points[k, 0] - cx, points[k, 1] - cy)
        angle[k] = math.atan2(points[k, 1] - cy, points[k, 0] - cx)
    found = np.empty(n, np.int64)
    count = 0
    for k in range(n):
        highest = True
        for j in range(n):
            if j == k:
                continue
            apart = abs(angle[j] - angle[k])
            apart = min(apart, 2.0 * math.pi - apart)
            if apart < spacing and (
                distance[j] > distance[k] or (distance[j] == distance[k] and j < k)
            ):
                highest = False
                break
        if highest:
            found[count] = k
            count += 1
    return found[:count].copy()
