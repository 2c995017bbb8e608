"""The robot's clock: time offset, drift and angle offset, segment by segment.

Odometry and ground truth describe the path of one robot (RAWSEEDS D2.1 part 2 compares its
headings). Offsets to a tenth of a second are found from movements over seconds
(`redetect.groundtruth.fusion.coarse_offset`). Then the likelihood of the measured poses, given
odometry's movements and their errors, is maximised: once for the headings of the ground truth
alone, and once for its full poses, if they have covariances, so that curves of the path and changes
of speed contribute, too. The more certain result is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import Bounds, minimize, minimize_scalar

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion import stream_errors
from redetect.groundtruth.fusion.clock import ClockModel, ClockSegment, ClockStatus, on_one_line
from redetect.groundtruth.fusion.coarse_offset import NEAR_S, OffsetSearch, Splits
from redetect.groundtruth.fusion.fuse import maximum_likelihood_noise, variance_inflation
from redetect.groundtruth.fusion.movement import MovementProblem, movement_problem
from redetect.groundtruth.fusion.resets import continuous_odometry
from redetect.groundtruth.settings import FuseSettings, SyncSettings
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    last_of_each_time,
    segments_between_gaps,
)

_FEWEST_SAMPLES = 20
# Deviation of a position that was not measured (m).
_UNKNOWN_M = 1e4
_LEAST_WAY_M = 1.0
_SMOOTHED_SAMPLES, _SMOOTHED_S = 5, 0.5
_ROUNDS = 2
# Steps of the search (s, at the middle and at the ends). Of the parabola at its minimum: its grid,
# its rise at the ends of that, the widest one (of the bounds), and shares of it that are tried.
_STEP_S = 0.005
_GRID, _RISE, _WIDEST, _SHRUNK = (-1.0, -0.5, 0.0, 0.5, 1.0), 15.0, 0.5, (1.0, 0.3, 0.1)
# Ratio of the errors in simulated sessions to the deviations from the likelihood's curvature, since
# errors of wheels do not follow the model exactly.
_SIGMA_FACTOR = 2.0
# Share of the bounds beyond which the search has not found a minimum within them.
_AT_A_BOUND = 0.999
# A segment determines the offset if its deviation is below this share of the search bound.
_LEAST_DETERMINED = 0.1
# The same for the drift, which is assumed to be 0 if it is not determined.
_DETERMINED_DRIFT = 0.025
_NEAR_S = 0.1
# Number of other offsets within the bounds, their least distance (deviations), and by how much
# their deviance must be higher: in straight drives it is by up to 30 (empirical).
_OTHERS, _OTHER_SIGMAS, _DISTINCT = 41, 4.0, 40.0
_ANOTHER_START_S = 0.2
_MOST_JUMPS = 3
_JUMP_OFFSETS = np.arange(-40, 41)
_JUMP_SPACING_S = 0.005
# Least decrease of the squared normalised errors by a jump.
_JUMP_GAIN = 60.0
_JUMP_SIGMAS = 3.5
_LEAST_JUMP_S = 0.004
_LEAST_PART_S = 5.0
_LARGEST_DRIFT_OF_A_QUARTZ = 2e-4
_NO_ODOMETRY = "no odometry"
_DEFAULT = SyncSettings()


def synchronise(
    odometry: PlanarPoses, groundtruth: PlanarPoses, settings: SyncSettings = _DEFAULT
) -> tuple[ClockSegment, ...]:
    """Align the odometry's clock with the ground truth's, per segment of the ground truth.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses on its own clock.
    groundtruth : PlanarPoses
        Poses on the ground truth's clock; without covariances only their headings are used. Of
        several of one time, in either, the last counts.

    Returns
    -------
    tuple of ClockSegment
        In order. Segments without enough turns have the status `no turns`, those whose best clock
        is at a bound the status `at a bound`; both have infinite deviations and an offset
        inter- or extrapolated from the others (0 if no segment determines one). A segment in which
        the clock was set is split there: its parts have the status `jump`. If one straight line
        through the session agrees with all segments, they get that line's values.

    Raises
    ------
    GroundTruthError
        If a stream has fewer than 20 poses, or they do not overlap.
    """
    odometry = continuous_odometry(last_of_each_time(odometry)).poses
    groundtruth = last_of_each_time(groundtruth)
    for name, poses in (("odometry", odometry), ("ground truth", groundtruth)):
        if len(poses) < _FEWEST_SAMPLES:
            raise GroundTruthError(
                f"{name} has {len(poses)} poses: expected {_FEWEST_SAMPLES} or more"
            )
    groundtruth = stream_errors.without_gross_errors(groundtruth)
    if groundtruth.covariances is not None:
        groundtruth, _ = stream_errors.with_usable_covariances("ground truth", groundtruth)
        groundtruth, _ = stream_errors.with_jitter_covered(groundtruth)
    slices = segments_between_gaps(groundtruth.times_s, settings.segment_gap_s)
    parts = [groundtruth.only(part) for part in slices]
    search = OffsetSearch(_smoothed(odometry), parts, settings.largest_offset_s)
    # Of all segments together, and of those before or after the clock was set.
    common_s = search.offset_s(parts, 0.0)
    near = replace(settings, largest_offset_s=min(settings.largest_offset_s, NEAR_S))
    no_match = (
        f"no offset within {settings.largest_offset_s:g} s and drift within "
        f"{settings.largest_drift:g} makes odometry's movements agree (--largest-offset-s, "
        "--largest-drift)"
    )
    found: list[ClockSegment] = []
    parts, set_at_s = _parted_where_set(parts, search, odometry.times_s, settings.largest_drift)
    for part in parts:
        around_s = search.offset_s([part], common_s)
        own = PlanarPoses(odometry.times_s - around_s, odometry.poses)
        best_s, drift = search.best_near(part, around_s, settings.largest_drift)
        start = np.array([best_s - around_s, drift])
        for clock in _segment(own, part, near, start, _MOST_JUMPS):
            clock = replace(clock, offset_s=clock.offset_s + around_s)
            here = part.only(part.during(clock.from_s, clock.to_s))
            if clock.is_determined and not search.matches(here, clock.offset_s, clock.rate - 1.0):
                clock = _undetermined(here, clock.turned_rad, no_match)
            beside = [at for at in set_at_s if at in (clock.from_s, clock.to_s)]
            found.append(_set_near(beside[0], clock) if beside else clock)
    if all(segment.note == _NO_ODOMETRY for segment in found):
        raise GroundTruthError(
            f"odometry from {odometry.times_s[0]:.3f} s to {odometry.times_s[-1]:.3f} s and ground "
            f"truth from {groundtruth.times_s[0]:.3f} s to {groundtruth.times_s[-1]:.3f} s do not "
            f"overlap within {settings.largest_offset_s:g} s"
        )
    return tuple(_interpolated(on_one_line(found)))


def _parted_where_set(
    parts: list[PlanarPoses], search: OffsetSearch, odometry_s: FloatArray, largest_drift: float
) -> tuple[list[PlanarPoses], list[float]]:
    """The parts of the ground truth, split where the clock was set by far, and the times beside."""
    found, times_s = [], []
    for part in parts:
        at_s = search.set_at_s(part, odometry_s, largest_drift)
        which = [part.times_s < at_s, part.times_s >= at_s] if at_s is not None else [slice(None)]
        halves = [part.only(one) for one in which]
        if len(halves) == 2:
            times_s += [float(halves[0].times_s[-1]), float(halves[1].times_s[0])]
        found += halves
    return found, times_s


def _segment(
    odometry: PlanarPoses, segment: PlanarPoses, bounds: SyncSettings, start: FloatArray,
    jumps_left: int,
) -> list[ClockSegment]:  # fmt: skip
    """One segment's clock; several parts if the clock was set within it.

    `start` (2,): offset at the middle (s) and drift from which the refinement starts.
    """
    # Means of ten, with less noise.
    tens = np.array_split(segment.continuous[:, 2], max(len(segment) // 10, 1))
    means = [part.mean() for part in tens]
    turned = float(np.sum(np.abs(np.diff(means))))
    reach = bounds.largest_offset_s + bounds.largest_drift * float(np.ptp(segment.times_s))
    near = odometry.during(segment.times_s[0] - 2.0 * reach, segment.times_s[-1] + 2.0 * reach)
    if len(segment) < _FEWEST_SAMPLES:
        few = f"{len(segment)} poses of the ground truth: expected {_FEWEST_SAMPLES} or more"
        return [_undetermined(segment, turned, few)]
    if np.count_nonzero(near) < _FEWEST_SAMPLES:
        return [_undetermined(segment, turned, _NO_ODOMETRY)]
    own = _smoothed(odometry.only(near))
    # The part covered by odometry, for all offsets within the bounds.
    measured = segment.only(segment.during(own.times_s[0] + reach, own.times_s[-1] - reach))
    if len(measured) < _FEWEST_SAMPLES:
        return [_undetermined(segment, turned, _NO_ODOMETRY)]
    jittered = _with_jitter(measured, own, stream_errors.rounding_sigmas(odometry.only(near)))
    fits = _fits_of_segment(own, jittered, start, bounds, measured.covariances is not None)
    no_offset = (
        f"its turns show no offset with a drift within {bounds.largest_drift:g} (--largest-drift)"
    )
    if fits is None:
        return [_undetermined(segment, turned, no_offset)]
    by_headings, best = fits
    # If the clock was set in between, the parts have clocks of their own.
    place = _jump(best, odometry.times_s, bounds) if jumps_left > 0 else None
    if place is not None:
        parts = []
        for which in (segment.times_s < place, segment.times_s >= place):
            part = segment.only(which)
            away_s = np.mean(part.times_s) - np.mean(segment.times_s)
            moved = np.array([start[0] + start[1] * away_s, start[1]])
            parts += _segment(odometry, part, bounds, moved, jumps_left - 1)
        if _differ(parts):
            return [_set_near(place, part) for part in parts]
    if not by_headings.is_distinct(bounds.largest_offset_s):
        return [_undetermined(segment, turned, no_offset)]
    reference_s = float(np.mean(measured.times_s))
    offset_s, drift = best.clock.tolist()
    times_s = measured.times_s + offset_s + drift * (measured.times_s - reference_s)
    angles = measured.poses[:, 2] - np.interp(times_s, own.times_s, own.continuous[:, 2])
    if np.any(np.abs(best.clock) > _AT_A_BOUND * np.array(bounds.largest)):
        note = (
            f"the best offset ({offset_s:+.2f} s beside the expected one) or drift ({drift:+.4f}) "
            "is at a bound of the search (--largest-offset-s, --largest-drift)"
        )
        return [replace(_undetermined(segment, turned, note), status=ClockStatus.AT_A_BOUND)]
    return [
        ClockSegment(
            from_s=float(segment.times_s[0]),
            to_s=float(segment.times_s[-1]),
            reference_s=reference_s,
            offset_s=offset_s,
            rate=1.0 + drift,
            angle_rad=float(np.angle(np.mean(np.exp(1j * angles)))),
            sigma_offset_s=float(best.sigmas[0]),
            sigma_rate=float(best.sigmas[1]),
            turned_rad=turned,
        )
    ]


def _fits_of_segment(
    odometry: PlanarPoses,
    measured: PlanarPoses,
    start: FloatArray,
    bounds: SyncSettings,
    whole: bool,
) -> tuple[ClockFit, ClockFit] | None:
    """The clock by headings alone, and the more certain of this and that by whole poses, if known.

    None if turns do not determine the offset.
    """
    headings_alone = stream_errors.with_common(
        measured, np.diag([_UNKNOWN_M**2, _UNKNOWN_M**2, 0.0])
    )
    by_headings = _most_likely_clock(odometry, headings_alone, start, bounds)
    least = _LEAST_DETERMINED * bounds.largest_offset_s
    if by_headings is None or not by_headings.sigmas[0] < least:
        return None
    driven = np.sum(np.hypot(*np.diff(odometry.poses[:, :2], axis=0).T))
    if not whole or driven < _LEAST_WAY_M:
        return by_headings, by_headings
    # Headings of a robot that hardly turns are a poor start.
    far = abs(start[0] - by_headings.clock[0]) > _ANOTHER_START_S
    starts = [by_headings.clock, start] if far else [by_headings.clock]
    fits = [_most_likely_clock(odometry, measured, at, bounds) for at in starts]
    maxima = [fit for fit in fits if fit is not None]
    by_poses = min(maxima, key=lambda fit: fit.deviance, default=by_headings)
    return by_headings, min((by_headings, by_poses), key=lambda fit: fit.uncertainty(measured))


def _set_near(time_s: float, clock: ClockSegment) -> ClockSegment:
    """The clock of a segment at an end of which it was set."""
    if clock.status != ClockStatus.OK:
        return clock
    return replace(clock, status=ClockStatus.JUMP, note=f"the clock was set near {time_s:.2f} s")


class ClockFit(NamedTuple):
    """The maximum likelihood estimate of the clock, given odometry's movements."""

    clock: FloatArray  # (2,): offset at the reference time (s), drift
    sigmas: FloatArray  # (2,)
    problem_at: Callable[[FloatArray], MovementProblem]  # By the clock
    noise: FloatArray  # (4,): odometry's random errors

    @property
    def deviance(self) -> float:
        """Minus twice the log-likelihood."""
        return self.problem_at(self.clock).innovations(self.noise).deviance

    def is_distinct(self, largest_offset_s: float) -> bool:
        """Whether no other offset within a bound is nearly as likely.

        Where nothing shows the offset, jitter makes the likelihood rough: it has maxima, with a
        curvature, anywhere.
        """
        offsets = np.linspace(-largest_offset_s, largest_offset_s, _OTHERS)
        near = max(_OTHER_SIGMAS * float(self.sigmas[0]), _NEAR_S)
        limit = self.deviance + _DISTINCT
        return all(
            self._replace(clock=np.array([offset, self.clock[1]])).deviance > limit
            for offset in offsets[np.abs(offsets - self.clock[0]) > near].tolist()
        )

    def squared(self, clock: FloatArray) -> FloatArray:
        """(M,) squared normalised errors of the measured poses with another clock, gated."""
        problem = self.problem_at(clock)
        return np.minimum(problem.innovations(self.noise).squared, problem.gate())

    def uncertainty(self, measured: PlanarPoses) -> float:
        """Variance of the offset at the ends of the measurements (s^2)."""
        half = 0.5 * float(np.ptp(measured.times_s))
        return float(np.sum(np.square(self.sigmas * [1.0, half])))


