"""Levenberg-Marquardt on sparse normal equations.

A residual depends on a few of many unknowns (poses, landmarks), and possibly on some that are
shared by all residuals (a camera's mounting or lens). The latter would fill the sparse matrix: they
are separated as a border, and solved for by the Schur complement of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from redetect.array_types import FloatArray, IntArray
from redetect.least_squares import LossKind

X = TypeVar("X")

_LEAST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e10


class StartError(ValueError):
    """A start at which the cost is not defined."""


class Loss(NamedTuple):
    """Cost of a residual: its square, or less beyond `scale` standard deviations."""

    kind: LossKind = "none"
    scale: float = 1.0


class Block(NamedTuple):
    """Whitened residuals of one kind, with their derivatives."""

    error: FloatArray  # (n, d): each row is one residual for the loss
    # ((n,), (n, d, k)): index of the first of k unknowns (below 0: none), and derivatives with
    # respect to them.
    jacobians: Sequence[tuple[IntArray, FloatArray]]
    shared: FloatArray | None = (
        None  # (n, d, s): derivatives with respect to shared unknowns; None: 0
    )
    loss: Loss = Loss()


class Linear(NamedTuple):
    """A linear problem: minimise ``|J x + B m + r|`` over changes x and m, m of shared unknowns."""

    residual: FloatArray  # (R,)
    jacobian: sparse.csr_array  # (R, K)
    border: FloatArray  # (R, s)


class Problem(Protocol[X]):
    """A function to minimise, of unknowns of any type."""

    def cost(self, at: X) -> float:
        """The sum to minimise; infinite if it is not defined."""

    def linear(self, at: X) -> Linear:
        """The problem, linearised at an estimate."""

    def moved(self, at: X, step: FloatArray, shared: FloatArray) -> X:
        """The estimate after a step of the (K,) unknowns and of the (s,) shared ones."""


@dataclass(frozen=True, eq=False)
class Minimum(Generic[X]):
    """Result of a minimisation: the estimate, and the costs at the start and after each step."""

    at: X
    costs: tuple[float, ...]
    converged: bool  # False if the number of steps was exhausted


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """J^T J and J^T r, with the shared unknowns separate."""

    matrix: sparse.csc_array  # (K, K)
    gradient: FloatArray  # (K,)
    border: FloatArray  # (K, s), between shared and other unknowns
    corner: FloatArray  # (s, s)
    corner_gradient: FloatArray  # (s,)
    considered: FloatArray | None = None  # (s, s): covariance of shared ones, not estimated

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of both kinds of unknowns, with the diagonal scaled by 1 + damping (Marquardt).

        Raises `numpy.linalg.LinAlgError` if the residuals do not determine the unknowns.
        """
        factored = factor(self.matrix, damping)
        step = -factored.solve(self.gradient)
        if self.corner.size == 0:
            return step, np.zeros(0)
        eliminated = factored.solve(self.border)
        corner = self.corner + damping * np.diag(np.diag(self.corner))
        inverse = scaled_inverse(corner - self.border.T @ eliminated)
        shared = inverse @ (-self.corner_gradient - self.border.T @ step)
        return step - eliminated @ shared, shared


