"""Poses of fixed scanners, aligned with each other and with the building, in steps.

The order is that of RAWSEEDS' deliverable D2.1, part 2: pairs of scanners by ICP; the scans merged
one after the other; each scanner aligned again with the others' merged scans; all together until
nothing moves; and the whole, then each scanner, to the building map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.icp import (
    IcpSettings,
    Scan,
    align_scans,
    explained,
    fit_outline,
    icp_to_segments,
    rigid_fit,
    scan_normals,
)
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.groundtruth.lasers.tracking_kernels import (
    OutlineFit,
    OutlinePose,
    Seen,
    refine_outline,
)
from redetect.groundtruth.settings import AlignmentSettings
from redetect.landmarks import wrap_angle
from redetect.plane import apply, between, compose, invert

#: Steps of the published order, by which results are named.
STEPS = ("pairs", "merged", "realigned", "together", "map as a whole", "each to the map")

_NORMAL_RADIUS_M, _NORMAL_REACH, _NORMAL_SPREAD = 0.4, 4, 0.2
_JUDGED_M = 0.05
_ROUNDS = 50
#: Standard deviations of readings, wall and map together, as the fit to the map narrows (m).
_NARROWING_M = (0.2, 0.1, 0.05, 0.03, 0.02, 0.01, 0.005)
_FLOOR_M = 0.001
_WEAK_M = 0.02
_LONE_STEPS = 30
# Pairs are begun from the measured headings turned by these.
_TURNS_DEG = (0.0, -2.0, 2.0, -4.0, 4.0)
# A scanner whose place on the map is farther from that among the other scanners is named.
_INCONSISTENT_M = 0.05


@dataclass(frozen=True, eq=False)
class StillScan:
    """Points of a scanner in the empty area, averaged over its scans."""

    points: FloatArray  # (n, 2): in the scanner's frame, in the order of the beams (m)
    range_m: FloatArray  # (n,)
    direction: FloatArray  # (n, 2): of the beams
    sigma_m: float  # Of the averaged readings
    normals: FloatArray  # (n, 2): of lines through the points; zeros where there is none.


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the scanners were found."""

    scanners: tuple[Scanner, ...]  # With poses on the map and their covariances
    # Poses after each of `STEPS`; those before the map are in the frame of the measured poses.
    steps: dict[str, FloatArray]
    # Share of two scans that coincides with the other scan after the pairwise ICP, 0 to 1
    pairs: dict[tuple[int, int], float]
    matched: IntArray  # (scanners,): number of beams that hit the map
    rms_m: FloatArray  # (scanners,): their root mean square distance from it
    undetermined: tuple[str, ...]  # Scanners whose view of the map leaves a direction open
    inconsistent: tuple[str, ...]  # Scanners whose place on the map is not that among the others


def still_scan(scanner: Scanner, empty: Scans) -> StillScan:
    """Average the scans of the empty area.

    Beams without a reading in half of the scans, and those along an edge, which see near and far
    in turn, are left out; a beam's readings far off its median, which passed by, too.
    """
    metres = empty.ranges_mm * 1e-3
    hit = scanner.has_return(empty.ranges_mm)
    masked = np.where(hit, metres, np.nan)
    usable = hit.sum(axis=0) >= max(1.0, 0.5 * len(empty))
    median = np.full(scanner.readings, np.nan)
    median[usable] = np.nanmedian(masked[:, usable], axis=0)
    off = np.abs(masked - median)
    close = off < 4.0 * max(scanner.sigma_m, 0.005)
    count = close.sum(axis=0)
    usable &= count >= 0.8 * hit.sum(axis=0)
    if int(usable.sum()) < 10:
        raise GroundTruthError(
            f"scanner {scanner.name}: {int(usable.sum())} beams see something in the empty area: "
            "expected 10 or more"
        )
    mean = np.where(close, metres, 0.0).sum(axis=0)[usable] / count[usable]
    angle = scanner.angles_rad[usable]
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = np.ascontiguousarray(mean[:, None] * direction)
    normals = scan_normals(points, _NORMAL_RADIUS_M, _NORMAL_REACH, _NORMAL_SPREAD)
    sigma = max(scanner.sigma_m, 0.003) / math.sqrt(float(np.median(count[usable])))
    return StillScan(points, mean, direction, sigma, normals)


