"""Matches two scans without odometry, by point-to-line ICP from many headings.

ICP finds the nearest minimum, which for two scans of a turning robot is often a wrong one. So a
coarse ICP is started from headings all round. Its results are scored by the share of *both* scans
that coincides with the other, and the best few are refined and scored again.

In a corridor poses along it explain both scans about equally, while the few readings that tell them
apart may be of somebody who walks there: residuals then say nothing of the error. So other poses
that explain nearly as much are looked for among the refined ones and along the direction that is
known least; where there are any, the match is ambiguous and its covariance reaches them.

References
----------
A. Censi, "An ICP variant using a point-to-line metric", ICRA 2008.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.icp import best_share, open_directions, trimmed_variance
from redetect.groundtruth.lasers.icp_kernels import moved, nearest_points
from redetect.groundtruth.lasers.icp_scan_kernels import align_scans, explained, scan_normals
from redetect.landmarks import wrap_angle
from redetect.storage.bounds import ABOVE_0, LIMIT, SHARE_ABOVE_0, Bounds, demand, whole

FloatArray = NDArray[np.float64]

# Share of what the best pose explains, beyond which a refined pose or one along the direction that
# is known least is as good; and how far along (m).
_RIVAL_SHARE = 0.8
_RIVAL_SHARE_ALONG = 0.95
_ALONG_M = np.array([sign * step for sign in (-1.0, 1.0) for step in np.arange(2, 11) / 10.0])

_TURN_DEG = Bounds("above 0, at most 360", 0.0, 360.0, above=True)


@dataclass(frozen=True)
class ScanMatchSettings:
    """Settings of the matching of two scans.

    Parameters
    ----------
    heading_step_deg : float
        Distance of the headings from which the coarse ICP is begun, all round (deg).
    coarse_gates_m, fine_gates_m : tuple of float
        Gates of the steps of the coarse and of the fine ICP; the last one is repeated (m).
    coarse_thinning : int
        The coarse ICP uses every `coarse_thinning`-th point.
    refined : int
        Number of coarse poses that are refined.
    kept : float
        Share of the pairs within the gate that is used: the best ones.
    largest_shift_m : float
        Poses farther than this from the start are rejected: the robot cannot have moved so far (m).
    normal_radius_m, normal_reach, normal_spread : float, int, float
        A point's line is fitted to the points up to `normal_reach` beams to either side, without a
        step longer than `normal_radius_m`, if their extent across the line is at most
        `normal_spread` times that along it.
    coarse_sigma_m, fine_sigma_m : float
        Distance at which a point no longer counts as explained in the score (m).
    weak_sigma_m : float
        A direction is undetermined if the standard deviation along it is larger (m).
    """

    heading_step_deg: float = 10.0
    coarse_gates_m: tuple[float, ...] = (1.0, 0.8, 0.6, 0.5, 0.4, 0.3)
    fine_gates_m: tuple[float, ...] = (0.3, 0.25, 0.2, 0.15, 0.15)
    coarse_thinning: int = 2
    refined: int = 4
    kept: float = 0.95
    largest_shift_m: float = 1.0
    normal_radius_m: float = 0.3
    normal_reach: int = 4
    normal_spread: float = 0.25
    coarse_sigma_m: float = 0.1
    fine_sigma_m: float = 0.05
    weak_sigma_m: float = 0.05

    def __post_init__(self) -> None:
        demand(
            self,
            GroundTruthError,
            heading_step_deg=_TURN_DEG,
            coarse_gates_m=ABOVE_0,
            fine_gates_m=ABOVE_0,
            coarse_thinning=whole(1),
            refined=whole(1),
            kept=SHARE_ABOVE_0,
            largest_shift_m=LIMIT,
            normal_radius_m=ABOVE_0,
            normal_reach=whole(1),
            normal_spread=ABOVE_0,
            coarse_sigma_m=ABOVE_0,
            fine_sigma_m=ABOVE_0,
            weak_sigma_m=ABOVE_0,
        )
        for name in ("coarse_gates_m", "fine_gates_m"):
            if not getattr(self, name):
                raise GroundTruthError(f"{name} is empty: expected one or more")


@dataclass(frozen=True, eq=False)
class ScanMatch:
    """The pose of a scan relative to another one.

    Attributes
    ----------
    pose : (3,) float64
        x, y (m), theta (rad) of the scan in the target's frame.
    covariance : (3, 3) float64
        From the residuals' size and the geometry, and wide enough for rivals where it is ambiguous;
        infinite on the diagonal where nothing is determined.
    explained : float
        Share of both scans' points that coincide with the other scan, 0 to 1.
    rival : float
        The same of the best other pose found, 0 without one.
    undetermined : (k, 3) float64
        Directions that the geometry leaves open, as in `redetect.groundtruth.lasers.icp.IcpResult`.
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
    points: ArrayLike,
    target: ArrayLike,
    settings: ScanMatchSettings | None = None,
    starts: ArrayLike | None = None,
) -> ScanMatch:
    """Find the pose of one scan in the frame of another one.

    Parameters
    ----------
    points, target : (n, 2), (m, 2) arrays
        The scans' points in the order of the beams, each in its own scanner's frame (m).
    settings : ScanMatchSettings, optional
    starts : (k, 3) array, optional
        Poses to begin from; by default no motion, with every heading all round.

    Returns
    -------
    ScanMatch

    Raises
    ------
    GeometryError
        If a scan has fewer than ten points, or no start leads anywhere.
    """
    s = ScanMatchSettings() if settings is None else settings
    moving, fixed = (np.ascontiguousarray(p, dtype=np.float64) for p in (points, target))
    if min(len(moving), len(fixed)) < 10:
        raise GeometryError(
            f"scans of {len(moving)} and {len(fixed)} points: expected 10 or more in each"
        )
    normals, good = scan_normals(fixed, s.normal_radius_m, s.normal_reach, s.normal_spread)
    thin = np.ascontiguousarray(moving[:: s.coarse_thinning])
    if starts is None:
        count = max(1, round(360.0 / s.heading_step_deg))
        starts = np.zeros((count, 3))
        starts[:, 2] = wrap_angle(2.0 * math.pi / count * np.arange(count))
    coarse = []
    for start in np.asarray(starts, dtype=np.float64).reshape(-1, 3):
        pose, _, _ = align_scans(
            thin, fixed, normals, good, start, np.array(s.coarse_gates_m), s.kept, 1e-3
        )
        if math.hypot(pose[0] - start[0], pose[1] - start[1]) <= s.largest_shift_m:  # NaN is not
            coarse.append((explained(thin, fixed, pose, s.coarse_sigma_m), pose))
    coarse.sort(key=lambda found: -found[0])
    fine: list[tuple[float, FloatArray]] = []
    for _, start in _distinct(coarse)[: s.refined]:
        pose, _, _ = align_scans(
            moving, fixed, normals, good, start, np.array(s.fine_gates_m), s.kept, 1e-6
        )
        if np.isfinite(pose).all():
            fine.append((explained(moving, fixed, pose, s.fine_sigma_m), pose))
    if not fine:
        raise GeometryError("no pose from which three points of one scan lie on the other")
    fine.sort(key=lambda found: -found[0])
    fine = _distinct(fine)
    share, pose = fine[0]
    pose[2] = wrap_angle(pose[2])
    covariance, undetermined = _uncertainty(moving, fixed, normals * good[:, None], pose, s)
    away = [rival - pose for other, rival in fine[1:] if other > _RIVAL_SHARE * share]
    away += _as_good_along(moving, fixed, normals * good[:, None], pose, covariance, s)
    for difference in away:
        difference[2] = wrap_angle(difference[2])
        # As wide as the error is if one of the rivals is right.
        covariance = covariance + np.outer(difference, difference) / len(away)
    rival = fine[1][0] if len(fine) > 1 else 0.0
    return ScanMatch(pose, covariance, share, rival, undetermined, bool(away))


