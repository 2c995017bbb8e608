"""Fusion of odometry with ground truths: Kalman filter forward, smoothing backward (RAWSEEDS D2.1).

Odometry is the control, poses from laser and markers are the measurements. Systematic errors of
odometry (scale of turns and distances, a bend) are part of the state, since they determine how well
a gap can be bridged; its random errors are estimated by maximum likelihood. The nodes are the times
of odometry and of the measurements, between which odometry moves along arcs; so no measurement is
interpolated, which would count the same noise twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import chdtri

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.inputs import (
    noise_of,
    pauses_of,
    systematic_sigmas,
    with_interpolation_error,
)
from redetect.groundtruth.fusion.kernels import POSE
from redetect.groundtruth.fusion.localisation import LocalisationErrors, as_localisation
from redetect.groundtruth.fusion.movement import MovementProblem, Smoothed, movement_problem
from redetect.groundtruth.fusion.resets import continuous_odometry
from redetect.groundtruth.fusion.slips import UNMEASURED_S, slipped_intervals
from redetect.groundtruth.fusion.stream_errors import (
    rounding_sigmas,
    with_common,
    with_jitter_covered,
    with_usable_covariances,
)
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    last_of_each_time,
    moved_poses,
    planar_alignment,
    segments_between_gaps,
)
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.messages import counted
from redetect.plane import pose_differences

# Factors on odometry's standard deviations that are tried, and the number of nodes used.
_NOISE_FACTORS = (0.01, 20.0)
_MOST_NODES_TO_LEARN_FROM = 30_000
_LONGEST_GAP_TO_LEARN_FROM_S = 20.0
_LEARNING_ROUNDS = 2
# Number of rounds for the factor of variances over seconds, and significance level for too small
# ones.
_LOOSENING_ROUNDS = 3
_DOUBT = 0.001
# Akaike's criterion: by chance, an estimate fits its own measurements better by this.
_COST_OF_TERM = 2.0
# Share of its prior standard deviation below which an estimate counts as measured.
_MEASURED = 0.5
# A longer pause in the ground truth begins another segment; fused poses and odometry are not
# interpolated over a longer one.
_SEGMENT_GAP_S = 5.0
_LARGEST_GAP_S = 2.0
# Odometry that moves less than the first, while measured poses move more than the second, has
# headings alone (m).
_STANDS_M, _MOVES_M = 0.01, 1.0
# Most measurements at a start that are rejected because most of those after them contradict them,
# and numbers of these.
_MOST_WRONG, _FEWEST_JUDGES, _MOST_JUDGES = 6, 3, 10
_DEFAULT = FuseSettings()


def maximum_likelihood_noise(problem: MovementProblem) -> FloatArray:
    """Maximum likelihood estimate of odometry's random errors, near those given.

    Long gaps are excluded: a linearised filter may be lost at their ends, and then the likelihood
    does not depend on the noise.
    """
    some = problem.shortened(_MOST_NODES_TO_LEARN_FROM).split(_LONGEST_GAP_TO_LEARN_FROM_S)
    given = noise_of(problem.settings)
    logarithms = np.zeros(3)
    bounds, options = tuple(math.log(factor) for factor in _NOISE_FACTORS), {"xatol": 0.05}

    def scaled(values: FloatArray) -> FloatArray:
        return np.asarray(given * np.exp(values[[0, 1, 2, 2]]))

    for _ in range(_LEARNING_ROUNDS):
        for axis in (2, 0, 1):

            def deviance(value: float, axis: int = axis) -> float:
                tried = logarithms.copy()
                tried[axis] = value
                return sum(part.innovations(scaled(tried)).deviance for part in some)

            found = minimize_scalar(deviance, bounds=bounds, method="bounded", options=options)
            logarithms[axis] = float(found.x)
    return scaled(logarithms)


def variance_inflation(
    problem: MovementProblem,
    noise: FloatArray,
    systematic: tuple[FloatArray, FloatArray] | None = None,
) -> float:
    """Factor of odometry's variances over seconds to those expected from single samples.

    A localisation, or filtered odometry, has smooth errors: small from sample to sample, but large
    over a gap. So its predictions between measurements seconds apart are compared with these. The
    factor is 1 unless the errors are significantly larger. `systematic`: as for
    `MovementProblem.innovations`.
    """
    short = problem.shortened(_MOST_NODES_TO_LEARN_FROM)
    # Outliers would look like odometry's errors, more so where few others are left.
    short = short.with_only(short.innovations(noise, systematic).accepted)
    some = [part.thinned() for part in short.split(_LONGEST_GAP_TO_LEARN_FROM_S)]
    numbers = POSE * sum(len(part.streams) - 1 for part in some)
    if numbers == 0:
        return 1.0
    inflation = 1.0
    for _ in range(_LOOSENING_ROUNDS):
        # The first one of each part gives no information on odometry.
        tried = (part.innovations(math.sqrt(inflation) * noise, systematic) for part in some)
        squared = sum(float(np.minimum(one.squared[1:], problem.gate()).sum()) for one in tried)
        if inflation == 1.0 and squared < chdtri(numbers, _DOUBT):
            return 1.0
        inflation *= max(squared / numbers, 1.0)
    return inflation


def useful_terms(
    problem: MovementProblem, noise: FloatArray, means: FloatArray, sigmas: FloatArray
) -> BoolArray:
    """(3,) mask of odometry's systematic errors whose estimates improve predictions over seconds.

    They are estimated from sample to sample. If these include odometry's own jitter, which measured
    poses do not confirm, a spurious scale of turns results (regression dilution). Over seconds, and
    over gaps, such an estimate makes predictions worse.
    """
    thin = problem.thinned().split(math.inf)
    kept = sigmas > 0.0

    def aic(terms: BoolArray) -> float:
        found = (part.innovations(noise, (means * terms, sigmas * terms)) for part in thin)
        return sum(part.deviance for part in found) + _COST_OF_TERM * np.count_nonzero(terms)

    best = aic(kept)
    # Terms that were hardly measured keep their uncertainty.
    measured = sigmas < _MEASURED * systematic_sigmas(problem.settings)
    while np.any(kept & measured):
        fewer = [kept & (np.arange(3) != term) for term in np.flatnonzero(kept & measured)]
        tried = [aic(terms) for terms in fewer]
        if min(tried) > best:
            break
        best, kept = min(tried), fewer[int(np.argmin(tried))]
    return kept


@dataclass(frozen=True)
class Rejected:
    """A measurement that the gate rejected."""

    stream: str  # Its stream
    time_s: float
    squared_innovation: float  # Squared normalised innovation


def _rejected(problem: MovementProblem, squared: FloatArray, which: BoolArray) -> list[Rejected]:
    """Those measurements (M,), with their squared normalised innovations."""
    columns = (problem.streams, problem.measured_s, squared)
    return [Rejected(*row) for row in zip(*(column[which].tolist() for column in columns))]


def wrong_starts(problem: MovementProblem) -> FloatArray:
    """(M,) squared innovations of measurements at the start, or after a gap, that most of those
    after them contradict; 0 of others.

    The filter would begin there, and reject the right ones.
    """
    squared, times_s = np.zeros(len(problem.streams)), problem.measured_s
    noise, every = noise_of(problem.settings), np.arange(len(times_s))
    for run in segments_between_gaps(times_s, UNMEASURED_S):
        for first in range(run.start, min(run.start + _MOST_WRONG, run.stop - _FEWEST_JUDGES)):
            judged = (every >= first) & (every <= min(first + _MOST_JUDGES, run.stop - 1))
            (part,) = problem.with_only(judged).split(math.inf)
            found = part.innovations(noise)
            if np.mean(found.accepted[1:]) > 0.5:
                break
            squared[first] = np.median(found.squared[1:])
        else:
            squared[run] = 0.0  # Those after them do not agree either.
    return squared


@dataclass(frozen=True)
class OdometryErrors:
    """Odometry's errors estimated from the measurements."""

    turn_scale: float  # Relative excess of true turns over odometry's
    turn_bias_per_metre: float  # Turn that odometry misses per metre (rad)
    distance_scale: float  # Relative excess of true distances over odometry's
    turn_scale_sigma: float  # Standard deviations of these three
    turn_bias_per_metre_sigma: float
    distance_scale_sigma: float
    distance_sigma: float  # Random errors, as in `FuseSettings`
    lateral_sigma: float
    turn_sigma: float
    turn_per_metre_sigma: float
    looser_in_gaps: float  # Factor on their variances if nothing is measured for over a second


