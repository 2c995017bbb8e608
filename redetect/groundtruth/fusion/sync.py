"""The robot's clock from headings: time offset, drift and angle offset, segment by segment.

The headings of odometry and ground truth are those of one robot; the offset and the rate between
their clocks minimise the squared difference, with the angle between their axes eliminated in closed
form (RAWSEEDS D2.1 part 2). The search is global and derivative-free and depends on no initial
value. Odometry's heading drifts, so that a plain sum of squares would explain drift by a time
offset. A second search around the first result therefore whitens the residuals, from which the
noise of the samples and the rate of the random walk are estimated.

Headings determine the time only through turns, and only as well as odometry's heading drift allows.
Where the ground truth has positions and covariances, the clock is refined, near the estimate by
headings, to maximise the likelihood of all measured poses given odometry's movements. Curves of the
path and changes of speed then contribute as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import Bounds, direct, minimize

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.clock import (
    ClockModel,
    ClockSegment,
    Status,
    knots_of,
    on_one_line,
)
from redetect.groundtruth.fusion.fuse import likeliest_noise
from redetect.groundtruth.fusion.headings import (
    HeadingPair,
    Wandering,
    continuous_headings,
    estimate_wandering,
    find_jump,
    pair_headings,
    without_turns,
)
from redetect.groundtruth.fusion.inputs import noise_of
from redetect.groundtruth.fusion.movement import MovementProblem, movement_problem
from redetect.groundtruth.settings import FuseSettings, SyncSettings
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    last_of_each_time,
    segments_between_gaps,
)
from redetect.landmarks import wrap_angle

_MOST_COARSE_SAMPLES = 400
_OUTLIER_SIGMAS = 6.0
_COARSE_SIGMA_RAD = 0.02
# A segment determines the offset, or the drift, if its deviation is below this share of the search
# bound.
_LEAST_DETERMINED = 0.1
_MOST_JUMPS = 3
_JUMP_SIGMAS = 3.5
_LEAST_JUMP_S = 0.004
_LARGEST_DRIFT_OF_A_QUARTZ = 2e-4
_FEWEST_SAMPLES = 20
_SIMPLEX_SIZE = 0.02
# Of variances: movement's are stated with a margin, so it is left only where headings clearly win.
_MUCH_LESS_CERTAIN = 4.0


def synchronise(
    odometry: PlanarPoses, groundtruth: PlanarPoses, settings: SyncSettings | None = None
) -> tuple[ClockSegment, ...]:
    """Align the odometry's clock with the ground truth's, per segment of the ground truth.

    Parameters
    ----------
    odometry : PlanarPoses
        The robot's own poses on its own clock; only headings and times are used.
    groundtruth : PlanarPoses
        Poses on the ground truth's clock. Of several of one time, in either, the last counts.

    Returns
    -------
    tuple of ClockSegment
        In order. Segments without enough turns have the status `no turns`, infinite deviations and
        an offset interpolated from the others (0 if no segment determines one). A segment in which
        the clock was set is split there: its parts have the status `jump`. If one straight line
        through the session agrees with all segments, they get that line's values.

    Raises
    ------
    GroundTruthError
        If a stream has fewer than 20 poses, or they do not overlap.
    """
    bounds = settings or SyncSettings()
    odometry, groundtruth = last_of_each_time(odometry), last_of_each_time(groundtruth)
    for name, poses in (("odometry", odometry), ("ground truth", groundtruth)):
        if len(poses) < _FEWEST_SAMPLES:
            raise GroundTruthError(
                f"{name} has {len(poses)} poses: expected {_FEWEST_SAMPLES} or more"
            )
    by_headings: list[ClockSegment] = []
    by_movement: list[ClockSegment] = []
    for part in segments_between_gaps(groundtruth.times_s, bounds.segment_gap_s):
        segment = groundtruth.only(part)
        own = _segment(odometry, segment, bounds, _MOST_JUMPS)
        refined = refine_by_movement(own, odometry, segment, bounds.largest)
        if len(refined) > 1 and not _differ(refined):
            # Headings suggested a jump of the clock that the whole movement does not confirm.
            own = _segment(odometry, segment, bounds, 0)
            refined = refine_by_movement(own, odometry, segment, bounds.largest)
        by_headings.extend(own)
        by_movement.extend(refined)
    if all(segment.turned_rad == 0.0 and segment.note == "no odometry" for segment in by_headings):
        raise GroundTruthError(
            f"odometry from {odometry.times_s[0]:.3f} s to {odometry.times_s[-1]:.3f} s and ground "
            f"truth from {groundtruth.times_s[0]:.3f} s to {groundtruth.times_s[-1]:.3f} s do not "
            f"overlap within {bounds.largest_offset_s:g} s"
        )
    best, alone = on_one_line(by_movement), on_one_line(by_headings)
    if _uncertainty(best) > _MUCH_LESS_CERTAIN * _uncertainty(alone):
        best = alone
    return tuple(_interpolated(best))


def _uncertainty(segments: list[ClockSegment]) -> float:
    """Variances of the offsets at the ends of the segments that are determined, summed up (s^2)."""
    return sum(
        segment.sigma_offset_s**2
        + (0.5 * segment.sigma_rate * (segment.to_s - segment.from_s)) ** 2
        for segment in segments
        if segment.status != "no turns"
    )


def _segment(
    odometry: PlanarPoses, segment: PlanarPoses, bounds: SyncSettings, jumps_left: int
) -> list[ClockSegment]:
    """One segment's clock; several parts where the clock was set within it."""
    pair = pair_headings(odometry, segment, bounds.largest, _FEWEST_SAMPLES)
    turned = float(np.sum(np.abs(np.diff(_smoothed(continuous_headings(segment))))))
    if pair is None:
        return [_undetermined(segment, 0.0, "no odometry")]
    offset, drift = _search(pair, bounds)
    pair = pair.kept(_inliers(pair, offset, drift))
    if len(pair.times_s) < _FEWEST_SAMPLES:
        return [_undetermined(segment, turned, "the headings have nothing in common")]
    for _ in range(2):
        wandering = estimate_wandering(
            pair.times_s, without_turns(pair.differences(offset, drift)), pair.systematic
        )
        offset, drift = _refine(pair, wandering, (offset, drift), bounds)
    sigma_offset_s, sigma_rate = _sigmas(pair, wandering, offset, drift, bounds).tolist()
    alone_s = float(_sigmas(pair, wandering, offset, drift, bounds, unknowns=1)[0])
    if not alone_s < _LEAST_DETERMINED * bounds.largest_offset_s:
        return [_undetermined(segment, turned, "turns too little to determine the offset")]
    note = ""
    if not sigma_rate < _LEAST_DETERMINED * bounds.largest_drift:
        note = "too short to determine the drift: assumed to be 0"
        offset, drift = _refine(pair, wandering, (offset, 0.0), bounds, unknowns=1)
        # Only at the reference time is the offset independent of the unknown drift.
        sigma_offset_s, sigma_rate = alone_s, bounds.largest_drift / math.sqrt(3.0)
    elif jumps_left > 0:
        place = find_jump(pair, offset, drift)
        if place is not None:
            parts = []
            for which in (segment.times_s < place, segment.times_s >= place):
                part = segment.only(which)
                if len(part) >= _FEWEST_SAMPLES:
                    parts += _segment(odometry, part, bounds, jumps_left - 1)
            if _differ(parts):
                return [
                    replace(part, status="jump", note=f"the clock was set near {place:.2f} s")
                    if part.status == "ok"
                    else part
                    for part in parts
                ]
    found, largest = np.abs([offset, drift]), np.array(bounds.largest)
    status: Status = "at a bound" if np.any(found > _AT_A_BOUND * largest) else "ok"
    level, level_sigma = wandering.level(
        without_turns(pair.differences(offset, drift), keep_mean=True)
    )
    return [
        ClockSegment(
            from_s=float(segment.times_s[0]),
            to_s=float(segment.times_s[-1]),
            reference_s=pair.reference_s,
            offset_s=offset,
            rate=1.0 + drift,
            angle_rad=float(wrap_angle(np.array(level))),
            sigma_offset_s=sigma_offset_s,
            sigma_rate=sigma_rate,
            sigma_angle_rad=level_sigma,
            turned_rad=turned,
            status=status,
            note=note,
        )
    ]


