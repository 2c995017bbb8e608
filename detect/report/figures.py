"""Figures of a report, as SVG files. No word in them comes from a file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from detect.comparison.result import DiscPairs, DistanceBin
from detect.drawing.inputs import SeenRows
from detect.report.plot import BAND, DATA, MARK, REFERENCE, SECOND, plotted
from detect.report.statistics import RateCurve, Residuals, normality
from detect.tune.table import knee, pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]

_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_WIDE = 7.6
_HISTOGRAM_REACH = 5.0
_MOST_DOTS = 4000


def counts_figure(rows: Sequence[SeenRows]) -> bytes:
    """Rows in each frame, over the run."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for kind, colour, dashes in (
            ("circles", DATA, "-"), ("lines", SECOND, "--"), ("markers", MARK, ":"),
        ):  # fmt: skip
            counts = [np.nan if (r := getattr(seen, kind)) is None else len(r) for seen in rows]
            if np.isfinite(counts).any():
                name = {"circles": "discs", "lines": "verticals"}.get(kind, kind)
                axes.plot(counts, color=colour, ls=dashes, lw=1.0, label=name)
        _finish(axes, "frame", "rows in it")
        axes.set_ylim(bottom=0)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, ncols=3)

    return plotted(draw, (_WIDE, 2.2), "svg")


def rates_figure(curve: RateCurve, axis: str, *, factor: float = 1.0) -> bytes:
    """Recall and precision over a threshold, and precision over recall with the knee."""

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        at = factor * curve.threshold
        left.plot(at, curve.recall, color=DATA, lw=1.4, label="recall")
        left.plot(at, curve.precision, color=SECOND, lw=1.4, ls="--", label="precision")
        best = knee(curve.recall, curve.precision)
        if best is not None:
            left.axvline(at[best], color=MARK, lw=0.9, ls=":", label=f"knee: {at[best]:.3g}")
        _finish(left, axis, "share")
        left.legend(fontsize=8)
        right.plot(curve.recall, curve.precision, ".-", color=DATA, lw=1.0, ms=4)
        front = pareto_front(curve.recall, curve.precision)
        if best is not None:
            right.plot(
                curve.recall[best], curve.precision[best], "o", mfc="none", mec=MARK, mew=1.8,
                ms=11, label=f"knee: {at[best]:.3g}",
            )  # fmt: skip
            for k in (front[0], front[-1]):
                if k != best:
                    right.annotate(
                        f"{at[k]:.3g}", (curve.recall[k], curve.precision[k]), fontsize=7,
                        xytext=(4, 4), textcoords="offset points",
                    )  # fmt: skip
            right.legend(fontsize=8)
        _finish(right, "recall", "precision")
        for limits in (left.set_ylim, right.set_ylim, right.set_xlim):
            limits(0.0, 1.05)

    return plotted(draw, (_WIDE, 3.1), "svg")