@dataclass(frozen=True, eq=False)
class Fusion:
    """The robot's path from all streams."""

    poses: PlanarPoses  # At odometry's times from the first measurement to the last
    filtered: PlanarPoses  # The same from the filter alone: each from measurements until then
    rejected: tuple[Rejected, ...]  # In order of time
    restarts_s: tuple[float, ...]  # When the filter restarted, as measurements did not fit any more
    used: dict[str, int]  # Number of measurements used, by stream
    odometry: OdometryErrors  # The estimated errors of odometry
    localisation: LocalisationErrors | None  # Errors of odometry treated as a localisation
    repaired: dict[str, int]  # Number of covariances that were not positive definite, by stream
    # Short-term scatter of the poses over their stated standard deviations, by stream; 1 if these
    # may be right. They were raised to it; to learn odometry's noise, too large ones were lowered.
    jitter: dict[str, float]
    # Intervals in which odometry contradicts the measured poses for good, as after a slip of its
    # wheels, and its pauses: the covariances do not rely on it there.
    slips_s: tuple[tuple[float, float], ...]
    pauses_s: tuple[tuple[float, float], ...]
    # Times before and after steps of odometry that no robot can make: they are left out.
    resets_s: tuple[tuple[float, float], ...]


def fuse(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings = _DEFAULT
) -> Fusion:
    """Fuse odometry with poses measured by other means.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses, on the measurements' clock; only movements between them count.
    streams : mapping of str to PlanarPoses
        Measured poses with covariances, by name.

    Raises
    ------
    GroundTruthError
        If there is no measurement within the odometry's time, or no sample of odometry between the
        first measurement and the last; if a stream has no covariances, or one of them cannot be
        repaired; if odometry has no distances.
    """
    usable = {name: with_usable_covariances(name, one) for name, one in streams.items()}
    covered = {name: with_jitter_covered(stream) for name, (stream, _) in usable.items()}
    own = last_of_each_time(odometry)
    driven, resets_s = continuous_odometry(own)
    of_x, of_y, of_heading = rounding_sigmas(own)
    rounding = np.diag(np.square([max(of_x, of_y)] * 2 + [of_heading]))
    streams = {
        name: with_common(with_interpolation_error(stream, driven), rounding)
        for name, (stream, _) in covered.items()
    }
    problem = movement_problem(driven, streams, settings, own.times_s)
    wrong = wrong_starts(problem)
    rejected = _rejected(problem, wrong, wrong > 0.0)
    problem = problem.with_only(wrong == 0.0)
    first, last = problem.times_s[0], problem.times_s[-1]
    inside = odometry.times_s[odometry.during(first, last)]
    if not len(inside):
        raise GroundTruthError(
            f"no sample of odometry from the first measured pose ({first:.3f} s) to the last "
            f"({last:.3f} s): expected some, which are the times of the result"
        )
    moved_m = float(np.max(np.ptp(problem.measured.poses[:, :2], axis=0)))
    if np.max(np.ptp(odometry.poses[:, :2], axis=0)) < _STANDS_M and moved_m > _MOVES_M:
        raise GroundTruthError(
            f"odometry stays at one place, while the measured poses move by {moved_m:.1f} m: "
            "expected distances, too, not headings alone"
        )
    # Odometry's random errors, and its systematic errors as part of the state.
    noise, inflation = noise_of(settings), 1.0
    if settings.learn_noise:
        least = np.array([min(covered[name][1], 1.0) for name in problem.streams])
        learn = problem.with_covariances(least[:, None, None] ** 2 * problem.measured.covariances)
        noise = maximum_likelihood_noise(learn)
    # Before the errors over seconds, to which slips would contribute.
    problem = problem.with_slips(noise)
    if settings.learn_noise:
        systematic = _systematic(problem.smooth(noise))
        inflation = variance_inflation(replace(learn, slips=problem.slips), noise, systematic)
    smoothed = problem.smooth(noise, inflation)
    # Again without the systematic errors that do not improve predictions over seconds.
    over_seconds = math.sqrt(inflation) * noise
    kept = useful_terms(problem, over_seconds, *_systematic(smoothed))
    if not np.all(kept):
        names = ("turn_scale_sigma", "turn_bias_per_metre_sigma", "distance_scale_sigma")
        fewer: dict[str, Any] = {name: 0.0 for name, keep in zip(names, kept) if not keep}
        problem = replace(problem, settings=replace(settings, **fewer)).with_slips(noise)
        smoothed = problem.smooth(noise, inflation)

    # Smoothed and filtered path at the samples of odometry.
    at = np.searchsorted(problem.times_s, inside)
    path = with_common(_path(inside, smoothed.states[at], smoothed.covariances[at]), rounding)
    states, spreads = problem.filtered(noise)
    innovations, restarted = smoothed.innovations, smoothed.innovations.restarted > 0
    # The errors of a localisation are stationary.
    localisation = None
    if settings.learn_noise:
        accepted = problem.with_only(innovations.accepted)
        found = as_localisation(own, accepted, over_seconds, smoothed.states[-1, POSE:], path)
        if found is not None:
            path, localisation = found
            restarted[:] = False
    rejected += _rejected(problem, innovations.squared, ~innovations.accepted)
    numbers = [*_systematic(smoothed), noise, np.array([inflation])]
    pauses = pauses_of(driven)
    return Fusion(
        poses=path,
        filtered=with_common(_path(inside, states[at], spreads[at]), rounding),
        rejected=tuple(sorted(rejected, key=lambda one: one.time_s)),
        restarts_s=tuple(float(time) for time in problem.times_s[restarted]),
        used={
            name: int(np.count_nonzero(innovations.accepted & (problem.streams == name)))
            for name in streams
        },
        odometry=OdometryErrors(*np.concatenate(numbers).tolist()),
        localisation=localisation,
        repaired={name: count for name, (_, count) in usable.items()},
        jitter={name: jitter for name, (_, jitter) in covered.items()},
        slips_s=slipped_intervals(problem.times_s, problem.slips),
        pauses_s=tuple(pause for pause in pauses if pause[1] > first and pause[0] < last),
        resets_s=tuple(reset for reset in resets_s if reset[1] > first and reset[0] < last),
    )


