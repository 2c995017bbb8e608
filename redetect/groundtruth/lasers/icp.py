"""Planar ICP: points to line segments, such as an outline or a building map, and scans to scans.

Each step pairs every point with the nearest target within a gate, keeps the best share of the pairs
and moves the points rigidly: onto segments by singular values (in the plane: in closed form), until
the root mean square error changes by less than a threshold; onto a scan by point-to-line distances.
Points are (n, 2); poses (x, y, theta) transform them to the target's frame (m, rad).

References
----------
P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", PAMI 14, 1992.
D. Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR 2002.
A. Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel
from redetect.plane import apply

# Most repetitions of the last gate in a match of scans, and its damping (a pair weighs up to 1), so
# that an undetermined direction keeps its start.
_REPEATED, _DAMPING = 10, 1e-3


@kernel()
def best_share(squared: FloatArray, gate_m: float, kept: float) -> BoolArray:
    """(n,) mask of squared distances (m^2) that are within the gate and in the best share."""
    within = squared <= gate_m * gate_m
    count = np.count_nonzero(within)
    if kept < 1.0 and count > 0:
        last = math.ceil(kept * count) - 1
        within &= squared <= np.sort(squared[within])[last]  # a partition takes longer to compile
    return within


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of a scan in the order of the beams, and the lines through them."""

    points: FloatArray  # (n, 2)
    normals: FloatArray  # (n, 2): of the lines; zeros if there is none

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def nearest(self, points: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared distances to the nearest of the scan's points, and their indices."""
        distance, index = self._tree.query(points)
        return distance**2, index


def scan_normals(points: FloatArray, radius_m: float, reach: int, spread: float) -> FloatArray:
    """Normals (n, 2) of lines through a scan's points in the order of the beams; zeros if none.

    The neighbours of a point are those of the `reach` points before and after that can be reached
    by steps no longer than `radius_m`. They form a line if there are three or more points, and
    their extent across it is at most `spread` times that along it.
    """
    at = np.arange(len(points))
    jumps = np.flatnonzero(np.hypot(*np.diff(points, axis=0).T) > radius_m)
    ends = np.concatenate([[-1], jumps, [len(points) - 1]])
    piece = np.searchsorted(ends, at)
    first = np.maximum(at - reach, ends[piece - 1] + 1)
    last = np.minimum(at + reach, ends[piece]) + 1
    count = (last - first).astype(np.float64)
    x, y = points.T
    sums = np.vstack([np.zeros(5), np.cumsum(np.stack([x, y, x * x, x * y, y * y], -1), axis=0)])
    mx, my, xx, xy, yy = ((sums[last] - sums[first]) / count[:, None]).T
    xx, xy, yy = xx - mx * mx, xy - mx * my, yy - my * my
    half, root = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    good = (count >= 3) & (np.maximum(half - root, 0.0) <= spread**2 * (half + root))
    return np.where(good[:, None], np.stack([-np.sin(along), np.cos(along)], axis=-1), 0.0)


def align_scans(
    points: FloatArray, target: Scan, start: ArrayLike, gates_m: ArrayLike, kept: float,
    threshold: float,
) -> FloatArray:  # fmt: skip
    """Pose of a scan's points in the frame of a target scan, from a start.

    Each step pairs every point with its nearest target point within the step's gate, keeps the best
    share, and minimises the linearised, robust squared distances to the targets' lines
    (to the points, at a tenth of the weight, if there is no line). The last gate is repeated
    until the pose moves by less than `threshold`. NaN if fewer than three pairs are left.
    """
    pose, gates = np.array(start, dtype=np.float64), np.atleast_1d(np.asarray(gates_m))
    for step, gate in enumerate([*gates, *np.repeat(gates[-1:], _REPEATED)]):
        world = apply(pose, points)
        squared, index = target.nearest(world)
        used = best_share(squared, gate, kept)
        if np.count_nonzero(squared <= gate * gate) < 3:
            return np.full(3, np.nan)
        off, lever = (world - target.points[index])[used], world[used] - pose[:2]
        normal = target.normals[index[used]]
        lone = ~np.any(normal != 0.0, axis=1)
        across = np.sum(normal * off, axis=1)
        error = np.concatenate([across[~lone], off[lone].ravel()])
        misfit = np.concatenate([across[~lone] ** 2, np.repeat(squared[used][lone], 2)])
        share = np.concatenate([np.ones(np.sum(~lone)), np.full(2 * np.sum(lone), 0.1)])
        normals = np.concatenate([normal[~lone], np.tile(np.eye(2), (int(np.sum(lone)), 1))])
        arms = np.concatenate([lever[~lone], np.repeat(lever[lone], 2, axis=0)])
        turn = normals[:, 1] * arms[:, 0] - normals[:, 0] * arms[:, 1]
        rows = np.column_stack([normals, turn])
        weighted = (share / (1.0 + misfit / (0.25 * gate * gate)))[:, None] * rows
        delta = -np.linalg.solve(rows.T @ weighted + _DAMPING * np.eye(3), weighted.T @ error)
        pose = pose + delta
        if step >= len(gates) - 1 and math.hypot(delta[0], delta[1]) + abs(delta[2]) < threshold:
            break
    return pose


def overlap_score(points: FloatArray, target: Scan, pose: FloatArray, sigma_m: float) -> float:
    """How well a pose explains both scans: mean over all points of exp(-d^2 / 2 sigma^2).

    d is the distance to the nearest point of the other scan. Both directions count; otherwise a
    pose that fits one scan to a small part of the other could win.
    """
    world = apply(pose, points)
    there, _ = target.nearest(world)
    back, _ = cKDTree(world).query(target.points)
    return float(np.mean(np.exp(-0.5 * np.concatenate([there, back**2]) / sigma_m**2)))


def face_normals(faces: FloatArray) -> FloatArray:
    """(k, 2) outward normals of counter-clockwise faces (k, 4)."""
    along = faces[:, 2:] - faces[:, :2]
    return np.asarray(np.stack([along[:, 1], -along[:, 0]], -1) / np.hypot(*along.T)[:, None])


@kernel()
def nearest_on_segments(
    points: FloatArray, segments: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Nearest points (n, 2) on (k, 4) segments x1, y1, x2, y2, the indices of these (of equally
    near ones the first), and squared distances.
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


@kernel()
def rigid_fit(points: FloatArray, target: FloatArray, used: BoolArray) -> FloatArray:
    """Pose (3,) of least squares of the used pairs, in closed form (Arun, Huang, Blostein 1987)."""
    # Plain loops: NumPy's sums and parts of arrays take seconds to compile.
    n, px, py, qx, qy = 0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(used)):
        if used[i]:
            n += 1
            px, py = px + points[i, 0], py + points[i, 1]
            qx, qy = qx + target[i, 0], qy + target[i, 1]
    if n == 0:
        return np.full(3, np.nan)
    px, py, qx, qy = px / n, py / n, qx / n, qy / n
    dot = cross = 0.0
    for i in range(len(used)):
        if used[i]:
            ax, ay = points[i, 0] - px, points[i, 1] - py
            bx, by = target[i, 0] - qx, target[i, 1] - qy
            dot += ax * bx + ay * by
            cross += ax * by - ay * bx
    theta = math.atan2(cross, dot)
    c, s = math.cos(theta), math.sin(theta)
    return np.array([qx - (c * px - s * py), qy - (s * px + c * py), theta])


@kernel()
def moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points transformed by a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    there = np.empty((len(points), 2))
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        there[i, 0], there[i, 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
    return there


@kernel()
def fit_outline(
    points: FloatArray, faces: FloatArray, start: FloatArray, gate_m: float, kept: float,
    threshold_m: float, most_steps: int,
) -> tuple[FloatArray, float, int]:  # fmt: skip
    """Trimmed ICP that moves segments onto points: pose, rms error, number of pairs used."""
    pose = start.copy()
    before = np.inf
    step = 0
    while True:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        back = np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])
        nearest, _, squared = nearest_on_segments(moved(points, back), faces)
        near = int(np.count_nonzero(squared <= gate_m * gate_m))
        if near < 3:
            return pose, np.inf, near
        used = best_share(squared, gate_m, kept)
        count = int(np.count_nonzero(used))
        total = 0.0
        for i in range(len(squared)):
            if used[i]:
                total += squared[i]
        rms = math.sqrt(total / count)
        if abs(before - rms) < threshold_m or step == most_steps:
            return pose, rms, count
        before = rms
        pose = rigid_fit(nearest, points, used)
        step += 1