def align_scanners(
    scanners: Sequence[Scanner],
    empties: Sequence[Scans],
    building: FloatArray,
    settings: AlignmentSettings | None = None,
) -> Alignment:
    """Align fixed scanners with each other and with the building.

    Parameters
    ----------
    scanners : sequence of Scanner
        With poses measured by hand.
    empties : sequence of Scans
        Scans of the empty area, as many.
    building : (k, 4) float64
        The map's walls x1, y1, x2, y2 (m).

    Raises
    ------
    GroundTruthError
        If there are no scanners, or one sees nothing.
    GeometryError
        If a scanner's readings do not reach the map within the gate.
    """
    s = AlignmentSettings() if settings is None else settings
    if not scanners:
        raise GroundTruthError("no scanners: expected some")
    scans = [still_scan(a, b) for a, b in zip(scanners, empties)]
    measured = np.stack([scanner.pose for scanner in scanners])
    steps: dict[str, FloatArray] = {}
    shares, relative = _pairs(scans, measured, s)
    steps["pairs"] = _chained(measured, shares, relative)
    steps["merged"] = _merged(scans, steps["pairs"], shares, s)
    steps["realigned"] = _round(scans, steps["merged"], s)
    steps["together"] = _together(scans, steps["realigned"], s)
    steps["map as a whole"] = _whole_to_map(scans, steps["together"], measured, building, s)
    found, matched, rms, weak = [], [], [], []
    for scanner, scan, start in zip(scanners, scans, steps["map as a whole"]):
        pose, covariance, fit = _to_map(scanner.name, scan, start, building, s)
        found.append(replace(scanner, pose=pose, covariance=covariance))
        matched.append(fit.used)
        rms.append(fit.rms_m)
        if fit.open_directions:
            weak.append(scanner.name)
    steps["each to the map"] = np.stack([scanner.pose for scanner in found])
    moved = steps["each to the map"] - steps["map as a whole"]
    far = np.hypot(moved[:, 0], moved[:, 1]) > _INCONSISTENT_M
    names = tuple(scanner.name for scanner, is_far in zip(found, far) if is_far)
    return Alignment(
        tuple(found), steps, shares, np.array(matched), np.array(rms), tuple(weak), names
    )


def _pairs(
    scans: list[StillScan], measured: FloatArray, s: AlignmentSettings
) -> tuple[dict[tuple[int, int], float], dict[tuple[int, int], FloatArray]]:
    """ICP of every pair, from the measured poses: shares explained, and poses j in i."""
    shares: dict[tuple[int, int], float] = {}
    relative: dict[tuple[int, int], FloatArray] = {}
    gates = np.geomspace(max(2.0 * s.gate_m, 0.1), 0.1, 12)
    for i, j in combinations(range(len(scans)), 2):
        apart = between(measured[i], measured[j])
        target, points = Scan(scans[i].points, scans[i].normals), scans[j].points
        best = (0.0, apart)
        for turn in np.radians(_TURNS_DEG):
            start = apart + np.array([0.0, 0.0, turn])
            pose = align_scans(points, target, start, gates, s.keep, 1e-6)
            if np.isfinite(pose).all():
                share = explained(points, target, pose, _JUDGED_M)
                best = max(best, (share, pose), key=lambda entry: entry[0])
        shares[i, j], relative[i, j] = best
    return shares, relative


def _chained(
    measured: FloatArray,
    shares: dict[tuple[int, int], float],
    relative: dict[tuple[int, int], FloatArray],
) -> FloatArray:
    """Poses by the pairs that agree best, from the first scanner, whose pose stays."""
    poses = measured.copy()
    placed = [0]
    while len(placed) < len(measured):
        pair = max(
            (p for p in shares if (p[0] in placed) != (p[1] in placed)), key=lambda p: shares[p]
        )
        i, j = pair
        if i in placed:
            poses[j] = compose(poses[i], relative[pair])
            placed.append(j)
        else:
            poses[i] = compose(poses[j], invert(relative[pair]))
            placed.append(i)
    return poses


def _merge(scans: list[StillScan], poses: FloatArray, members: Iterable[int]) -> Scan:
    """Several scans in one frame."""
    return Scan(
        np.concatenate([apply(poses[k], scans[k].points) for k in members]),
        np.concatenate([apply([0.0, 0.0, poses[k][2]], scans[k].normals) for k in members]),
    )


def _align_one(
    scans: list[StillScan], poses: FloatArray, k: int, target: Scan, gates: FloatArray, kept: float
) -> FloatArray:
    pose = align_scans(scans[k].points, target, poses[k], gates, kept, 1e-7)
    return pose if np.isfinite(pose).all() else poses[k]


