"""Compares poses with the truth: absolute and relative errors, and their covariances."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    pose_differences,
    read_rows_of_numbers,
)
from redetect.landmarks import is_positive_definite, squared_mahalanobis
from redetect.plane import between

#: Covariances that files round to six decimals are singular below this.
LEAST_CORRELATION = 1e-9


@dataclass(frozen=True)
class PoseScore:
    """How far poses are from the truth."""

    poses: int  # Poses compared with the truth
    unmatched: int  # Poses without truth at their time
    # `position_mean_m`, `position_sigma_m`, `position_rmse_m`, `position_max_m`: Of the distances
    # from the truth; sigma with N - 1.
    position_mean_m: float
    position_sigma_m: float
    position_rmse_m: float
    position_max_m: float
    # `angle_mean_rad`, `angle_sigma_rad`, `angle_max_rad`: Of the signed differences of heading;
    # the largest without sign.
    angle_mean_rad: float
    angle_sigma_rad: float
    angle_max_rad: float
    angle_abs_mean_rad: float  # Mean of the differences without sign
    position_median_m: float
    normalised: int  # Poses whose covariance could be inverted
    # Mean of error^T covariance^-1 error over 3, the degrees of freedom: 1 if the covariances are
    # right. NaN without covariances.
    normalised_error: float


def score_poses(poses: PlanarPoses, truth: PlanarPoses, unmatched: int = 0) -> PoseScore:
    """Errors of poses whose truth is known at the same times.

    Parameters
    ----------
    poses, truth : PlanarPoses
        With the same times. If the truth has covariances, they count in the normalised error.
    unmatched : int
        Handed through.
    """
    error = pose_differences(poses.poses, truth.poses)
    distance = np.hypot(error[:, 0], error[:, 1])
    normalised, count = float("nan"), 0
    if poses.covariances is not None:
        covariances = poses.covariances
        if truth.covariances is not None:
            covariances = covariances + truth.covariances
        usable = is_positive_definite(covariances, LEAST_CORRELATION)
        count = int(usable.sum())
        if count:
            squared = squared_mahalanobis(error[usable], covariances[usable])
            normalised = float(np.mean(squared) / 3.0)
    return PoseScore(
        len(poses),
        unmatched,
        float(distance.mean()),
        sigma_of(distance),
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        float(error[:, 2].mean()),
        sigma_of(error[:, 2]),
        float(np.abs(error[:, 2]).max()),
        float(np.abs(error[:, 2]).mean()),
        float(np.median(distance)),
        count,
        normalised,
    )


def sigma_of(values: FloatArray) -> float:
    """Standard deviation with N - 1; 0 of a single value."""
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Relations:
    """Poses of the robot at one time relative to another."""

    # `from_s`, `to_s`: (N,): the two times (s); either may be the earlier one.
    from_s: FloatArray
    to_s: FloatArray
    # (N, 3): x, y (m), theta (rad) of the pose at `to_s` in the frame of the pose at `from_s`
    from_to: FloatArray

    def __len__(self) -> int:
        return len(self.from_s)


@dataclass(frozen=True)
class RelativeScore:
    """Relative errors."""

    pairs: int  # Pairs of times compared with the truth
    unmatched: int  # Pairs that one side has no pose for, or that are too far apart
    # `position_mean_m`, `position_sigma_m`, `position_median_m`, `position_rmse_m`,
    # `position_max_m`: Of the lengths of the relative errors' translations; sigma with N - 1.
    position_mean_m: float
    position_sigma_m: float
    position_median_m: float
    position_rmse_m: float
    position_max_m: float
    # `angle_rmse_rad`, `angle_abs_mean_rad`, `angle_max_rad`: Of the relative errors' rotations
    angle_rmse_rad: float
    angle_abs_mean_rad: float
    angle_max_rad: float


def read_relations(path: str | os.PathLike[str]) -> Relations:
    """Read a file of relations: rows t_i, t_j, x, y, z, roll, pitch, yaw between blanks or commas.

    Of these x, y and yaw count: poses are on a floor.

    Raises
    ------
    StreamError
        If the file cannot be read or a row is malformed; the message names file and line.
    """
    table = read_rows_of_numbers(path, 8, "t_i, t_j, x, y, z, roll, pitch, yaw")
    return Relations(table[:, 0].copy(), table[:, 1].copy(), table[:, [2, 3, 7]])


def score_relations(
    poses: PlanarPoses, relations: Relations, largest_gap_s: float = np.inf
) -> RelativeScore:
    """Hold poses against known relations; the poses are interpolated at the relations' times.

    Parameters
    ----------
    largest_gap_s : float
        Nothing is interpolated across longer gaps.

    Raises
    ------
    GroundTruthError
        If no relation has poses at both its times.
    """
    before, known_before = _at(poses, relations.from_s, largest_gap_s)
    after, known_after = _at(poses, relations.to_s, largest_gap_s)
    known = known_before & known_after
    return relative_score(
        relations.from_to[known], between(before[known], after[known]), int((~known).sum())
    )


def score_steps(
    poses: PlanarPoses, truth: PlanarPoses, step: int, longest_s: float = np.inf
) -> RelativeScore:
    """Relative errors over steps of a truth, from every pose.

    Parameters
    ----------
    poses, truth : PlanarPoses
        With the same times.
    step : int
        From each pose to the one `step` poses later.
    longest_s : float
        Steps that take longer, as across a gap, do not count (s).

    Raises
    ------
    GroundTruthError
        If no step remains.
    """
    if step < 1:
        raise GroundTruthError(f"step is {step}: expected 1 or more")
    known = truth.times_s[step:] - truth.times_s[:-step] <= longest_s
    mine, right = (between(p.poses[:-step], p.poses[step:])[known] for p in (poses, truth))
    return relative_score(right, mine, int((~known).sum()))


def relative_score(truth: FloatArray, estimates: FloatArray, unmatched: int = 0) -> RelativeScore:
    """Figures of the errors truth^-1 * estimate of (N, 3) relative poses."""
    if not len(truth):
        raise GroundTruthError("no two times with poses to compare relative to each other")
    error = between(truth, estimates)
    length = np.hypot(error[:, 0], error[:, 1])
    return RelativeScore(
        len(error),
        unmatched,
        float(length.mean()),
        sigma_of(length),
        float(np.median(length)),
        float(np.sqrt(np.mean(length**2))),
        float(length.max()),
        float(np.sqrt(np.mean(error[:, 2] ** 2))),
        float(np.abs(error[:, 2]).mean()),
        float(np.abs(error[:, 2]).max()),
    )


def _at(
    poses: PlanarPoses, times_s: FloatArray, largest_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """(N, 3) poses at times in any order, and which of them there are; zeros elsewhere."""
    order = np.argsort(times_s, kind="stable")
    interpolated, found = interpolate_poses(poses, times_s[order], largest_gap_s)
    result, known = np.zeros((len(times_s), 3)), np.zeros(len(times_s), dtype=np.bool_)
    result[order[found]] = interpolated.poses
    known[order[found]] = True
    return result, known
