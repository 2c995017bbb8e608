"""Headings of two clocks side by side, the noise of their differences, and jumps of a clock.

The model of a difference between two headings: odometry's error adds up (a random walk, variance
`rate` per second), the other's does not (white, `sigma`). Systematic errors may come on top, such
as a turn that odometry takes for a share longer than it was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar, nnls

from redetect.array_types import BoolArray, FloatArray
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle


def continuous_headings(poses: PlanarPoses) -> FloatArray:
    """(N,) headings (rad) without jumps of whole turns, of poses less than half a turn apart."""
    return np.asarray(np.unwrap(poses.poses[:, 2]))


def heading_noise(headings_rad: FloatArray) -> float:
    """How rough continuous headings (N,) are: standard deviation beside their neighbours (rad).

    Third differences cancel whatever turns smoothly; their median does not mind single jumps.
    """
    third = np.diff(headings_rad, 3)
    # Variance of a third difference of white noise: 1 + 9 + 9 + 1.
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


def sampling_interval(times_s: FloatArray) -> float:
    """Median time between samples (s)."""
    return float(np.median(np.diff(times_s)))


@dataclass(frozen=True, eq=False)
class HeadingIntegral:
    """Headings as a function of time, straight between samples, of which exact means are taken."""

    times_s: FloatArray  # (N,): ascending strictly
    headings_rad: FloatArray  # (N,): continuous

    def means(self, from_s: FloatArray, to_s: FloatArray) -> FloatArray:
        """Mean headings between pairs of times (M,), the second of which is later."""
        return np.asarray((self._integral(to_s) - self._integral(from_s)) / (to_s - from_s))

    def covers(self, from_s: FloatArray, to_s: FloatArray, largest_gap_s: float) -> BoolArray:
        """Which of M spans of time are within the samples and overlap no longer gap."""
        covered = (from_s >= self.times_s[0]) & (to_s <= self.times_s[-1])
        for gap in np.flatnonzero(np.diff(self.times_s) > largest_gap_s):
            covered &= (to_s <= self.times_s[gap]) | (from_s >= self.times_s[gap + 1])
        return np.asarray(covered)

    @cached_property
    def _integral(self) -> BSpline:
        return make_interp_spline(self.times_s, self.headings_rad, k=1).antiderivative()


def windowed_means(
    times_s: FloatArray, headings_rad: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Middles (M,) and means (M,) of headings over windows side by side, but those with a gap in
    them.

    Headings are continuous.
    """
    count = int((times_s[-1] - times_s[0]) / window_s)
    edges = times_s[0] + window_s * np.arange(count + 1)
    integral = HeadingIntegral(times_s, headings_rad)
    whole = integral.covers(edges[:-1], edges[1:], 0.5 * window_s)
    means = integral.means(edges[:-1], edges[1:])
    return (0.5 * (edges[1:] + edges[:-1]))[whole], means[whole]


_SLOWEST_INTERPOLATED_S = 0.25
_WINDOW_S = 0.4
# Between slow samples one must not interpolate: they are met by a short window of the other stream.
_FEWEST_PER_WINDOW = 5
_SHORT_WINDOW_S = 0.1
_LARGEST_STREAM_GAP_S = 0.5
_STRIDE_S = 0.5
# Systematic errors of a robot's odometry: a share of each turn, and a curvature.
_TURN_SCALE_SIGMA = 0.03
_TURN_PER_METRE_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class HeadingPair:
    """One segment's two streams: means of one over windows, and the other to take means of.

    Windows, since single samples of odometry are rough: shifting them against the other stream
    changes how the roughness is met, which would pass for a better or worse fit.

    `sign` is 1 where the windows are the ground truth's. `systematic` holds what odometry's heading
    may be off by in proportion to the way turned and driven, (N, 2), in deviations.
    """

    times_s: FloatArray
    headings: FloatArray
    window_s: float
    other: HeadingIntegral
    reference_s: float
    sign: int
    systematic: FloatArray

    def warped(self, times_s: FloatArray, offset_s: float, drift: float) -> FloatArray:
        """Times of the windowed stream on the other's clock."""
        if self.sign > 0:
            return times_s + offset_s + drift * (times_s - self.reference_s)
        return (times_s - offset_s + drift * self.reference_s) / (1.0 + drift)

    def differences(self, offset_s: float, drift: float) -> FloatArray:
        """Heading of the ground truth minus heading of the odometry, as far as time goes."""
        half = 0.5 * self.window_s
        means = self.other.means(
            self.warped(self.times_s - half, offset_s, drift),
            self.warped(self.times_s + half, offset_s, drift),
        )
        return np.asarray(self.sign * (self.headings - means))

    def kept(self, which: BoolArray) -> HeadingPair:
        return replace(
            self,
            times_s=self.times_s[which],
            headings=self.headings[which],
            systematic=self.systematic[which],
        )

    def sensitivities(self, offset_s: float, drift: float) -> FloatArray:
        """(N, 2) derivatives of the differences by offset and drift."""
        step_s = 0.25 * self.window_s
        half_length = max(float(np.ptp(self.times_s)) / 2.0, step_s)
        by_offset = self.differences(offset_s + step_s, drift) - self.differences(
            offset_s - step_s, drift
        )
        step = step_s / half_length
        by_drift = self.differences(offset_s, drift + step) - self.differences(
            offset_s, drift - step
        )
        return np.column_stack([by_offset / (2.0 * step_s), by_drift / (2.0 * step)])


