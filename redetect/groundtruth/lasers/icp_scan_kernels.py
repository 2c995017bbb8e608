"""Kernels that match two scans: normals, point-to-line steps, and how well a pose explains both."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from redetect.groundtruth.lasers.icp_kernels import moved, nearest_points, solve3

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@njit(cache=True, error_model="numpy")
def scan_normals(
    points: FloatArray, radius_m: float, reach: int, spread: float
) -> tuple[FloatArray, BoolArray]:
    """Normals (n, 2) of a scan's points in the order of the beams, and which of them are good.

    The neighbours of a point are those of the `reach` points before and after that can be
    reached by steps no longer than `radius_m`; the normal is their direction of least extent.

    It is good where there are three or more and their extent across is at most `spread` of that
    along.
    """
    count = points.shape[0]
    normals = np.zeros((count, 2))
    good = np.zeros(count, dtype=np.bool_)
    for i in range(count):
        first = i
        while first > 0 and i - first < reach:
            dx = points[first - 1, 0] - points[first, 0]
            dy = points[first - 1, 1] - points[first, 1]
            if dx * dx + dy * dy > radius_m * radius_m:
                break
            first -= 1
        last = i
        while last < count - 1 and last - i < reach:
            dx = points[last + 1, 0] - points[last, 0]
            dy = points[last + 1, 1] - points[last, 1]
            if dx * dx + dy * dy > radius_m * radius_m:
                break
            last += 1
        n = last - first + 1
        if n < 3:
            continue
        mx = my = 0.0
        for k in range(first, last + 1):
            mx += points[k, 0]
            my += points[k, 1]
        mx, my = mx / n, my / n
        xx = xy = yy = 0.0
        for k in range(first, last + 1):
            ax, ay = points[k, 0] - mx, points[k, 1] - my
            xx += ax * ax
            xy += ax * ay
            yy += ay * ay
        half = 0.5 * (xx + yy)
        root = math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        along = 0.5 * math.atan2(2.0 * xy, xx - yy)
        normals[i, 0], normals[i, 1] = -math.sin(along), math.cos(along)
        good[i] = max(half - root, 0.0) <= spread * spread * (half + root)
    return normals, good


@njit(cache=True, error_model="numpy")
def align_scans(
    points: FloatArray,
    target: FloatArray,
    normals: FloatArray,
    good: BoolArray,
    start: FloatArray,
    gates_m: FloatArray,
    kept: float,
    threshold: float,
) -> tuple[FloatArray, float, int]:
    """Pose of a scan in the frame of a target scan, from a start.

    Each step pairs every point with its nearest target point within the step's gate, keeps the
    best share `kept`, and solves the linearised least squares of the distances to the targets'
    lines (to the points where there is no line). The last gate is repeated until the pose moves
    by less than `threshold`.

    Returns the pose, the share of points paired and the number of steps; NaN when fewer
    than three pairs are left or they leave the pose undetermined.
    """
    pose = start.copy()
    share = 0.0
    extra = 10
    for step in range(gates_m.shape[0] + extra):
        gate = gates_m[min(step, gates_m.shape[0] - 1)]
        world = moved(points, pose)
        index, squared = nearest_points(world, target)
        limit = gate * gate
        within = squared[squared <= limit]
        share = within.size / points.shape[0]
        if within.size < 3:
            return np.full(3, np.nan), 0.0, step
        if kept < 1.0:
            within.sort()
            limit = min(limit, within[math.ceil(kept * within.size) - 1])
        scale2 = 0.25 * gate * gate
        a = np.zeros((3, 3))
        b = np.zeros(3)
        for i in range(points.shape[0]):
            if squared[i] > limit:
                continue
            j = index[i]
            dx, dy = world[i, 0] - target[j, 0], world[i, 1] - target[j, 1]
            lx, ly = world[i, 0] - pose[0], world[i, 1] - pose[1]
            if good[j]:
                nx, ny = normals[j, 0], normals[j, 1]
                e = nx * dx + ny * dy
                w = 1.0 / (1.0 + e * e / scale2)
                t = ny * lx - nx * ly
                a[0, 0] += w * nx * nx
                a[1, 0] += w * nx * ny
                a[1, 1] += w * ny * ny
                a[2, 0] += w * t * nx
                a[2, 1] += w * t * ny
                a[2, 2] += w * t * t
                b[0] -= w * e * nx
                b[1] -= w * e * ny
                b[2] -= w * e * t
            else:
                w = 0.1 / (1.0 + (dx * dx + dy * dy) / scale2)
                a[0, 0] += w
                a[1, 1] += w
                a[2, 0] -= w * ly
                a[2, 1] += w * lx
                a[2, 2] += w * (lx * lx + ly * ly)
                b[0] -= w * dx
                b[1] -= w * dy
                b[2] -= w * (lx * dy - ly * dx)
        # A millimetre's worth of damping: a direction without evidence stays where it is.
        for k in range(3):
            a[k, k] += 1e-3
        delta = solve3(a, b)
        if not math.isfinite(delta[0] + delta[1] + delta[2]):
            return np.full(3, np.nan), 0.0, step
        pose = pose + delta
        moved_by = math.sqrt(delta[0] ** 2 + delta[1] ** 2) + abs(delta[2])
        if step >= gates_m.shape[0] - 1 and moved_by < threshold:
            break
    return pose, share, step + 1


@njit(cache=True, error_model="numpy")
def explained(points: FloatArray, target: FloatArray, pose: FloatArray, sigma_m: float) -> float:
    """How well a pose explains both scans: mean over all points of exp(-d^2 / 2 sigma^2).

    d is the distance to the nearest point of the other scan; both directions count, so that a pose
    which lays one scan on a small part of the other does not win.
    """
    world = moved(points, pose)
    scale = -0.5 / (sigma_m * sigma_m)
    total = 0.0
    _, squared = nearest_points(world, target)
    for i in range(squared.size):
        total += math.exp(scale * squared[i])
    _, squared = nearest_points(target, world)
    for i in range(squared.size):
        total += math.exp(scale * squared[i])
    return float(total / (points.shape[0] + target.shape[0]))
