"""Covariances at a minimum: parts of the inverse of sparse normal equations."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from redetect.array_types import FloatArray, IntArray
from redetect.compiled import kernel
from redetect.least_squares.solver import NormalEquations, factor, scaled_inverse

# Number of columns of the inverse computed at once.
_CHUNK = 128


def marginal_covariances(
    equations: NormalEquations, blocks: list[tuple[int, IntArray]]
) -> tuple[list[FloatArray], FloatArray]:
    """Covariances of groups of unknowns, and of the shared ones, marginalised over all others.

    Takes width and first indices (b,) of groups; returns their covariances (b, width, width), and
    (s, s). Raises `numpy.linalg.LinAlgError` if the residuals do not determine the unknowns.
    """
    found = inverse_blocks(equations.matrix, blocks)
    eliminated, shared = by_shared(equations)
    for k, (width, first) in enumerate(blocks):
        by = eliminated[first[:, None] + np.arange(width)]
        found[k] = found[k] + by @ shared @ np.swapaxes(by, 1, 2)
    return found, shared


def joint_marginal_covariance(equations: NormalEquations, chosen: IntArray) -> FloatArray:
    """(n, n) joint covariance of n chosen unknowns; errors as `marginal_covariances`."""
    factored, size = factor(equations.matrix), equations.matrix.shape[0]
    covariance = np.empty((len(chosen), len(chosen)))
    for first in range(0, len(chosen), _CHUNK):
        some = chosen[first : first + _CHUNK]
        unit = np.zeros((size, len(some)))
        unit[some, np.arange(len(some))] = 1.0
        covariance[:, first : first + len(some)] = factored.solve(unit)[chosen]
    eliminated, shared = by_shared(equations)
    covariance += eliminated[chosen] @ shared @ eliminated[chosen].T
    return np.asarray(0.5 * (covariance + covariance.T))


def by_shared(equations: NormalEquations) -> tuple[FloatArray, FloatArray]:
    """Border solved by the matrix of the others (K, s), and covariance of the shared (s, s)."""
    if equations.corner.size == 0:
        return equations.border, equations.corner
    eliminated = factor(equations.matrix).solve(equations.border)
    if equations.considered is not None:
        return eliminated, equations.considered
    return eliminated, scaled_inverse(equations.corner - equations.border.T @ eliminated)


def inverse_blocks(
    matrix: sparse.csc_array, blocks: list[tuple[int, IntArray]]
) -> list[FloatArray]:
    """Diagonal blocks of the inverse of a sparse positive definite matrix."""
    factored = factor(matrix)
    order = np.asarray(factored.perm_c, dtype=np.int64)
    if not np.array_equal(order, factored.perm_r):
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    # Row i of the matrix is row order[i] of the factor's.
    entries = matrix.tocoo()
    # The requested entries must be in the pattern, even if the matrix is zero there.
    asked = [(f + i, f + j) for width, f in blocks for i in range(width) for j in range(width)]
    row = order[np.concatenate([entries.row, *(i for i, _ in asked)])]
    column = order[np.concatenate([entries.col, *(j for _, j in asked)])]
    pattern = sparse.csc_array((np.ones(len(row)), (row, column)))
    keys = np.sort(
        filled_pattern(pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64))
    )
    indptr = np.searchsorted(keys, len(order) * np.arange(len(order) + 1))
    indices = keys % len(order)
    lower = sparse.tril(factored.L, -1).tocoo()
    values = np.zeros(len(indices))
    values[np.searchsorted(keys, lower.col.astype(np.int64) * len(order) + lower.row)] = lower.data
    below, on_diagonal = selected_inverse(indptr, indices, values, factored.U.diagonal())
    found = []
    for width, first in blocks:
        block = np.zeros((len(first), width, width))
        for i in range(width):
            block[:, i, i] = on_diagonal[order[first + i]]
            for j in range(i):
                one, other = order[first + i], order[first + j]
                key = np.minimum(one, other) * len(order) + np.maximum(one, other)
                block[:, i, j] = block[:, j, i] = below[np.searchsorted(keys, key)]
        found.append(block)
    return found


@kernel()
def filled_pattern(indptr: IntArray, indices: IntArray) -> IntArray:
    """Entries of the Cholesky factor of a symmetric matrix, strictly below the diagonal.

    Each is its column times the matrix's size plus its row; in any order. SuperLU's own factor
    lacks entries that cancel or, as around a long loop of poses, underflow: the entries of the
    inverse there would be missing.

    T. A. Davis, Algorithm 849: A concise sparse Cholesky factorization package, ACM Transactions on
    Mathematical Software 31, 2005.
    """
    n = len(indptr) - 1
    parent = np.full(n, -1, dtype=np.int64)
    mark = np.full(n, -1, dtype=np.int64)
    entries: list[int] = []
    for row in range(n):
        mark[row] = row
        for at in range(indptr[row], indptr[row + 1]):
            column = indices[at]
            # Up the elimination tree, to entries of this row that were found before.
            while column < row and mark[column] != row:
                mark[column] = row
                entries.append(column * n + row)
                if parent[column] < 0:
                    parent[column] = row
                column = parent[column]
    return np.array(entries, dtype=np.int64)


@kernel()
def selected_inverse(
    indptr: IntArray, indices: IntArray, lower: FloatArray, diagonal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Entries of the inverse of ``L D L^T`` in the pattern of L, and on the diagonal.

    K. Takahashi, J. Fagan, M.-S. Chin, Formation of a sparse bus impedance matrix and its
    application to short circuit study, PICA 1973.
    """
    n = len(diagonal)
    below = np.zeros(len(lower))
    on_diagonal = np.zeros(n)
    place = np.full(n, -1, dtype=np.int64)
    sums = np.zeros(n)
    for j in range(n - 1, -1, -1):
        first, last = indptr[j], indptr[j + 1]
        for at in range(first, last):
            place[indices[at]] = at
            sums[at - first] = 0.0
        for at in range(first, last):
            k = indices[at]
            sums[at - first] += on_diagonal[k] * lower[at]
            for other in range(indptr[k], indptr[k + 1]):
                here = place[indices[other]]
                if here >= 0:
                    sums[here - first] += below[other] * lower[at]
                    sums[at - first] += below[other] * lower[here]
        variance = 1.0 / diagonal[j]
        for at in range(first, last):
            below[at] = -sums[at - first]
            variance -= lower[at] * below[at]
            place[indices[at]] = -1
        on_diagonal[j] = variance
    return below, on_diagonal