def _most_likely_clock(
    odometry: PlanarPoses, measured: PlanarPoses, start: FloatArray, bounds: SyncSettings
) -> ClockFit | None:
    """The most likely clock near a start and within the bounds; None without a maximum."""
    reference_s = float(np.mean(measured.times_s))
    largest = np.array(bounds.largest)
    half = 0.5 * float(np.ptp(measured.times_s))

    def problem_at(clock: FloatArray) -> MovementProblem:
        offset_s, drift = clock
        times = (odometry.times_s - offset_s + drift * reference_s) / (1.0 + drift)
        own = PlanarPoses(times, odometry.poses)
        return movement_problem(own, {"pose": measured}, FuseSettings())

    def deviance(clock: FloatArray) -> float:
        # The prior is uniform between the bounds.
        prior = 3.0 * float(np.sum(np.square(clock / largest)))
        return problem_at(clock).innovations(noise).deviance + prior

    unit = np.minimum([_STEP_S, _STEP_S / half], largest)
    clock, found = np.clip(start, -0.999 * largest, 0.999 * largest), None
    for _ in range(_ROUNDS):
        problem = problem_at(clock)
        noise = maximum_likelihood_noise(problem)
        noise *= math.sqrt(variance_inflation(problem, noise))
        if found is None:
            inward = np.where(clock > 0.0, -unit, unit)
            corners = (clock + np.vstack([np.zeros(2), np.diag(inward)])) / unit
            descended = minimize(
                lambda x, unit: deviance(x * unit),
                clock / unit,
                (unit,),
                method="Nelder-Mead",
                bounds=Bounds(-largest / unit, largest / unit),
                options={"xatol": 0.05, "fatol": 0.1, "initial_simplex": corners},
            )
            clock = unit * descended.x
        found = _parabola(deviance, clock, unit, largest)
        if found is None:
            return None
        clock, unit = found
    sigmas = _SIGMA_FACTOR * unit
    # If the drift is not determined, it is 0.
    if not sigmas[1] < _DETERMINED_DRIFT * largest[1]:
        offset_s = minimize_scalar(
            lambda offset_s: deviance(np.array([offset_s, 0.0])),
            bounds=np.clip(clock[0] + [-_NEAR_S, _NEAR_S], -largest[0], largest[0]),
            method="bounded",
            options={"xatol": 1e-4},
        ).x
        clock, sigmas = np.array([offset_s, 0.0]), np.array([sigmas[0], largest[1] / math.sqrt(3)])
    return ClockFit(clock, sigmas, problem_at, noise)