def _merged(
    scans: list[StillScan], poses: FloatArray, shares: dict[tuple[int, int], float],
    s: AlignmentSettings,
) -> FloatArray:  # fmt: skip
    """One scan after the other, best overlapping first, aligned with those merged already."""
    poses = poses.copy()
    members = [0]
    gates = np.geomspace(s.gate_m, 0.08, 8)
    while len(members) < len(scans):
        outside = [k for k in range(len(scans)) if k not in members]
        k = max(outside, key=lambda k: max(shares[min(k, m), max(k, m)] for m in members))
        poses[k] = _align_one(scans, poses, k, _merge(scans, poses, members), gates, s.keep)
        members.append(k)
    return poses


def _round(scans: list[StillScan], poses: FloatArray, s: AlignmentSettings) -> FloatArray:
    """Each scanner but the first aligned again with the merged scans of all others."""
    poses = poses.copy()
    gates = np.geomspace(0.15, 0.06, 4)
    for k in range(1, len(scans)):
        others = [m for m in range(len(scans)) if m != k]
        poses[k] = _align_one(scans, poses, k, _merge(scans, poses, others), gates, s.keep)
    return poses


def _together(scans: list[StillScan], poses: FloatArray, s: AlignmentSettings) -> FloatArray:
    """Rounds until no scanner moves."""
    for _ in range(_ROUNDS):
        before = poses
        poses = _round(scans, poses, s)
        if np.abs(poses - before).max() < 1e-5:
            break
    return poses


def _whole_to_map(
    scans: list[StillScan], poses: FloatArray, measured: FloatArray, building: FloatArray,
    s: AlignmentSettings,
) -> FloatArray:  # fmt: skip
    """All scanners as one rigid body on the map, from where they were measured."""
    if len(poses) > 1:
        body = rigid_fit(poses[:, :2].copy(), measured[:, :2].copy(), np.ones(len(poses), bool))
    else:
        body = compose(measured[0], invert(poses[0]))
    everything = _merge(scans, poses, range(len(scans))).points
    for gate in (2.0 * s.gate_m, s.gate_m, 0.5 * s.gate_m, 0.25 * s.gate_m, 0.1):
        body = icp_to_segments(everything, building, body, IcpSettings(gate, s.keep, 1e-5)).pose
    return compose(np.broadcast_to(body, poses.shape), poses)


def icp_by_step(
    scan: StillScan, building: FloatArray, start: FloatArray, s: AlignmentSettings, steps: int
) -> FloatArray:
    """(steps + 1,) root mean square distances (m) from the map of the readings that count.

    Those of an ICP of a scanner's readings to the map, from a start (3,), after each of its steps.
    """
    return np.array(
        [
            fit_outline(scan.points, building, invert(start), s.gate_m, s.keep, 0.0, k)[1]
            for k in range(steps + 1)
        ]
    )


def _to_map(
    name: str, scan: StillScan, start: FloatArray, building: FloatArray, s: AlignmentSettings
) -> tuple[FloatArray, FloatArray, OutlinePose]:
    """Pose of one scanner on the map, its covariance, and the fit.

    The kernel moves faces to points: here the map to the scanner's frame. Walls are seen from both
    sides. Readings of objects in front of a wall are far from the wall that the beam would hit, and
    are excluded as the gate narrows.
    """
    faces = np.vstack([building, building[:, [2, 3, 0, 1]]])
    lone = np.zeros(len(scan.points), dtype=np.int64)
    seen = Seen(scan.points, lone, scan.direction, scan.range_m)
    pose, floor = invert(start), _FLOOR_M
    for narrow in (*(n for n in _NARROWING_M if n <= s.gate_m), _FLOOR_M, 0.0):
        # Last, the residuals themselves say how large the errors are.
        floor = narrow if narrow > 0.0 else floor
        fit = OutlineFit(floor, 0.25, 3.0, s.gate_m, 0.5, _WEAK_M, 1.0, _LONE_STEPS)
        found = refine_outline(seen, faces, pose, np.zeros((1, 2)), np.array([scan.sigma_m]), fit)
        pose = found.pose
        if found.used < 10:
            raise GeometryError(
                f"scanner {name}: {found.used} readings lie on the map: expected 10 or more"
            )
        if narrow == _FLOOR_M:
            ratio = found.chi2 / (found.used - 3.0)
            floor = max(_FLOOR_M * math.sqrt(max(ratio, 1.0)), _FLOOR_M)
    ratio = max(found.chi2 / (found.used - 3.0), 0.1)
    world = invert(pose)
    # The inverse's covariance: x' = -R' t and theta' = -theta.
    c, sn = math.cos(world[2]), math.sin(world[2])
    jacobian = np.array([[-c, sn, world[1]], [-sn, -c, -world[0]], [0.0, 0.0, -1.0]])
    covariance = ratio * jacobian @ found.covariance @ jacobian.T
    world[2] = wrap_angle(world[2])
    return world, 0.5 * (covariance + covariance.T), found