def pair_headings(
    odometry: PlanarPoses,
    segment: PlanarPoses,
    largest: tuple[float, float],
    fewest: int,
) -> HeadingPair | None:
    """The comparable part of two streams, fixed for a whole search of offset and drift.

    The segment is ground truth without long pauses; `largest` are the offset (s) and the drift that
    are searched to. None if the other stream covers fewer samples than `fewest` in that range.
    """
    largest_offset_s, largest_drift = largest
    if len(segment) < fewest:
        return None
    reach = largest_offset_s + largest_drift * (segment.times_s[-1] - segment.times_s[0])
    near = odometry.during(segment.times_s[0] - 2.0 * reach, segment.times_s[-1] + 2.0 * reach)
    if np.count_nonzero(near) < fewest:
        return None
    odometry = PlanarPoses(odometry.times_s[near], odometry.poses[near])
    streams = [(poses.times_s, continuous_headings(poses)) for poses in (segment, odometry)]
    reference = float(np.mean(segment.times_s))
    sampled = 0 if _odometry_is_interpolated(*streams) else 1
    times, headings = streams[sampled]
    other = HeadingIntegral(*streams[1 - sampled])
    window = _WINDOW_S
    if sampling_interval(times) * _FEWEST_PER_WINDOW <= window:
        times, headings = windowed_means(times, headings, window)
    else:
        window = _SHORT_WINDOW_S
    sign = 1 if sampled == 0 else -1
    driven = _way_driven(segment if sampled == 0 else odometry, times)
    systematic = np.column_stack([_TURN_SCALE_SIGMA * headings, _TURN_PER_METRE_SIGMA * driven])
    if len(times):
        systematic -= systematic.mean(axis=0)
    pair = HeadingPair(times, headings, window, other, reference, sign, systematic)
    if len(times) == 0:
        return None
    # The other stream must cover the samples in the whole search range.
    corners = [
        pair.warped(times + end * window, offset, drift)
        for end in (-0.5, 0.5)
        for offset in (-largest_offset_s, largest_offset_s)
        for drift in (-largest_drift, largest_drift)
    ]
    covered = other.covers(np.min(corners, axis=0), np.max(corners, axis=0), _LARGEST_STREAM_GAP_S)
    pair = pair.kept(covered)
    return pair if len(pair.times_s) >= fewest else None


def _odometry_is_interpolated(
    groundtruth: tuple[FloatArray, FloatArray], odometry: tuple[FloatArray, FloatArray]
) -> bool:
    """Whether odometry is the smoother, faster stream, between whose samples one interpolates."""
    slow = [
        sampling_interval(times) > _SLOWEST_INTERPOLATED_S for times, _ in (groundtruth, odometry)
    ]
    if slow[0] != slow[1]:
        return slow[0]
    return heading_noise(odometry[1]) <= heading_noise(groundtruth[1])


def _way_driven(poses: PlanarPoses, times_s: FloatArray) -> FloatArray:
    """Metres driven until each of the times, in half seconds: noise lengthens those little."""
    coarse = np.arange(poses.times_s[0], poses.times_s[-1] + _STRIDE_S, _STRIDE_S)
    xy = np.column_stack([np.interp(coarse, poses.times_s, poses.poses[:, k]) for k in (0, 1)])
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    return np.asarray(np.interp(times_s, coarse, way))


def without_turns(differences: FloatArray, *, keep_mean: bool = False) -> FloatArray:
    """Differences of headings without whole turns: all within half a turn of their mean angle.

    `differences` (N,). `keep_mean`: whether their mean angle stays in; else it is subtracted, which
    eliminates the angle between the streams' axes.
    """
    middle = float(np.angle(np.mean(np.exp(1j * differences))))
    level = wrap_angle(differences - middle)
    return np.asarray(level + middle if keep_mean else level)


