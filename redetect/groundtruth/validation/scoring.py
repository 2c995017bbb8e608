"""Compares poses with the truth: errors, and whether their covariances are right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.alignment import align_poses
from redetect.groundtruth.trajectories.interpolation import matched_streams
from redetect.groundtruth.trajectories.streams import PlanarPoses, is_positive_definite
from redetect.landmarks import wrap_angle

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class PoseScore:
    """How far poses are from the truth.

    Attributes
    ----------
    poses : int
        Poses compared with the truth.
    unmatched : int
        Poses without truth at their time.
    position_mean_m, position_sigma_m, position_rmse_m, position_max_m : float
        Of the distances from the truth; sigma with N - 1.
    angle_mean_rad, angle_sigma_rad, angle_max_rad : float
        Of the signed differences of heading; the largest without sign.
    angle_abs_mean_rad : float
        Mean of the differences without sign.
    position_median_m : float
    normalised : int
        Poses whose covariance could be inverted.
    normalised_error : float
        Mean of error^T covariance^-1 error over 3, the degrees of freedom: 1 if the covariances
        are right. NaN without covariances.
    """

    poses: int
    unmatched: int
    position_mean_m: float
    position_sigma_m: float
    position_rmse_m: float
    position_max_m: float
    angle_mean_rad: float
    angle_sigma_rad: float
    angle_max_rad: float
    angle_abs_mean_rad: float
    position_median_m: float
    normalised: int
    normalised_error: float


def score_poses(poses: PlanarPoses, truth: PlanarPoses, unmatched: int = 0) -> PoseScore:
    """Errors of poses whose truth is known at the same times.

    Parameters
    ----------
    poses, truth : PlanarPoses
        With the same times. If the truth has covariances, they count in the normalised error.
    unmatched : int
        Handed through.

    Returns
    -------
    PoseScore

    Raises
    ------
    GroundTruthError
        If there is no pose, or the numbers differ.
    """
    if len(poses) == 0 or len(poses) != len(truth):
        raise GroundTruthError(
            f"{len(poses)} poses and {len(truth)} of the truth: expected as many, and at least one"
        )
    error = poses.poses - truth.poses
    error[:, 2] = wrap_angle(error[:, 2])
    distance = np.hypot(error[:, 0], error[:, 1])
    normalised, count = float("nan"), 0
    if poses.covariances is not None:
        covariances = poses.covariances
        if truth.covariances is not None:
            covariances = covariances + truth.covariances
        usable = is_positive_definite(covariances)
        count = int(usable.sum())
        if count:
            weighted = np.linalg.solve(covariances[usable], error[usable][..., None])[..., 0]
            normalised = float(np.mean(np.sum(error[usable] * weighted, axis=1)) / 3.0)
    return PoseScore(
        len(poses),
        unmatched,
        float(distance.mean()),
        _sigma(distance),
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        float(error[:, 2].mean()),
        _sigma(error[:, 2]),
        float(np.abs(error[:, 2]).max()),
        float(np.abs(error[:, 2]).mean()),
        float(np.median(distance)),
        count,
        normalised,
    )


def compare_streams(
    poses: PlanarPoses,
    truth: PlanarPoses,
    *,
    largest_gap_s: float = 0.5,
    interpolate: str = "truth",
    align: bool = False,
) -> PoseScore:
    """Score two streams whose times differ.

    Parameters
    ----------
    poses, truth : PlanarPoses
    largest_gap_s : float
        Nothing is interpolated across longer gaps.
    interpolate : str
        `truth` at the poses' times, or `poses` at the truth's times (RAWSEEDS' definition).
    align : bool
        Move the poses rigidly onto the truth first, for solutions with a world of their own.

    Returns
    -------
    PoseScore

    Raises
    ------
    GroundTruthError
        If no pose has a truth at its time.
    """
    mine, theirs, unmatched = matched_streams(
        poses, truth, largest_gap_s=largest_gap_s, interpolate=interpolate
    )
    if align:
        mine = align_poses(mine, theirs)
    return score_poses(mine, theirs, unmatched)


def _sigma(values: FloatArray) -> float:
    return float(values.std(ddof=1)) if len(values) > 1 else 0.0