def whitened_figure(residuals: Residuals) -> bytes:
    """Histogram of whitened residuals beside the standard normal density."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        reach = _HISTOGRAM_REACH
        edges = np.linspace(-reach, reach, 51)
        inside = residuals.whitened[np.abs(residuals.whitened) <= reach]
        beyond = len(residuals.whitened) - len(inside)
        counts, _ = np.histogram(inside, edges)
        density = counts / (max(len(residuals.whitened), 1) * (edges[1] - edges[0]))
        axes.stairs(density, edges, fill=True, color=BAND, alpha=0.35)
        axes.stairs(density, edges, color=DATA, lw=1.0, label="residuals")
        x = np.linspace(-reach, reach, 301)
        normal = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
        axes.plot(x, normal, color=MARK, lw=1.4, ls="--", label="N(0, 1)")
        figures = normality(residuals.whitened)
        if figures is not None:
            axes.set_title(
                f"{figures.count} residuals: mean {figures.mean:.2f}, "
                f"deviation {figures.deviation:.2f}; {beyond} beyond ±{reach:g}",
                fontsize=9,
            )
        _finish(axes, f"residual / {_SIGMA}", "density")
        axes.legend(fontsize=8)

    return plotted(draw, (_WIDE, 2.8), "svg")


def distance_figure(bins: Sequence[DistanceBin]) -> bytes:
    """Recall and precision by forward distance, over how many rows there are."""

    def draw(figure: Figure) -> None:
        shown = [part for part in bins if part.reference or part.detected]
        at = np.arange(len(shown))
        rows, rates = figure.subplots(1, 2)
        for one, key, shift, colour, name in (
            (rows, "reference", -0.2, REFERENCE, "reference rows"),
            (rows, "detected", 0.2, DATA, "detected rows"),
        ):
            one.bar(at + shift, [getattr(p, key) for p in shown], 0.4, color=colour, label=name)
        for key, mark, colour in (("recall", "o-", DATA), ("precision", "s--", SECOND)):
            share = [np.nan if (v := getattr(p, key)) is None else v for p in shown]
            rates.plot(at, share, mark, color=colour, lw=1.2, ms=4, label=key)
        rates.set_ylim(0.0, 1.05)
        names = [
            f"<{p.to_m:g}" if p.from_m is None
            else f"≥{p.from_m:g}" if p.to_m is None else f"{p.from_m:g}-{p.to_m:g}"
            for p in shown
        ]  # fmt: skip
        for one, name in ((rows, "rows"), (rates, "share")):
            one.set_xticks(at, names, fontsize=7)
            _finish(one, "forward distance / m", name)
            one.legend(fontsize=8)

    return plotted(draw, (_WIDE, 2.8), "svg")


def floor_figure(pairs: DiscPairs, *, lean: bool) -> bytes:
    """Differences on the floor over distance, along and across the view; also after a lean."""

    def draw(figure: Figure) -> None:
        left_of = np.column_stack([-pairs.away[:, 1], pairs.away[:, 0]])
        at = np.hypot(*pairs.reference_xy.T)
        # Both of one panel are of the same scale, so that what a lean explains is seen.
        series = [("as the rows are", pairs.offset, SECOND, "s--")]
        if lean:
            series.append(("after the common lean", pairs.left, DATA, "o-"))
        thin = max(1, len(at) // _MOST_DOTS)
        names = ("along the view, farther is positive", "across, left is positive")
        both = figure.subplots(1, 2)
        for axes, direction, name in zip(both, (pairs.away, left_of), names):
            spread = []
            for label, offset, colour, mark in series:
                usable = np.isfinite(offset).all(axis=1)
                error = 1e3 * (offset * direction).sum(axis=1)[usable]
                here = at[usable]
                axes.plot(here[::thin], error[::thin], ".", color=colour, ms=1.5, alpha=0.25)
                middle, half, _ = binned(here, error)
                axes.plot(middle, half, mark, color=colour, lw=1.4, ms=4, label=label)
                spread += [*np.quantile(error, [0.01, 0.99])] if len(error) else []
            axes.axhline(0.0, color=REFERENCE, lw=0.8)
            if spread:
                margin = 0.1 * (max(spread) - min(spread)) + 1e-3
                axes.set_ylim(min(spread) - margin, max(spread) + margin)
            _finish(axes, "distance / m", "difference / mm")
            axes.set_title(name, fontsize=9)
        both[0].legend(fontsize=8)

    return plotted(draw, (_WIDE, 3.1), "svg")


def errors_figure(residuals: Residuals, unit: str, factor: float) -> bytes:
    """Errors over bearing: dots, medians, 95 % quantiles."""

    def draw(figure: Figure) -> None:
        at = np.degrees(residuals.bearing_rad)
        error = factor * residuals.error
        axes = figure.subplots()
        thin = max(1, len(at) // _MOST_DOTS)
        axes.plot(at[::thin], error[::thin], ".", color=REFERENCE, ms=2.5, alpha=0.6)
        middle, half, most = binned(at, error)
        axes.plot(middle, half, "o-", color=DATA, lw=1.4, ms=4, label="median")
        axes.plot(middle, most, "s--", color=SECOND, lw=1.2, ms=3.5, label="95 %")
        if (error > 0.0).any():
            axes.set_yscale("log")
        _finish(axes, "bearing / deg, positive to the left", f"error / {unit}")
        axes.legend(fontsize=8)

    return plotted(draw, (_WIDE, 2.8), "svg")


def tilt_figure(rows: Sequence[SeenRows]) -> bytes:
    """Pitch and roll over the run, with bands of one standard deviation."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(2, 1, sharex=True)
        at = np.arange(len(rows))
        tilts = [seen.tilt for seen in rows]
        nothing = (np.nan, np.nan)
        for one, name, pairs in (
            (axes[0], "pitch / deg", [nothing if t is None else (t.pitch, t.cpp) for t in tilts]),
            (axes[1], "roll / deg", [nothing if t is None else (t.roll, t.crr) for t in tilts]),
        ):
            value, variance = np.array(pairs, dtype=np.float64).T
            value, sigma = np.degrees(value), np.degrees(np.sqrt(variance))
            one.fill_between(
                at, value - sigma, value + sigma, color=BAND, alpha=0.3, lw=0, label=f"±1 {_SIGMA}"
            )
            one.plot(at, value, ".-", color=DATA, lw=0.9, ms=3)
            one.axhline(0.0, color=REFERENCE, lw=0.6)
            _finish(one, "", name)
        axes[0].legend(fontsize=8)
        axes[1].set_xlabel("frame")

    return plotted(draw, (_WIDE, 3.4), "svg")


def binned(at: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Medians and 95 % quantiles of values in up to 10 bins of equally many.

    Parameters
    ----------
    at, values : (N,) float64
        Where, and what.

    Returns
    -------
    middle, median, quantile : (K,) float64
        Median of `at` in each bin, and the two figures of `values`.
    """
    if not len(at):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    parts = np.array_split(np.argsort(at, kind="stable"), max(1, min(10, len(at) // 8)))
    return (
        np.array([np.median(at[part]) for part in parts]),
        np.array([np.median(values[part]) for part in parts]),
        np.array([np.quantile(values[part], 0.95) for part in parts]),
    )


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25, lw=0.6)
