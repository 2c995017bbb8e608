"""Landmark records as arrays and back; matching of the rows of two sets.

Matching is gated, one to one, and optimal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.landmarks.records import CircleLandmark

IndexArray = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class CircleArrays:
    """N rows of discs as arrays."""

    xy: FloatArray  #: (N, 2) centres in the robot frame (m)
    quality: FloatArray  #: (N,) confidence, 0 to 1
    covariance: FloatArray  #: (N, 2, 2) of `xy` (m^2)
    ids: IntArray  #: (N,) each row's first known identifier; -1 if there is none


def circle_arrays(circles: Sequence[CircleLandmark]) -> CircleArrays:
    """Collect rows of discs in arrays (of length 0 if there are none)."""
    numbers = np.array(
        [(c.px, c.py, c.quality, c.cxx, c.cxy, c.cyy) for c in circles], dtype=np.float64
    ).reshape(-1, 6)
    return CircleArrays(
        xy=numbers[:, :2].copy(),
        quality=numbers[:, 2].copy(),
        covariance=numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2),
        ids=np.array([next((i for i in c.ids if i >= 0), -1) for c in circles], dtype=np.int64),
    )


def circle_landmarks(
    xy: ArrayLike, quality: ArrayLike, covariance: ArrayLike, ids: ArrayLike | None = None
) -> tuple[CircleLandmark, ...]:
    """Convert arrays to rows of discs.

    Parameters
    ----------
    xy : (N, 2) array_like
        Centres in the robot frame (m).
    quality : (N,) array_like
        Confidence, 0 to 1.
    covariance : (N, 2, 2) array_like
        Of `xy` (m^2).
    ids : (N,) array_like of int, optional
        Identifiers, -1 if unknown; by default the rows have none.

    Raises
    ------
    LandmarkError
        If a number is not finite.
    ValueError
        If the arrays' lengths differ.
    """
    spread = np.asarray(covariance, dtype=np.float64).reshape(-1, 4)[:, [0, 1, 3]]
    numbers = np.column_stack([np.reshape(xy, (-1, 2)), quality, spread]).tolist()
    count = len(numbers)
    identifiers = np.zeros((count, 0), np.int64) if ids is None else np.reshape(ids, (-1, 1))
    return tuple(
        CircleLandmark(px, py, q, cxx, cxy, cyy, tuple(own))
        for (px, py, q, cxx, cxy, cyy), own in zip(numbers, identifiers.tolist(), strict=True)
    )


def is_positive_definite(covariance: ArrayLike, least: float = 1e-12) -> BoolArray:
    """Which covariance matrices are positive definite, and thus invertible and usable.

    Covariances are read from files unchecked; callers that need valid ones check them here.

    Parameters
    ----------
    covariance : (..., n, n) array_like
        Symmetric matrices.
    least : float
        Bound of the correlation matrix's eigenvalues; below it, quantities are linearly dependent.

    Returns
    -------
    (...) bool
    """
    matrices = np.asarray(covariance, dtype=np.float64)
    scale = np.sqrt(np.clip(np.diagonal(matrices, axis1=-2, axis2=-1), 0.0, None))
    safe = np.where(scale > 0.0, scale, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = matrices / safe[..., :, None] / safe[..., None, :]
    sane = np.all(scale > 0.0, axis=-1) & np.all(np.isfinite(correlation), axis=(-2, -1))
    correlation = np.where(sane[..., None, None], correlation, 0.0)
    return np.asarray(sane & (np.linalg.eigvalsh(correlation)[..., 0] > least))


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Pairs of rows of two sets; no row is in two pairs."""

    #: (M,) pairs: row `first[k]`, ascending, of the first set matches row `second[k]` of the second
    first: IndexArray
    second: IndexArray
    #: The unmatched rows of each set, in ascending order
    first_unmatched: IndexArray
    second_unmatched: IndexArray


def associate(costs: ArrayLike, allowed: ArrayLike) -> Association:
    """Pair the rows of two sets: as many pairs as possible, with the least total cost.

    This is a linear assignment problem. The result is deterministic; if several solutions have the
    same number of pairs and the same cost, it may depend on the order of the rows.

    Parameters
    ----------
    costs : (N, M) array_like
        Cost of pairing row n of the first set with row m of the second, at least 0. Costs of pairs
        that are not allowed are ignored.
    allowed : (N, M) array_like of bool
        The gate.

    Raises
    ------
    ValueError
        If the shapes differ or an allowed cost is negative or not finite.
    """
    from scipy.optimize import linear_sum_assignment

    cost = np.asarray(costs, dtype=np.float64)
    gate = np.asarray(allowed, dtype=np.bool_)
    if cost.ndim != 2 or cost.shape != gate.shape:
        raise ValueError(f"costs {cost.shape}, allowed {gate.shape}: expected both (N, M)")
    if not (np.isfinite(cost[gate]) & (cost[gate] >= 0)).all():
        raise ValueError("a cost is negative or not finite where a pair is allowed")
    # One forbidden pair costs more than all allowed ones together: as few as possible are used.
    scale = cost[gate].max(initial=0.0) or 1.0
    forbidden = 1.0 + min(cost.shape)
    weights = np.full(cost.shape, forbidden)
    weights[gate] = cost[gate] / scale
    first, second = linear_sum_assignment(weights)
    paired = gate[first, second]
    first, second = first[paired], second[paired]
    return Association(
        first=first,
        second=second,
        first_unmatched=np.setdiff1d(np.arange(cost.shape[0]), first),
        second_unmatched=np.setdiff1d(np.arange(cost.shape[1]), second),
    )


def associate_positions(first: ArrayLike, second: ArrayLike, *, gate_m: float) -> Association:
    """Pair positions within `gate_m` of each other, with least squared distances.

    Parameters
    ----------
    first, second : (N, 2), (M, 2) array_like
        Positions in one frame (m).
    gate_m : float
        Largest distance of a pair (m), at least 0.
    """
    one, other = (np.asarray(xy, dtype=np.float64).reshape(-1, 2) for xy in (first, second))
    with np.errstate(over="ignore"):  # distances that overflow are beyond any gate
        distance = np.linalg.norm(one[:, np.newaxis] - other, axis=-1)
        return associate(distance**2, distance <= gate_m)


def squared_mahalanobis(offset: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Square of the Mahalanobis distance, ``offset' covariance^-1 offset``.

    Parameters
    ----------
    offset : (..., n) array_like
        Differences.
    covariance : (..., n, n) array_like
        Their positive definite covariances; broadcast against `offset`.

    Returns
    -------
    (...) float64

    Raises
    ------
    numpy.linalg.LinAlgError
        If a covariance is singular.
    """
    difference = np.asarray(offset, dtype=np.float64)
    solved = np.linalg.solve(np.asarray(covariance, dtype=np.float64), difference[..., np.newaxis])
    return np.asarray(np.einsum("...i,...i->...", difference, solved[..., 0]), dtype=np.float64)


def wrap_angle(angle_rad: ArrayLike) -> FloatArray:
    """Wrap angles to [-pi, pi) (rad)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, dtype=np.float64)
