"""Kernels of the planar ICP: nearest neighbours, rigid fits and normal equations on plain arrays.

Points are (n, 2) float64, poses (x, y, theta) that take the points to the target's frame.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def nearest_points(points: FloatArray, target: FloatArray) -> tuple[IntArray, FloatArray]:
    """Index of, and squared distance to, the nearest of a few hundred target points, one by one.

    For the sizes of single scans this is quicker than any tree.
    """
    count = points.shape[0]
    index = np.empty(count, dtype=np.int64)
    squared = np.empty(count)
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        best, where = np.inf, -1
        for j in range(target.shape[0]):
            dx, dy = target[j, 0] - x, target[j, 1] - y
            d = dx * dx + dy * dy
            if d < best:
                best, where = d, j
        index[i], squared[i] = where, best
    return index, squared


@njit(cache=True, error_model="numpy")
def nearest_on_segments(
    points: FloatArray, segments: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Nearest points on (k, 4) segments x1, y1, x2, y2: (n, 2), their segments, squared distances.

    Where two segments are equally near the first one is taken.
    """
    count = points.shape[0]
    nearest = np.empty((count, 2))
    index = np.full(count, -1, dtype=np.int64)
    squared = np.full(count, np.inf)
    for k in range(segments.shape[0]):
        x1, y1 = segments[k, 0], segments[k, 1]
        ex, ey = segments[k, 2] - x1, segments[k, 3] - y1
        length2 = ex * ex + ey * ey
        for i in range(count):
            t = 0.0
            if length2 > 0.0:
                t = ((points[i, 0] - x1) * ex + (points[i, 1] - y1) * ey) / length2
                t = min(1.0, max(0.0, t))
            qx, qy = x1 + t * ex, y1 + t * ey
            dx, dy = points[i, 0] - qx, points[i, 1] - qy
            d = dx * dx + dy * dy
            if d < squared[i]:
                squared[i], index[i] = d, k
                nearest[i, 0], nearest[i, 1] = qx, qy
    return nearest, index, squared


@njit(cache=True, error_model="numpy")
def rigid_fit(points: FloatArray, target: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Pose (3,) with the least sum of squared distances between the used pairs of points.

    The plane's closed form of the fit by singular values (Arun, Huang, Blostein 1987).
    """
    n = 0
    px = py = qx = qy = 0.0
    for i in range(points.shape[0]):
        if used[i]:
            n += 1
            px += points[i, 0]
            py += points[i, 1]
            qx += target[i, 0]
            qy += target[i, 1]
    pose = np.full(3, np.nan)
    if n == 0:
        return pose
    px, py, qx, qy = px / n, py / n, qx / n, qy / n
    dot = cross = 0.0
    for i in range(points.shape[0]):
        if used[i]:
            ax, ay = points[i, 0] - px, points[i, 1] - py
            bx, by = target[i, 0] - qx, target[i, 1] - qy
            dot += ax * bx + ay * by
            cross += ax * by - ay * bx
    theta = math.atan2(cross, dot)
    c, s = math.cos(theta), math.sin(theta)
    pose[0] = qx - (c * px - s * py)
    pose[1] = qy - (s * px + c * py)
    pose[2] = theta
    return pose


@njit(cache=True, error_model="numpy")
def moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points taken by a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out = np.empty_like(points)
    for i in range(points.shape[0]):
        out[i, 0] = pose[0] + c * points[i, 0] - s * points[i, 1]
        out[i, 1] = pose[1] + s * points[i, 0] + c * points[i, 1]
    return out


@njit(cache=True, error_model="numpy")
def solve3(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution (3,) of a symmetric positive definite system by Cholesky; NaN where it is not."""
    a = math.sqrt(matrix[0, 0])
    b = matrix[1, 0] / a
    c = matrix[2, 0] / a
    d = math.sqrt(matrix[1, 1] - b * b)
    e = (matrix[2, 1] - c * b) / d
    f = math.sqrt(matrix[2, 2] - c * c - e * e)
    u = right[0] / a
    v = (right[1] - b * u) / d
    w = (right[2] - c * u - e * v) / f
    x = np.empty(3)
    x[2] = w / f
    x[1] = (v - e * x[2]) / d
    x[0] = (u - b * x[1] - c * x[2]) / a
    return x
