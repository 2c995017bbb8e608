"""Compares a ground truth with reference poses: errors at each, statistics, and NEES."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.clocks.clock import ClockModel
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses, pose_differences
from redetect.groundtruth.validation.reference_poses import DistancePose
from redetect.groundtruth.validation.reference_poses_scans import Onboard, refine_pose, still_points
from redetect.groundtruth.validation.scoring import LEAST_CORRELATION, sigma_of
from redetect.landmarks import is_positive_definite, squared_mahalanobis

_BAND = 0.95
_FARTHEST_S = 0.5


@dataclass(frozen=True)
class Published:
    """Figures that RAWSEEDS printed for a ground truth (deliverable D2.1, part 2)."""

    name: str
    position_mean_m: float
    position_sigma_m: float
    angle_mean_deg: float
    angle_sigma_deg: float


#: Over 23 reference poses.
PUBLISHED = (
    Published("RAWSEEDS, laser", 0.020, 0.011, 0.15, 1.56),
    Published("RAWSEEDS, cameras", 0.112, 0.090, -0.80, 2.16),
)


@dataclass(frozen=True, eq=False)
class ReferencePose:
    """A reference pose, and how it came about."""

    index: int  # Its number in the file of distances
    time_s: float  # On the ground truth's clock
    pose: FloatArray  # (3,): x, y (m), theta (rad)
    covariance: FloatArray  # (3, 3)
    distances: DistancePose
    # Use of the on-board scans
    # (`redetect.groundtruth.validation.reference_poses_scans.RefinedPose`)
    scans: str
    note: str  # Remarks
    points: int  # Points of the scans on walls
    rms_m: float  # Of their distances from the walls; NaN without.


@dataclass(frozen=True)
class Refused:
    """A pose that is no reference, and why."""

    index: int
    time_s: float
    status: str
    reason: str


@dataclass(frozen=True)
class PoseError:
    """How far a ground truth is from a reference pose."""

    index: int
    time_s: float
    # `x_m`, `y_m`: Ground truth minus reference
    x_m: float
    y_m: float
    linear_m: float  # Their length
    angular_rad: float  # Signed, the short way round
    # error^T (C + C_reference)^-1 error, with three degrees of freedom; NaN without covariances
    # that can be inverted.
    nees: float
    # `sigma_linear_m`, `sigma_angular_rad`: Expected standard deviations by both covariances: root
    # of the trace, and of the heading; NaN if the ground truth has none.
    sigma_linear_m: float
    sigma_angular_rad: float


@dataclass(frozen=True)
class Figures:
    """Figures of the errors at the reference poses."""

    poses: int
    # `linear_mean_m`, `linear_sigma_m`, `linear_worst_m`: Sigma with N - 1
    linear_mean_m: float
    linear_sigma_m: float
    linear_worst_m: float
    # `angular_mean_rad`, `angular_sigma_rad`, `angular_worst_rad`: Of the signed errors; the worst
    # without sign.
    angular_mean_rad: float
    angular_sigma_rad: float
    angular_worst_rad: float
    normalised: int  # Poses with a NEES
    # Its mean over 3, the degrees of freedom: 1 if the covariances are right. NaN without.
    nees: float
    # `nees_low`, `nees_high`: 95 % of means over as many independent poses are between these. NaN
    # without.
    nees_low: float
    nees_high: float


def reference_poses(
    distances: Sequence[DistancePose],
    onboard: Sequence[Onboard] = (),
    segments: FloatArray | None = None,
    clock: ClockModel | None = None,
) -> tuple[list[ReferencePose], list[Refused]]:
    """Poses from distances, refined by scans where these help.

    Parameters
    ----------
    distances : sequence of DistancePose
        From `redetect.groundtruth.validation.reference_poses.poses_from_distances`.
    onboard : sequence of Onboard
        Scanners on board; without any, distances alone count.
    segments : (S, 4) array, optional
        The building's walls, needed with scanners.
    clock : ClockModel, optional
        Without it the robot's clock is assumed to be the ground truth's.

    Returns
    -------
    refused : list of Refused
        Those that distances leave ambiguous, undetermined or inconsistent.
    """
    references: list[ReferencePose] = []
    refused: list[Refused] = []
    for d in distances:
        ask = bool(onboard) and segments is not None
        if d.status not in ("ok", "ambiguous") or (d.status == "ambiguous" and not ask):
            refused.append(Refused(d.index, d.time_s, d.status, d.reason))
            continue
        if not ask:
            references.append(_unrefined(d, "not asked", d.reason))
            continue
        assert segments is not None
        reference = _refined(d, onboard, segments, clock)
        if reference is None:
            reason = f"{d.reason}; the walls do not decide"
            refused.append(Refused(d.index, d.time_s, d.status, reason))
        else:
            references.append(reference)
    return references, refused


def _refined(
    d: DistancePose,
    onboard: Sequence[Onboard],
    segments: FloatArray,
    clock: ClockModel | None,
) -> ReferencePose | None:
    time = d.time_s if clock is None else float(clock.robot_times([d.time_s])[0])
    try:
        points = still_points(onboard, time)
    except GeometryError as error:
        return None if d.status == "ambiguous" else _unrefined(d, "moved", str(error))
    refined = refine_pose(d, points, segments)
    if refined is None:
        return None
    note = "; ".join(part for part in (d.reason, refined.reason) if part)
    return ReferencePose(
        d.index, d.time_s, refined.pose, refined.covariance, d, refined.scans, note,
        refined.points, refined.rms_m,
    )  # fmt: skip


def _unrefined(d: DistancePose, scans: str, note: str) -> ReferencePose:
    return ReferencePose(
        d.index, d.time_s, d.candidates[0], d.covariances[0], d, scans, note, 0, math.nan
    )


def stream_of(references: Sequence[ReferencePose]) -> PlanarPoses:
    """Reference poses, in order of time, as a stream with covariances."""
    return PlanarPoses(
        np.array([r.time_s for r in references]),
        np.array([r.pose for r in references]).reshape(-1, 3),
        np.array([r.covariance for r in references]).reshape(-1, 3, 3),
    )


def pose_errors(
    references: Sequence[ReferencePose], poses: PlanarPoses
) -> tuple[list[PoseError], list[Refused]]:
    """Errors of a ground truth at reference poses.

    Parameters
    ----------
    references : sequence of ReferencePose
        In order of time.
    poses : PlanarPoses
        The ground truth. The pose nearest in time is used, as the robot is at rest: the covariance
        of an interpolated pose would depend on the unknown correlation of their errors; but not
        one more than half a second away.

    Returns
    -------
    without : list of Refused
        References at whose time there is no ground truth.
    """
    stream = stream_of(references)
    at_times, known = _nearest(poses, stream.times_s)
    without = [
        Refused(r.index, r.time_s, "no ground truth", "no pose of the ground truth at this time")
        for r, there in zip(references, known)
        if not there
    ]
    assert stream.covariances is not None
    error = pose_differences(at_times.poses, stream.poses[known])
    nees = np.full(len(error), np.nan)
    sigma = np.full((len(error), 2), np.nan)
    if at_times.covariances is not None and len(error):
        both = at_times.covariances + stream.covariances[known]
        usable = is_positive_definite(at_times.covariances, LEAST_CORRELATION)
        usable &= is_positive_definite(both, LEAST_CORRELATION)
        nees[usable] = squared_mahalanobis(error[usable], both[usable])
        sigma[usable, 0] = np.sqrt(both[usable, 0, 0] + both[usable, 1, 1])
        sigma[usable, 1] = np.sqrt(both[usable, 2, 2])
    there = [r for r, found in zip(references, known) if found]
    errors = [
        PoseError(
            r.index, r.time_s, float(e[0]), float(e[1]), float(math.hypot(e[0], e[1])),
            float(e[2]), float(n), float(s[0]), float(s[1]),
        )
        for r, e, n, s in zip(there, error, nees, sigma)
    ]  # fmt: skip
    return errors, without


def _nearest(poses: PlanarPoses, times_s: FloatArray) -> tuple[PlanarPoses, BoolArray]:
    """The poses nearest to times, and which times have one."""
    after = np.clip(np.searchsorted(poses.times_s, times_s), 0, len(poses) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(times_s - poses.times_s[before]) <= np.abs(poses.times_s[after] - times_s)
    index = np.where(earlier, before, after)
    known = np.abs(poses.times_s[index] - times_s) <= _FARTHEST_S
    return poses.only(index[known]), known


def figures_of(errors: Sequence[PoseError]) -> Figures:
    """Mean, sigma, worst and NEES of errors."""
    if not errors:
        raise GroundTruthError("no reference pose with ground truth at its time")
    linear = np.array([e.linear_m for e in errors])
    angular = np.array([e.angular_rad for e in errors])
    nees = np.array([e.nees for e in errors])
    nees = nees[np.isfinite(nees)]
    low, high = (math.nan, math.nan)
    if len(nees):
        freedom = 3 * len(nees)
        tails = [0.5 * (1.0 + _BAND), 0.5 * (1.0 - _BAND)]
        low, high = (float(v) / freedom for v in chdtri(freedom, tails))

    return Figures(
        len(errors),
        float(linear.mean()),
        sigma_of(linear),
        float(linear.max()),
        float(angular.mean()),
        sigma_of(angular),
        float(np.abs(angular).max()),
        len(nees),
        float(nees.mean() / 3.0) if len(nees) else math.nan,
        low,
        high,
    )


def table_rows(
    references: Sequence[ReferencePose], errors: Sequence[PoseError]
) -> list[dict[str, Any]]:
    """Rows of the table: every reference pose with its error, if it has one."""
    by_index = {error.index: error for error in errors}
    rows: list[dict[str, Any]] = []
    for r in references:
        error = by_index.get(r.index)
        sigma = np.sqrt(np.diagonal(r.covariance))
        good = r.distances.residuals_m[r.distances.used]
        rows.append(
            {
                "pose": r.index,
                "t": r.time_s,
                "x_m": float(r.pose[0]),
                "y_m": float(r.pose[1]),
                "theta_rad": float(r.pose[2]),
                "sigma_x_m": float(sigma[0]),
                "sigma_y_m": float(sigma[1]),
                "sigma_theta_rad": float(sigma[2]),
                "distances": int(r.distances.used.sum()),
                "gross": int((~r.distances.used).sum()),
                "distance_rms_m": float(np.sqrt(np.mean(good**2))),
                "scans": r.scans,
                "error_x_m": None if error is None else error.x_m,
                "error_y_m": None if error is None else error.y_m,
                "linear_m": None if error is None else error.linear_m,
                "angular_deg": None if error is None else math.degrees(error.angular_rad),
                "nees": None if error is None else finite_or_none(error.nees),
            }
        )
    return rows


def document(figures: Figures, refused: Sequence[Refused]) -> dict[str, Any]:
    """Figures and refused poses as written to a JSON file: null for missing values."""
    return {
        "figures": {k: finite_or_none(v) for k, v in asdict(figures).items()},
        "published": [asdict(published) for published in PUBLISHED],
        "refused": [asdict(r) for r in refused],
    }


def finite_or_none(value: float) -> float | None:
    """A number as JSON has it."""
    return value if math.isfinite(value) else None