def _parabola(
    deviance: Callable[[FloatArray], float], at: FloatArray, step: FloatArray, largest: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Minimum (2,) of minus twice the log-likelihood of two unknowns, and deviations (2,).

    Between samples odometry's path is interpolated, so that the likelihood has kinks: the parabola
    is fitted over a range in which it rises by much more than these. What it leaves is included in
    the deviations.
    """
    here, steps = deviance(at), np.minimum(step, _WIDEST * largest)
    for k, axis in enumerate(np.eye(2)):
        while steps[k] < _WIDEST * largest[k]:
            rise = 0.5 * sum(deviance(at + sign * steps * axis) for sign in (-1.0, 1.0)) - here
            if rise > _RISE:
                break
            steps[k] = min(1.6 * steps[k], _WIDEST * largest[k])
    grid = np.array(list(product(_GRID, repeat=2)))
    x, y = grid.T
    design = np.column_stack([x, y, 0.5 * x * x, x * y, 0.5 * y * y, np.ones(len(x))])
    inverse = np.linalg.inv(design.T @ design)
    for scale in _SHRUNK:
        values = np.array([deviance(at + scale * steps * point) for point in grid])
        c = inverse @ design.T @ values
        curvature = np.array([[c[2], c[3]], [c[3], c[4]]])
        if np.linalg.eigvalsh(curvature)[0] > 0.0:
            root = np.linalg.inv(curvature)
            kinks = float(np.sum((values - design @ c) ** 2)) / (len(x) - len(c))
            sigmas = np.sqrt(np.diag(2.0 * root + kinks * root @ inverse[:2, :2] @ root))
            minimum = np.clip(-root @ c[:2], -1.0, 1.0)
            return at + scale * steps * minimum, scale * steps * sigmas
    return None


def _with_jitter(measured: PlanarPoses, odometry: PlanarPoses, rounding: FloatArray) -> PlanarPoses:
    """Measured poses with odometry's own jitter and rounding added to their covariances.

    A localisation jitters from sample to sample, and this error does not accumulate.
    """
    covariances = measured.covariances
    if covariances is None:
        covariances = np.diag([0.0, 0.0, stream_errors.white_noise_sigmas(measured)[2] ** 2])
    # Between two samples odometry's path may be off its chord by the sagitta of a parabola.
    sagitta = np.sqrt(np.mean(np.square(np.diff(odometry.continuous, 2, axis=0)), axis=0)) / 8.0
    variances = stream_errors.white_noise_sigmas(odometry) ** 2 + sagitta**2 + rounding**2
    own = np.tile(np.diag(variances), (len(measured), 1, 1))
    return PlanarPoses(measured.times_s, measured.poses, covariances + own)


def _smoothed(odometry: PlanarPoses) -> PlanarPoses:
    """Means of up to five samples, since single ones are noisier than interpolated ones.

    If samples have a constant phase relative to the measured poses, that difference would look like
    a better or worse fit of the clock.
    """
    # Relative to the first one, since sums of times since 1970 lose digits.
    begin_s = odometry.times_s[0]
    columns = np.column_stack([odometry.times_s - begin_s, odometry.continuous])
    interval_s = float(np.median(np.diff(odometry.times_s)))
    aside = min(_SMOOTHED_SAMPLES, int(_SMOOTHED_S / interval_s)) // 2
    means = uniform_filter1d(columns, 1 + 2 * aside, axis=0)
    return PlanarPoses(begin_s + means[:, 0], means[:, 1:])


def _jump(fit: ClockFit, odometry_s: FloatArray, bounds: SyncSettings) -> float | None:
    """Time at which the clock was set, on the ground truth's clock; None if it was not.

    The parts before and after a time have the best of many offsets, without drift; a jump is found
    if both together fit much better than the best clock without one.
    """
    offsets = fit.clock[0] + max(float(fit.sigmas[0]), _JUMP_SPACING_S) * _JUMP_OFFSETS
    offsets = offsets[np.abs(offsets) <= bounds.largest_offset_s]
    squared = np.array([fit.squared(np.array([offset, 0.0])) for offset in offsets])
    splits = Splits.of([squared], fit.problem_at(fit.clock).measured_s, _LEAST_PART_S)
    if not float(np.sum(fit.squared(fit.clock)) - np.min(splits.costs)) >= _JUMP_GAIN:
        return None
    return splits.jump_s(offsets, odometry_s)


def _differ(parts: list[ClockSegment]) -> bool:
    """Whether the clock is determined before and after a jump, and differs there."""
    for before, after in pairwise([part for part in parts if part.is_determined]):
        place = 0.5 * (before.to_s + after.from_s)
        offsets, variances = [], []
        for part in (before, after):
            away = place - part.reference_s
            offsets.append(part.offset_s + (part.rate - 1.0) * away)
            # If the drift is not determined, it still is that of a quartz.
            rate_sigma = min(part.sigma_rate, _LARGEST_DRIFT_OF_A_QUARTZ)
            variances.append(part.sigma_offset_s**2 + (rate_sigma * away) ** 2)
        jump = abs(offsets[1] - offsets[0])
        if jump > _LEAST_JUMP_S and jump > _JUMP_SIGMAS * math.sqrt(sum(variances)):
            return True
    return False


def _undetermined(segment: PlanarPoses, turned_rad: float, note: str) -> ClockSegment:
    from_s, to_s, at_s = (float(f(segment.times_s)) for f in (np.min, np.max, np.mean))
    status = ClockStatus.NO_TURNS
    return ClockSegment(from_s, to_s, at_s, turned_rad=turned_rad, status=status, note=note)


def _interpolated(segments: list[ClockSegment]) -> list[ClockSegment]:
    """The segments, with clocks of undetermined ones from the others, as in `ClockModel`."""
    determined = [segment for segment in segments if segment.is_determined]
    if not determined:
        return segments
    model, first, last = ClockModel(tuple(determined)), determined[0], determined[-1]
    found = []
    for s in segments:
        if not s.is_determined:
            offset_s = float(model.robot_times(s.reference_s)) - s.reference_s
            beyond = first if s.to_s <= first.from_s else last if s.from_s >= last.to_s else s
            s = replace(s, offset_s=offset_s, rate=beyond.rate)
        found.append(s)
    return found