LAGS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
# The median of a chi-squared variable with one degree of freedom.
_MEDIAN_CHI2 = 0.45493642
_LEAST_SIGMA_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class Wandering:
    """Noise of N samples of a difference."""

    times_s: FloatArray  # (N,): ascending strictly
    sigma: float  # Standard deviation of each sample's own noise, above 0
    rate: float  # Variance that the random walk gains per second, above 0
    # (N, k): shapes that the difference may have besides, each times an unknown factor of deviation
    # 1
    systematic: FloatArray

    def whiten(self, values: FloatArray) -> FloatArray:
        """Multiply by the inverse of the covariance, the walk's level being unknown to it."""
        weighted = self._without_walk(values)
        shapes, inverse = self._shapes
        return np.asarray(weighted - shapes @ (inverse @ (self.systematic.T @ weighted)))

    def squared(self, values: FloatArray) -> float:
        """Squared Mahalanobis length of (N,) values, the walk's level being unknown."""
        return float(values @ self.whiten(values))

    def level(self, values: FloatArray) -> tuple[float, float]:
        """Mean over time of the walk that explains (N,) values best, and its deviation."""
        _, inverse = self._shapes
        factors = inverse @ (self.systematic.T @ self._without_walk(values))
        rest = values - self.systematic @ factors
        walk = cho_solve_banded((self._factor, True), rest / self.sigma**2)
        ones = np.ones(len(values)) / len(values)
        variance = ones @ cho_solve_banded((self._factor, True), ones)
        return float(np.mean(walk)), float(np.sqrt(variance))

    def _without_walk(self, values: FloatArray) -> FloatArray:
        """Multiply by the inverse of the covariance of noise and walk alone."""
        explained = cho_solve_banded((self._factor, True), values / self.sigma**2)
        return np.asarray((values - explained) / self.sigma**2)

    @cached_property
    def _shapes(self) -> tuple[FloatArray, FloatArray]:
        """The systematic shapes, weighted, and the covariance of their factors."""
        weighted = self._without_walk(self.systematic)
        information = np.eye(self.systematic.shape[1]) + self.systematic.T @ weighted
        return weighted, np.asarray(np.linalg.inv(information))

    @cached_property
    def _factor(self) -> FloatArray:
        """Banded Cholesky factor of the walk's information, given the samples."""
        between = 1.0 / (self.rate * np.diff(self.times_s))
        bands = np.zeros((2, len(self.times_s)))
        bands[0] = 1.0 / self.sigma**2
        bands[0, 1:] += between
        bands[0, :-1] += between
        bands[1, :-1] = -between
        return np.asarray(cholesky_banded(bands, lower=True))


def estimate_wandering(
    times_s: FloatArray,
    values: FloatArray,
    systematic: FloatArray | None = None,
    lags: tuple[int, ...] = LAGS,
) -> Wandering:
    """Separate noise from random walk by the differences of samples over increasing time lags.

    `times_s` (N,): ascending strictly, N of 10 or more. `values` (N,): differences of headings,
    without jumps. `systematic` (N, k): shapes that the differences may have besides; what of them
    is in the values is taken off. `lags`: how many samples apart they are compared; short ones do
    not mind what changes slowly.
    """
    shapes = np.zeros((len(times_s), 0)) if systematic is None else systematic
    if shapes.shape[1]:
        # Their factors by least squares of what changes from sample to sample, which noise and
        # wandering disturb alike everywhere.
        change = np.diff(shapes, axis=0)
        typical = float(np.mean(np.diff(values) ** 2)) + _LEAST_SIGMA_RAD**2
        information = change.T @ change / typical + np.eye(shapes.shape[1])
        values = values - shapes @ np.linalg.solve(
            information, change.T @ np.diff(values) / typical
        )
    rows, squares = [], []
    for lag in lags:
        if lag > len(times_s) // 4 and lag > 1:
            break
        apart = times_s[lag:] - times_s[:-lag]
        typical = float(np.median(apart))
        squared = (values[lag:] - values[:-lag])[apart <= 2.0 * typical] ** 2
        # Between mean and median: a few gross errors must not pass for wandering, nor may turns,
        # in which odometry errs most, be passed over.
        clipped = np.minimum(squared, 30.0 * np.median(squared) / _MEDIAN_CHI2 + 1e-30)
        rows.append((2.0, typical))
        squares.append(float(np.mean(clipped)))
    design, target = np.array(rows), np.array(squares)
    weight = 1.0 / np.maximum(target, 2.0 * _LEAST_SIGMA_RAD**2)
    (variance, rate), _ = nnls(design * weight[:, None], target * weight)
    sigma = max(float(np.sqrt(variance)), 0.1 * float(np.sqrt(squares[0] / 2.0)), _LEAST_SIGMA_RAD)
    duration = float(times_s[-1] - times_s[0])
    # A random walk of a hundredth of the noise over the whole segment is negligible.
    return Wandering(times_s, sigma, max(float(rate), (0.01 * sigma) ** 2 / duration), shapes)


