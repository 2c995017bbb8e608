"""Least squares for differences with a random walk plus white noise of each sample.

The model of a difference between two headings: odometry's error adds up (a random walk, variance
`rate` per second), the other's does not (white, `sigma`). Systematic errors may come on top, such
as a turn that odometry takes for a share longer than it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar, nnls

from redetect.array_types import FloatArray
from redetect.groundtruth.clocks.headings import HeadingPair, without_turns
from redetect.groundtruth.errors import GroundTruthError

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
    if len(times_s) < 10:
        raise GroundTruthError(f"{len(times_s)} samples: expected 10 or more")
    if not np.all(np.diff(times_s) > 0.0):
        raise GroundTruthError("two samples of one time: expected times that ascend")
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
    split = _relocate(pair, wandering, places, best, offset_s)
    gained = wandering.squared(differences) - split.squared_error
    if gained < _INSTEAD_OF_DRIFT or abs(split.jump_s) < _LEAST_JUMP_S:
        best = int(np.argmax(beside))
        if beside[best] < _BEYOND_DRIFT or abs(size[best]) < _LEAST_JUMP_S:
            return None
        split = _relocate(pair, wandering, places, best, offset_s)
    return split.time_s if pair.sign > 0 else split.time_s - offset_s


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


@dataclass(frozen=True)
class _Split:
    """Two offsets, one before and one after a time of the pair's clock."""

    time_s: float
    jump_s: float
    squared_error: float


def _relocate(
    pair: HeadingPair, wandering: Wandering, places: FloatArray, best: int, near_s: float
) -> _Split:
    """The place that fits best if each side has its own offset, without drift."""
    split = None
    for _ in range(_RELOCATIONS):
        before = pair.times_s < places[best]
        sides = [_side_offset(pair.kept(which), wandering, near_s) for which in (before, ~before)]
        first, second = (without_turns(pair.differences(offset, 0.0)) for offset in sides)
        errors = [
            wandering.squared(np.where(pair.times_s < place, first, second)) for place in places
        ]
        moved = int(np.argmin(errors))
        split = _Split(float(places[moved]), sides[1] - sides[0], errors[moved])
        if moved == best:
            break
        best = moved
    assert split is not None
    return split


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
