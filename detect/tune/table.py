"""Trials of settings as records, and as a curve of precision over recall with its knee."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.report.plot import DATA, MARK, figure_file
from detect.tune.grid import Combination
from detect.tune.run import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]

# Largest number of points that are labelled.
_MOST_NAMED = 12


def trial_records(
    combinations: Sequence[Combination], trials: Sequence[Trial], unit: str
) -> list[dict[str, Any]]:
    """One record for each trial: the parameters, then the figures; `unit` is that of the errors."""
    recall, precision = _rates(trials)
    f1 = f1_score(recall, precision)
    front, best = pareto_front(recall, precision), knee(recall, precision)
    return [
        {
            **combination,
            "reference": trial.reference,
            "detected": trial.detected,
            "matched": trial.matched,
            "recall": _rounded(trial.recall),
            "precision": _rounded(trial.precision),
            "f1": _rounded(float(f1[k]) if np.isfinite(f1[k]) else None),
            f"error_median_{unit}": _rounded(trial.error_median),
            "normalised_error": _rounded(trial.normalised_error),
            "front": k in front,
            "knee": k == best,
        }
        for k, (combination, trial) in enumerate(zip(combinations, trials))
    ]


def curve_picture(
    combinations: Sequence[Combination], trials: Sequence[Trial], title: str
) -> bytes:
    """Precision over recall as a PNG file: all trials, their front, and the knee."""
    with figure_file((6.4, 6.2), "png") as (figure, content):
        axes = figure.subplots()
        names = [", ".join(f"{name} {value}" for name, value in c.items()) for c in combinations]
        draw_rates(axes, *_rates(trials), names, _MOST_NAMED)
        axes.margins(0.15)
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside lower center", fontsize=8, ncols=1)
    return content.getvalue()


def draw_rates(
    axes: Axes, recall: FloatArray, precision: FloatArray, names: Sequence[str], most_named: int
) -> None:
    """Draw precision over recall (N,): all settings, their front with some names, and the knee."""
    front, best = pareto_front(recall, precision), knee(recall, precision)
    axes.plot(recall, precision, "o", color=DATA, ms=4, label="tried")
    axes.plot(
        recall[front], precision[front], "--", color=DATA, lw=1.2, label="none is better in both"
    )
    if best is not None:
        axes.plot(
            recall[best], precision[best], "o", mfc="none", mec=MARK, mew=2.0, ms=12,
            label=f"knee: {names[best]}",
        )  # fmt: skip
    for k in front[:: max(1, -(-(len(front) - 1) // (most_named - 1)))]:
        axes.annotate(
            names[k], (recall[k], precision[k]), xytext=(-7, -9), textcoords="offset points",
            ha="right", fontsize=7,
        )  # fmt: skip
    axes.set(xlabel="recall", ylabel="precision")
    axes.grid(alpha=0.25, lw=0.6)


def _rates(trials: Sequence[Trial]) -> tuple[FloatArray, FloatArray]:
    """(N,) recall and precision, NaN where there is none."""
    rates = np.array([(t.recall, t.precision) for t in trials], np.float64).reshape(-1, 2)
    return rates[:, 0], rates[:, 1]


def _rounded(value: float | None) -> float | None:
    """Six significant digits, as in the files of rows."""
    return None if value is None else float(f"{value:.6g}")


def f1_score(recall: ArrayLike, precision: ArrayLike) -> FloatArray:
    """Harmonic mean of recall and precision; 0 where both are, NaN where one is."""
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    return np.asarray(2.0 * r * p / np.where(r + p == 0.0, 1.0, r + p))


def pareto_front(recall: ArrayLike, precision: ArrayLike) -> NDArray[np.intp]:
    """(M,) indices of settings that none beats in recall or precision without losing in the other.

    By rising recall; of equals the first. Recalls and precisions (N,) are NaN where there are none.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    known = np.flatnonzero(np.isfinite(r) & np.isfinite(p))
    # By falling recall, then falling precision: points no better than before are dominated.
    order = known[np.lexsort((known, -p[known], -r[known]))]
    before = np.maximum.accumulate(np.concatenate([[-np.inf], p[order]]))[:-1]
    return order[p[order] > before][::-1]


def knee(recall: ArrayLike, precision: ArrayLike) -> int | None:
    """The setting at the knee of the curve of precision over recall; None without any.

    That is the point of the front farthest beyond the chord between the front's ends, both axes
    scaled to the front's extent (Satopää, Albrecht, Irwin, Raghavan: Finding a "Kneedle" in a
    Haystack, 2011). Where no point is beyond it, there is no knee, and the point with the greatest
    harmonic mean of recall and precision is used instead.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    front = pareto_front(r, p)
    if not len(front):
        return None
    if len(front) > 2:
        x = (r[front] - r[front[0]]) / (r[front[-1]] - r[front[0]])
        y = (p[front] - p[front[-1]]) / (p[front[0]] - p[front[-1]])
        beyond = x + y - 1.0
        if beyond.max() > 1e-9:
            return int(front[np.argmax(beyond)])
    return int(front[np.argmax(f1_score(r[front], p[front]))])