def _systematic(smoothed: Smoothed) -> tuple[FloatArray, FloatArray]:
    """(3,) odometry's systematic errors and their standard deviations.

    They are constants, whose estimate at the last node uses everything.
    """
    variances = np.diagonal(smoothed.covariances[-1])[POSE:]
    return smoothed.states[-1, POSE:], np.sqrt(np.maximum(variances, 0.0))


def _path(times_s: FloatArray, states: FloatArray, covariances: FloatArray) -> PlanarPoses:
    """The poses of states, headings within +-pi."""
    poses = states[:, :POSE].copy()
    poses[:, 2] = wrap_angle(poses[:, 2])
    return PlanarPoses(times_s, poses, covariances[:, :POSE, :POSE].copy())


@dataclass(frozen=True)
class LeftOut:
    """A segment of the ground truth, predicted without it."""

    from_s: float  # Start of the segment
    to_s: float
    poses: int  # Number of its ground truth poses with a prediction
    position_rms_m: float  # Root of the mean squared error of the fused path; NaN without poses
    heading_rms_rad: float
    normalised_error: float  # Mean squared normalised error per number, 1 if covariances are right
    aligned_position_rms_m: float  # The same for odometry, aligned with the other segments
    aligned_heading_rms_rad: float


def leave_out(
    odometry: PlanarPoses, streams: Mapping[str, PlanarPoses], settings: FuseSettings = _DEFAULT
) -> tuple[LeftOut, ...]:
    """Leave out each segment of the ground truth between two others, and predict it.

    Parameters as for `fuse`. Segments are those of the first stream; the others are left out at the
    same times. A fused path ends with the measured poses: the first and the last segment are not
    predicted. Raises `GroundTruthError` if there are fewer than three within the odometry's time.
    """
    truth = next(iter(streams.values()))
    own = last_of_each_time(odometry)
    truth = truth.only(truth.during(own.times_s[0], own.times_s[-1]))
    parts = [truth.times_s[s] for s in segments_between_gaps(truth.times_s, _SEGMENT_GAP_S)]
    if len(parts) < 3:
        raise GroundTruthError(
            f"{counted(len(parts), 'segment')} of ground truth within the odometry's time: "
            "expected 3 or more, to leave one out between two others"
        )
    found = []
    for times in parts[1:-1]:
        span = (float(times[0]), float(times[-1]))
        others = {name: one.only(~one.during(*span)) for name, one in streams.items()}
        path = fuse(own, others, settings).poses
        here = truth.during(*span)
        segment, rest = truth.only(here), truth.only(~here)
        predicted, known = interpolate_poses(path, segment.times_s, _LARGEST_GAP_S)
        error = pose_differences(predicted.poses, segment.only(known).poses)
        assert predicted.covariances is not None
        assert segment.covariances is not None
        covariances = predicted.covariances + segment.covariances[known]
        squared = squared_mahalanobis(error, covariances)
        nees = float(np.mean(squared) / 3.0) if len(squared) else np.nan
        beside, aligned = interpolate_poses(own, rest.times_s, _LARGEST_GAP_S)
        moved = moved_poses(own, planar_alignment(beside, rest.only(aligned)))
        rigid, known = interpolate_poses(moved, segment.times_s, _LARGEST_GAP_S)
        rigid_error = pose_differences(rigid.poses, segment.only(known).poses)
        found.append(LeftOut(*span, len(predicted), *_rms(error), nees, *_rms(rigid_error)))
    return tuple(found)


def _rms(difference: FloatArray) -> tuple[float, float]:
    """Root mean square of position (m) and heading (rad)."""
    if len(difference) == 0:
        return np.nan, np.nan
    squared = np.mean(np.square(difference), axis=0)
    return float(np.sqrt(squared[0] + squared[1])), float(np.sqrt(squared[2]))
