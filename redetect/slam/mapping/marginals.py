"""Marginal covariances of all poses and landmarks at a least-squares solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from redetect.slam.errors import SlamError
from redetect.slam.mapping.graph import Estimate, Graph
from redetect.slam.mapping.graph_terms import Weighting, layout_of, linearise
from redetect.slam.mapping.marginal_kernels import filled_pattern, selected_inverse
from redetect.slam.mapping.solve import factor, normal_equations

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Marginals:
    """Covariance of each unknown, all others unknown too.

    Attributes
    ----------
    poses : (N + 1, 3, 3) float64
        Zero for the first, which is given.
    discs : (M, 2, 2) float64
    lines : (K, 2, 2) float64
    mounting : (4, 4) float64 or None
        Of the rotation vector (rad) and the height (m).
    """

    poses: FloatArray
    discs: FloatArray
    lines: FloatArray
    mounting: FloatArray | None


def marginals(graph: Graph, estimate: Estimate, weighting: Weighting) -> Marginals:
    """Invert the normal equations as far as poses and landmarks need it.

    Parameters
    ----------
    graph : Graph
        The measurements.
    estimate : Estimate
        Where their sum of squares is least.
    weighting : Weighting
        As it was minimised. Under a robust loss, rows' information is multiplied by their weights.

    Returns
    -------
    Marginals

    Raises
    ------
    SlamError
        If the measurements do not determine the unknowns.
    """
    layout = layout_of(graph, weighting)
    equations = normal_equations(linearise(graph, estimate, weighting))
    blocks = [
        (3, np.arange(0, layout.first_tilt, 3)),
        (2, np.arange(layout.first_disc, layout.first_line, 2)),
        (2, np.arange(layout.first_line, layout.size, 2)),
    ]
    try:
        found = inverse_blocks(equations.matrix, blocks)
        mounting = None
        if equations.corner.size:
            eliminated = factor(equations.matrix).solve(equations.border)
            mounting = np.linalg.inv(equations.corner - equations.border.T @ eliminated)
            for k, (width, first) in enumerate(blocks):
                by = eliminated[first[:, None] + np.arange(width)]
                found[k] = found[k] + by @ mounting @ np.swapaxes(by, 1, 2)
    except (RuntimeError, np.linalg.LinAlgError):
        raise SlamError(
            "covariances: the measurements do not determine all poses and landmarks"
        ) from None
    poses = np.concatenate([np.zeros((1, 3, 3)), found[0]])
    return Marginals(poses, found[1], found[2], mounting)


def inverse_blocks(
    matrix: sparse.csc_array, blocks: list[tuple[int, IntArray]]
) -> list[FloatArray]:
    """Diagonal blocks of the inverse of a sparse positive definite matrix.

    Parameters
    ----------
    matrix : (n, n) sparse
    blocks : list of (width, (b,) int64)
        Width and first index of blocks.

    Returns
    -------
    list of (b, width, width) float64
    """
    factored = factor(matrix)
    order = np.asarray(factored.perm_c, dtype=np.int64)
    if not np.array_equal(order, factored.perm_r):
        raise RuntimeError("the matrix is not positive definite")
    # Row i of the matrix is row order[i] of the factor's.
    entries = matrix.tocoo()
    # The requested entries must be in the pattern, even if the matrix is zero there.
    asked = [
        (first + i, first + j)
        for width, first in blocks
        for i in range(width)
        for j in range(width)
    ]
    row = order[np.concatenate([entries.row, *(i for i, _ in asked)])]
    column = order[np.concatenate([entries.col, *(j for _, j in asked)])]
    pattern = sparse.csc_array((np.ones(len(row)), (row, column)))
    indptr, indices = filled_pattern(
        pattern.indptr.astype(np.int64), pattern.indices.astype(np.int64)
    )
    columns = np.repeat(np.arange(len(order), dtype=np.int64), np.diff(indptr))
    keys = columns * len(order) + indices
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
