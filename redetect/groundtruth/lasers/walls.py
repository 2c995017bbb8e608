"""Scans of an area at rest, and the pose of scanners from the walls of the building.

Drawings differ from buildings by centimetres. Scanners would fit the few walls that they see too
well, and readings of the others would look like those of objects. So the walls' offsets from the
map are estimated with the poses of all fixed scanners.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.landmarks import wrap_angle
from redetect.plane import compose, pose_differences, rotation

#: Least joint standard deviation of readings, wall and map (m).
FLOOR_M = 0.001
# Of the fit of scanners to the map: the gate of readings, the lower bound of the cosine between
# beam and normal, and the fewest readings.
_GATE_SIGMA, _LEAST_COSINE, _LEAST_READINGS = 3.0, 0.25, 10
# Standard deviations of the walls' offsets that are tried, what is assumed while the gate narrows
# (m), the least decrease of the deviance by walls that are off, and the largest factor on the
# covariance where few walls determine it.
_MAP_SIGMAS_M, _LIKELY_MAP_SIGMA_M = np.geomspace(1e-4, 0.3, 80), 0.02
_MAP_EVIDENCE, _MOST_INFLATED = 7.0, 9.0
# If few walls are seen, they do not show whether they are off: what is assumed then (m), and the
# least increase of the deviance that refutes it.
_USUAL_MAP_SIGMA_M, _REFUTED = 0.01, 4.0
# Steps at each gate, most steps afterwards, and the change (m, rad) that ends them.
_STEPS_PER_GATE, _MOST_STEPS, _SETTLED = 3, 15, 1e-6
_SIGMA_PER_MEDIAN = 1.4826  # Of a normal distribution
# Of the grid of starts: standard deviations from the measured pose, number of readings, largest
# cost of that deviation, and the difference (m, rad) up to which poses are the same.
_START_SIGMAS, _COARSE_READINGS, _LARGEST_PRIOR_COST, _SAME_POSE = 1.5, 240, 50.0, 2e-3
# Walls farther than this from what scanners at their measured poses see are ignored (m).
_AROUND_M = 5.0
# Change of a mount (m, rad) for derivatives.
_DIFFERENCE = 1e-5
# Neighbouring walls are chords of a curve that leaves them by less than this (m), and turns by less
# (rad) from one to the next; ends this close are the same corner (m).
BULGE_M, _MOST_TURN, _SAME_CORNER_M = 0.003, 0.6, 1e-4
# Largest correlation of the offsets of a curve's chords, and the distance in which it falls (m).
_LARGEST_CORRELATION, _CORRELATION_LENGTH_M = 0.99, 3.0
# A direction that only this many readings determine is undetermined.
_FEW_READINGS = 3
# Away from a pose: joint standard deviation (m), and share of the prior that holds a pose there.
_WIDE_M, _HELD = 0.3, 1e-3
# Length (m) that a turn of a radian corresponds to, where directions are compared.
_TURN_ARM_M = 3.0


class AveragedScan(NamedTuple):
    """Readings of a scanner while nothing moves, averaged beam by beam."""

    range_m: FloatArray  # (n,)
    direction: FloatArray  # (n, 2): of the beams, in the scanner's frame
    sigma_m: float  # Standard deviation of an averaged reading

    @property
    def points(self) -> FloatArray:
        """(n, 2) points in the scanner's frame, in the order of the beams (m)."""
        return self.range_m[:, None] * self.direction


def averaged_scan(scanner: Scanner, ranges_mm: NDArray[np.uint16]) -> AveragedScan:
    """Average scans (N, readings) in which nothing moves.

    Without beams that have no reading in half of the scans or jump along an edge, and readings far
    from a beam's median, of passing objects.
    """
    metres = scanner.metres(ranges_mm)
    readings = np.isfinite(metres).sum(axis=0)
    usable = readings >= max(1.0, 0.5 * len(ranges_mm))
    median = np.full(scanner.readings, np.nan)
    median[usable] = np.nanmedian(metres[:, usable], axis=0)
    close = np.abs(metres - median) < 4.0 * max(scanner.sigma_m, 0.005)
    count = close.sum(axis=0)
    usable &= count >= 0.8 * readings
    mean = np.where(close, metres, 0.0).sum(axis=0)[usable] / count[usable]
    angle = scanner.angles_rad[usable]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    averaged = float(np.median(count[usable])) if usable.any() else 1.0
    return AveragedScan(mean, direction, max(scanner.sigma_m, 0.003) / math.sqrt(averaged))


