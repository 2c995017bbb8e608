"""Precision over recall of many settings: which of them are worth having, and the knee."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def f1_score(recall: ArrayLike, precision: ArrayLike) -> FloatArray:
    """Harmonic mean of recall and precision; 0 where both are, NaN where one is."""
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    total = r + p
    return np.asarray(2.0 * r * p / np.where(total > 0.0, total, 1.0) + 0.0 * total)


def pareto_front(recall: ArrayLike, precision: ArrayLike) -> NDArray[np.intp]:
    """Settings that no other one beats in recall or precision without losing in the other.

    Parameters
    ----------
    recall, precision : (N,) array_like
        Of each setting; NaN where there is none.

    Returns
    -------
    (M,) intp
        Which settings, by rising recall (and so by falling precision); of equals the first.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    known = np.flatnonzero(np.isfinite(r) & np.isfinite(p))
    # By falling recall, then falling precision: points no better than before are dominated.
    order = known[np.lexsort((known, -p[known], -r[known]))]
    front = []
    best = -np.inf
    for k in order:
        if p[k] > best:
            front.append(k)
            best = p[k]
    return np.array(front[::-1], dtype=np.intp)


def knee(recall: ArrayLike, precision: ArrayLike) -> int | None:
    """The setting at the knee of the curve of precision over recall.

    That is the point of the front farthest beyond the chord between the front's ends, both axes
    scaled to the front's extent. Where no point is beyond it, there is no knee, and the point with
    the greatest harmonic mean of recall and precision is used instead.

    Parameters
    ----------
    recall, precision : (N,) array_like
        Of each setting; NaN where there is none.

    Returns
    -------
    int or None
        Which setting; None without any.

    References
    ----------
    Satopää, Albrecht, Irwin, Raghavan: Finding a "Kneedle" in a Haystack, 2011.
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
            return int(front[int(np.argmax(beyond))])
    return int(front[int(np.argmax(f1_score(r[front], p[front])))])
