"""Poses of fixed scanners, aligned with each other and with the building, step by step.

The steps are those of RAWSEEDS' deliverable D2.1, part 2: pairs of scanners are aligned by ICP;
their scans are merged one after the other; each is aligned again with the others', in rounds until
none moves; finally all as one body with the map, then each, together with the walls' offsets.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers import walls
from redetect.groundtruth.lasers.icp import (
    Scan,
    align_scans,
    fit_outline,
    overlap_score,
    scan_normals,
)
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.groundtruth.settings import AlignmentSettings
from redetect.plane import apply, between, compose, fitted, invert

#: The steps in the published order; results are named after them.
STEPS = ("pairs", "merged", "realigned", "together", "map as a whole", "each to the map")

# Of lines through a scan's points: the longest step to a neighbour (m), neighbours on either side,
# and the largest ratio of the extents across and along.
_NORMALS = (0.4, 4, 0.2)
_JUDGED_M = 0.05
_ROUNDS = 50
#: Standard deviations of readings, wall and map together, as the fit to the map narrows (m).
_NARROWING_M = (0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005)
_WEAK_M = 0.02
# Start headings of the pairs, relative to the measured ones.
_TURNS_DEG = (0.0, -2.0, 2.0, -4.0, 4.0)
# Decrease of the share of a scan that others explain, by its pose on the map, that is noticed.
_MUCH_WORSE = 0.1
# Neighbouring walls may be chords of a curve that leaves them by less than this (m).
_MOST_BULGE_M = 0.1
# A scanner's start on the map is found with standard deviations down to this (m).
_COARSE_M = 0.02
# Standard deviations of measured poses (m, rad): without a covariance, and the least.
_UNKNOWN_SIGMA, _LEAST_SIGMA = 0.5, 1e-4
_DEFAULT = AlignmentSettings()


@dataclass(frozen=True, eq=False)
class Alignment:
    """Estimated poses of the scanners."""

    scanners: tuple[Scanner, ...]  # With poses on the map and their covariances
    steps: dict[str, FloatArray]  # Poses after each of `STEPS`, at first in the measured frame
    pairs: dict[tuple[int, int], float]  # Shares of two scans that coincide after their ICP
    matched: IntArray  # (scanners,): number of beams that hit the map
    rms_m: FloatArray  # (scanners,): their root mean square distance from it
    covariance: FloatArray  # (3 scanners, 3 scanners): of their poses, jointly
    # Standard deviation of the walls' ends from the map (m): 0 if exact, a usual one if few walls
    # are seen.
    map_sigma_m: float
    undetermined: tuple[str, ...]  # Scanners whose view of the map does not determine a direction
    inconsistent: tuple[str, ...]  # Scanners whose map position contradicts the others


def align_scanners(
    scanners: Sequence[Scanner],
    empties: Sequence[Scans],
    building: FloatArray,
    settings: AlignmentSettings = _DEFAULT,
) -> Alignment:
    """Align fixed scanners with each other and with the building.

    Parameters
    ----------
    scanners : sequence of Scanner
        With poses measured by hand.
    empties : sequence of Scans
        Scans of the empty area, one for each scanner.
    building : (k, 4) float64
        The map's walls x1, y1, x2, y2 (m).
    settings : AlignmentSettings
        The gate, and the share of matches that are used.

    Raises
    ------
    GroundTruthError
        If a scanner has too few readings.
    GeometryError
        If too few of a scanner's readings are within the gate of the map.
    """
    averaged = [walls.averaged_scan(a, b.ranges_mm) for a, b in zip(scanners, empties)]
    for scanner, scan in zip(scanners, averaged):
        if len(scan.range_m) < 10:
            raise GroundTruthError(
                f"scanner {scanner.name}: {len(scan.range_m)} beams see something in the empty "
                "area: expected 10 or more"
            )
    scans = [Scan(one.points, scan_normals(one.points, *_NORMALS)) for one in averaged]
    measured = np.stack([scanner.pose for scanner in scanners])
    reach = max(float(one.range_m.max()) for one in averaged)
    building = walls.walls_near(building, measured, reach)
    if not len(building):
        raise GeometryError("no wall of the map is near the scanners: expected some")
    shares, steps = _together(scans, measured, settings)
    narrowing = [n for n in _NARROWING_M if n <= settings.gate_m] or [settings.gate_m]
    whole, curves = _whole_to_map(averaged, steps["together"], measured, building, narrowing)
    steps["map as a whole"] = whole
    priors = [_prior(scanner) for scanner in scanners]
    coarse = [n for n in narrowing if n >= _COARSE_M] or narrowing
    starts, others = [], []
    for one, scan, pose, prior in zip(scanners, averaged, whole, priors):
        try:
            lone = walls.MapProblem([scan], one.pose[None], prior, building, curves)
            start, other = lone.likely_pose(pose, coarse)
        except GeometryError as error:
            raise GeometryError(f"scanner {one.name}: {error}") from None
        starts.append(start)
        others.append(other)
    problem = walls.MapProblem(averaged, measured, block_diag(*priors), building, curves)
    fit = problem.fit(np.stack(starts), narrowing, _WEAK_M)
    steps["each to the map"] = fit.poses
    covariance = fit.covariance + block_diag(*others)
    blocks = [covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(scanners))]
    elsewhere = np.array([np.trace(other[:2, :2]) for other in others]) > _WEAK_M**2
    is_undetermined = (fit.undetermined_directions > 0) | elsewhere
    wrong = [_contradicts(scans, fit.poses, steps["together"], k) for k in range(len(scanners))]
    undetermined, inconsistent = (
        tuple(one.name for one, noted in zip(scanners, which) if noted)
        for which in (is_undetermined, wrong)
    )
    placed = tuple(
        replace(scanner, pose=pose, covariance=block)
        for scanner, pose, block in zip(scanners, fit.poses, blocks)
    )
    return Alignment(
        scanners=placed, steps=steps, pairs=shares, matched=fit.used, rms_m=fit.rms_m,
        covariance=covariance, map_sigma_m=fit.map_sigma_m, undetermined=undetermined,
        inconsistent=inconsistent,
    )  # fmt: skip


def _together(
    scans: list[Scan], measured: FloatArray, settings: AlignmentSettings
) -> tuple[dict[tuple[int, int], float], dict[str, FloatArray]]:
    """Align scans with each other: overlaps of pairs, and the poses after each step."""
    steps: dict[str, FloatArray] = {}
    pairs = _pairs(scans, measured, settings)
    steps["pairs"], order = _chained(measured, pairs)
    # One scan after the other, the best overlapping first, with those merged already.
    targets = [(k, order[:i]) for i, k in enumerate(order)][1:]
    gates = np.geomspace(settings.gate_m, min(settings.gate_m, 0.08), 8)
    steps["merged"] = _realigned(scans, steps["pairs"], targets, gates, settings.keep)
    steps["realigned"] = together = _round(scans, steps["merged"], settings)
    for _ in range(_ROUNDS):  # until no scanner moves
        before, together = together, _round(scans, together, settings)
        if np.abs(together - before).max() < 1e-5:
            break
    shares = {pair: found.share for pair, found in pairs.items()}
    return shares, steps | {"together": together}


def _prior(scanner: Scanner) -> FloatArray:
    """(3, 3) information of a scanner's measured pose; of an unknown accuracy, hardly any."""
    if not np.any(scanner.covariance):
        return np.eye(3) / _UNKNOWN_SIGMA**2
    return np.asarray(np.linalg.inv(scanner.covariance + np.eye(3) * _LEAST_SIGMA**2))


