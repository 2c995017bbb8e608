"""Which row of one set is which row of another: gated, one to one, optimal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redetect.array_types import FloatArray

IndexArray = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Pairs of rows of two sets; no row is in two pairs.

    Attributes
    ----------
    first, second : (M,) intp
        The pairs: row `first[k]` of the first set belongs to row `second[k]` of the second. `first`
        ascends.
    first_alone, second_alone : intp
        The rows of each set that are in no pair, ascending.
    """

    first: IndexArray
    second: IndexArray
    first_alone: IndexArray
    second_alone: IndexArray


def associate(costs: ArrayLike, allowed: ArrayLike) -> Association:
    """Pair the rows of two sets: as many pairs as possible, and of those the least total cost.

    A linear assignment problem. Deterministic; where several solutions have the same number of
    pairs and the same cost, which one comes out may depend on the order of the rows.

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
    # One forbidden pair costs more than all allowed ones together: no more are taken than must.
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
        first_alone=np.setdiff1d(np.arange(cost.shape[0]), first),
        second_alone=np.setdiff1d(np.arange(cost.shape[1]), second),
    )


def associate_positions(first: ArrayLike, second: ArrayLike, *, gate_m: float) -> Association:
    """Pair positions that lie within `gate_m` of each other, with least squared distances.

    Parameters
    ----------
    first, second : (N, 2), (M, 2) array_like
        Positions in one frame (m).
    gate_m : float
        Largest distance of a pair (m), at least 0.
    """
    with np.errstate(over="ignore"):  # distances that overflow are beyond any gate
        distance = np.linalg.norm(_differences(first, second), axis=-1)
        squared = distance**2
    return associate(squared, distance <= gate_m)


def associate_within_covariance(
    first: ArrayLike, second: ArrayLike, covariance: ArrayLike, *, gate_sigma: float
) -> Association:
    """Pair positions by their Mahalanobis distance.

    Parameters
    ----------
    first, second : (N, 2), (M, 2) array_like
        Positions in one frame (m).
    covariance : (N, 2, 2) or (N, M, 2, 2) array_like
        Positive definite covariance of each position of the first set, or of each difference (m^2).
    gate_sigma : float
        Largest Mahalanobis distance of a pair (standard deviations), at least 0.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a covariance is singular.
    ValueError
        If one makes a squared distance negative.
    """
    spread = np.asarray(covariance, dtype=np.float64)
    if spread.ndim == 3:
        spread = spread[:, np.newaxis]
    with np.errstate(over="ignore", invalid="ignore"):  # as in associate_positions
        squared = squared_mahalanobis(_differences(first, second), spread)
    return associate(squared, squared <= gate_sigma**2)


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
    """Bring angles into [-pi, pi) (rad)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, dtype=np.float64)


def _differences(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """All (N, M, 2) differences between two sets of positions."""
    positions = [np.asarray(xy, dtype=np.float64).reshape(-1, 2) for xy in (first, second)]
    return np.asarray(positions[0][:, np.newaxis] - positions[1], dtype=np.float64)
