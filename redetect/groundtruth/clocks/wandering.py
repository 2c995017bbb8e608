"""Least squares for differences with a random walk plus white noise of each sample.

The model of a difference between two headings: odometry's error adds up (a random walk, variance
`rate` per second), the other's does not (white, `sigma`). Systematic errors may come on top, such
as a turn that odometry takes for a share longer than it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import nnls

from redetect.groundtruth.errors import GroundTruthError

FloatArray = NDArray[np.float64]

LAGS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
# The median of a chi-squared variable with one degree of freedom.
_MEDIAN_CHI2 = 0.45493642
_LEAST_SIGMA_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class Wandering:
    """Noise of N samples of a difference.

    Attributes
    ----------
    times_s : (N,) float64
        Ascending strictly.
    sigma : float
        Standard deviation of each sample's own noise, above 0.
    rate : float
        Variance that the random walk gains per second, above 0.
    systematic : (N, k) float64
        Shapes that the difference may have besides, each times an unknown factor of deviation 1.
    """

    times_s: FloatArray
    sigma: float
    rate: float
    systematic: FloatArray

    def whiten(self, values: FloatArray) -> FloatArray:
        """Multiply by the inverse of the covariance, the walk's level being unknown to it.

        Parameters
        ----------
        values : (N,) or (N, k) array

        Returns
        -------
        array of the same shape
        """
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

    Parameters
    ----------
    times_s : (N,) array
        Ascending strictly, N of 10 or more.
    values : (N,) array
        Differences of headings, without jumps.
    systematic : (N, k) array, optional
        Shapes that the differences may have besides; what of them is in the values is taken off.
    lags : tuple of int
        How many samples apart they are compared; short ones do not mind what changes slowly.

    Returns
    -------
    Wandering

    Raises
    ------
    GroundTruthError
        If there are fewer samples, or two of one time.
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