def first_walls(
    origin: FloatArray, directions: FloatArray, walls: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Distances (N,), infinite if there is none, and indices (N,) of the walls (S, 4) that rays
    from a point first meet in `directions` (N, 2), unit vectors; cosines (N,) of the incidence.
    """
    start, along = walls[:, :2] - origin, walls[:, 2:] - walls[:, :2]
    across = directions[:, :1] * along[:, 1] - directions[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
        part = (start[:, 0] * directions[:, 1:] - start[:, 1] * directions[:, :1]) / across
    far = np.where((far > 0.0) & (part >= 0.0) & (part <= 1.0), far, np.inf)
    rows, first = np.arange(len(directions)), np.argmin(far, axis=1)
    cosines = np.abs(across[rows, first]) / np.hypot(*along[first].T)
    return far[rows, first], first, cosines


def walls_near(walls: FloatArray, poses: FloatArray, reach_m: float) -> FloatArray:
    """The walls (S, 4) that scanners at poses (N, 3) may see; drawings may show a whole city."""
    around = reach_m + _AROUND_M
    low, high = poses[:, :2].min(axis=0) - around, poses[:, :2].max(axis=0) + around
    ends = walls.reshape(-1, 2, 2)
    return walls[np.all((ends.max(axis=1) > low) & (ends.min(axis=1) < high), axis=1)]


class WallCurves(NamedTuple):
    """Which of S walls are chords of curves."""

    bends: FloatArray  # (S, 2): angles from walls to the curve at both ends (rad); 0 if straight
    curve: IntArray  # (S,): equal for walls of the same curve


def wall_curves(walls: FloatArray, bulge_m: float = BULGE_M) -> WallCurves:
    """Chords among walls (S, 4): similar neighbours, from which their curve bulges by less.

    Otherwise their corners would be features that fix how scanners in a round hall are turned.
    """
    along, count = walls[:, 2:] - walls[:, :2], len(walls)
    pairs = cKDTree(walls.reshape(-1, 2)).query_pairs(_SAME_CORNER_M, output_type="ndarray")
    # Corners of exactly two walls.
    pairs = pairs[np.all(np.bincount(pairs.ravel(), minlength=2 * count)[pairs] == 1, axis=1)]
    side, end = np.divmod(pairs, 2)
    # From the first wall through the corner to the second.
    x, y = np.moveaxis(along[side] * np.where(end == [1, 0], 1, -1)[..., None], -1, 0)
    turn = np.arctan2(x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1], x[:, 0] * x[:, 1] + y[:, 0] * y[:, 1])
    length = np.hypot(*along.T)[side]
    total = np.maximum(length.sum(axis=1), 1e-9)
    chords = (np.abs(turn) * total < 16.0 * bulge_m) & (np.abs(turn) < _MOST_TURN)
    chords &= total < 4.0 * length.min(axis=1)
    bends, side = np.full((count, 2), np.nan), side[chords]
    bends[side, end[chords]] = ([1.0, -1.0] * length * (turn / total)[:, None])[chords]
    # The last chord is as bent at its other end.
    bends = np.nan_to_num(np.where(np.isnan(bends), -bends[:, ::-1], bends))
    joined = csr_array((np.ones(len(side)), side.T), shape=(count, count))
    return WallCurves(bends, connected_components(joined, directed=False)[1])


class MapFit(NamedTuple):
    """Poses of scanners, or of a body with scanners, on a map whose walls may be off."""

    poses: FloatArray  # (poses, 3)
    covariance: FloatArray  # (3 poses, 3 poses): jointly
    # Standard deviation of the offsets of the walls' ends: 0 if exact, a usual one if few walls are
    # seen.
    map_sigma_m: float
    used: IntArray  # (poses,): number of readings on walls
    rms_m: FloatArray  # (poses,): of their distances from the walls
    undetermined_directions: IntArray  # (poses,): number of directions that walls do not determine
    by_mounts: FloatArray  # (3, 3 scanners): derivative of a body's pose by its scanners' mounts


class _OnWalls(NamedTuple):
    """Readings of scanners that lie on walls of a map, at given poses."""

    cost: float  # Squared normalised distances of all readings, those of others as at the gate
    body: IntArray  # (N,): index of the pose
    wall: IntArray  # (N,)
    share: FloatArray  # (N,): of the wall's length, from its first end
    error_m: FloatArray  # (N,): distances from the walls
    rest_m: FloatArray  # (N,): from the walls moved by their offsets
    weight: FloatArray  # (N,): inverse variances
    by_pose: FloatArray  # (N, 3): derivatives of the distances by the pose


class _Solution(NamedTuple):
    """Least squares of poses and the offsets of walls, at one linearisation."""

    step: FloatArray  # (poses, 3)
    offsets_m: FloatArray  # (S, 2)
    map_sigma_m: float
    covariance: FloatArray  # (3 poses, 3 poses)


class MapProblem(NamedTuple):
    """Scanners at rest on a map whose walls may be off.

    Readings of a wall share its error: the offsets of each wall's two ends, along its normal, are
    unknowns of the same adjustment, with a standard deviation that is estimated as well. All
    scanners are fitted together, since they see the same walls.
    """

    scans: Sequence[AveragedScan]  # One of each scanner
    measured: FloatArray  # (poses, 3): measured by hand
    prior: FloatArray  # (3 poses, 3 poses): information of the measured poses
    walls: FloatArray  # (S, 4): pieces of wall, seen from both sides (m)
    curves: WallCurves  # Which of them are chords
    mounts: FloatArray | None = None  # (scanners, 3): on one body, the only pose; else no body

    def fit(self, starts: FloatArray, narrowing_m: Sequence[float], weak_sigma_m: float) -> MapFit:
        """The most likely poses near starts.

        Parameters
        ----------
        starts : (poses, 3) float64
            Where the fit begins.
        narrowing_m : sequence of float
            Joint standard deviations of readings and walls as the fit narrows; readings farther
            away than three of them are rejected.
        weak_sigma_m : float
            Directions along which the readings leave a larger standard deviation are undetermined.

        Raises
        ------
        GeometryError
            If fewer than ten readings match walls.
        """
        poses, offsets, _ = self.narrowed(starts, narrowing_m)
        # Walls are not straight to a millimetre everywhere.
        usual = np.median(np.abs(self._on_walls(poses, offsets, min(narrowing_m)).rest_m))
        floor = max(FLOOR_M, _SIGMA_PER_MEDIAN * float(usual))
        for _ in range(_MOST_STEPS):
            on = self._on_walls(poses, offsets, floor)
            found = self._solved(on, poses, None)
            poses, offsets = poses + found.step, found.offsets_m
            if np.abs(found.step).max() < _SETTLED:
                break
        # Again with the weights that the residuals suggest.
        ratio = float(np.sum(on.weight * on.rest_m**2)) / max(len(on.rest_m) - poses.size, 1)
        on = on._replace(weight=on.weight / max(ratio, 0.1))
        scale, parts = np.array([1.0, 1.0, _TURN_ARM_M]), range(0, poses.size, 3)
        for k in range(len(poses)):  # Few readings may match a small object by chance.
            own = np.flatnonzero(on.body == k)
            rows = on.by_pose[own] / scale * np.sqrt(on.weight[own])[:, None]
            share = (rows @ np.linalg.eigh(rows.T @ rows)[1][:, 0]) ** 2
            few = np.argsort(share)[-_FEW_READINGS:]
            if share.sum() - share[few].sum() < 1.0 / weak_sigma_m**2:
                on.weight[own[few]] = 0.0
        found = self._solved(on, poses, None)
        poses, offsets = poses + found.step, found.offsets_m
        used = np.bincount(on.body, minlength=len(poses))
        squares = np.bincount(on.body, weights=on.rest_m**2, minlength=len(poses))
        by_mounts = []
        for change in _DIFFERENCE * np.eye(0 if self.mounts is None else self.mounts.size):
            moved = self._replace(mounts=self.mounts + change.reshape(-1, 3))
            on = moved._on_walls(poses, offsets, floor)
            by_mounts.append(self._solved(on, poses, found.map_sigma_m).step.ravel() / _DIFFERENCE)
        of_readings = [
            np.linalg.inv(found.covariance[k : k + 3, k : k + 3]) - self.prior[k : k + 3, k : k + 3]
            for k in parts
        ]
        values = np.linalg.eigvalsh(np.array(of_readings) / np.outer(scale, scale))
        rms, undetermined = np.sqrt(squares / np.maximum(used, 1)), values < 1.0 / weak_sigma_m**2
        covariance, of_mounts = found.covariance, np.array(by_mounts).T
        if undetermined.any():
            covariance = covariance + self._by_curvature(poses, offsets, found)
        poses[:, 2] = wrap_angle(poses[:, 2])
        return MapFit(
            poses, covariance, found.map_sigma_m, used, rms, undetermined.sum(axis=1), of_mounts
        )

    def _by_curvature(self, poses: FloatArray, offsets: FloatArray, found: _Solution) -> FloatArray:
        """(3 poses, 3 poses) covariance since poses that fit are on a curve, as in a round hall."""
        parts = range(0, poses.size, 3)
        values, vectors = np.linalg.eigh([found.covariance[k : k + 3, k : k + 3] for k in parts])
        far, off = np.sqrt(values[:, -1:]) * vectors[:, :, -1], np.zeros_like(poses)
        for at in (poses + far, poses - far):
            there = self._replace(measured=at, prior=_HELD * self.prior)
            with suppress(GeometryError):
                on = there._on_walls(at, offsets, _WIDE_M)
                off += 0.5 * there._solved(on, at, found.map_sigma_m).step
        # The fourth moment of a normal distribution.
        return np.asarray(block_diag(*(3.0 * np.outer(one, one) for one in off)))

    def likely_pose(
        self, aligned: FloatArray, narrowing_m: Sequence[float]
    ) -> tuple[FloatArray, FloatArray]:
        """The pose (3,) near which readings and measured pose of the only scanner are most likely.

        From a grid of starts around the measured pose, and the one by which it is `aligned` with
        others (3,). Also returns the covariance (3, 3) of other places that are about as likely.
        """
        scan, measured = self.scans[0], self.measured[0]
        every = max(1, len(scan.range_m) // _COARSE_READINGS)
        thin = AveragedScan(scan.range_m[::every], scan.direction[::every], scan.sigma_m)
        coarse = self._replace(scans=[thin])
        wide = _START_SIGMAS / np.sqrt(np.diag(self.prior))
        grid = [measured + wide * shift for shift in product((0.0, -1.0, 1.0), repeat=3)]
        found: list[tuple[float, FloatArray]] = []
        for start in (aligned, *grid):
            with suppress(GeometryError):
                poses, _, cost = coarse.narrowed(start[None], narrowing_m)
                off = [np.abs(pose_differences(poses[0], other)).max() for _, other in found]
                if min(off, default=np.inf) > _SAME_POSE:
                    found.append((cost, poses[0]))
        if not found:
            raise GeometryError("hardly any readings lie on the map")
        best, pose = min(found, key=lambda entry: entry[0])
        weights = np.exp([0.5 * (best - cost) for cost, _ in found])
        apart = pose_differences(np.stack([other for _, other in found]), pose)
        return pose, (weights[:, None] * apart).T @ apart / weights.sum()

    def narrowed(
        self, starts: FloatArray, narrowing_m: Sequence[float]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Poses, offsets of the walls' ends, and cost, as the gate of readings narrows."""
        poses, offsets, cost = starts, np.zeros((len(self.walls), 2)), math.inf
        for floor in np.repeat(narrowing_m, _STEPS_PER_GATE):
            on = self._on_walls(poses, offsets, floor)
            # Walls may be off meanwhile, or what is on them would be rejected.
            likely = min(floor, _LIKELY_MAP_SIGMA_M)
            found = self._solved(on, poses, likely)
            poses, offsets = poses + found.step, found.offsets_m
            missing = pose_differences(poses, self.measured).ravel()
            cost = on.cost + float(np.sum(offsets**2)) / likely**2
            cost += min(float(missing @ self.prior @ missing), _LARGEST_PRIOR_COST)
        return poses, offsets, cost

    def _on_walls(self, poses: FloatArray, offsets_m: FloatArray, floor_m: float) -> _OnWalls:
        """Readings on the walls that their beams meet first, moved by `offsets_m` (S, 2)."""
        found: list[list[NDArray[Any]]] = []
        cost = 0.0
        for k, scan in enumerate(self.scans):
            body = k if self.mounts is None else 0
            pose = poses[body] if self.mounts is None else compose(poses[0], self.mounts[k])
            rays = scan.direction @ rotation(pose[2]).T
            far, first, cosines = first_walls(pose[:2], rays, self.walls)
            along = self.walls[first, 2:] - self.walls[first, :2]
            length = np.hypot(*along.T)
            normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / length[:, None]
            points = pose[:2] + scan.range_m[:, None] * rays
            apart, arm = points - self.walls[first, :2], points - poses[body, :2]
            share = np.clip(np.sum(apart * along, axis=1) / length**2, 0.0, 1.0)
            # A cubic from end to end, by its bends: height and slope.
            t, bends = share[:, None], self.curves.bends[first]
            height = np.sum(bends * t * (1.0 - t) * np.hstack([1.0 - t, -t]), axis=1) * length
            slope = np.sum(bends * np.hstack([(1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0)]), 1)
            error = np.sum(apart * normal, axis=1) - height
            normal = normal - (slope / length)[:, None] * along
            rest = error - (1.0 - share) * offsets_m[first, 0] - share * offsets_m[first, 1]
            weight = 1.0 / ((scan.sigma_m * np.maximum(cosines, _LEAST_COSINE)) ** 2 + floor_m**2)
            squared = np.where(np.isfinite(far), weight * rest**2, np.inf)
            cost += float(np.sum(np.minimum(squared, _GATE_SIGMA**2)))
            turn = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
            rows = (np.full(len(first), body), first, share, error, rest, weight)
            near = squared < _GATE_SIGMA**2
            found.append([v[near] for v in (*rows, np.column_stack([normal, turn]))])
        columns = [np.concatenate(column) for column in zip(*found)]
        if (used := len(columns[0])) < _LEAST_READINGS:
            raise GeometryError(
                f"{used} readings lie on the map: expected {_LEAST_READINGS} or more"
            )
        return _OnWalls(cost, *columns)

    def _solved(self, on: _OnWalls, poses: FloatArray, map_sigma_m: float | None) -> _Solution:
        """Solve for poses and offsets of the seen walls; without `map_sigma_m`, for that too."""
        seen, index = np.unique(on.wall, return_inverse=True)
        count, rows = poses.size, np.arange(len(on.error_m))
        columns = [*(3 * on.body + c for c in range(3)), count + 2 * index, count + 2 * index + 1]
        jacobian = np.zeros((len(rows), count + 2 * len(seen)))
        jacobian[rows, columns] = *on.by_pose.T, on.share - 1.0, -on.share
        weighted = on.weight[:, None] * jacobian
        h, g = jacobian.T @ weighted, weighted.T @ on.error_m
        root = np.linalg.cholesky(self._offset_correlations(seen))
        h[count:], g[count:] = root.T @ h[count:], root.T @ g[count:]
        h[:, count:] = h[:, count:] @ root
        own = np.linalg.inv(h[:count, :count] + self.prior)
        of_poses = own @ (g[:count] + self.prior @ pose_differences(poses, self.measured).ravel())
        by_offsets = own @ h[:count, count:]
        rest = h[count:, count:] - h[count:, :count] @ by_offsets
        gradient = g[count:] - h[count:, :count] @ of_poses
        inflation = 1.0
        if map_sigma_m is None:
            map_sigma_m, inflation = _map_sigma(rest, gradient)
        of_offsets = np.linalg.inv(rest + np.eye(len(rest)) / max(map_sigma_m, 1e-6) ** 2)
        offsets = np.zeros((len(self.walls), 2))
        apart = -of_offsets @ gradient
        offsets[seen] = (root @ apart).reshape(-1, 2)
        step = -of_poses - by_offsets @ apart
        covariance = own + inflation * by_offsets @ of_offsets @ by_offsets.T
        return _Solution(step.reshape(-1, 3), offsets, map_sigma_m, covariance)

    def _offset_correlations(self, seen: IntArray) -> FloatArray:
        """(2 s, 2 s) correlation of the offsets of s walls' ends: of neighbours on a curve."""
        ends, along = self.walls[seen].reshape(-1, 2), self.walls[seen, 2:] - self.walls[seen, :2]
        along = np.repeat(along / np.hypot(*along.T)[:, None], 2, axis=0)
        curve = np.repeat(self.curves.curve[seen], 2)
        same = (curve[:, None] == curve) & np.repeat(self.curves.bends[seen].any(axis=1), 2)
        squared = np.sum((ends[:, None] - ends) ** 2, axis=-1)
        correlation = _LARGEST_CORRELATION * np.exp(-0.5 * squared / _CORRELATION_LENGTH_M**2)
        correlation = correlation * (along @ along.T)
        return np.where(np.eye(len(ends)), 1.0, np.where(same, correlation, 0.0))


def _map_sigma(h: FloatArray, g: FloatArray) -> tuple[float, float]:
    """The most likely standard deviation of offsets (m), and a factor on covariances due to it.

    `h`, `g`: normal equations of the offsets whatever the poses (restricted maximum likelihood).
    """
    values, vectors = np.linalg.eigh(h)
    values, variances = np.maximum(values, 0.0), _MAP_SIGMAS_M[:, None] ** 2
    gain = variances / (1.0 + variances * values)
    deviance = np.sum(np.log1p(variances * values) - (vectors.T @ g) ** 2 * gain, axis=1)
    best = int(np.argmin(deviance))
    if deviance[best] > -_MAP_EVIDENCE:
        usual = deviance[np.argmin(np.abs(_MAP_SIGMAS_M - _USUAL_MAP_SIGMA_M))]
        return (0.0 if usual > _REFUTED else _USUAL_MAP_SIGMA_M), 1.0
    # Few walls hardly determine it: then errors have Student's distribution.
    dof = float(np.sum(gain[best] * values))
    return float(_MAP_SIGMAS_M[best]), dof / max(dof - 2.0, dof / _MOST_INFLATED)
