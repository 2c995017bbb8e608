"""Compiled search for rows and landmarks that belong together (see `compatibility`)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@njit(cache=True, error_model="numpy", nogil=True)
def _append(
    factor: FloatArray,
    whitened: FloatArray,
    size: int,
    cross: FloatArray,
    own: FloatArray,
    innovation: FloatArray,
) -> float:
    """Extend a Cholesky factor and the whitened innovation by one pair's block, in place.

    Returns what the pair adds to the squared distance; negative if the covariance is not positive
    definite with it.
    """
    width = len(innovation)
    added = 0.0
    for a in range(width):
        row = size + a
        for column in range(row):
            value = cross[a, column] if column < size else own[a, column - size]
            for k in range(column):
                value -= factor[row, k] * factor[column, k]
            factor[row, column] = value / factor[column, column]
        square = own[a, a]
        rest = innovation[a]
        for k in range(row):
            square -= factor[row, k] ** 2
            rest -= factor[row, k] * whitened[k]
        if not square > 1e-12 * own[a, a]:
            return -1.0
        factor[row, row] = math.sqrt(square)
        whitened[row] = rest / factor[row, row]
        added += whitened[row] ** 2
    return added


@njit(cache=True, error_model="numpy", nogil=True)
def individual_distances(
    innovations: FloatArray, predicted: FloatArray, noise: FloatArray
) -> FloatArray:
    """Squared Mahalanobis distance of each row from each landmark (n, m).

    Infinite where a covariance is not positive definite or an innovation is not finite.
    """
    n, m, width = innovations.shape
    squared = np.full((n, m), np.inf)
    factor = np.zeros((width, width))
    whitened = np.zeros(width)
    cross = np.zeros((width, 0))
    own = np.zeros((width, width))
    for i in range(n):
        for j in range(m):
            for a in range(width):
                for b in range(width):
                    own[a, b] = predicted[j * width + a, j * width + b] + noise[i, a, b]
            value = _append(factor, whitened, 0, cross, own, innovations[i, j])
            if value >= 0.0:
                squared[i, j] = value
    return squared


@njit(cache=True, error_model="numpy", nogil=True)
def pair_nearest_first(squared: FloatArray, gate: float) -> IntArray:
    """Landmark of each row, -1 without: closest pairs first, each row and landmark once."""
    n, m = squared.shape
    partner = np.full(n, -1, dtype=np.int64)
    taken = np.zeros(m, dtype=np.bool_)
    order = np.argsort(squared.copy().reshape(-1), kind="mergesort")
    for index in order:
        i, j = index // m, index % m
        if not squared[i, j] <= gate:
            break
        if partner[i] < 0 and not taken[j]:
            partner[i] = j
            taken[j] = True
    return partner


@njit(cache=True, error_model="numpy", nogil=True)
def search_jointly(
    innovations: FloatArray,
    predicted: FloatArray,
    noise: FloatArray,
    squared: FloatArray,
    gates: FloatArray,
    most_nodes: int,
) -> tuple[IntArray, float, int]:
    """Depth-first branch and bound over all ways to give rows landmarks.

    Parameters are those of `redetect.slam.association.compatibility.joint_compatible`, and the
    individual distances (n, m), the joint gate of k pairs `gates[k]` (n + 1), and how many pairs
    may be tried.

    Returns `partner` (n,), `squared distance`, `nodes`.
    """
    n, m, width = innovations.shape
    # Rows with few candidates first: they decide most.
    counts = np.zeros(n, dtype=np.int64)
    candidates = np.zeros((n, m), dtype=np.int64)
    for i in range(n):
        order = np.argsort(squared[i], kind="mergesort")
        for j in order:
            if squared[i, j] <= gates[1]:
                candidates[i, counts[i]] = j
                counts[i] += 1
    rows = np.argsort(counts, kind="mergesort")
    first = 0
    while first < n and counts[rows[first]] == 0:
        first += 1
    rows = rows[first:]
    depth = len(rows)

    best = np.full(n, -1, dtype=np.int64)
    best_count, best_squared = 0, 0.0
    partner = np.full(n, -1, dtype=np.int64)
    taken = np.zeros(m, dtype=np.bool_)
    factor = np.zeros((depth * width, depth * width))
    whitened = np.zeros(depth * width)
    cross = np.zeros((width, depth * width))
    own = np.zeros((width, width))
    chosen_row = np.zeros(depth, dtype=np.int64)  # of the pairs so far
    total = np.zeros(depth + 1)  # squared distance after k pairs
    choice = np.zeros(depth + 1, dtype=np.int64)  # next candidate to try at each level
    paired = np.zeros(depth, dtype=np.bool_)  # whether the level holds a pair now
    pairs, level, nodes = 0, 0, 0
    while level >= 0:
        if level < depth and paired[level]:  # back from below: undo this level's pair
            paired[level] = False
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
        size = pairs * width
        for k in range(pairs):
            other = partner[chosen_row[k]]
            for a in range(width):
                for b in range(width):
                    cross[a, k * width + b] = predicted[j * width + a, other * width + b]
        for a in range(width):
            for b in range(width):
                own[a, b] = predicted[j * width + a, j * width + b] + noise[row, a, b]
        added = _append(factor, whitened, size, cross, own, innovations[row, j])
        if added < 0.0 or total[pairs] + added > gates[reachable]:
            continue
        chosen_row[pairs] = row
        total[pairs + 1] = total[pairs] + added
        pairs += 1
        paired[level] = True
        partner[row] = j
        taken[j] = True
        if total[pairs] <= gates[pairs] and (
            pairs > best_count or (pairs == best_count and total[pairs] < best_squared)
        ):
            best_count, best_squared = pairs, total[pairs]
            best[:] = partner
        level += 1
        choice[level] = 0
    return best, best_squared, nodes
