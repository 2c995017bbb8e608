"""Planar ICP: points to line segments, such as an outline or a building map, and scans to scans.

Each step pairs every point with the nearest target within a gate, keeps the best share of the pairs
and moves the points rigidly: onto segments by singular values (in the plane: in closed form), until
the root mean square error changes by less than a threshold; onto a scan by the distances to its
lines. Points are (n, 2), poses (x, y, theta) that take the points to the target's frame (m, rad).

References
----------
P. J. Besl, N. D. McKay, "A method for registration of 3-D shapes", PAMI 14, 1992.
D. Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR 2002.
A. Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.special import ndtri

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.compiled import kernel
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.plane import apply, invert
from redetect.storage.bounds import Positive, ShareAbove0, demand_fields

_MOST_STEPS = 500
# How often the last gate of a match of scans is repeated at most, and its damping: a millimetre's
# worth, so that a direction without evidence stays where it is.
_REPEATED, _DAMPING = 10, 1e-3


@dataclass(frozen=True)
class IcpSettings:
    """Settings of an ICP."""

    gate_m: Positive = 0.2  # Pairs farther apart than this do not count (m)
    kept: ShareAbove0 = 0.95  # Share of the pairs within the gate that counts: the best
    # The ICP ends when the root mean square error changes by less than this (m)
    threshold_m: Positive = 1e-7
    # A direction is undetermined if the pose's standard deviation along it is larger than this (m;
    # a rotation counts by what it does to the points, root mean square).
    weak_sigma_m: Positive = 0.05

    def __post_init__(self) -> None:
        demand_fields(self, GroundTruthError)


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Where an ICP ended."""

    pose: FloatArray  # (3,): x, y (m), theta (rad): takes the points to the target's frame
    # (3, 3): of the pose, from the residuals' size and the geometry; infinite on the diagonal where
    # the geometry determines nothing at all.
    covariance: FloatArray
    rms_m: float  # Root mean square distance of the pairs that count
    used: BoolArray  # (n,): which points count
    # (k, 3): directions of (x, y, theta) that the geometry leaves open, of unit length with theta
    # measured by what it does to the points; k is 0 for a good pose.
    undetermined: FloatArray


