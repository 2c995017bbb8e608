"""IDs of known discs, carried over to detected ones.

Both ways rows and discs are matched where they belong together before all others: each is the
other's nearest by the Mahalanobis distance, again and again until none is left within the gate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import CircleLandmark, circle_arrays

#: Chi-squared of two degrees of freedom exceeds this once in a thousand.
_GATE = 2.0 * math.log(1000.0)


class MappedDisc(NamedTuple):
    """A disc of a map in the robot frame of a frame (m), with its covariance (m^2)."""

    id: int
    x: float
    y: float
    cxx: float
    cxy: float
    cyy: float


def ids_of_rows(seen_xy: FloatArray, rows: Sequence[CircleLandmark]) -> list[tuple[int, ...]]:
    """The IDs of the rows of the same discs in the same frame; () for discs without a row.

    Discs (N, 2) are compared without a correction for the tilt if the rows are without one: then
    both are the same pixels, whatever the tilt.
    """
    known = circle_arrays(rows)
    found = matched(seen_xy, np.zeros((len(seen_xy), 2, 2)), known.xy, known.covariance)
    return [rows[i].ids if i >= 0 else () for i in found.tolist()]


def ids_of_map(
    floor_xy: FloatArray, covariance: FloatArray, discs: Sequence[MappedDisc], slack_m: float
) -> IntArray:
    """(N,) IDs of the mapped discs that detected ones fall on; -1 where there is none.

    `slack_m` is the standard deviation of what neither covariance includes, in every direction.
    """
    if not discs:
        return np.full(len(floor_xy), -1)
    table = np.array([disc[1:] for disc in discs], dtype=np.float64)
    spread = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2) + slack_m**2 * np.eye(2)
    found = matched(floor_xy, covariance, table[:, :2], spread)
    ids = np.array([disc.id for disc in discs] + [-1], dtype=np.int64)
    return ids[found]


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
