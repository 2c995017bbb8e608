"""The least-squares core against SciPy, dense inverses, and finite differences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, sparse

from redetect.least_squares import LossKind
from redetect.least_squares.covariance import (
    filled_pattern,
    inverse_blocks,
    joint_marginal_covariance,
    marginal_covariances,
)
from redetect.least_squares.solver import (
    Block,
    Linear,
    Loss,
    minimise,
    normal_equations,
    robust,
    robust_cost,
    stack,
)

FloatArray = NDArray[np.float64]


class _Curves(NamedTuple):
    """Unknown: (V, 2) amplitudes and offsets of curves, and the (1,) decay that they share."""

    own: FloatArray
    decay: FloatArray


class _Decays:
    """Curves a exp(-k t) + b with a common k, seen with noise and some outliers."""

    def __init__(self, loss: Loss) -> None:
        rng = np.random.default_rng(5)
        self.curve = np.repeat(np.arange(6), 30)
        self.time = rng.uniform(0.0, 3.0, len(self.curve))
        true = np.column_stack([rng.uniform(1.0, 3.0, 6), rng.uniform(-1.0, 1.0, 6)])
        self.seen = self.predicted(_Curves(true, np.array([1.3])))
        self.seen += 0.02 * rng.standard_normal(len(self.seen))
        self.seen[::17] += 0.5
        self.loss = loss

    def predicted(self, at: _Curves) -> FloatArray:
        a, b = at.own[self.curve].T
        return np.asarray(a * np.exp(-at.decay[0] * self.time) + b)

    def error(self, at: _Curves) -> FloatArray:
        return np.asarray((self.predicted(at) - self.seen)[:, None] / 0.02)

    def cost(self, at: _Curves) -> float:
        return robust_cost([(self.error(at), self.loss)])

    def linear(self, at: _Curves) -> Linear:
        fall = np.exp(-at.decay[0] * self.time)
        by = np.stack([fall, np.ones_like(fall)], axis=-1)[:, None, :] / 0.02
        shared = (-at.own[self.curve, 0] * self.time * fall / 0.02)[:, None, None]
        block = Block(self.error(at), [(2 * self.curve, by)], shared, self.loss)
        return stack([block], 12, 1)

    def moved(self, at: _Curves, step: FloatArray, shared: FloatArray) -> _Curves:
        return _Curves(at.own + step.reshape(-1, 2), at.decay + shared)


_START = _Curves(np.ones((6, 2)), np.array([0.5]))


@pytest.mark.parametrize(
    ("kind", "name"), [("none", "linear"), ("huber", "huber"), ("cauchy", "cauchy")]
)
def test_minimum_is_that_of_scipy(kind: LossKind, name: str) -> None:
    problem = _Decays(Loss(kind, 2.0))
    found = minimise(problem, _START, tolerance=1e-14)
    assert found.converged
    assert all(b <= a for a, b in zip(found.costs, found.costs[1:]))

    def errors(x: FloatArray) -> FloatArray:
        return problem.error(_Curves(x[:12].reshape(-1, 2), x[12:])).ravel()

    start = np.append(_START.own.ravel(), _START.decay)
    theirs = optimize.least_squares(errors, start, loss=name, f_scale=2.0, xtol=1e-14, ftol=1e-14)
    ours = np.append(found.at.own.ravel(), found.at.decay)
    np.testing.assert_allclose(ours, theirs.x, atol=1e-5)
    assert found.costs[-1] == pytest.approx(2.0 * theirs.cost, rel=1e-8)


def test_covariances_are_those_of_the_dense_inverse() -> None:
    problem = _Decays(Loss())
    linear = problem.linear(minimise(problem, _START).at)
    whole = np.hstack([linear.jacobian.toarray(), linear.border])
    dense = np.linalg.inv(whole.T @ whole)
    equations = normal_equations(linear)
    (own,), shared = marginal_covariances(equations, [(2, np.arange(0, 12, 2))])
    np.testing.assert_allclose(shared, dense[12:, 12:], rtol=1e-8)
    np.testing.assert_allclose(own[2], dense[4:6, 4:6], rtol=1e-8)
    chosen = np.array([1, 4, 11])
    joint = joint_marginal_covariance(equations, chosen)
    np.testing.assert_allclose(joint, dense[np.ix_(chosen, chosen)], rtol=1e-8)


def test_unknowns_that_nothing_determines_are_an_error() -> None:
    problem = _Decays(Loss())
    problem.curve = np.where(problem.curve == 3, 2, problem.curve)
    with pytest.raises(np.linalg.LinAlgError):
        minimise(problem, _START)


def test_fixed_unknowns_have_no_column() -> None:
    by = np.ones((3, 1, 2))
    block = Block(np.ones((3, 1)), [(np.array([-2, 0, 0]), by)])
    linear = stack([block], 2, 0)
    np.testing.assert_array_equal(linear.jacobian.toarray(), [[0, 0], [1, 1], [1, 1]])


@pytest.mark.parametrize("kind", ["none", "huber", "cauchy", "geman-mcclure"])
def test_weight_of_a_loss_is_its_derivative(kind: LossKind) -> None:
    loss = Loss(kind, 2.0)
    squared = np.array([0.0, 0.5, 3.9, 4.1, 25.0, 1e4])
    h = 1e-6
    above, weight = robust(squared + h, loss)[0], robust(squared, loss)[1]
    np.testing.assert_allclose((above - robust(squared, loss)[0]) / h, weight, atol=1e-4)
    near, one = robust(np.array([1e-8]), loss)
    np.testing.assert_allclose((near[0], one[0]), (1e-8, 1.0), rtol=1e-6)


def test_filled_pattern_is_that_of_a_dense_factor() -> None:
    rng = np.random.default_rng(1)
    root = sparse.random_array((40, 40), density=0.04, rng=rng).toarray()
    matrix = root @ root.T + np.eye(40)
    columns = sparse.csc_array(matrix)
    entries = filled_pattern(columns.indptr.astype(np.int64), columns.indices.astype(np.int64))
    dense = np.abs(np.tril(np.linalg.cholesky(matrix), -1)) > 1e-14
    assert {40 * column + row for row, column in np.argwhere(dense).tolist()} <= set(entries)
    assert len(set(entries)) == len(entries)


def test_inverse_blocks_are_right_where_the_matrix_has_zeros() -> None:
    matrix = np.diag([4.0, 3.0, 5.0, 2.0])
    matrix[0, 3] = matrix[3, 0] = matrix[1, 3] = matrix[3, 1] = 1.0
    (found,) = inverse_blocks(sparse.csc_array(matrix), [(2, np.array([0, 2]))])
    dense = np.linalg.inv(matrix)
    np.testing.assert_allclose(found[0], dense[:2, :2], rtol=1e-12)
    np.testing.assert_allclose(found[1], dense[2:, 2:], rtol=1e-12)
    (alone,) = inverse_blocks(sparse.csc_array(np.diag([4.0, 2.0, 8.0])), [(3, np.array([0]))])
    np.testing.assert_allclose(alone[0], np.diag([0.25, 0.5, 0.125]))


def test_variances_around_a_long_loop_are_right() -> None:
    """Elimination leaves links across it, which in a numerical factor may underflow."""
    count, decay = 3000, 1e-3
    poses = np.arange(count)
    links = sparse.csc_array((np.ones(count), (poses, np.roll(poses, 1))), shape=(count, count))
    matrix = sparse.csc_array(2.0 * np.cosh(decay) * sparse.eye_array(count) - links - links.T)
    (found,) = inverse_blocks(matrix, [(1, poses)])
    # Of a circulant matrix.
    variance = 1.0 / (2.0 * np.sinh(decay) * np.tanh(0.5 * count * decay))
    np.testing.assert_allclose(found[:, 0, 0], variance, rtol=1e-8)