def icp_to_segments(
    points: ArrayLike,
    segments: ArrayLike,
    start: ArrayLike = (0.0, 0.0, 0.0),
    settings: IcpSettings | None = None,
) -> IcpResult:
    """Align points with line segments: an outline, a building map.

    `points` (n, 2): to be moved (m). `segments` (k, 4): x1, y1, x2, y2 (m). `start` (3,): pose to
    start from.
    """
    s = IcpSettings() if settings is None else settings
    lines = np.ascontiguousarray(segments, dtype=np.float64)
    cloud = np.ascontiguousarray(points, dtype=np.float64)
    found, rms, count = fit_outline(
        cloud, lines, invert(start), s.gate_m, s.kept, s.threshold_m, _MOST_STEPS
    )
    if count < 3:
        raise GeometryError(
            f"{count} of {len(cloud)} points within {s.gate_m:g} m of the target: "
            "expected 3 or more"
        )
    pose = invert(found)
    world = moved(cloud, pose)
    target, index, squared = nearest_on_segments(world, lines)
    used = best_share(squared, s.gate_m, s.kept)
    along = lines[:, 2:] - lines[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    normals = (
        np.stack([-along[:, 1], along[:, 0]], -1) / np.where(length > 0.0, length, 1.0)[:, None]
    )
    covariance, undetermined = pose_uncertainty(
        pose, world[used], target[used], normals[index[used]], s.kept, s.weak_sigma_m
    )
    return IcpResult(pose, covariance, rms, used, undetermined)


def trimmed_variance(kept: float) -> tuple[float, float]:
    """Factors of variances due to keeping only the best share of Gaussian residuals.

    With the cut c at +-c sigma and phi the normal density, both follow from
    v = kept - 2 c phi(c), the part of the variance within the cut, which is also the derivative of
    the estimating equation: shrinkage v / kept, variance v / v^2 per residual, kept or not.

    Returns `shrinkage`: variance of the residuals kept, relative to all. `inflation`: variance of a
    mean of those kept by their own distance from it, relative to the mean of as many residuals as
    were kept.
    """
    if kept >= 1.0:
        return 1.0, 1.0
    cut = float(ndtri(0.5 * (1.0 + kept)))
    inside = kept - 2.0 * cut * math.exp(-0.5 * cut * cut) / math.sqrt(2.0 * math.pi)
    return inside / kept, kept / inside


def best_share(squared: FloatArray, gate_m: float, kept: float) -> BoolArray:
    """Which of (n,) squared distances (m^2) are within the gate and among the best share."""
    within = np.asarray(squared <= gate_m * gate_m)
    count = int(within.sum())
    if kept < 1.0 and count > 0:
        last = math.ceil(kept * count) - 1
        within &= squared <= np.partition(squared[within], last)[last]
    return within


def pose_uncertainty(
    pose: FloatArray,
    world: FloatArray,
    target: FloatArray,
    normals: FloatArray,
    kept: float,
    weak_sigma_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Covariance (3, 3) of a converged pose, and the directions (k, 3) that are open.

    From points in the world and those they are paired with, with normals of these (zeros where a
    point is on no line); of the pairs the best share was kept.
    """
    lever = world - pose[:2]
    rows = np.column_stack([normals, normals[:, 1] * lever[:, 0] - normals[:, 0] * lever[:, 1]])
    residual = np.sum(normals * (world - target), axis=1)
    freedom = max(int(np.any(normals != 0.0, axis=1).sum()) - 3, 1)
    shrinkage, inflation = trimmed_variance(kept)
    variance = float(residual @ residual) / freedom / shrinkage
    # Exactly fitting points do not make a pose exact to less than rounding.
    information = rows.T @ rows / max(variance * inflation, 1e-18)
    # About the middle of the points, where rotation and translation are least correlated; a
    # rotation counts by what it does to the points.
    middle = lever.mean(axis=0)
    scale_m = max(math.sqrt(float(np.mean(np.sum((lever - middle) ** 2, axis=1)))), 1e-9)
    shift = np.array([[1.0, 0.0, middle[1]], [0.0, 1.0, -middle[0]], [0.0, 0.0, 1.0]])
    shift[:, 2] /= scale_m
    values, vectors = np.linalg.eigh(shift.T @ information @ shift)
    undetermined = np.asarray(vectors[:, values < 1.0 / weak_sigma_m**2].T)
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 1e-12 * values[2]:
        return np.diag(np.full(3, np.inf)), undetermined
    return np.asarray((vectors / values) @ vectors.T), undetermined


class Scan:
    """Points of a scan in the order of the beams, and the lines through them.

    Attributes
    ----------
    points : (n, 2) float64
    normals : (n, 2) float64
        Of the lines; zeros where there is none.
    """

    def __init__(self, points: FloatArray, normals: FloatArray) -> None:
        self.points, self.normals = points, normals
        self._tree = cKDTree(points)

    def nearest(self, points: FloatArray) -> tuple[FloatArray, IntArray]:
        """Squared distances to the nearest of the scan's points, and which they are."""
        distance, index = self._tree.query(points)
        return distance**2, index


def scan_normals(points: FloatArray, radius_m: float, reach: int, spread: float) -> FloatArray:
    """Normals (n, 2) of lines through a scan's points in the order of the beams; zeros without.

    The neighbours of a point are those of the `reach` points before and after that can be reached
    by steps no longer than `radius_m`. They are on a line if there are three or more and their
    extent across is at most `spread` of that along.
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
    share, and solves the linearised, robust least squares of the distances to the targets' lines
    (to the points, at a tenth of the weight, where there is no line). The last gate is repeated
    until the pose moves by less than `threshold`. NaN where fewer than three pairs are left.
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


def explained(points: FloatArray, target: Scan, pose: FloatArray, sigma_m: float) -> float:
    """How well a pose explains both scans: mean over all points of exp(-d^2 / 2 sigma^2).

    d is the distance to the nearest point of the other scan; both directions count, so that a pose
    which lays one scan on a small part of the other does not win.
    """
    world = apply(pose, points)
    there, _ = target.nearest(world)
    back, _ = cKDTree(world).query(target.points)
    return float(np.mean(np.exp(-0.5 * np.concatenate([there, back**2]) / sigma_m**2)))


@kernel()
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


@kernel()
def rigid_fit(points: FloatArray, target: FloatArray, used: BoolArray) -> FloatArray:
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


@kernel()
def moved(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Points taken by a pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out = np.empty_like(points)
    for i in range(points.shape[0]):
        out[i, 0] = pose[0] + c * points[i, 0] - s * points[i, 1]
        out[i, 1] = pose[1] + s * points[i, 0] + c * points[i, 1]
    return out


@kernel()
def fit_outline(
    points: FloatArray,
    faces: FloatArray,
    start: FloatArray,
    gate_m: float,
    kept: float,
    threshold_m: float,
    most_steps: int,
) -> tuple[FloatArray, float, int]:
    """Trimmed ICP of segments to points: pose, root mean square error, pairs used.

    The pose takes the segments to the points.
    """
    pose = start.copy()
    before = np.inf
    rms, count, step = np.inf, 0, 0
    used = np.zeros(points.shape[0], dtype=np.bool_)
    while True:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        back = np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])
        nearest, _, squared = nearest_on_segments(moved(points, back), faces)
        limit = gate_m * gate_m
        within = squared[squared <= limit]
        if within.size < 3:
            return pose, np.inf, within.size
        within.sort()
        limit = within[math.ceil(kept * within.size) - 1]
        total, count = 0.0, 0
        for i in range(points.shape[0]):
            used[i] = squared[i] <= limit
            if used[i]:
                total += squared[i]
                count += 1
        rms = math.sqrt(total / count)
        if abs(before - rms) < threshold_m or step == most_steps:
            return pose, rms, count
        before = rms
        pose = rigid_fit(nearest, points, used)
        step += 1
