"""Odometry from a localisation: a rigid motion plus stationary errors, without drift.

A localisation in a map, or a path with closed loops, does not drift as wheels do. Its poses are
those of the ground truth after a rigid motion and with a lever arm on the robot, plus stationary
errors: an Ornstein-Uhlenbeck process for x, y and the heading, each with a deviation and a
correlation time (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, appendix
B). The process is Markov: in a gap between measurements the errors depend only on those at its two
ends, in closed form. Odometry is treated as a localisation if that model predicts the measurements
better than the movements between its poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.fusion.inputs import systematic_sigmas
from redetect.groundtruth.fusion.kernels import POSE
from redetect.groundtruth.fusion.movement import MovementProblem
from redetect.groundtruth.fusion.slips import UNMEASURED_S
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    moved_poses,
    planar_alignment,
)
from redetect.landmarks import wrap_angle
from redetect.plane import pose_differences, rotation

# Both models of odometry are compared on thinned measurements, if there are enough, and only if a
# longer gap has to be bridged.
_FEWEST = 10
_LEAST_EXTENT_M = 0.01
_LEAST_GAP_S = 20.0
_MOST_TO_LEARN_FROM = 500
# Prior means of the correlation times of positions and of headings, which a few visits hardly
# determine, and the deviation of their logarithms.
_POSITION_CORRELATION_S, _HEADING_CORRELATION_S = 10.0, 2.0
_LOG_CORRELATION_SIGMA = 0.7
# Prior deviation of the motion (m, rad), and those of the lever arm on the robot (m), from its
# point to that of the ground truth: none, or one.
_LEVEL_SIGMA, _LEVER_ARM_SIGMAS = 10.0, (1e-6, 0.2)
# Differences this many times the median are gross errors, of which there is one in 10000, anywhere
# within 10 m by 10 m.
_USUAL = 6.0
_TRIMMINGS = 5
_OUTLIER_DEVIANCE = -2.0 * math.log(1e-4 / (100.0 * 2.0 * math.pi))


@dataclass(frozen=True)
class LocalisationErrors:
    """Errors of odometry that is a localisation."""

    position_sigma: float  # Standard deviation of x and y, each (m)
    heading_sigma: float  # Of the heading (rad)
    position_correlation_s: float  # Time after which the correlation is 1/e
    heading_correlation_s: float
    heading_offset: float  # Heading of the ground truth minus that of the localisation (rad)
    # Lever arm, forward and left: from the localisation's point on the robot to that of the ground
    # truth (m). A clock with a constant error looks like a distance forward.
    forward_m: float
    left_m: float


def as_localisation(
    odometry: PlanarPoses,
    problem: MovementProblem,
    noise: FloatArray,
    systematic: FloatArray,
    path: PlanarPoses,
) -> tuple[PlanarPoses, LocalisationErrors] | None:
    """The path from odometry that is a localisation, if it is one.

    `problem` has the same odometry, with distinct times, and accepted measurements. As movements,
    it has random errors over seconds, `noise` (4,), and `systematic` (3,) ones. `path` is the one
    from movements, with covariances: it is kept where poses were measured, and the gaps in between
    are bridged again.
    """
    # A gyroscope, whose headings come without positions, is no localisation.
    if np.max(np.ptp(odometry.poses[:, :2], axis=0)) < _LEAST_EXTENT_M:
        return None
    thin = problem.thinned()
    if len(thin.streams) < _FEWEST or np.max(np.diff(problem.measured_s)) <= _LEAST_GAP_S:
        return None
    own, _ = interpolate_poses(odometry, thin.measured_s)
    measured = PlanarPoses(thin.measured_s, *thin.measured[1:])
    trimmed = _trimmed_alignment(own, measured)
    if trimmed is None:
        return None
    motion, usual = trimmed
    times_s, there = measured.times_s[usual], moved_poses(own, motion).poses[usual]
    errors = pose_differences(measured.poses[usual], there)
    variances = np.diagonal(thin.measured.covariances[usual], axis1=1, axis2=2)
    centre = there[:, :2].mean(axis=0)
    design, motion_priors = _by_motion_and_lever_arm(there, centre), np.full(POSE, _LEVEL_SIGMA)
    variance = np.mean(variances[:, :2], axis=1)
    # A lever arm only if the measurements say so.
    position = min(
        (
            _stationary(times_s, errors[:, :2], variance, design, priors, _POSITION_CORRELATION_S)
            for priors in (np.append(motion_priors, [arm] * 2) for arm in _LEVER_ARM_SIGMAS)
        ),
        key=lambda found: found.deviance,
    )
    heading = _stationary(
        times_s,
        errors[:, 2:],
        variances[:, 2],
        np.ones((len(errors), 1, 1)),
        motion_priors[2:],
        _HEADING_CORRELATION_S,
    )
    deviance = position.deviance + heading.deviance + _OUTLIER_DEVIANCE * np.count_nonzero(~usual)
    # A contradiction after a gap costs two outliers, not all those until the next one.
    parts = replace(thin, restart_after=2).split(math.inf)
    errors_of_movements = systematic, systematic_sigmas(problem.settings)
    by_movements = (part.innovations(noise, errors_of_movements).deviance for part in parts)
    if not deviance < sum(by_movements):
        return None
    aligned = moved_poses(odometry, motion)
    design = _by_motion_and_lever_arm(aligned.poses, centre)
    aligned.poses[:, :2] += design @ position.mean
    aligned.poses[:, 2] += heading.mean
    spread = np.zeros((len(aligned), POSE, POSE))
    spread[:, :2, :2] = design @ position.mean_covariance @ np.swapaxes(design, 1, 2)
    spread[:, 2, 2] = heading.mean_covariance[0, 0]
    found = LocalisationErrors(
        position_sigma=position.sigma,
        heading_sigma=heading.sigma,
        position_correlation_s=position.correlation_s,
        heading_correlation_s=heading.correlation_s,
        heading_offset=float(heading.mean[0]),
        forward_m=float(position.mean[POSE]),
        left_m=float(position.mean[POSE + 1]),
    )
    aligned = PlanarPoses(aligned.times_s, aligned.poses, spread)
    return _bridged(path, aligned, problem.measured_s, found), found


def _trimmed_alignment(
    own: PlanarPoses, measured: PlanarPoses
) -> tuple[FloatArray, BoolArray] | None:
    """Rigid motion (3,) that aligns poses with measured ones, and a mask without gross errors."""
    usual = np.ones(len(measured), dtype=np.bool_)
    for _ in range(_TRIMMINGS):
        motion = planar_alignment(own.only(usual), measured.only(usual))
        errors = pose_differences(measured.poses, moved_poses(own, motion).poses)
        off = np.column_stack([np.hypot(errors[:, 0], errors[:, 1]), errors[:, 2]])
        usual = np.all(np.abs(off) <= _USUAL * np.median(np.abs(off), axis=0), axis=1)
        if np.count_nonzero(usual) < _FEWEST:
            return None
    return motion, usual


def _by_motion_and_lever_arm(poses: FloatArray, centre: FloatArray) -> FloatArray:
    """(M, 2, 5) derivatives of the positions of poses (M, 3) by a motion x, y, theta about a centre
    (2,), and by the lever arm on the robot, forward and to the left.
    """
    derivatives = np.zeros((len(poses), 2, POSE + 2))
    derivatives[:, :, :2] = np.eye(2)
    derivatives[:, :, 2] = (poses[:, :2] - centre)[:, ::-1] * [-1.0, 1.0]
    derivatives[:, :, POSE:] = rotation(poses[:, 2])
    return derivatives


class _Stationary(NamedTuple):
    """A process with a deviation and a correlation time about a mean with k unknowns."""

    sigma: float
    correlation_s: float
    mean: FloatArray  # (k,)
    mean_covariance: FloatArray  # (k, k)
    deviance: float  # Minus twice the log-likelihood


def _stationary(
    times_s: FloatArray,
    values: FloatArray,
    variances: FloatArray,
    design: FloatArray,
    priors: FloatArray,
    usual_correlation_s: float,
) -> _Stationary:
    """Maximum likelihood estimate of the process for (M, n) values, with unknown mean.

    `design` (M, n, k): the values' derivatives by the unknowns of the mean, which have the prior
    deviations `priors` (k,). Values have the variances (M,) of their times. Since an estimated mean
    follows the errors, in particular with few visits, the restricted likelihood is used (Rasmussen
    and Williams, section 2.7).
    """
    stride = 1 + len(times_s) // _MOST_TO_LEARN_FROM
    apart = np.abs(times_s[::stride, None] - times_s[::stride])
    noise = np.diag(variances[::stride])
    columns = np.concatenate([design, values[:, :, None]], axis=2)[::stride]

    def fitted(logarithms: FloatArray) -> _Stationary:
        sigma, correlation = np.exp(logarithms).tolist()
        lower = cholesky(sigma**2 * np.exp(-apart / correlation) + noise, lower=True)
        white = solve_triangular(lower, columns.reshape(len(columns), -1), lower=True)
        white = white.reshape(-1, columns.shape[2])
        normal = white.T @ white
        covariance = np.linalg.inv(normal[:-1, :-1] + np.diag(priors**-2))
        mean = covariance @ normal[:-1, -1]
        squared = normal[-1, -1] - normal[:-1, -1] @ mean
        determinant = 2.0 * values.shape[1] * np.sum(np.log(np.diagonal(lower)))
        determinant -= np.linalg.slogdet(covariance / np.outer(priors, priors))[1]
        deviance = stride * float(squared + determinant)
        return _Stationary(sigma, correlation, mean, covariance, deviance)

    def with_prior(logarithms: FloatArray) -> float:
        off = logarithms[1] - math.log(usual_correlation_s)
        return fitted(logarithms).deviance / stride + float(off / _LOG_CORRELATION_SIGMA) ** 2

    start = np.log(np.array([float(np.std(values)) + 1e-6, usual_correlation_s]))
    options = {"xatol": 0.02, "fatol": 0.02}
    return fitted(minimize(with_prior, start, method="Nelder-Mead", options=options).x)


def _bridged(
    path: PlanarPoses, aligned: PlanarPoses, measured_s: FloatArray, errors: LocalisationErrors
) -> PlanarPoses:
    """A path with gaps filled by an aligned localisation plus its errors given at both ends.

    The localisation's covariances are those of its alignment.
    """
    assert path.covariances is not None
    times, poses, covariances = path.times_s, path.poses.copy(), path.covariances.copy()
    there, _ = interpolate_poses(aligned, times)
    assert there.covariances is not None
    correlation = np.array([errors.position_correlation_s] * 2 + [errors.heading_correlation_s])
    variances = np.square([errors.position_sigma] * 2 + [errors.heading_sigma])
    for gap in np.flatnonzero(np.diff(measured_s) > UNMEASURED_S):
        first = max(int(np.searchsorted(times, measured_s[gap], side="right")) - 1, 0)
        last = min(int(np.searchsorted(times, measured_s[gap + 1])), len(times) - 1)
        within = slice(first + 1, last)
        ends = pose_differences(poses[[first, last]], there.poses[[first, last]])
        after = np.exp(-np.abs(times[within, None] - times[first]) / correlation)
        before = np.exp(-np.abs(times[within, None] - times[last]) / correlation)
        whole = np.exp(-(times[last] - times[first]) / correlation)
        by_first = (after - whole * before) / (1.0 - whole**2)
        by_last = (before - whole * after) / (1.0 - whole**2)
        free = 1.0 - by_first - by_last
        poses[within] = there.poses[within] + by_first * ends[0] + by_last * ends[1]
        covariances[within] = (
            by_first[:, :, None] * path.covariances[first] * by_first[:, None]
            + by_last[:, :, None] * path.covariances[last] * by_last[:, None]
            + free[:, :, None] * there.covariances[within] * free[:, None]
        )
        own = variances * (1.0 - by_first * after - by_last * before)
        covariances[within] += own[:, :, None] * np.eye(POSE)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times, poses, covariances)