_PLACES = 60
# By how much a step must reduce the squared error, more than the best of `_PLACES` would by chance:
# in addition to the drift, and instead of it (100 draws without a jump reached 13 and 11).
_BEYOND_DRIFT = 20.0
_INSTEAD_OF_DRIFT = 15.0
_LEAST_JUMP_S = 0.004
# A jump changes the differences slowly and must not be mistaken for a random walk.
_SHORT_LAGS = (1, 2, 3, 4)
_RELOCATIONS = 4
_FEWEST_PER_SIDE = 5
_SEARCH_S = 1.0


def find_jump(pair: HeadingPair, offset_s: float, drift: float) -> float | None:
    """When the clock was set, on the ground truth's clock; None if it was not.

    A step of the offset at each of many places is compared with the drift: there was a jump if a
    step explains the headings better than the drift does, or much that the drift leaves over.
    `offset_s` and `drift` are the best without a jump.
    """
    jacobian = pair.sensitivities(offset_s, drift)
    information = np.cumsum(jacobian[:, 0] ** 2)
    if not information[-1] > 0.0 or len(information) < 4 * _FEWEST_PER_SIDE:
        return None
    differences = without_turns(pair.differences(offset_s, drift))
    wandering = estimate_wandering(pair.times_s, differences, pair.systematic, _SHORT_LAGS)
    places = np.clip(
        np.interp(np.linspace(0.05, 0.95, _PLACES) * information[-1], information, pair.times_s),
        pair.times_s[_FEWEST_PER_SIDE],
        pair.times_s[-_FEWEST_PER_SIDE],
    )
    steps = np.where(pair.times_s[:, None] >= places, jacobian[:, :1], 0.0)
    # To first order, the differences with the offset alone.
    without_drift = differences - jacobian[:, 1] * drift
    instead, _ = _gains(without_drift, steps, jacobian[:, :1], wandering)
    beside, size = _gains(without_drift, steps, jacobian, wandering)
    best = int(np.argmax(instead))
    time_s, jump_s, error = _relocate(pair, wandering, places, best, offset_s)
    gained = wandering.squared(differences) - error
    if gained < _INSTEAD_OF_DRIFT or abs(jump_s) < _LEAST_JUMP_S:
        best = int(np.argmax(beside))
        if beside[best] < _BEYOND_DRIFT or abs(size[best]) < _LEAST_JUMP_S:
            return None
        time_s, _, _ = _relocate(pair, wandering, places, best, offset_s)
    return time_s if pair.sign > 0 else time_s - offset_s


def _gains(
    residual: FloatArray, columns: FloatArray, known: FloatArray, wandering: Wandering
) -> tuple[FloatArray, FloatArray]:
    """By how much each of (N, k) columns lowers the squared error, and its size."""
    whitened = wandering.whiten(known)
    normal = known.T @ whitened
    apart = columns - known @ np.linalg.solve(normal, whitened.T @ columns)
    left = residual - known @ np.linalg.solve(normal, whitened.T @ residual)
    weighted = wandering.whiten(apart)
    power = np.einsum("np,np->p", apart, weighted)
    size = -(weighted.T @ left) / np.where(power > 0.0, power, np.inf)
    return size**2 * power, size


def _relocate(
    pair: HeadingPair, wandering: Wandering, places: FloatArray, best: int, near_s: float
) -> tuple[float, float, float]:
    """Where the offset jumps, fits best if each side has its own, without drift.

    Returns the time, on the pair's clock, by how much it jumps there (s), and the squared error.
    """
    time_s, jump_s, error = math.nan, math.nan, math.inf
    for _ in range(_RELOCATIONS):
        before = pair.times_s < places[best]
        sides = [_side_offset(pair.kept(which), wandering, near_s) for which in (before, ~before)]
        first, second = (without_turns(pair.differences(offset, 0.0)) for offset in sides)
        errors = [
            wandering.squared(np.where(pair.times_s < place, first, second)) for place in places
        ]
        moved = int(np.argmin(errors))
        time_s, jump_s, error = float(places[moved]), sides[1] - sides[0], errors[moved]
        if moved == best:
            break
        best = moved
    return time_s, jump_s, error


def _side_offset(side: HeadingPair, wandering: Wandering, near_s: float) -> float:
    """Offset of one side of a jump, without drift."""
    own = Wandering(side.times_s, wandering.sigma, wandering.rate, side.systematic)

    def error(offset_s: float) -> float:
        return own.squared(without_turns(side.differences(offset_s, 0.0)))

    coarse = near_s + np.linspace(-_SEARCH_S, _SEARCH_S, 81)
    begin = float(coarse[int(np.argmin([error(offset) for offset in coarse]))])
    spacing = float(coarse[1] - coarse[0])
    found = minimize_scalar(
        error, bounds=(begin - spacing, begin + spacing), method="bounded", options={"xatol": 1e-5}
    )
    return float(found.x)