def whitening(covariance: FloatArray) -> FloatArray:
    """(..., d, d) lower triangular W with ``W C W^T = I``, for positive definite covariances C."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def robust(squared: FloatArray, loss: Loss) -> tuple[FloatArray, FloatArray]:
    """Costs of (n,) squared residuals, and their weights.

    A weight is the derivative of the cost with respect to the squared residual. Huber's, Cauchy's
    (Lorentzian) and Geman and McClure's losses are quadratic near 0.
    """
    c2 = loss.scale**2
    if loss.kind == "huber":
        far = squared > c2
        root = np.sqrt(np.where(far, squared, c2))
        cost = np.where(far, 2.0 * loss.scale * root - c2, squared)
        return cost, np.where(far, loss.scale / root, 1.0)
    if loss.kind == "cauchy":
        return c2 * np.log1p(squared / c2), 1.0 / (1.0 + squared / c2)
    if loss.kind == "geman-mcclure":
        return squared * c2 / (c2 + squared), (c2 / (c2 + squared)) ** 2
    return squared, np.ones_like(squared)


def robust_cost(errors: Iterable[tuple[FloatArray, Loss]]) -> float:
    """Sum of the costs of (n, d) whitened residuals; infinite if one is not finite."""
    parts = [np.sum(robust(np.sum(error**2, axis=1), loss)[0]) for error, loss in errors]
    total = float(np.sum(parts))
    return total if np.isfinite(total) else float("inf")


def stack(blocks: Sequence[Block], unknowns: int, shared: int) -> Linear:
    """The linear problem of blocks, with robust losses as weights (iteratively reweighted)."""
    residuals, border, values, rows, columns = [], [], [], [], []
    first_row = 0
    for block in blocks:
        n, d = block.error.shape
        root = np.sqrt(robust(np.sum(block.error**2, axis=1), block.loss)[1])[:, None, None]
        residuals.append((block.error * root[:, :, 0]).ravel())
        by_shared = np.zeros((n, d, shared)) if block.shared is None else root * block.shared
        border.append(by_shared.reshape(n * d, shared))
        row = first_row + np.arange(n * d, dtype=np.int64).reshape(n, d, 1)
        for first, jacobian in block.jacobians:
            free = slice(None) if np.all(first >= 0) else first >= 0
            some = jacobian[free] * root[free]
            column = first[free, None, None] + np.arange(jacobian.shape[2], dtype=np.int64)
            values.append(some.ravel())
            rows.append(np.broadcast_to(row[free], some.shape).ravel())
            columns.append(np.broadcast_to(column, some.shape).ravel())
        first_row += n * d
    places = (np.concatenate(rows), np.concatenate(columns))
    return Linear(
        residual=np.concatenate(residuals),
        jacobian=sparse.csr_array((np.concatenate(values), places), shape=(first_row, unknowns)),
        border=np.concatenate(border),
    )


def normal_equations(problem: Linear) -> NormalEquations:
    """Normal equations of a linear problem."""
    transposed = problem.jacobian.T
    return NormalEquations(
        matrix=(transposed @ problem.jacobian).tocsc(),
        gradient=np.asarray(transposed @ problem.residual),
        border=np.asarray(transposed @ problem.border),
        corner=problem.border.T @ problem.border,
        corner_gradient=problem.border.T @ problem.residual,
    )


def factor(matrix: sparse.csc_array, damping: float = 0.0) -> SuperLU:
    """Factorise a positive definite matrix, with its diagonal scaled by 1 + damping.

    Raises `numpy.linalg.LinAlgError` if it is singular.
    """
    if damping > 0.0:
        matrix = matrix.copy()
        column = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
        matrix.data[matrix.indices == column] *= 1.0 + damping
    options = {"SymmetricMode": True}
    try:
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError as error:
        raise np.linalg.LinAlgError(str(error)) from None


def scaled_inverse(matrix: FloatArray) -> FloatArray:
    """Pseudo-inverse of a positive semidefinite matrix with unknowns of very different scale."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    both = np.outer(scale, scale)
    return np.asarray(np.linalg.pinv(matrix / both, 1e-14, hermitian=True) / both)


def minimise(
    problem: Problem[X],
    start: X,
    *,
    tolerance: float = 1e-10,
    most_steps: int = 200,
    damping: float = 1e-6,
    refined: Callable[[X, float], tuple[X, float]] | None = None,
) -> Minimum[X]:
    """Minimise by Levenberg and Marquardt's method.

    Ends if a step lowers the cost by less than the share `tolerance` of it. `damping` is the first
    one, as a share of the diagonal; `refined` improves each trial before it is judged, and takes
    and returns the trial and its cost. Raises `StartError` if the cost is not finite at the start,
    `numpy.linalg.LinAlgError` if the residuals do not determine the unknowns.
    """
    at, lowest = start, problem.cost(start)
    if not np.isfinite(lowest):
        raise StartError("the cost is not finite at the start")
    costs = [lowest]
    for _ in range(most_steps):
        before = lowest
        equations = normal_equations(problem.linear(at))
        while damping < _LARGEST_DAMPING:
            try:
                trial = problem.moved(at, *equations.step(damping))
            except np.linalg.LinAlgError:
                damping *= 10.0
                if damping >= _LARGEST_DAMPING:
                    raise
                continue
            cost = problem.cost(trial)
            if refined is not None and np.isfinite(cost):
                trial, cost = refined(trial, cost)
            if cost < before:
                at, lowest = trial, cost
                damping = max(damping / 10.0, _LEAST_DAMPING)
                break
            damping *= 10.0
        costs.append(lowest)
        if before - lowest <= tolerance * lowest:
            return Minimum(at, tuple(costs), converged=True)
    return Minimum(at, tuple(costs), converged=False)
