"""Odometry that is a localisation: its poses err about a rigid motion, however long it goes on.

A localisation in a map, or a path that was closed into loops, doesn't drift as wheels do. Its
poses are those of the ground truth after one rigid motion, and their errors besides are stationary:
an Ornstein-Uhlenbeck process for x, y and the heading, of a deviation and a correlation time each
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, appendix B). Filter and
smoother over it are linear. Odometry is taken for a localisation only if, as such, it predicts the
measurements a hundred times as well as by the movements between its poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from redetect.array_types import FloatArray
from redetect.compiled import kernel
from redetect.groundtruth.fusion.kernels import (
    POSE,
    FilterHistory,
    empty_history,
    keep,
    smooth_backward,
    squared_innovation,
    take_in,
    wrap,
)
from redetect.groundtruth.fusion.movement import MovementProblem
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    moved_poses,
    planar_alignment,
    pose_differences,
)
from redetect.landmarks import wrap_angle

# Errors of x, y (m) and heading (rad); then the rigid motion about the measured poses' centroid
# beyond the first alignment, and the angle at which its heading is mounted.
_STATE = 7
# Deviations of the last four before anything was measured.
_ALIGNMENT_SIGMAS = (10.0, 10.0, 1.0, 0.1)
# Deviations (m, rad) and correlation times (s) to begin with, and how far from them is searched. A
# few visits hardly determine the latter: a deviation of their logarithms is assumed.
_START = (0.1, 0.03, 10.0, 10.0)
_LARGEST_FACTOR = 300.0
_LOG_CORRELATION_SIGMA = 0.7
_MOST_TO_LEARN_FROM = 1000
# Both ways to see odometry are compared by measurements this far apart, if there are enough, and
# only where a longer gap is to be bridged.
_SPACING_S = 2.0
_FEWEST = 10
_LEAST_GAP_S = 20.0
_CLEAR_LEAD = 2.0 * math.log(100.0)
# Poses this many times as far off as half of them are no part of the alignment, nor of the path.
_USUAL = 6.0
_TRIMMINGS = 5
# Of a pose that may be anywhere within 10 m by 10 m, of which there is one in 10000.
_OUTLIER_SURPRISE = -2.0 * math.log(1e-4 / (100.0 * 2.0 * math.pi))


@dataclass(frozen=True)
class LocalisationErrors:
    """How odometry errs that is a localisation."""

    position_sigma: float  # Standard deviation of x and y, each (m)
    heading_sigma: float  # Of the heading (rad)
    position_correlation_s: float  # After which time errors are alike by 1/e only
    heading_correlation_s: float
    # Heading of the ground truth beyond that of the aligned localisation (rad)
    heading_offset: float


class Differences(NamedTuple):
    """Measured poses less those of aligned odometry."""

    times_s: FloatArray  # (M,)
    poses: FloatArray  # (M, 3): NaN where nothing was measured, or grossly wrong
    covariances: FloatArray  # (M, 3, 3): of the measured poses
    offsets: FloatArray  # (M, 2): odometry's positions less the centroid (m)


class LocalisationProblem(NamedTuple):
    """Measured poses beside odometry's, aligned."""

    odometry: PlanarPoses  # Aligned rigidly with the measured poses
    measured: Differences
    centroid: FloatArray  # (2,)
    gate: float  # Largest squared normalised innovation


def localisation_problem(odometry: PlanarPoses, problem: MovementProblem) -> LocalisationProblem:
    """Align odometry, that of the problem, with the two or more poses measured there.

    `odometry` has no two samples of one time.
    """
    _, poses, covariances = problem.measured
    measured = PlanarPoses(problem.measured_s, poses, covariances)
    own, _ = interpolate_poses(odometry, measured.times_s)
    usual = np.ones(len(measured), dtype=np.bool_)
    for _ in range(_TRIMMINGS):
        motion = planar_alignment(own.only(usual), measured.only(usual))
        beside = moved_poses(own, motion)
        differences = pose_differences(measured.poses, beside.poses)
        off = np.column_stack([np.hypot(differences[:, 0], differences[:, 1]), differences[:, 2]])
        usual = np.all(np.abs(off) <= _USUAL * np.median(np.abs(off), axis=0), axis=1)
        if np.count_nonzero(usual) < 2:
            break
    differences[~usual] = np.nan
    centroid = beside.poses[:, :2].mean(axis=0)
    return LocalisationProblem(
        moved_poses(odometry, motion),
        Differences(measured.times_s, differences, covariances, beside.poses[:, :2] - centroid),
        centroid,
        problem.gate(),
    )


