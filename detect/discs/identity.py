"""Transfers the IDs of known discs to detected ones.

Rows and discs are matched greedily, nearest pairs first by the Mahalanobis distance, until no pair
is left within the gate.
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
    """IDs of discs, from rows of the same discs in the same frame; () for discs without a row.

    If the rows are not corrected for the tilt, the discs (N, 2) must not be either: then both refer
    to the same pixels, whatever the tilt, and the discs' own covariance is not used. `slack_m` is
    the standard deviation, per axis, of errors that no covariance includes.
    """
    own = np.zeros((len(xy), 2, 2)) if covariance is None else covariance
    known = circle_arrays(rows)
    found = matched(xy, own, known.xy, known.covariance + slack_m**2 * np.eye(2))
    return [rows[i].ids if i >= 0 else () for i in found.tolist()]


def matched(
    xy: FloatArray, covariance: FloatArray, known_xy: FloatArray, known_covariance: FloatArray
) -> IntArray:
    """(N,) indices of the known positions that match N positions; -1 if none is within the gate.

    Of positions (N, 2), (M, 2) with covariances, each is matched at most once, nearest pairs first.
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
