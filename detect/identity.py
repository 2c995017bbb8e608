"""Transfers the IDs of known discs to detected ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from redetect.array_types import FloatArray
from redetect.landmarks import (
    CircleLandmark,
    associate,
    circle_arrays,
    is_positive_definite,
    squared_mahalanobis,
)

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
    the standard deviation, per axis, of errors that no covariance includes. Rows with a singular
    covariance, such as zero, give no ID.
    """
    known = circle_arrays(rows)
    spread = known.covariance + slack_m**2 * np.eye(2)
    if covariance is not None:
        spread = spread + covariance[:, None]
    usable = is_positive_definite(spread)
    spread = np.where(usable[..., None, None], spread, np.eye(2))
    distance = squared_mahalanobis(xy[:, None] - known.xy, spread)
    pairs = associate(distance, usable & (distance <= _GATE))
    ids: list[tuple[int, ...]] = [()] * len(xy)
    for disc, row in zip(pairs.first, pairs.second):
        ids[disc] = rows[row].ids
    return ids
