"""Figures of a report: pairs of detected and reference rows, and rates over thresholds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.comparison.circles import pair_discs
from detect.comparison.lines import joined_lines, pair_lines
from detect.comparison.result import CompareOptions, DiscPairs, LineCompareOptions
from detect.seen import FrameView
from landmarks import (
    CircleLandmark,
    LineLandmark,
    is_positive_definite,
    wrap_angle,
)

FloatArray = NDArray[np.float64]
RowType = TypeVar("RowType", CircleLandmark, LineLandmark)

_LEAST_SIGMA_RAD = 1e-12


@dataclass(frozen=True)
class FramePair(Generic[RowType]):
    """The rows of one image on both sides, and how discs come back into it."""

    reference: Sequence[RowType]
    detected: Sequence[RowType]
    view: FrameView | None = None


@dataclass(frozen=True, eq=False)
class Residuals:
    """Errors of detected rows that are paired with a reference row.

    Attributes
    ----------
    bearing_rad : (N,) float64
        Of the reference row: 0 forward, positive to the left.
    error : (N,) float64
        Distance on the floor (m) for discs, difference in bearing without sign (rad) for verticals.
    whitened : (M,) float64
        Errors in units of the detected rows' covariances: two independent components for each disc
        with a positive definite one, one for each vertical with a positive sigma. Standard normal
        if the covariances are right.
    """

    bearing_rad: FloatArray
    error: FloatArray
    whitened: FloatArray


@dataclass(frozen=True, eq=False)
class RateCurve:
    """Recall and precision of the rows that pass a threshold.

    Attributes
    ----------
    threshold : (K,) float64
        Least score.
    recall, precision : (K,) float64
        NaN where there are no rows to compute them from.
    kept : (K,) int64
        Detected rows that pass.
    """

    threshold: FloatArray
    recall: FloatArray
    precision: FloatArray
    kept: NDArray[np.int64]


def disc_residuals(pairs: DiscPairs) -> Residuals:
    """Residuals of discs after the common lean; whitened by the Cholesky factor of covariances."""
    xy, offset = pairs.reference_xy, pairs.left
    usable = is_positive_definite(pairs.covariance) & np.isfinite(offset).all(axis=1)
    factor = np.linalg.cholesky(pairs.covariance[usable])
    whitened = np.linalg.solve(factor, offset[usable][:, :, None])[:, :, 0]
    return Residuals(
        bearing_rad=np.arctan2(xy[:, 0], -xy[:, 1]),
        error=np.hypot(offset[:, 0], offset[:, 1]),
        whitened=whitened.ravel(),
    )


def line_residuals(
    frames: Sequence[FramePair[LineLandmark]], gate: LineCompareOptions
) -> Residuals:
    """Residuals of verticals' bearings."""
    truth: list[float] = []
    rows: list[LineLandmark] = []
    for frame in frames:
        pairs = pair_lines(frame.reference, frame.detected, gate)
        truth += [frame.reference[i].alpha for i in pairs.first]
        rows += [frame.detected[j] for j in pairs.second]
    bearing = np.array(truth, dtype=np.float64)
    error = wrap_angle(np.array([row.alpha for row in rows], dtype=np.float64) - bearing)
    sigma = np.array([row.sigma for row in rows], dtype=np.float64)
    usable = sigma >= _LEAST_SIGMA_RAD
    return Residuals(
        bearing_rad=bearing,
        error=np.abs(error),
        whitened=error[usable] / sigma[usable],
    )


def disc_rates(
    frames: Sequence[FramePair[CircleLandmark]], gate: CompareOptions, thresholds: ArrayLike
) -> RateCurve:
    """Recall and precision of discs of at least each quality."""

    def count(frame: FramePair[CircleLandmark]) -> tuple[int, int]:
        matched = len(pair_discs(frame.reference, frame.detected, gate, frame.view).first)
        return matched, matched

    return _rates(frames, lambda row: row.quality, count, thresholds)


def line_rates(
    frames: Sequence[FramePair[LineLandmark]], gate: LineCompareOptions, sigmas_rad: ArrayLike
) -> RateCurve:
    """Recall and precision of verticals of at most each sigma; `threshold` is its negative."""

    def count(frame: FramePair[LineLandmark]) -> tuple[int, int]:
        pairs = pair_lines(frame.reference, frame.detected, gate)
        left = [frame.reference[i] for i in pairs.first_alone]
        joined = joined_lines(left, [frame.detected[j] for j in pairs.second], gate)
        return len(pairs.first) + int(joined.sum()), len(pairs.second)

    return _rates(frames, lambda row: -row.sigma, count, -np.asarray(sigmas_rad, np.float64))


def _rates(
    frames: Sequence[FramePair[RowType]],
    score: Callable[[RowType], float],
    count: Callable[[FramePair[RowType]], tuple[int, int]],
    thresholds: ArrayLike,
) -> RateCurve:
    """Rates at each threshold; rows are paired anew whenever fewer pass."""
    levels = np.asarray(thresholds, dtype=np.float64)
    wanted = sum(len(frame.reference) for frame in frames)
    found, right, kept = (np.zeros(len(levels), np.int64) for _ in range(3))
    for frame in frames:
        before, counts = -1, (0, 0)
        for k in np.argsort(levels, kind="stable"):
            passed = [row for row in frame.detected if score(row) >= levels[k]]
            if len(passed) != before:
                before, counts = len(passed), count(replace(frame, detected=passed))
            kept[k] += len(passed)
            found[k] += counts[0]
            right[k] += counts[1]
    nothing = np.full(len(levels), np.nan)
    return RateCurve(
        threshold=levels,
        recall=found / wanted if wanted else nothing,
        precision=np.divide(right, kept, out=nothing.copy(), where=kept > 0),
        kept=kept,
    )


@dataclass(frozen=True)
class Normality:
    """How whitened residuals compare with the standard normal distribution.

    Attributes
    ----------
    count : int
    mean, deviation : float
        0 and 1 if covariances are right.
    within : tuple of 3 float
        Shares within 1, 2 and 3 standard deviations.
    """

    count: int
    mean: float
    deviation: float
    within: tuple[float, float, float]


#: Shares of a standard normal variable within 1, 2 and 3.
NORMAL_WITHIN = (0.6826894921370859, 0.9544997361036416, 0.9973002039367398)


def normality(whitened: FloatArray) -> Normality | None:
    """Compare with the standard normal distribution; None without residuals."""
    if not len(whitened):
        return None
    far = np.abs(whitened)
    return Normality(
        len(whitened),
        float(whitened.mean()),
        float(whitened.std()),
        (float((far <= 1).mean()), float((far <= 2).mean()), float((far <= 3).mean())),
    )