def learn_localisation(problem: LocalisationProblem) -> tuple[FloatArray, float]:
    """Deviations (m, rad) and correlation times (s) that make the measurements likeliest.

    From a few measurements, seconds apart. Returns the deviations of position and heading and their
    correlation times (4,), and minus twice the logarithm of the measurements' likelihood.
    """
    start = np.array(_START)
    bound = math.log(_LARGEST_FACTOR)
    stride = max(1, len(problem.measured.times_s) // _MOST_TO_LEARN_FROM)
    some = Differences(*(values[::stride] for values in problem.measured))

    def surprise(logarithms: FloatArray, measured: Differences) -> float:
        errors = start * np.exp(np.clip(logarithms, -bound, bound))
        return float(_filter(measured, errors, problem.gate, empty_history(0, _STATE))[1])

    def with_prior(logarithms: FloatArray) -> float:
        prior = float(np.sum((logarithms[2:] / _LOG_CORRELATION_SIGMA) ** 2))
        return surprise(logarithms, some) + prior

    found = minimize(
        with_prior,
        np.zeros(4),
        method="Nelder-Mead",
        options={
            "xatol": 0.02,
            "fatol": 0.02,
            "initial_simplex": np.vstack([np.zeros(4), -np.eye(4)]),
        },
    )
    errors = start * np.exp(np.clip(found.x, -bound, bound))
    return np.asarray(errors), surprise(found.x, problem.measured)


@kernel()
def _filter(
    measured: Differences, errors: FloatArray, gate: float, history: FilterHistory
) -> tuple[FloatArray, float]:
    """Kalman filter over the errors; differences that are NaN are not measured.

    `history`: filled, unless it is of no nodes. Returns the squared normalised innovations (M,) and
    minus twice the logarithm of the measurements' likelihood.
    """
    times_s, differences, covariances, offsets = measured
    count = len(times_s)
    x = np.zeros(_STATE)
    p = np.zeros((_STATE, _STATE))
    for i in range(_STATE):
        p[i, i] = _variance(errors, i) if i < POSE else _ALIGNMENT_SIGMAS[i - POSE] ** 2
    kept = len(history.predicted) > 0
    squared = np.zeros(count)
    surprise = 0.0
    innovation = np.zeros(POSE)
    common = np.zeros((_STATE, POSE))
    gain = np.zeros((_STATE, POSE))
    s = np.zeros((POSE, POSE))
    s_inverse = np.zeros((POSE, POSE))
    shares = np.ones(_STATE)
    for k in range(count):
        if k > 0:
            for i in range(POSE):
                shares[i] = math.exp(-(times_s[k] - times_s[k - 1]) / errors[3 if i == 2 else 2])
            for i in range(_STATE):
                x[i] *= shares[i]
                for j in range(_STATE):
                    p[i, j] *= shares[i] * shares[j]
            for i in range(POSE):
                p[i, i] += _variance(errors, i) * (1.0 - shares[i] * shares[i])
        if kept:
            for i in range(_STATE):
                for j in range(_STATE):
                    history.transitions[k, i, j] = shares[i] if i == j else 0.0
            keep(history.predicted, history.predicted_covariance, k, x, p)
        if math.isnan(differences[k, 0]):
            squared[k] = math.inf
            surprise += _OUTLIER_SURPRISE
        else:
            # What is measured: (x0 + x3 - y x5, x1 + x4 + x x5, x2 + x5 + x6) at an offset (x, y).
            across, along = -offsets[k, 1], offsets[k, 0]
            innovation[0] = differences[k, 0] - (x[0] + x[3] + across * x[5])
            innovation[1] = differences[k, 1] - (x[1] + x[4] + along * x[5])
            innovation[2] = wrap(differences[k, 2] - (x[2] + x[5] + x[6]))
            for i in range(_STATE):
                common[i, 0] = p[i, 0] + p[i, 3] + across * p[i, 5]
                common[i, 1] = p[i, 1] + p[i, 4] + along * p[i, 5]
                common[i, 2] = p[i, 2] + p[i, 5] + p[i, 6]
            for j in range(POSE):
                s[0, j] = common[0, j] + common[3, j] + across * common[5, j]
                s[1, j] = common[1, j] + common[4, j] + along * common[5, j]
                s[2, j] = common[2, j] + common[5, j] + common[6, j]
                for i in range(POSE):
                    s[i, j] += covariances[k, i, j]
            squared[k], determinant = squared_innovation(innovation, s, s_inverse)
            surprise += min(squared[k] + math.log(determinant), _OUTLIER_SURPRISE)
            if squared[k] <= gate:
                take_in(x, p, common, innovation, s_inverse, gain)
        if kept:
            keep(history.filtered, history.filtered_covariance, k, x, p)
    return squared, surprise


@kernel()
def _variance(errors: FloatArray, i: int) -> float:
    """Stationary variance of the error of x, y (m^2) or the heading (rad^2)."""
    sigma = errors[1] if i == 2 else errors[0]
    return float(sigma * sigma)


def smooth_localisation(
    problem: LocalisationProblem, errors: FloatArray, times_s: FloatArray
) -> tuple[PlanarPoses, FloatArray, float]:
    """The path at some of odometry's times (N,), from odometry that is a localisation.

    `errors` (4,) are those of `learn_localisation`. Returns poses with covariances, the squared
    normalised innovations of the measurements (M,), and the heading's offset (rad).
    """
    there, _ = interpolate_poses(problem.odometry, times_s)
    none = Differences(
        times_s,
        np.full((len(times_s), POSE), np.nan),
        np.zeros((len(times_s), POSE, POSE)),
        there.poses[:, :2] - problem.centroid,
    )
    both = [np.concatenate(pair) for pair in zip(none, problem.measured)]
    order = np.argsort(both[0], kind="stable")
    merged = Differences(*(values[order] for values in both))
    history = empty_history(len(order), _STATE)
    squared, _ = _filter(merged, errors, problem.gate, history)
    states, spreads = smooth_backward(history)
    own = np.flatnonzero(order < len(times_s))
    h = np.zeros((len(own), POSE, _STATE))
    h[:, [0, 0, 1, 1, 2, 2, 2], [0, 3, 1, 4, 2, 5, 6]] = 1.0
    h[:, 0, 5], h[:, 1, 5] = -merged.offsets[own, 1], merged.offsets[own, 0]
    poses = there.poses + np.einsum("nij,nj->ni", h, states[own])
    poses[:, 2] = wrap_angle(poses[:, 2])
    covariances = h @ spreads[own] @ np.swapaxes(h, 1, 2)
    return (
        PlanarPoses(times_s, poses, covariances),
        squared[order >= len(times_s)],
        float(states[-1, 6]),
    )


def as_localisation(
    odometry: PlanarPoses, problem: MovementProblem, noise: FloatArray, times_s: FloatArray
) -> tuple[PlanarPoses, FloatArray, LocalisationErrors] | None:
    """The path from odometry that is a localisation, if it clearly is one.

    `problem` has the same odometry, `noise` (4,) its random errors over seconds, `times_s` (N,)
    those of the path. The squared normalised innovations (M,) are infinite where measurements were
    left out.
    """
    thin = problem.thinned(_SPACING_S)
    if len(thin.streams) < _FEWEST or len(problem.split(_LEAST_GAP_S)) < 2:
        return None
    errors, surprise = learn_localisation(localisation_problem(odometry, thin))
    if not surprise < thin.account(noise).surprise - _CLEAR_LEAD:
        return None
    poses, squared, offset = smooth_localisation(
        localisation_problem(odometry, problem), errors, times_s
    )
    return poses, squared, LocalisationErrors(*(float(error) for error in (*errors, offset)))
