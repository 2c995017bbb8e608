"""Compares a ground truth with reference poses: errors at each, statistics, and NEES."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import PlanarPoses, pose_differences
from redetect.groundtruth.validation.onboard import ReferencePose, Refused
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


class ReferenceErrors(NamedTuple):
    """How far a ground truth is from E reference poses."""

    references: list[ReferencePose]  # Those at whose time there is ground truth
    # (E, 3): ground truth minus reference: x, y (m), theta (rad), the short way round
    error: FloatArray
    # (E,): error^T (C + C_reference)^-1 error, with three degrees of freedom; NaN without
    # covariances that can be inverted
    nees: FloatArray
    # (E, 2): expected standard deviations by both covariances: root of the trace (m), and of the
    # heading (rad); NaN if the ground truth has none
    sigma: FloatArray

    @property
    def linear_m(self) -> FloatArray:
        """(E,) lengths of the errors in x and y."""
        return np.hypot(self.error[:, 0], self.error[:, 1])


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


def stream_of(references: Sequence[ReferencePose]) -> PlanarPoses:
    """Reference poses, in order of time, as a stream with covariances."""
    return PlanarPoses(
        np.array([r.time_s for r in references]),
        np.array([r.pose for r in references]).reshape(-1, 3),
        np.array([r.covariance for r in references]).reshape(-1, 3, 3),
    )


def pose_errors(
    references: Sequence[ReferencePose], poses: PlanarPoses
) -> tuple[ReferenceErrors, list[Refused]]:
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
    times = np.array([r.time_s for r in references])
    nearest = _nearest(poses.times_s, times)
    known = np.abs(poses.times_s[nearest] - times) <= _FARTHEST_S
    missing = "no pose of the ground truth at this time"
    without = [
        Refused(r.index, r.time_s, "no ground truth", missing)
        for r, there in zip(references, known)
        if not there
    ]
    there = [r for r, found in zip(references, known) if found]
    right, found = stream_of(there), poses.only(nearest[known])
    error = pose_differences(found.poses, right.poses)
    nees, sigma = np.full(len(error), np.nan), np.full((len(error), 2), np.nan)
    if found.covariances is not None and right.covariances is not None and len(error):
        both = found.covariances + right.covariances
        usable = is_positive_definite(found.covariances, LEAST_CORRELATION)
        usable &= is_positive_definite(both, LEAST_CORRELATION)
        nees[usable] = squared_mahalanobis(error[usable], both[usable])
        sigma[usable, 0] = np.sqrt(both[usable, 0, 0] + both[usable, 1, 1])
        sigma[usable, 1] = np.sqrt(both[usable, 2, 2])
    return ReferenceErrors(there, error, nees, sigma), without


def _nearest(times_s: FloatArray, wanted_s: FloatArray) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Indices of the ascending times that are nearest to those wanted."""
    after = np.clip(np.searchsorted(times_s, wanted_s), 0, len(times_s) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(wanted_s - times_s[before]) <= np.abs(times_s[after] - wanted_s)
    return np.where(earlier, before, after)


def figures_of(errors: ReferenceErrors) -> Figures:
    """Mean, sigma, worst and NEES of errors."""
    if not len(errors.error):
        raise GroundTruthError("no reference pose with ground truth at its time")
    linear, angular = errors.linear_m, errors.error[:, 2]
    nees = errors.nees[np.isfinite(errors.nees)]
    low, high, mean = math.nan, math.nan, math.nan
    if len(nees):
        freedom = 3 * len(nees)
        tails = [0.5 * (1.0 + _BAND), 0.5 * (1.0 - _BAND)]
        low, high = (float(v) / freedom for v in chdtri(freedom, tails))
        mean = float(nees.mean() / 3.0)
    return Figures(
        len(linear),
        float(linear.mean()),
        sigma_of(linear),
        float(linear.max()),
        float(angular.mean()),
        sigma_of(angular),
        float(np.abs(angular).max()),
        len(nees),
        mean,
        low,
        high,
    )


def table_rows(
    references: Sequence[ReferencePose], errors: ReferenceErrors
) -> list[dict[str, Any]]:
    """Rows of the table: every reference pose with its error, NaN if it has none."""
    columns = ("error_x_m", "error_y_m", "linear_m", "angular_deg", "nees")
    degrees = np.degrees(errors.error[:, 2])
    table = np.column_stack([errors.error[:, :2], errors.linear_m, degrees, errors.nees])
    by_index = {r.index: row for r, row in zip(errors.references, table.tolist())}
    rows: list[dict[str, Any]] = []
    for r in references:
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
                **dict(zip(columns, by_index.get(r.index, [math.nan] * len(columns)))),
            }
        )
    return rows
