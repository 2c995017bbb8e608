"""Matches two scans without odometry, by point-to-line ICP from many headings.

ICP finds the nearest minimum, which for two scans of a turning robot is often a wrong one. So a
coarse ICP is started from headings all round. Its results are scored by the share of *both* scans
that coincides with the other, and the best few are refined and scored again.

In a corridor poses along it explain both scans about equally, while the few readings that tell them
apart may be of somebody who walks there: residuals then say nothing of the error. So other poses
that explain nearly as much are looked for among the refined ones and along the direction that is
known least; where there are any, the match is ambiguous and its covariance reaches them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.icp import (
    Scan,
    align_scans,
    best_share,
    explained,
    pose_uncertainty,
    scan_normals,
)
from redetect.landmarks import wrap_angle
from redetect.plane import apply
from tools.arrays import FloatArray

_COARSE_GATES_M = (1.0, 0.8, 0.6, 0.5, 0.4, 0.3)
_FINE_GATES_M = (0.3, 0.25, 0.2, 0.15, 0.15)
_THINNING, _REFINED, _KEPT = 2, 4, 0.95
_LARGEST_SHIFT_M = 1.0
_NORMALS = (0.3, 4, 0.25)  # radius (m), reach, spread of `scan_normals`
_COARSE_SIGMA_M, _FINE_SIGMA_M, _WEAK_SIGMA_M = 0.1, 0.05, 0.05
# Share of what the best pose explains, beyond which a refined pose or one along the direction that
# is known least is as good; and how far along (m).
_RIVAL_SHARE = 0.8
_RIVAL_SHARE_ALONG = 0.95
_ALONG_M = np.array([sign * step for sign in (-1.0, 1.0) for step in np.arange(2, 11) / 10.0])


@dataclass(frozen=True, eq=False)
class ScanMatch:
    """The pose of a scan relative to another one.

    Attributes
    ----------
    pose : (3,) float64
        x, y (m), theta (rad) of the scan in the target's frame.
    covariance : (3, 3) float64
        From the residuals' size and the geometry, and wide enough for rivals where it is ambiguous.
    explained : float
        Share of both scans' points that coincide with the other scan, 0 to 1.
    rival : float
        The same of the best other pose found, 0 without one.
    undetermined : (k, 3) float64
        Directions that the geometry leaves open.
    ambiguous : bool
        Another pose explains nearly as much: the match may be grossly wrong.
    """

    pose: FloatArray
    covariance: FloatArray
    explained: float
    rival: float
    undetermined: FloatArray
    ambiguous: bool


def match_scans(
    points: FloatArray,
    target: FloatArray,
    *,
    heading_step_deg: float = 10.0,
    largest_shift_m: float = _LARGEST_SHIFT_M,
) -> ScanMatch:
    """Find the pose of one scan (n, 2) in the frame of another (m, 2), from no motion.

    Headings from which it begins are `heading_step_deg` apart, all round; poses farther than
    `largest_shift_m` from there are rejected.

    Raises
    ------
    GeometryError
        If a scan has fewer than ten points, or no start leads anywhere.
    """
    if min(len(points), len(target)) < 10:
        raise GeometryError(
            f"scans of {len(points)} and {len(target)} points: expected 10 or more in each"
        )
    fixed = Scan(target, scan_normals(target, *_NORMALS))
    thin = points[::_THINNING]
    count = max(1, round(360.0 / heading_step_deg))
    coarse = []
    for heading in wrap_angle(2.0 * math.pi / count * np.arange(count)):
        pose = align_scans(thin, fixed, [0.0, 0.0, heading], _COARSE_GATES_M, _KEPT, 1e-3)
        if math.hypot(pose[0], pose[1]) <= largest_shift_m:  # NaN is not
            coarse.append((explained(thin, fixed, pose, _COARSE_SIGMA_M), pose))
    fine: list[tuple[float, FloatArray]] = []
    for _, start in _distinct(coarse)[:_REFINED]:
        pose = align_scans(points, fixed, start, _FINE_GATES_M, _KEPT, 1e-6)
        if np.isfinite(pose).all():
            fine.append((explained(points, fixed, pose, _FINE_SIGMA_M), pose))
    if not fine:
        raise GeometryError("no pose from which three points of one scan lie on the other")
    fine = _distinct(fine)
    share, pose = fine[0]
    pose[2] = wrap_angle(pose[2])
    world = apply(pose, points)
    squared, index = fixed.nearest(world)
    used = best_share(squared, _FINE_GATES_M[-1], _KEPT)
    near = index[used]
    covariance, undetermined = pose_uncertainty(
        pose, world[used], fixed.points[near], fixed.normals[near], _KEPT, _WEAK_SIGMA_M
    )
    away = [rival - pose for other, rival in fine[1:] if other > _RIVAL_SHARE * share]
    away += _as_good_along(points, fixed, pose, covariance)
    for difference in away:
        difference[2] = wrap_angle(difference[2])
        # As wide as the error is if one of the rivals is right.
        covariance = covariance + np.outer(difference, difference) / len(away)
    rival = fine[1][0] if len(fine) > 1 else 0.0
    return ScanMatch(pose, covariance, share, rival, undetermined, bool(away))


def _as_good_along(
    points: FloatArray, fixed: Scan, pose: FloatArray, covariance: FloatArray
) -> list[FloatArray]:
    """Shifts along the direction that is known least that leave points as near to their lines."""
    if not np.isfinite(covariance).all():
        return []
    direction = np.append(np.linalg.eigh(covariance[:2, :2])[1][:, 1], 0.0)

    def near(shift: float) -> float:
        world = apply(pose + shift * direction, points)
        squared, index = fixed.nearest(world)
        normal = fixed.normals[index]
        across = np.sum(normal * (world - fixed.points[index]), axis=1) ** 2
        on_line = np.any(normal != 0.0, axis=1) & (squared < _ALONG_M[-1] ** 2)
        off = np.where(on_line, across, squared)
        return float(np.mean(np.exp(-0.5 * off / _FINE_SIGMA_M**2)))

    least = _RIVAL_SHARE_ALONG * near(0.0)
    return [shift * direction for shift in _ALONG_M if near(shift) > least]


def _distinct(found: list[tuple[float, FloatArray]]) -> list[tuple[float, FloatArray]]:
    """The best first, without those that are a better one once more (within 5 cm and 2 degrees)."""
    kept: list[tuple[float, FloatArray]] = []
    for share, pose in sorted(found, key=lambda entry: -entry[0]):
        if not any(
            math.hypot(pose[0] - p[0], pose[1] - p[1]) < 0.05
            and abs(float(wrap_angle(pose[2] - p[2]))) < math.radians(2.0)
            for _, p in kept
        ):
            kept.append((share, pose))
    return kept
