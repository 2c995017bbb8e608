"""IDs of known discs, carried over to detected ones.

Both ways rows and discs are matched where they belong together before all others: each is the
other's nearest by the Mahalanobis distance, again and again until none is left within the gate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import CircleLandmark, circle_arrays

#: Chi-squared of two degrees of freedom exceeds this once in a thousand.
_GATE = 2.0 * math.log(1000.0)


def ids_of_rows(
    xy: FloatArray,
    rows: Sequence[CircleLandmark],
    covariance: FloatArray | None = None,
    slack_m: float = 0.0,
) -> list[tuple[int, ...]]:
    """The IDs of the rows of the same discs in the same frame; () for discs without a row.

    Discs (N, 2) are compared without a correction for the tilt if the rows are without one: then
    both are the same pixels, whatever the tilt, and the discs' own covariance does not count.
    `slack_m` is the standard deviation of what no covariance includes, in every direction.
    """
    own = np.zeros((len(xy), 2, 2)) if covariance is None else covariance
    known = circle_arrays(rows)
    found = matched(xy, own, known.xy, known.covariance + slack_m**2 * np.eye(2))
    return [rows[i].ids if i >= 0 else () for i in found.tolist()]


def matched(
    xy: FloatArray, covariance: FloatArray, known_xy: FloatArray, known_covariance: FloatArray
) -> IntArray:
    """(N,) which of M known places each of N places is; -1 where none is within the gate.

    Of places (N, 2), (M, 2) with covariances, each is used once at most, the nearest pairs first.
    """
    found = np.full(len(xy), -1)
    if not len(xy) or not len(known_xy):
        return found
    off = xy[:, None] - known_xy
    spread = covariance[:, None] + known_covariance
    solved = np.linalg.solve(spread, off[..., None])[..., 0]
    distance = np.einsum("nmi,nmi->nm", off, solved)
    order = np.argsort(distance, axis=None, kind="stable")
    taken = np.zeros(len(known_xy), np.bool_)
    for n, m in zip(*np.unravel_index(order, distance.shape)):
        if not distance[n, m] <= _GATE:
            break
        if found[n] < 0 and not taken[m]:
            found[n] = m
            taken[m] = True
    return found
