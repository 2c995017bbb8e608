"""Compiled search for points where rays of many frames meet (`slam.association.line_points`)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class Rays(NamedTuple):
    """Rows of verticals in the map.

    Attributes
    ----------
    centre : (n, 2) float64
        The camera's place (m).
    angle : (n,) float64
        Bearing in the map (rad).
    sigma : (n,) float64
        Of it (rad).
    frame : (n,) int64
        Ascending from 0.
    start : (F + 1,) int64
        Rays start[f] to start[f + 1] are those of frame f.
    heading : (F,) float64
        Of the robot (rad).
    widest_rad : float
        Half the field of view.
    """

    centre: FloatArray
    angle: FloatArray
    sigma: FloatArray
    frame: IntArray
    start: IntArray
    heading: FloatArray
    widest_rad: float


class Detection(NamedTuple):
    """How verticals are detected.

    Attributes
    ----------
    probability : float
        That a vertical in view gives a row.
    gate : float
        Standard deviations within which a ray may be that row.
    """

    probability: float
    gate: float


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
    rays: Rays,
    gaps: IntArray,
    least_parallax: float,
    farthest_m: float,
) -> tuple[FloatArray, IntArray]:
    """Where rays of frames that are some steps apart cross, ahead of both.

    Parameters
    ----------
    rays : Rays
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
    centre, angle, sigma, frame, start = rays.centre, rays.angle, rays.sigma, rays.frame, rays.start
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
    rays: Rays,
    free: BoolArray,
    first: int,
    last: int,
    detection: Detection,
    rows: IntArray,
) -> float:
    """The unbroken stretch of frames with the most evidence for a vertical at a point.

    A frame in which a ray passes within the gate adds the logarithm of how much likelier the ray is
    from there than from anywhere; one without such a ray, though the point is in the field of view,
    adds that of the probability to miss a vertical.

    Parameters
    ----------
    point : (2,) float64
        In the map (m).
    rays : Rays
    free : (n,) bool
        Rays that may be used.
    first, last : int
        Frames considered, the second one excluded.
    detection : Detection
    rows : (F,) int64
        Is filled with the row of each frame of that stretch, -1 where there is none.

    Returns
    -------
    float
        The sum over the stretch.
    """
    start, angle, sigma = rays.start, rays.angle, rays.sigma
    # Rays from anywhere, per frame and radian.
    clutter = len(angle) / len(rays.heading) / (2.0 * rays.widest_rad)
    best, total = 0.0, 0.0
    best_first, best_last, began = first, first, first
    for f in range(first, last):
        rows[f] = -1
        if start[f] == start[f + 1]:
            continue
        x, y = point[0] - rays.centre[start[f], 0], point[1] - rays.centre[start[f], 1]
        if math.hypot(x, y) < _NEAREST_M:
            continue
        bearing = math.atan2(x, -y)
        if abs(_wrapped(bearing - rays.heading[f])) > rays.widest_rad:
            continue
        gained = math.log(1.0 - detection.probability)
        for i in range(start[f], start[f + 1]):
            off = _wrapped(bearing - angle[i]) / sigma[i]
            if free[i] and abs(off) < detection.gate:
                likelier = detection.probability / (sigma[i] * _ROOT_TWO_PI * clutter)
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
    points: FloatArray, frames: IntArray, rays: Rays, window: int, detection: Detection
) -> FloatArray:
    """`best_run` of many points, all rays being free; each considers `window` frames both ways."""
    count = len(rays.start) - 1
    rows = np.empty(count, dtype=np.int64)
    free = np.ones(len(rays.angle), dtype=np.bool_)
    scores = np.empty(len(points))
    for k in range(len(points)):
        first, last = max(0, frames[k] - window), min(count, frames[k] + window)
        scores[k] = best_run(points[k], rays, free, first, last, detection, rows)
    return scores