def _contradicts(scans: list[Scan], poses: FloatArray, aligned: FloatArray, k: int) -> bool:
    """Whether a scan fits the others much worse by its pose on the map than when aligned."""
    others = [m for m in range(len(scans)) if m != k]
    if not others:
        return False
    on_map, best = (
        overlap_score(scans[k].points, _merge(scans, where, others), where[k], _JUDGED_M)
        for where in (poses, aligned)
    )
    return best - on_map > _MUCH_WORSE


class _AlignedPair(NamedTuple):
    """Two scans after their ICP."""

    share: float  # Of their points that coincide
    a_from_b: FloatArray  # (3,)


def _pairs(
    scans: list[Scan], measured: FloatArray, settings: AlignmentSettings
) -> dict[tuple[int, int], _AlignedPair]:
    """ICP of every pair from the measured poses."""
    found: dict[tuple[int, int], _AlignedPair] = {}
    gates = np.geomspace(max(2.0 * settings.gate_m, 0.1), 0.1, 12)
    for i, j in combinations(range(len(scans)), 2):
        apart = between(measured[i], measured[j])
        target, points = scans[i], scans[j].points
        tried = [_AlignedPair(0.0, apart)]
        for turn in np.radians(_TURNS_DEG):
            start = apart + np.array([0.0, 0.0, turn])
            pose = align_scans(points, target, start, gates, settings.keep, 1e-6)
            if np.isfinite(pose).all():
                tried.append(_AlignedPair(overlap_score(points, target, pose, _JUDGED_M), pose))
        found[i, j] = max(tried, key=lambda pair: pair.share)
    return found


