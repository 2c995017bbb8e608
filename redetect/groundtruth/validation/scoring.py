"""Comparison of poses with the truth or reference poses: errors, and consistency of covariances.

A normalised error (NEES) is error^T covariance^-1 error over 3, its degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import PathLike, read_table
from redetect.groundtruth.trajectories.streams import PlanarPoses, interpolate_poses
from redetect.groundtruth.validation.onboard import ReferencePose, Refused
from redetect.landmarks import is_positive_definite, squared_mahalanobis
from redetect.plane import between, pose_differences

#: Covariances rounded to six decimals in files are singular below this.
LEAST_CORRELATION = 1e-9
#: Largest time between a reference pose and the nearest pose (s).
_FARTHEST_S = 0.5


@dataclass(frozen=True)
class ErrorFigures:
    """Statistics of absolute or relative errors of poses; sigmas are computed with N - 1."""

    position_mean_m: float  # Of the distances from the truth
    position_sigma_m: float
    position_median_m: float
    position_rmse_m: float
    position_max_m: float
    angle_mean_rad: float  # Of the signed differences in heading
    angle_sigma_rad: float
    angle_rmse_rad: float
    angle_abs_mean_rad: float  # Of the absolute differences
    angle_max_rad: float


def _figures(error: FloatArray) -> dict[str, float]:
    """The `ErrorFigures` of (N, 3) errors x, y (m), theta (rad)."""
    distance, turn = np.hypot(error[:, 0], error[:, 1]), error[:, 2]
    figures = {
        "position_mean_m": distance.mean(),
        "position_sigma_m": sigma_of(distance),
        "position_median_m": np.median(distance),
        "position_rmse_m": np.sqrt(np.mean(distance**2)),
        "position_max_m": distance.max(),
        "angle_mean_rad": turn.mean(),
        "angle_sigma_rad": sigma_of(turn),
        "angle_rmse_rad": np.sqrt(np.mean(turn**2)),
        "angle_abs_mean_rad": np.abs(turn).mean(),
        "angle_max_rad": np.abs(turn).max(),
    }
    return {name: float(value) for name, value in figures.items()}


@dataclass(frozen=True)
class PoseScore(ErrorFigures):
    """Errors of poses against the truth."""

    poses: int  # Poses compared with the truth
    unmatched: int  # Poses without truth at their time
    normalised: int  # Poses with an invertible covariance
    normalised_error: float  # Mean of these: 1 if covariances are right; NaN without any

    def lines(self) -> list[str]:
        """The figures to print."""
        nees = "none: no invertible covariance"
        if self.normalised:
            low, high = normalised_band(self.normalised)
            nees = (
                f"{self.normalised_error:.3f} over {self.normalised} poses; 95 % interval of "
                f"consistent, independent ones {low:.3f} to {high:.3f}"
            )
        return [
            f"position error     mean {1e3 * self.position_mean_m:.2f} mm, sigma "
            f"{1e3 * self.position_sigma_m:.2f}, rmse {1e3 * self.position_rmse_m:.2f}, max "
            f"{1e3 * self.position_max_m:.2f}",
            f"angle error        mean {math.degrees(self.angle_mean_rad):+.3f} deg, sigma "
            f"{math.degrees(self.angle_sigma_rad):.3f}, max {math.degrees(self.angle_max_rad):.3f}",
            f"normalised error squared / dof  {nees}",
        ]


def score_poses(poses: PlanarPoses, truth: PlanarPoses, unmatched: int = 0) -> PoseScore:
    """Errors of poses whose truth is known at the same times.

    If the truth has covariances, the normalised error includes them. `unmatched` is passed on.
    """
    normalised = normalised_errors(poses, truth)
    normalised = normalised[np.isfinite(normalised)]
    return PoseScore(
        **_figures(pose_differences(poses.poses, truth.poses)),
        poses=len(poses),
        unmatched=unmatched,
        normalised=len(normalised),
        normalised_error=float(normalised.mean()) if len(normalised) else float("nan"),
    )


def normalised_errors(poses: PlanarPoses, truth: PlanarPoses) -> FloatArray:
    """(N,) normalised errors of poses; NaN if a covariance is not invertible."""
    found = np.full(len(poses), np.nan)
    if poses.covariances is not None:
        both = poses.covariances
        if truth.covariances is not None:
            both = both + truth.covariances
        usable = is_positive_definite(poses.covariances, LEAST_CORRELATION)
        usable &= is_positive_definite(both, LEAST_CORRELATION)
        error = pose_differences(poses.poses, truth.poses)[usable]
        found[usable] = squared_mahalanobis(error, both[usable]) / 3.0
    return found


def normalised_band(count: int) -> tuple[float, float]:
    """95 % interval of the mean of `count` independent normalised errors, if consistent."""
    low, high = (float(v) / (3 * count) for v in chdtri(3 * count, (0.975, 0.025)))
    return low, high


def sigma_of(values: FloatArray) -> float:
    """Standard deviation with N - 1; 0 for a single value."""
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


class Relations(NamedTuple):
    """Poses of the robot at one time relative to another."""

    from_s: FloatArray  # (N,)
    to_s: FloatArray  # (N,): may be the earlier one
    from_to: FloatArray  # (N, 3): x, y (m), theta (rad) of the second pose in the first's frame


@dataclass(frozen=True)
class RelativeScore(ErrorFigures):
    """Relative errors: of the translations and rotations truth^-1 * estimate."""

    pairs: int  # Pairs of times compared with the truth
    unmatched: int  # Pairs without poses on one side, or too far apart


def read_relations(path: PathLike) -> Relations:
    """Read relations: rows t_i, t_j, x, y, z, roll, pitch, yaw separated by blanks or commas.

    Only x, y and yaw are used, as poses are on a floor. Raises `GroundTruthError` if the file
    cannot be read or a row is malformed; the message names file and line.
    """
    rows = read_table(path, "t_i,t_j,x,y,z,roll,pitch,yaw")
    if not rows:
        raise GroundTruthError(f"{path}: contains no relations")
    table = np.array([row.numbers for row in rows])
    return Relations(table[:, 0].copy(), table[:, 1].copy(), table[:, [2, 3, 7]])


def score_relations(
    poses: PlanarPoses, relations: Relations, largest_gap_s: float = np.inf
) -> RelativeScore:
    """Compare poses, interpolated at the relations' times, with known relations.

    Gaps longer than `largest_gap_s` are not interpolated. Raises `GroundTruthError` if no relation
    has poses at both its times.
    """
    before, after = (_at(poses, times_s, largest_gap_s) for times_s in relations[:2])
    known = np.isfinite(before[:, 0]) & np.isfinite(after[:, 0])
    mine = between(before[known], after[known])
    return relative_score(relations.from_to[known], mine, int((~known).sum()))


def score_steps(
    poses: PlanarPoses, truth: PlanarPoses, step: int, longest_s: float = np.inf
) -> RelativeScore:
    """Relative errors from every pose to the one `step` poses later; both have the same times.

    Steps that take more than `longest_s`, as across a gap, are not used. Raises `GroundTruthError`
    if none remains.
    """
    known = truth.times_s[step:] - truth.times_s[:-step] <= longest_s
    mine, right = (between(p.poses[:-step], p.poses[step:])[known] for p in (poses, truth))
    return relative_score(right, mine, int((~known).sum()))


def relative_score(truth: FloatArray, estimates: FloatArray, unmatched: int = 0) -> RelativeScore:
    """Statistics of the errors truth^-1 * estimate of (N, 3) relative poses."""
    if not len(truth):
        raise GroundTruthError("no two times with poses to compare relative to each other")
    error = between(truth, estimates)
    return RelativeScore(**_figures(error), pairs=len(error), unmatched=unmatched)


def _at(poses: PlanarPoses, times_s: FloatArray, largest_gap_s: float) -> FloatArray:
    """(N, 3) poses at times in any order; NaN if unknown."""
    order = np.argsort(times_s, kind="stable")
    interpolated, found = interpolate_poses(poses, times_s[order], largest_gap_s)
    result = np.full((len(times_s), 3), np.nan)
    result[order[found]] = interpolated.poses
    return result


@dataclass(frozen=True)
class Published:
    """Figures that RAWSEEDS published for a ground truth (deliverable D2.1, part 2)."""

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


class ReferenceErrors(NamedTuple):
    """Errors of a ground truth at E reference poses."""

    references: list[ReferencePose]  # Those with ground truth at their time
    poses: PlanarPoses  # The ground truth's poses nearest in time
    reference_poses: PlanarPoses  # The references as a stream

    @property
    def error(self) -> FloatArray:
        """(E, 3) ground truth minus reference: x, y (m), wrapped theta (rad)."""
        return pose_differences(self.poses.poses, self.reference_poses.poses)

    @property
    def sigma(self) -> FloatArray:
        """(E, 2) standard deviations of position (m; root of the trace) and heading (rad), from
        both covariances; NaN if the ground truth has no invertible one.
        """
        found = np.full((len(self.poses), 2), np.nan)
        if self.poses.covariances is not None and self.reference_poses.covariances is not None:
            both = self.poses.covariances + self.reference_poses.covariances
            variances = np.stack([both[:, 0, 0] + both[:, 1, 1], both[:, 2, 2]], axis=-1)
            usable = np.isfinite(normalised_errors(self.poses, self.reference_poses))
            found[usable] = np.sqrt(variances[usable])
        return found


def stream_of(references: Sequence[ReferencePose]) -> PlanarPoses:
    """Reference poses, in order of time, as a stream with covariances."""
    return PlanarPoses(
        np.array([r.time_s for r in references]),
        np.array([r.pose for r in references]).reshape(-1, 3),
        np.array([r.covariance for r in references]).reshape(-1, 3, 3),
    )


def reference_errors(
    references: Sequence[ReferencePose], poses: PlanarPoses
) -> tuple[ReferenceErrors, list[Refused]]:
    """Errors of a ground truth at reference poses, in order of time, and those without any.

    As the robot is at rest, the pose nearest in time is used, if it is at most half a second away:
    the covariance of an interpolated pose would depend on the unknown correlation of its
    neighbours' errors.
    """
    times = np.array([r.time_s for r in references])
    nearest = np.argmin(np.abs(times[:, None] - poses.times_s), axis=1)
    known = np.abs(poses.times_s[nearest] - times) <= _FARTHEST_S
    without = [
        Refused(r.index, r.time_s, "no ground truth", "no pose of the ground truth at this time")
        for r, there in zip(references, known)
        if not there
    ]
    there = [r for r, found in zip(references, known) if found]
    return ReferenceErrors(there, poses.only(nearest[known]), stream_of(there)), without