def _as_good_along(
    moving: FloatArray,
    fixed: FloatArray,
    normals: FloatArray,
    pose: FloatArray,
    covariance: FloatArray,
    s: ScanMatchSettings,
) -> list[FloatArray]:
    """Shifts along the direction that is known least that leave points as near to their lines."""
    if not np.isfinite(covariance).all():
        return []
    direction = np.append(np.linalg.eigh(covariance[:2, :2])[1][:, 1], 0.0)

    def near(shift: float) -> float:
        world = moved(moving, pose + shift * direction)
        index, squared = nearest_points(world, fixed)
        normal = normals[index]
        across = np.sum(normal * (world - fixed[index]), axis=1) ** 2
        on_line = np.any(normal != 0.0, axis=1) & (squared < _ALONG_M[-1] ** 2)
        off = np.where(on_line, across, squared)
        return float(np.mean(np.exp(-0.5 * off / s.fine_sigma_m**2)))

    least = _RIVAL_SHARE_ALONG * near(0.0)
    return [shift * direction for shift in _ALONG_M if near(shift) > least]


def _distinct(found: list[tuple[float, FloatArray]]) -> list[tuple[float, FloatArray]]:
    """Without those that are a better one once more (within 5 cm and 2 degrees)."""
    kept: list[tuple[float, FloatArray]] = []
    for share, pose in found:
        if not any(
            math.hypot(pose[0] - p[0], pose[1] - p[1]) < 0.05
            and abs(float(wrap_angle(pose[2] - p[2]))) < math.radians(2.0)
            for _, p in kept
        ):
            kept.append((share, pose))
    return kept


def _uncertainty(
    moving: FloatArray, fixed: FloatArray, normals: FloatArray, pose: FloatArray,
    s: ScanMatchSettings,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    world = moved(moving, pose)
    index, squared = nearest_points(world, fixed)
    used = best_share(squared, s.fine_gates_m[-1], s.kept)
    normal = normals[index[used]]
    lever = world[used] - pose[:2]
    rows = np.column_stack([normal, normal[:, 1] * lever[:, 0] - normal[:, 0] * lever[:, 1]])
    residual = np.sum(normal * (world[used] - fixed[index[used]]), axis=1)
    freedom = max(int(np.any(normal != 0.0, axis=1).sum()) - 3, 1)
    shrinkage, inflation = trimmed_variance(s.kept)
    variance = float(residual @ residual) / freedom / shrinkage * inflation
    information = rows.T @ rows / max(variance, 1e-18)
    middle = lever.mean(axis=0) if len(lever) else np.zeros(2)
    scale_m = math.sqrt(float(np.mean(np.sum((lever - middle) ** 2, axis=1)))) if len(lever) else 1
    shift = np.array([[1.0, 0.0, middle[1]], [0.0, 1.0, -middle[0]], [0.0, 0.0, 1.0]])
    undetermined = open_directions(shift.T @ information @ shift, scale_m, s.weak_sigma_m)
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 1e-12 * max(values[2], 1e-300):
        return np.diag(np.full(3, np.inf)), undetermined
    return np.asarray((vectors / values) @ vectors.T), undetermined