def _chained(
    measured: FloatArray, pairs: dict[tuple[int, int], _AlignedPair]
) -> tuple[FloatArray, list[int]]:
    """Poses chained along the best-matching pairs, from the first scanner, and in which order."""
    poses = measured.copy()
    placed = [0]
    while len(placed) < len(measured):
        joining = [(a, b) for a, b in pairs if (a in placed) != (b in placed)]
        a, b = max(joining, key=lambda pair: pairs[pair].share)
        a_from_b = pairs[a, b].a_from_b
        if b in placed:
            a, b, a_from_b = b, a, invert(a_from_b)
        poses[b] = compose(poses[a], a_from_b)
        placed.append(b)
    return poses, placed


def _merge(scans: list[Scan], poses: FloatArray, members: Iterable[int]) -> Scan:
    """Several scans in one frame."""
    points = [apply(poses[k], scans[k].points) for k in members]
    normals = [apply([0.0, 0.0, poses[k][2]], scans[k].normals) for k in members]
    return Scan(np.concatenate(points), np.concatenate(normals))


def _realigned(
    scans: list[Scan], poses: FloatArray, targets: Iterable[tuple[int, list[int]]],
    gates: FloatArray, kept: float,
) -> FloatArray:  # fmt: skip
    """Align scanners, one after the other, with the merged scans of others."""
    poses = poses.copy()
    for k, others in targets:
        target = _merge(scans, poses, others)
        pose = align_scans(scans[k].points, target, poses[k], gates, kept, 1e-7)
        poses[k] = pose if np.isfinite(pose).all() else poses[k]
    return poses


def _round(scans: list[Scan], poses: FloatArray, settings: AlignmentSettings) -> FloatArray:
    """Align each scanner but the first again with the merged scans of all others."""
    count = len(scans)
    targets = ((k, [m for m in range(count) if m != k]) for k in range(1, count))
    return _realigned(scans, poses, targets, np.geomspace(0.15, 0.06, 4), settings.keep)


def _whole_to_map(
    averaged: list[walls.AveragedScan],
    poses: FloatArray,
    measured: FloatArray,
    building: FloatArray,
    narrowing_m: list[float],
) -> tuple[FloatArray, walls.WallCurves]:
    """Align all scanners, as one rigid body, with the map, from their measured poses.

    Also says which walls are chords of curves: whether coarse ones are, the readings decide.
    """
    if len(poses) > 1:
        body = fitted(poses[:, :2], measured[:, :2])
    else:
        body = compose(measured[0], invert(poses[0]))
    prior = np.eye(3) / _UNKNOWN_SIGMA**2
    start, least = body[None], inf
    curves = walls.wall_curves(building)
    for tried in (curves, walls.wall_curves(building, _MOST_BULGE_M)):
        problem = walls.MapProblem(averaged, start, prior, building, tried, poses)
        with suppress(GeometryError):  # then each scanner is searched around its measured pose
            found, _, cost = problem.narrowed(start, narrowing_m)
            if cost < least:
                body, curves, least = found[0], tried, cost
    return compose(np.broadcast_to(body, poses.shape), poses), curves


def icp_by_step(
    points: FloatArray, building: FloatArray, start: FloatArray, settings: AlignmentSettings,
    steps: int,
) -> FloatArray:  # fmt: skip
    """(steps + 1,) rms distances (m) of the readings used from the map, after each step of an ICP
    of a scanner's points (n, 2) to it, from a start (3,).
    """
    gate_m, keep = settings.gate_m, settings.keep
    reach_m = float(np.hypot(*points.T).max()) + gate_m
    near, pose, errors = walls.walls_near(building, start[None], reach_m), invert(start), []
    for k in range(steps + 1):
        pose, rms, _ = fit_outline(points, near, pose, gate_m, keep, 0.0, min(k, 1))
        errors.append(rms)
    return np.array(errors)
