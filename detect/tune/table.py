"""Trials of settings as a table (CSV), as JSON and as a curve of precision over recall (PNG)."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.report.plot import DATA, MARK, REFERENCE, figure_file
from detect.tune.grid import Combination
from detect.tune.run import Trial

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


def records_csv(records: Sequence[dict[str, Any]]) -> bytes:
    """Records as CSV: a head with the names, truth as 1 and 0, nothing where there is no figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(records[0])
    for record in records:
        writer.writerow([int(v) if name in ("front", "knee") else v for name, v in record.items()])
    return text.getvalue().encode()


def records_json(head: dict[str, Any], records: Sequence[dict[str, Any]]) -> bytes:
    """A head and the records as JSON."""
    document = {**head, "trials": list(records)}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def curve_picture(
    combinations: Sequence[Combination], trials: Sequence[Trial], title: str
) -> bytes:
    """Precision over recall as a PNG file: all trials, their front, and the knee."""
    recall, precision = _rates(trials)
    front, best = pareto_front(recall, precision), knee(recall, precision)
    known = np.flatnonzero(np.isfinite(recall) & np.isfinite(precision))
    one_varied = len(combinations[0]) == 1
    with figure_file((6.4, 6.2), "png") as (figure, content):
        axes = figure.subplots()
        if one_varied:
            axes.plot(recall[known], precision[known], color=REFERENCE, lw=0.8, zorder=1)
        axes.plot(recall[known], precision[known], "o", color=DATA, ms=4, label="tried", zorder=3)
        axes.plot(
            recall[front], precision[front], color=DATA, lw=1.4, ls=(0, (5, 2)), zorder=2,
            label="none is better in both",
        )  # fmt: skip
        if best is not None:
            axes.plot(
                recall[best], precision[best], "o", mfc="none", mec=MARK, mew=2.0, ms=13, zorder=4,
                label=f"knee: {_words(combinations[best])}",
            )  # fmt: skip
        if len(known):
            low = [max(0.0, 1.08 * v.min() - 0.09) for v in (recall[known], precision[known])]
            axes.set_xlim(low[0], 1.06 - 0.06 * low[0])
            axes.set_ylim(low[1], 1.06 - 0.06 * low[1])
            x, y = (np.linspace(max(start, 1e-3), 1.0, 200) for start in low)
            lines = axes.contour(
                x, y, f1_score(x, y[:, None]), levels=[0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95],
                colors="#cccccc", linewidths=0.7, zorder=0,
            )  # fmt: skip
            axes.clabel(lines, fmt="F1 %g", fontsize=6, colors=REFERENCE)
        named = known if len(trials) <= _MOST_NAMED else np.sort(front)
        for k in named[:: max(1, len(named) // _MOST_NAMED)]:
            # Towards the middle, where there is space.
            left = recall[k] > sum(axes.get_xlim()) / 2.0
            axes.annotate(
                str(*combinations[k].values()) if one_varied else _words(combinations[k]),
                (recall[k], precision[k]), xytext=(-7 if left else 7, 5),
                textcoords="offset points", ha="right" if left else "left", fontsize=7,
            )  # fmt: skip
        axes.set_xlabel("recall")
        axes.set_ylabel("precision")
        axes.grid(alpha=0.25, lw=0.6)
        axes.set_title(title, fontsize=10)
        figure.legend(loc="outside lower center", fontsize=8, ncols=1)
    return content.getvalue()


def _rates(trials: Sequence[Trial]) -> tuple[FloatArray, FloatArray]:
    """(N,) recall and precision, NaN where there is none."""
    return (
        np.array([t.recall for t in trials], dtype=np.float64),
        np.array([t.precision for t in trials], dtype=np.float64),
    )


def _words(combination: Combination) -> str:
    return ", ".join(f"{name} {value}" for name, value in combination.items())


def _rounded(value: float | None) -> float | None:
    """Six significant digits, as in the files of rows."""
    return None if value is None else float(f"{value:.6g}")


def f1_score(recall: ArrayLike, precision: ArrayLike) -> FloatArray:
    """Harmonic mean of recall and precision; 0 where both are, NaN where one is."""
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    return np.asarray(2.0 * r * p / np.where(r + p == 0.0, 1.0, r + p))


def pareto_front(recall: ArrayLike, precision: ArrayLike) -> NDArray[np.intp]:
    """Settings that no other one beats in recall or precision without losing in the other.

    Of (N,) recalls and precisions, NaN where there are none, the (M,) indices of these settings, by
    rising recall and so by falling precision; of equals the first.
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
