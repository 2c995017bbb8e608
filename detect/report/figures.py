"""The figures of a report."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from detect.comparison.compare import LEAST_SIGMA_RAD
from detect.comparison.matching import numbers
from detect.comparison.result import DiscComparison, DiscPairs, LineComparison, LinePairs
from detect.projection import summed_steps
from detect.row_files import ImageRows
from redetect.array_types import FloatArray
from redetect.landmarks import (
    CircleArrays,
    associate,
    circle_arrays,
    is_positive_definite,
    squared_mahalanobis,
)
from redetect.plane import apply, ellipses, rotation
from redetect.reporting.page import Part, figure_file, image_part

#: Colours distinguishable in print and by the colour-blind; line styles differ as well.
DATA, SECOND, REFERENCE, MARK, BAND = "#1f5f99", "#b8560f", "#777777", "#a8321e", "#2a78b5"
SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_WIDE = 7.6
_MOST_DOTS = 4000

_SIGMAS = 3.0  #: Semi-axes of the map's ellipses, in standard deviations.
_CORNERS = 32  #: Their number of points.
#: Matplotlib cannot scale axes to any number.
_FARTHEST_M = 1e12
#: Variance on the floor above which discs of different frames are not paired.
_VAGUE_M2 = 0.05


def rates_figure(least: FloatArray, recall: FloatArray, precision: FloatArray) -> Part:
    """Recall and precision over the threshold of the quality."""
    with figure_file((_WIDE, 2.8), "svg") as (figure, content):
        axes = figure.subplots()
        axes.plot(least, recall, color=DATA, lw=1.4, label="recall")
        axes.plot(least, precision, color=SECOND, lw=1.4, ls="--", label="precision")
        axes.set_ylim(0.0, 1.05)
        _finish(axes, "least quality", "share")
    return _part("Recall and precision of the rows of a least quality.", content, 2.8)


def whitened_figure(residuals: FloatArray, what: str) -> Part:
    """Histogram of whitened residuals beside the standard normal density."""
    with figure_file((_WIDE, 2.8), "svg") as (figure, content):
        axes = figure.subplots()
        reach = 5.0
        edges = np.linspace(-reach, reach, 51)
        counts, _ = np.histogram(residuals, edges)
        density = counts / (len(residuals) * (edges[1] - edges[0]))
        axes.stairs(density, edges, fill=True, color=BAND, alpha=0.35)
        axes.stairs(density, edges, color=DATA, lw=1.0, label="residuals")
        x = np.linspace(-reach, reach, 301)
        normal = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
        axes.plot(x, normal, color=MARK, lw=1.4, ls="--", label="N(0, 1)")
        axes.set_title(
            f"{len(residuals)} residuals: mean {residuals.mean():.2f}, "
            f"deviation {residuals.std():.2f}; {len(residuals) - counts.sum()} beyond ±{reach:g}",
            fontsize=9,
        )
        _finish(axes, f"residual / {SIGMA}", "density")
    words = (
        f"Residuals in units of the covariance that the rows state, {what}: standard normal if "
        "the covariances are right, wider if they are too small."
    )
    return _part(words, content, 2.8)


def floor_figure(pairs: DiscPairs) -> Part:
    """Differences on the floor over distance, along and across the view; also levelled alike."""
    left_of = np.column_stack([-pairs.away[:, 1], pairs.away[:, 0]])
    distance = np.hypot(*pairs.reference_xy.T)
    # Both panels have the same scale, so that the effect of levelling is visible.
    series = [("as the rows are", pairs.as_written, SECOND, "s--")]
    if pairs.levelled_apart:
        series.append(("levelled alike", pairs.offset, DATA, "o-"))
    with figure_file((_WIDE, 3.1), "svg") as (figure, content):
        both = figure.subplots(1, 2)
        for axes, direction, name in (
            (both[0], pairs.away, "along the view, farther is positive"),
            (both[1], left_of, "across, left is positive"),
        ):
            ends = []
            for label, offset, colour, mark in series:
                error = 1e3 * (offset * direction).sum(axis=1)
                _dots(axes, distance, error, colour)
                centre, median, _ = binned(distance, error)
                axes.plot(centre, median, mark, color=colour, lw=1.4, ms=4, label=label)
                ends += [*np.quantile(error, [0.01, 0.99])] if len(error) else []
            axes.axhline(0.0, color=REFERENCE, lw=0.8)
            if ends:
                margin = 0.1 * np.ptp(ends) + 1e-3
                axes.set_ylim(min(ends) - margin, max(ends) + margin)
            _finish(axes, "distance / m", "difference / mm", legend=axes is both[0])
            axes.set_title(name, fontsize=9)
    words = (
        "Positions of the same disc on the floor, detected minus reference: each pair, and medians "
        "in bins of equal counts."
    )
    return _part(words, content, 3.1)


def bearings_figure(pairs: LinePairs) -> Part:
    """Errors over bearing: dots, medians, 95 % quantiles."""
    at, error = np.degrees(pairs.bearing_rad), np.degrees(np.abs(pairs.error_rad))
    words = "Absolute bearing errors of matched verticals over bearing: each vertical,"
    return _spread(words, "bearing / deg, positive to the left", "error / deg", at, error)


def sigma_figure(discs: CircleArrays) -> Part:
    """Stated standard deviations of rows on the floor, in the worst direction, over distance."""
    sigma = 1e3 * np.sqrt(np.maximum(np.linalg.eigvalsh(discs.covariance)[:, 1], 0.0))
    words = f"Stated {SIGMA} of discs on the floor, in the worst direction: each row,"
    return _spread(words, "distance / m", f"{SIGMA} / mm", np.hypot(*discs.xy.T), sigma)


def _spread(words: str, x: str, y: str, at: FloatArray, values: FloatArray) -> Part:
    """Values on a logarithmic scale, with medians and quantiles."""
    with figure_file((_WIDE, 2.8), "svg") as (figure, content):
        axes = figure.subplots()
        _dots(axes, at, values, REFERENCE)
        centre, median, p95 = binned(at, values)
        axes.plot(centre, median, "o-", color=DATA, lw=1.4, ms=4, label="median")
        axes.plot(centre, p95, "s--", color=SECOND, lw=1.2, ms=3.5, label="95 %")
        if (values > 0.0).any():
            axes.set_yscale("log")
        _finish(axes, x, y)
    words += " medians and 95 % quantiles in bins of equal counts."
    return _part(words, content, 2.8)


def tilt_figure(rows: Sequence[ImageRows]) -> Part:
    """Pitch and roll over the run, with bands of one standard deviation."""
    nothing = (np.nan,) * 4
    tilts = [each.tilt for each in rows]
    figures = [nothing if t is None else (t.pitch, t.cpp, t.roll, t.crr) for t in tilts]
    pitch, pitch_variance, roll, roll_variance = np.array(figures, dtype=np.float64).T
    with figure_file((_WIDE, 3.4), "svg") as (figure, content):
        both = figure.subplots(2, 1, sharex=True)
        at = np.arange(len(rows))
        for axes, name, value, variance in (
            (both[0], "pitch / deg", pitch, pitch_variance),
            (both[1], "roll / deg", roll, roll_variance),
        ):
            angle, sigma = np.degrees(value), np.degrees(np.sqrt(variance))
            band = (angle - sigma, angle + sigma)
            axes.fill_between(at, *band, color=BAND, alpha=0.3, lw=0, label=f"±1 {SIGMA}")
            axes.plot(at, angle, ".-", color=DATA, lw=0.9, ms=3)
            axes.axhline(0.0, color=REFERENCE, lw=0.6)
            _finish(axes, "", name, legend=axes is both[0])
        both[1].set_xlabel("frame")
    words = "Pitch and roll that level measured directions, with one standard deviation."
    return _part(words, content, 3.4)


def _dots(axes: Axes, at: FloatArray, values: FloatArray, colour: str) -> None:
    """Draw a subset of the points, small and pale unless they are few."""
    thin = max(1, len(at) // _MOST_DOTS)
    size, alpha = (1.5, 0.25) if len(at) > 100 else (5.0, 0.7)
    axes.plot(at[::thin], values[::thin], ".", color=colour, ms=size, alpha=alpha)


def _finish(axes: Axes, x: str, y: str, *, legend: bool = True) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.grid(alpha=0.25, lw=0.6)
    if legend:
        axes.legend(fontsize=8)


def _part(words: str, content: BytesIO, height: float) -> Part:
    return image_part(words, content.getvalue(), "svg+xml", 96.0 * _WIDE, 96.0 * height)


def floor_map(rows: Sequence[ImageRows], unmatched: str = "") -> Part | None:
    """Map of the discs found and of the reference, along the path summed from the steps.

    Forward at the start is up, left is left. The caption ends with `unmatched`, on discs without a
    reference row. None if there are no discs; a note if some are too far away for a figure.
    """
    pairs = [(one.circles, one.reference_circles) for one in rows if one.circles is not None]
    if not any(found.circles for found, _ in pairs):
        return None
    poses = summed_steps(found.step for found, _ in pairs)
    outlines, true = [], [np.zeros((0, 2))]
    for (found, reference), pose in zip(pairs, poses[1:]):
        discs = circle_arrays(found.circles)
        outlines.append(apply(pose, ellipses(discs.xy, discs.covariance, _SIGMAS, _CORNERS)))
        if reference is not None:
            true.append(apply(pose, circle_arrays(reference.circles).xy))
    outline, marks = np.concatenate(outlines), np.concatenate(true)
    if not all(np.all(np.abs(part) < _FARTHEST_M) for part in (poses, outline, marks)):
        return Part("note", f"No map of the floor: positions above {_FARTHEST_M:g} m.")
    ahead = np.array([1.0, -1.0])  # X is to the left, Y backward
    with figure_file((_WIDE, _WIDE), "svg") as (figure, content):
        axes = figure.subplots()
        if poses.any():
            path = (ahead * poses[:, :2]).T
            axes.plot(*path, color=REFERENCE, lw=1.0, label="path by the odometry")
        if len(marks):
            axes.plot(*(ahead * marks).T, "+", color=MARK, ms=6, mew=0.7, label="reference")
        closed = outline[:, [*range(_CORNERS), 0]]
        gaps = np.pad(closed, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        axes.plot(*(ahead * gaps.reshape(-1, 2)).T, color=DATA, lw=0.7, label="found")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_xaxis()
        _finish(axes, "to the left / m", "forward / m")
    along = "along the path summed from the odometry" if poses.any() else "as seen from the robot"
    words = f"The floor from above: the ellipse of {_SIGMAS:g} standard deviations of each disc of "
    return _part(f"{words}each frame, {along}.{unmatched}", content, _WIDE)


def repeated(rows: Sequence[ImageRows]) -> tuple[int, float, float, float] | None:
    """How well discs in successive frames agree, the latter moved by the odometry's step.

    Discs are paired within five standard deviations, unless these are too large to identify them.
    The step's error, common to the pairs of two frames, is estimated. Returns the number of pairs,
    the rms of their differences beyond that error, and as the rows state (m); and the mean squared
    normalised difference with the covariances of rows and steps. Steps whose covariance is zero,
    which means unknown, or invalid are left out. None without pairs.
    """
    row_residuals, stated, squared = [np.zeros(0)], [np.zeros(0)], 0.0
    frames = [each.circles for each in rows]
    for one, other in pairwise(frames):
        if one is None or other is None:
            continue
        first, second, s = circle_arrays(one.circles), circle_arrays(other.circles), other.step
        of_step = [[s.cxx, s.cxy, s.cxphi], [s.cxy, s.cyy, s.cyphi], [s.cxphi, s.cyphi, s.cphiphi]]
        if not is_positive_definite(of_step):
            continue
        turn = rotation(s.dphi)
        lever = second.xy @ turn.T
        offset = np.add(lever, (s.dx, s.dy)) - first.xy[:, None]
        of_rows = first.covariance[:, None] + turn @ second.covariance @ turn.T
        by_step = np.tile(np.eye(2, 3), (len(lever), 1, 1))
        by_step[:, :, 2] = lever @ [[0.0, 1.0], [-1.0, 0.0]]
        both = of_rows + by_step @ of_step @ by_step.swapaxes(1, 2)
        cost = np.full(both.shape[:2], np.inf)
        usable = is_positive_definite(of_rows) & (np.trace(both, axis1=2, axis2=3) < _VAGUE_M2)
        cost[usable] = squared_mahalanobis(offset[usable], both[usable])
        pairs = associate(cost, cost <= 25.0)
        i, j = pairs.first, pairs.second
        jacobian, residual = by_step[j].reshape(-1, 3), offset[i, j].ravel()
        covariance = block_diag(*of_rows[i, j]) if len(i) else np.zeros((0, 0))
        weight = np.linalg.inv(covariance + jacobian @ of_step @ jacobian.T)
        squared += float(residual @ weight @ residual)
        row_residuals.append(covariance @ weight @ residual)
        stated.append(np.diag(covariance @ weight @ covariance))
    residuals, variance = np.concatenate(row_residuals), np.concatenate(stated)
    if not len(residuals):
        return None
    rms_m, stated_m = np.sqrt([2.0 * np.mean(residuals**2), 2.0 * variance.mean()]).tolist()
    return len(residuals) // 2, rms_m, stated_m, squared / len(residuals)


def rates_over(comparison: DiscComparison, qualities: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Recall and precision (NaN without rows) of discs of at least each quality."""
    levels = np.asarray(qualities, np.float64)
    found, beside = np.zeros((2, len(levels)), np.int64)
    for match in comparison.frames:
        found += (levels[:, None] <= numbers(match.matched, "quality")).sum(axis=1)
        beside += (levels[:, None] <= numbers(match.extra, "quality")).sum(axis=1)
    with np.errstate(invalid="ignore"):
        recall, precision = found / np.float64(comparison.reference), found / (found + beside)
    return recall, precision


def whitened(comparison: DiscComparison | LineComparison) -> FloatArray:
    """(M,) errors in units of their covariances: standard normal if these are right.

    Two for each disc with a positive definite covariance, one for each line with a positive sigma.
    """
    if isinstance(comparison, LineComparison):
        usable = comparison.pairs.sigma_rad >= LEAST_SIGMA_RAD
        return comparison.pairs.error_rad[usable] / comparison.pairs.sigma_rad[usable]
    pairs = comparison.pairs
    usable = is_positive_definite(pairs.covariance)
    factor = np.linalg.cholesky(pairs.covariance[usable])
    return np.linalg.solve(factor, pairs.offset[usable][:, :, None]).ravel()


def binned(at: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Medians of `at`, medians and 95 % quantiles of `values` in up to 10 bins of equal counts."""
    parts = np.array_split(np.argsort(at, kind="stable"), np.clip(len(at) // 8, 1, 10))
    figures = [
        (np.median(at[part]), np.median(values[part]), np.quantile(values[part], 0.95))
        for part in parts
        if len(part)
    ]
    centre, median, p95 = np.array(figures, dtype=np.float64).reshape(-1, 3).T
    return centre, median, p95
