"""Figures of a report beyond those of a comparison: rates over thresholds, whitened residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.comparison.compare import LEAST_SIGMA_RAD
from detect.comparison.matching import match_frame
from detect.comparison.result import DiscComparison, LineComparison
from redetect.landmarks import is_positive_definite

FloatArray = NDArray[np.float64]


class RateCurve(NamedTuple):
    """Recall and precision (NaN without rows) of the `kept` rows that pass each threshold.

    That is the least quality of discs, or the largest sigma of lines (degrees).
    """

    threshold: FloatArray
    recall: FloatArray
    precision: FloatArray
    kept: NDArray[np.int64]


def disc_rates(comparison: DiscComparison, qualities: ArrayLike) -> RateCurve:
    """Recall and precision of discs of at least each quality."""
    return _rates(comparison, "quality", np.asarray(qualities, np.float64), 1.0)


def line_rates(comparison: LineComparison, sigmas_rad: ArrayLike) -> RateCurve:
    """Recall and precision of lines of at most each sigma."""
    curve = _rates(comparison, "sigma", np.asarray(sigmas_rad, np.float64), -1.0)
    return curve._replace(threshold=np.degrees(curve.threshold))


def _rates(
    comparison: DiscComparison | LineComparison, score: str, levels: FloatArray, sign: float
) -> RateCurve:
    """Rates at each threshold; rows are paired anew whenever fewer pass."""
    found, right, kept = np.zeros((3, len(levels)), np.int64)
    for match in comparison.frames:
        passed = match.frame.detected
        for k in np.argsort(sign * levels, kind="stable"):
            fewer = [row for row in passed if sign * getattr(row, score) >= sign * levels[k]]
            if len(fewer) < len(passed):
                passed = fewer
                match = match_frame(match.frame._replace(detected=passed), comparison.options)
            found[k] += len(match.matched) + len(match.joined)
            right[k] += len(match.matched)
            kept[k] += len(match.matched) + len(match.extra)
    with np.errstate(invalid="ignore"):
        recall, precision = found / np.float64(comparison.reference), right / kept
    return RateCurve(levels, recall, precision, kept)


def whitened(comparison: DiscComparison | LineComparison) -> FloatArray:
    """(M,) errors in units of their covariances: standard normal if these are right.

    Two independent components for each disc with a positive definite covariance, after the common
    lean; one for each line with a positive sigma.
    """
    if isinstance(comparison, LineComparison):
        usable = comparison.pairs.sigma_rad >= LEAST_SIGMA_RAD
        return comparison.pairs.error_rad[usable] / comparison.pairs.sigma_rad[usable]
    pairs = comparison.pairs
    usable = is_positive_definite(pairs.covariance) & np.isfinite(pairs.left).all(axis=1)
    factor = np.linalg.cholesky(pairs.covariance[usable])
    return np.linalg.solve(factor, pairs.left[usable][:, :, None]).ravel()


def binned(at: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Medians of `at`, medians and 95 % quantiles of `values` in up to 10 bins of equally many."""
    parts = np.array_split(np.argsort(at, kind="stable"), np.clip(len(at) // 8, 1, 10))
    figures = [
        (np.median(at[part]), np.median(values[part]), np.quantile(values[part], 0.95))
        for part in parts
        if len(part)
    ]
    middle, median, most = np.array(figures, dtype=np.float64).reshape(-1, 3).T
    return middle, median, most