def _differ(parts: list[ClockSegment]) -> bool:
    """Whether the clock is determined before and after a jump, and differs there."""
    determined = [part for part in parts if part.status != "no turns"]
    for before, after in pairwise(determined):
        place = 0.5 * (before.to_s + after.from_s)
        offsets, variances = [], []
        for part in (before, after):
            away = place - part.reference_s
            offsets.append(part.offset_s + (part.rate - 1.0) * away)
            # A clock's drift is far smaller than the search bounds, which are used if it is open.
            rate_sigma = min(part.sigma_rate, _LARGEST_DRIFT_OF_A_QUARTZ)
            variances.append(part.sigma_offset_s**2 + (rate_sigma * away) ** 2)
        jump = abs(offsets[1] - offsets[0])
        if jump > _LEAST_JUMP_S and jump > _JUMP_SIGMAS * math.sqrt(sum(variances)):
            return True
    return False


def _smoothed(headings: FloatArray) -> FloatArray:
    """Headings without their noise, coarsely: means of ten."""
    count = max(len(headings) // 10, 1)
    return np.array([part.mean() for part in np.array_split(headings, count)])


def _sum_of_squares(pair: HeadingPair, offset_s: float, drift: float) -> float:
    """Squared differences after the best angle and the best of the systematic errors."""
    level = without_turns(pair.differences(offset_s, drift))
    level -= level.mean()
    shapes = pair.systematic
    # The systematic errors are weighted against a coarse guess of the noise.
    information = shapes.T @ shapes + _COARSE_SIGMA_RAD**2 * np.eye(shapes.shape[1])
    along = shapes.T @ level
    return float((level @ level - along @ np.linalg.solve(information, along)) / len(level))


def _search(pair: HeadingPair, bounds: SyncSettings) -> tuple[float, float]:
    """Global least squares: offset and drift, the angle eliminated."""
    stride = max(1, len(pair.times_s) // _MOST_COARSE_SAMPLES)
    coarse = pair.kept(np.arange(len(pair.times_s)) % stride == 0)
    box = Bounds([-1.0, -1.0], [1.0, 1.0])
    scale = np.array(bounds.largest)
    found = direct(lambda x: _sum_of_squares(coarse, *(x * scale)), box, maxfun=1500, maxiter=1000)
    best = _minimum(lambda x: _sum_of_squares(pair, *(x * scale)), found.x, 1e-6, 1e-14)
    offset, drift = best * scale
    return float(offset), float(drift)


def _simplex(start: FloatArray) -> FloatArray:
    """A first simplex inside the box of -1 to 1."""
    inward = np.where(start > 0.0, -_SIMPLEX_SIZE, _SIMPLEX_SIZE)
    return np.asarray(start + np.vstack([np.zeros(len(start)), np.diag(inward)]))


def _inliers(pair: HeadingPair, offset_s: float, drift: float) -> BoolArray:
    """Which samples are no gross errors of one of the streams."""
    level = without_turns(pair.differences(offset_s, drift))
    centre = float(np.median(level))
    sigma = float(np.median(np.abs(level - centre))) / 0.6745
    return np.asarray(np.abs(level - centre) <= max(_OUTLIER_SIGMAS * sigma, 1e-6))


def _refine(
    pair: HeadingPair,
    wandering: Wandering,
    start: tuple[float, float],
    bounds: SyncSettings,
    unknowns: int = 2,
) -> tuple[float, float]:
    """Least whitened squares near a result of the global search; of one unknown, the offset."""
    scale = np.array(bounds.largest)
    best = np.clip(np.array(start) / scale, -1.0, 1.0)

    def squared(x: FloatArray) -> float:
        tried = np.concatenate([x, best[unknowns:]]) * scale
        return wandering.squared(without_turns(pair.differences(*tried)))

    best[:unknowns] = _minimum(squared, best[:unknowns], 1e-7, 1e-9)
    offset, drift = best * scale
    return float(offset), float(drift)


def _minimum(
    cost: Callable[[FloatArray], float], start: FloatArray, xatol: float, fatol: float
) -> FloatArray:
    """Minimum of a cost within -1 to 1, near a start."""
    options = {"xatol": xatol, "fatol": fatol, "initial_simplex": _simplex(start)}
    box = Bounds(-1.0, 1.0)
    found = minimize(cost, start, method="Nelder-Mead", bounds=box, options=options)
    return np.asarray(found.x)


def _sigmas(
    pair: HeadingPair,
    wandering: Wandering,
    offset_s: float,
    drift: float,
    bounds: SyncSettings,
    unknowns: int = 2,
) -> FloatArray:
    """(2,) deviations of offset and drift by the information in the segment's turns."""
    # In deviations before anything was measured, which differ much: even between the bounds.
    prior = np.array(bounds.largest) / math.sqrt(3.0)
    jacobian = (pair.sensitivities(offset_s, drift) * prior)[:, :unknowns]
    information = jacobian.T @ wandering.whiten(jacobian) + np.eye(unknowns)
    prior[:unknowns] *= np.sqrt(np.diag(np.linalg.inv(information)))
    return prior


def _undetermined(segment: PlanarPoses, turned_rad: float, note: str) -> ClockSegment:
    return ClockSegment(
        from_s=float(segment.times_s[0]),
        to_s=float(segment.times_s[-1]),
        reference_s=float(np.mean(segment.times_s)),
        turned_rad=turned_rad,
        status="no turns",
        note=note,
    )


def _interpolated(segments: list[ClockSegment]) -> list[ClockSegment]:
    """Interpolate the offsets of undetermined segments from the others."""
    determined = [segment for segment in segments if segment.status != "no turns"]
    if not determined:
        return segments
    times, offsets = knots_of(determined)
    return [
        replace(segment, offset_s=float(np.interp(segment.reference_s, times, offsets)))
        if segment.status == "no turns"
        else segment
        for segment in segments
    ]


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
    here = groundtruth.during(segment.from_s, segment.to_s)
    near = odometry.during(
        segment.from_s + segment.offset_s - _MARGIN_S, segment.to_s + segment.offset_s + _MARGIN_S
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
        return problem_at(x).account(noise).surprise

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
    covariance = _curvature_covariance(surprise, best)
    if covariance is None:
        return segment
    sigma = _SIGMA_FACTOR * unit * np.sqrt(np.diag(covariance))
    return replace(moved(best), sigma_offset_s=float(sigma[0]), sigma_rate=float(sigma[1]))


_SIMPLEX = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
# Largest distance from the estimate by headings, in its deviations; beyond it is rejected.
_FARTHEST = 8.0
# Share of the bounds beyond which the search has not found a minimum within them.
_AT_A_BOUND = 0.999


def _curvature_covariance(
    surprise: Callable[[FloatArray], float], at: FloatArray
) -> FloatArray | None:
    """Of the two unknowns, from the curvature of minus twice the logarithm of the likelihood."""
    h = 0.7
    e, f = h * np.eye(2)
    hessian = np.empty((2, 2))
    for i, step in enumerate((e, f)):
        hessian[i, i] = (surprise(at + step) + surprise(at - step) - 2.0 * surprise(at)) / h**2
    hessian[0, 1] = hessian[1, 0] = (
        surprise(at + e + f) - surprise(at + e - f) - surprise(at - e + f) + surprise(at - e - f)
    ) / (2.0 * h) ** 2
    if not (np.linalg.eigvalsh(hessian)[0] > 0.0 and math.isfinite(hessian.sum())):
        return None
    return np.asarray(2.0 * np.linalg.inv(hessian))
