"""Compiled search for points where rays of many frames meet (`slam.association.line_points`)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_NEAREST_M = 0.3
_ROOT_TWO_PI = math.sqrt(2.0 * math.pi)


@njit(cache=True, error_model="numpy", nogil=True)
def _wrapped(angle: float) -> float:
    return float((angle + math.pi) % (2.0 * math.pi) - math.pi)


@njit(cache=True, error_model="numpy", nogil=True)
def _crossing(centre: FloatArray, angle: FloatArray, i: int, j: int) -> tuple[float, float]:
    """How far from their origins two rays cross; negative behind."""
    ux, uy = math.sin(angle[i]), -math.cos(angle[i])
    vx, vy = math.sin(angle[j]), -math.cos(angle[j])
    determinant = vx * uy - ux * vy
    if abs(determinant) < 1e-9:
        return -1.0, -1.0
    x, y = centre[j, 0] - centre[i, 0], centre[j, 1] - centre[i, 1]
    return (vx * y - vy * x) / determinant, (ux * y - uy * x) / determinant


@njit(cache=True, error_model="numpy", nogil=True)
def crossings(
    centre: FloatArray,
    angle: FloatArray,
    sigma: FloatArray,
    frame: IntArray,
    start: IntArray,
    gaps: IntArray,
    least_parallax: float,
    farthest_m: float,
) -> tuple[FloatArray, IntArray]:
    """Where rays of frames that are some steps apart cross, ahead of both.

    Parameters
    ----------
    centre : (n, 2) float64
        Origins of the rays in the map (m).
    angle : (n,) float64
        Their bearings in the map (rad).
    sigma : (n,) float64
        Of those.
    frame : (n,) int64
        The frame of each, ascending.
    start : (F + 1,) int64
        The rays of frame f are start[f] to start[f + 1].
    gaps : (g,) int64
        Distances of frames that are tried.
    least_parallax : float
        Least angle between two rays, in standard deviations of it.
    farthest_m : float
        Crossings farther away than this do not count.

    Returns
    -------
    points : (k, 2) float64
    frames : (k,) int64
        The first of the two frames.
    """
    points = []
    frames = []
    for i in range(len(angle)):
        for gap in gaps:
            other = frame[i] + gap
            if other >= len(start) - 1:
                continue
            for j in range(start[other], start[other + 1]):
                parallax = abs(_wrapped(angle[j] - angle[i]))
                if parallax < least_parallax * math.hypot(sigma[i], sigma[j]):
                    continue
                near, far = _crossing(centre, angle, i, j)
                if min(near, far) < _NEAREST_M or max(near, far) > farthest_m:
                    continue
                points.append(centre[i, 0] + near * math.sin(angle[i]))
                points.append(centre[i, 1] - near * math.cos(angle[i]))
                frames.append(frame[i])
    return np.array(points, dtype=np.float64).reshape(-1, 2), np.array(frames, dtype=np.int64)


@njit(cache=True, error_model="numpy", nogil=True)
def best_run(
    point: FloatArray,
    centre: FloatArray,
    angle: FloatArray,
    sigma: FloatArray,
    start: IntArray,
    free: BoolArray,
    first: int,
    last: int,
    heading: FloatArray,
    widest_rad: float,
    clutter: float,
    detected: float,
    gate: float,
    rows: IntArray,
) -> float:
    """Score of a vertical at a point, over the contiguous frames that support it most.

    A frame with a ray within the gate adds the logarithm of the ratio of the ray's likelihood for
    this point to that for clutter. A frame without such a ray, though the point is in the field of
    view, adds the logarithm of the probability to miss a vertical.

    Parameters
    ----------
    point : (2,) float64
        In the map (m).
    centre, angle, sigma, start
        The rays, see `crossings`.
    free : (n,) bool
        Rays that may be used.
    first, last : int
        Range of frames to score, `last` excluded.
    heading : (F,) float64
        Of the robot in each frame (rad).
    widest_rad : float
        Half the field of view.
    clutter : float
        Rays per frame and radian.
    detected : float
        Probability that a vertical in view gives a row.
    gate : float
        Standard deviations.
    rows : (F,) int64
        Is filled with the row of each frame of that stretch, -1 where there is none.

    Returns
    -------
    float
        The sum over the stretch.
    """
    best, total = 0.0, 0.0
    best_first, best_last, began = first, first, first
    for f in range(first, last):
        rows[f] = -1
        if start[f] == start[f + 1]:
            continue
        x, y = point[0] - centre[start[f], 0], point[1] - centre[start[f], 1]
        if math.hypot(x, y) < _NEAREST_M:
            continue
        bearing = math.atan2(x, -y)
        if abs(_wrapped(bearing - heading[f])) > widest_rad:
            continue
        gained = math.log(1.0 - detected)
        for i in range(start[f], start[f + 1]):
            off = _wrapped(bearing - angle[i]) / sigma[i]
            if free[i] and abs(off) < gate:
                likelier = detected / (sigma[i] * _ROOT_TWO_PI * clutter)
                value = math.log(likelier) - 0.5 * off * off
                if value > gained:
                    gained, rows[f] = value, i
        if total <= 0.0:
            total, began = 0.0, f
        total += gained
        if total > best:
            best, best_first, best_last = total, began, f + 1
    for f in range(first, last):
        if f < best_first or f >= best_last:
            rows[f] = -1
    return best


@njit(cache=True, error_model="numpy", nogil=True)
def scores_of(
    points: FloatArray,
    frames: IntArray,
    centre: FloatArray,
    angle: FloatArray,
    sigma: FloatArray,
    start: IntArray,
    window: int,
    heading: FloatArray,
    widest_rad: float,
    clutter: float,
    detected: float,
    gate: float,
) -> FloatArray:
    """`best_run` of many points, all rays being free; each uses `window` frames both ways."""
    count = len(start) - 1
    rows = np.empty(count, dtype=np.int64)
    free = np.ones(len(angle), dtype=np.bool_)
    scores = np.empty(len(points))
    for k in range(len(points)):
        scores[k] = best_run(
            points[k],
            centre,
            angle,
            sigma,
            start,
            free,
            max(0, frames[k] - window),
            min(count, frames[k] + window),
            heading,
            widest_rad,
            clutter,
            detected,
            gate,
            rows,
        )
    return scores
