"""Refines the robot's clock with its whole movement, starting from the estimate by headings.

Headings determine the time only through turns, and only as well as odometry's heading drift allows.
Where the ground truth has positions and covariances, the clock is refined, near the estimate by
headings, to maximise the likelihood of all measured poses given odometry's movements. Curves of the
path and changes of speed then contribute as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import Bounds, minimize

from redetect.array_types import FloatArray
from redetect.groundtruth.clocks.clock import ClockModel, ClockSegment
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.fuse import likeliest_noise, noise_of
from redetect.groundtruth.fusion.inputs import FuseSettings
from redetect.groundtruth.fusion.movement import MovementProblem, movement_problem
from redetect.groundtruth.trajectories.streams import PlanarPoses

_MARGIN_S = 2.0
_LEAST_WAY_M = 1.0
_FEWEST_POSES = 20
_ROUNDS = 2
# Ratio of the errors in simulated sessions to the deviations by the likelihood's curvature: errors
# of wheels do not follow the model exactly.
_SIGMA_FACTOR = 2.0


def refine_by_movement(
    segments: Sequence[ClockSegment],
    odometry: PlanarPoses,
    groundtruth: PlanarPoses,
    largest: tuple[float, float],
) -> list[ClockSegment]:
    """Move each segment's offset and rate to where the movements fit best.

    Refined are segments with the status `ok` or `jump` in which the robot drove a metre or more, if
    the result is near the estimate by headings and within the bounds `largest` of offset (s) and
    drift; the ground truth has covariances.
    """
    if groundtruth.covariances is None:
        return list(segments)
    return [
        _refined(segment, odometry, groundtruth, largest)
        if segment.status in ("ok", "jump")
        else segment
        for segment in segments
    ]


def _refined(
    segment: ClockSegment,
    odometry: PlanarPoses,
    groundtruth: PlanarPoses,
    largest: tuple[float, float],
) -> ClockSegment:
    assert groundtruth.covariances is not None
    here = (groundtruth.times_s >= segment.from_s) & (groundtruth.times_s <= segment.to_s)
    near = (odometry.times_s >= segment.from_s + segment.offset_s - _MARGIN_S) & (
        odometry.times_s <= segment.to_s + segment.offset_s + _MARGIN_S
    )
    steps = np.diff(odometry.poses[near][:, :2], axis=0)
    if (
        np.count_nonzero(here) < _FEWEST_POSES
        or np.count_nonzero(near) < _FEWEST_POSES
        or float(np.sum(np.hypot(steps[:, 0], steps[:, 1]))) < _LEAST_WAY_M
    ):
        return segment
    measured = groundtruth.only(here)
    robot_times, own = odometry.times_s[near], odometry.poses[near]
    settings = FuseSettings()
    noise = noise_of(settings)
    # One unit of the search: what the headings leave open, but no less than a millisecond at the
    # segment's middle and at its ends.
    half = 0.5 * (segment.to_s - segment.from_s)
    unit = np.array([max(segment.sigma_offset_s, 1e-3), max(segment.sigma_rate, 1e-3 / half)])
    start = np.array([segment.offset_s, segment.rate - 1.0])
    bounds = Bounds((-np.array(largest) - start) / unit, (np.array(largest) - start) / unit)

    def moved(x: FloatArray) -> ClockSegment:
        offset_s, rate = (segment.offset_s, segment.rate) + unit * x
        return replace(segment, offset_s=float(offset_s), rate=float(rate))

    def problem_at(x: FloatArray) -> MovementProblem:
        times = ClockModel((moved(x),)).groundtruth_times(robot_times)
        return movement_problem(PlanarPoses(times, own), {"pose": measured}, settings)

    def surprise(x: FloatArray) -> float:
        return problem_at(x).surprise(noise)

    best = np.zeros(2)
    try:
        for _ in range(_ROUNDS):
            noise = likeliest_noise(problem_at(best))
            found = minimize(
                surprise,
                best,
                method="Nelder-Mead",
                bounds=bounds,
                options={"xatol": 0.01, "fatol": 0.01, "initial_simplex": best + _SIMPLEX},
            )
            best = found.x
    except GroundTruthError:
        return segment
    at_bound = np.abs(start + unit * best) > _AT_A_BOUND * np.array(largest)
    if np.max(np.abs(best)) > _FARTHEST or np.any(at_bound):
        return segment
    covariance = _covariance(surprise, best)
    if covariance is None:
        return segment
    sigma = _SIGMA_FACTOR * unit * np.sqrt(np.diag(covariance))
    return replace(moved(best), sigma_offset_s=float(sigma[0]), sigma_rate=float(sigma[1]))


_SIMPLEX = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
# Largest distance from the estimate by headings, in its deviations; beyond it is rejected.
_FARTHEST = 8.0
# Share of the bounds beyond which the search has not found a minimum within them.
_AT_A_BOUND = 0.999


def _covariance(surprise: Callable[[FloatArray], float], at: FloatArray) -> FloatArray | None:
    """Of the two unknowns, from the curvature of minus twice the logarithm of the likelihood."""
    middle = surprise(at)
    step = np.array([0.7, 0.7])
    hessian = np.empty((2, 2))
    for i in range(2):
        e = np.eye(2)[i] * step[i]
        hessian[i, i] = (surprise(at + e) + surprise(at - e) - 2.0 * middle) / step[i] ** 2
    e, f = np.array([step[0], 0.0]), np.array([0.0, step[1]])
    hessian[0, 1] = hessian[1, 0] = (
        surprise(at + e + f) - surprise(at + e - f) - surprise(at - e + f) + surprise(at - e - f)
    ) / (4.0 * step[0] * step[1])
    if not (np.linalg.eigvalsh(hessian)[0] > 0.0 and math.isfinite(hessian.sum())):
        return None
    return np.asarray(2.0 * np.linalg.inv(hessian))
