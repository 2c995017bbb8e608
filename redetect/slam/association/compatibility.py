"""Associates rows with known landmarks: individual gate, or joint compatibility (JCBB).

A frame's innovations are not independent: all of them share the error of the pose. Joint
compatibility tests whether a set of pairs is likely *together*; branch and bound finds the largest
such set (J. Neira, J. D. Tardos, "Data association in stochastic mapping using the joint
compatibility test", IEEE Transactions on Robotics and Automation 17(6), 2001).

All functions take innovations and covariances, whatever the landmarks are: n rows and m landmarks
that may be visible, each measured by d numbers (2 for a disc, 1 for a bearing).
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.special import chdtri

from redetect.array_types import FloatArray, IntArray
from redetect.compiled import kernel
from redetect.landmarks import is_positive_definite, squared_mahalanobis
from redetect.slam.settings import DEFAULT_GATE_PROBABILITY


def compatible(
    method: str,
    innovations: FloatArray,
    predicted_covariance: FloatArray,
    noise: FloatArray,
    gate_probability: float = DEFAULT_GATE_PROBABILITY,
    *,
    most_nodes: int = 30_000,
) -> IntArray:
    """Associate rows with landmarks.

    Parameters
    ----------
    method : str
        `nearest`: nearest neighbour with Mahalanobis gate, closest pairs first, each row and
        landmark once. `joint`: the largest set of pairs that are compatible jointly, among equals
        the most likely one. Every pair must pass the individual gate, and all k pairs together the
        gate of d k degrees of freedom. Unlike the published search, a branch is pruned only if no
        set below it can pass, so that the result does not depend on the order of the rows.
    innovations, predicted_covariance, noise : (n, m, d), (m d, m d), (n, d, d) float64
    gate_probability : float
        Share of correct pairs, or sets of pairs, that pass.
    most_nodes : int
        Bound of the joint search.

    Returns
    -------
    (n,) int64
        Index of each row's landmark, -1 if it shows none of them; each occurs at most once.
    """
    arrays = map(np.ascontiguousarray, (innovations, predicted_covariance, noise))
    innovations, predicted_covariance, noise = arrays
    n, _, width = innovations.shape
    squared = individual_distances(innovations, predicted_covariance, noise)
    gates = chi_squared_gates(gate_probability, width, max(n, 1))
    if method == "nearest":
        return pair_nearest_first(squared, gates[1])
    candidates = np.argsort(squared, axis=1, kind="stable")
    counts = np.sum(squared <= gates[1], axis=1)
    # Rows with few candidates first, since they constrain the search most.
    rows = np.argsort(counts, kind="stable")
    rows = rows[counts[rows] > 0]
    return search_jointly(
        innovations, predicted_covariance, noise, rows, candidates, counts, gates, most_nodes
    )


@cache
def chi_squared_gates(probability: float, width: int, most_pairs: int) -> FloatArray:
    """(most_pairs + 1,) chi-squared quantiles for 0, 1, 2, ... pairs, not to be modified."""
    gates = chdtri(width * np.arange(1, most_pairs + 1), 1.0 - probability)
    return np.concatenate([[0.0], gates])


@kernel()
def _append(
    factor: FloatArray,
    whitened: FloatArray,
    predicted: FloatArray,
    landmarks: IntArray,
    noise: FloatArray,
    innovation: FloatArray,
) -> float:
    """Extend a Cholesky factor and the whitened innovation by one pair's block, in place.

    Takes the landmarks of the pairs so far, then that of the new pair, and its row's noise (d, d)
    and innovation (d,). Returns the pair's part of the squared distance; negative if the covariance
    is not positive definite.
    """
    width, last = len(innovation), len(landmarks) - 1
    added = 0.0
    for a in range(width):
        row = last * width + a
        value = rest = 0.0
        for column in range(row + 1):
            other, b = column // width, column % width
            value = predicted[landmarks[last] * width + a, landmarks[other] * width + b]
            if other == last:
                value += noise[a, b]
            rest = value
            for k in range(column):
                rest -= factor[row, k] * factor[column, k]
            if column < row:
                factor[row, column] = rest / factor[column, column]
        if not rest > 1e-12 * value:
            return -1.0
        factor[row, row] = math.sqrt(rest)
        off = innovation[a]
        for k in range(row):
            off -= factor[row, k] * whitened[k]
        whitened[row] = off / factor[row, row]
        added += whitened[row] ** 2
    return added


def individual_distances(
    innovations: FloatArray, predicted: FloatArray, noise: FloatArray
) -> FloatArray:
    """(n, m) squared Mahalanobis distances of rows from landmarks, infinite if a covariance is not
    positive definite or an innovation is not finite.
    """
    n, m, width = innovations.shape
    every = np.arange(m)
    covariance = predicted.reshape(m, width, m, width)[every, :, every, :] + noise[:, None]
    usable = np.isfinite(innovations).all(axis=2) & is_positive_definite(covariance)
    squared = np.full((n, m), np.inf)
    squared[usable] = squared_mahalanobis(innovations[usable], covariance[usable])
    return squared


def pair_nearest_first(squared: FloatArray, gate: float) -> IntArray:
    """Landmark of each row, -1 without: closest pairs first, each row and landmark once."""
    partner = np.full(len(squared), -1, dtype=np.int64)
    for index in np.argsort(squared, axis=None, kind="stable"):
        i, j = divmod(int(index), squared.shape[1])
        if not squared[i, j] <= gate:
            break
        if partner[i] < 0 and j not in partner:
            partner[i] = j
    return partner


@kernel()
def search_jointly(
    innovations: FloatArray,
    predicted: FloatArray,
    noise: FloatArray,
    rows: IntArray,
    candidates: IntArray,
    counts: IntArray,
    gates: FloatArray,
    most_nodes: int,
) -> IntArray:
    """Depth-first branch and bound over all assignments of landmarks to rows.

    Parameters are those of `compatible`, and the order in which rows are assigned, the candidates
    of each row, the first `counts` (n,) of `candidates` (n, m), the joint gate of k pairs
    `gates[k]` (n + 1), and the largest number of pairs to try.

    Returns (n,): the landmark of each row, -1 without.
    """
    n, m, width = innovations.shape
    depth = len(rows)

    best = np.full(n, -1, dtype=np.int64)
    best_count, best_squared = 0, 0.0
    partner = np.full(n, -1, dtype=np.int64)
    taken = np.zeros(m, dtype=np.bool_)
    factor = np.zeros((depth * width, depth * width))
    whitened = np.zeros(depth * width)
    chosen = np.zeros(depth, dtype=np.int64)  # landmarks of the pairs so far
    total = np.zeros(depth + 1)  # squared distance after k pairs
    choice = np.zeros(depth + 1, dtype=np.int64)  # next candidate to try at each level
    pairs, level, nodes = 0, 0, 0
    while level >= 0:
        if level < depth and partner[rows[level]] >= 0:  # back from below: undo this level's pair
            pairs -= 1
            taken[partner[rows[level]]] = False
            partner[rows[level]] = -1
        reachable = pairs + depth - level
        if (
            level == depth
            or choice[level] > counts[rows[level]]
            or reachable < best_count
            or (reachable == best_count and total[pairs] >= best_squared)
            or total[pairs] > gates[reachable]
            or nodes >= most_nodes
        ):
            level -= 1
            continue
        row = rows[level]
        index = choice[level]
        choice[level] += 1
        if index == counts[row]:  # this row shows none of the landmarks
            level += 1
            choice[level] = 0
            continue
        j = candidates[row, index]
        if taken[j]:
            continue
        nodes += 1
        chosen[pairs] = j
        landmarks = chosen[: pairs + 1]
        added = _append(factor, whitened, predicted, landmarks, noise[row], innovations[row, j])
        if added < 0.0 or total[pairs] + added > gates[reachable]:
            continue
        total[pairs + 1] = total[pairs] + added
        pairs += 1
        partner[row] = j
        taken[j] = True
        if total[pairs] <= gates[pairs] and (
            pairs > best_count or (pairs == best_count and total[pairs] < best_squared)
        ):
            best_count, best_squared = pairs, total[pairs]
            for i in range(n):
                best[i] = partner[i]
        level += 1
        choice[level] = 0
    return best
