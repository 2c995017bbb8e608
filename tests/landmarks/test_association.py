"""Association: gate, one to one, optimal, whatever the order."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.array_types import BoolArray, FloatArray
from redetect.landmarks import (
    Association,
    associate,
    associate_positions,
    squared_mahalanobis,
    wrap_angle,
)


@st.composite
def problems(draw: st.DrawFn) -> tuple[FloatArray, BoolArray]:
    """Costs and gates of up to 5 x 5 rows, ties and wide ranges among them."""
    shape = draw(st.integers(0, 5)), draw(st.integers(0, 5))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    kind = draw(st.sampled_from(["plain", "ties", "wide"]))
    costs = {
        "plain": rng.uniform(0, 1, shape),
        "ties": rng.integers(0, 3, shape).astype(float),
        "wide": 10.0 ** rng.uniform(-9, 9, shape),
    }[kind]
    allowed = rng.uniform(size=shape) < draw(st.sampled_from([0.0, 0.2, 0.5, 0.8, 1.0]))
    return costs, allowed


def best_by_trying_all(costs: FloatArray, allowed: BoolArray) -> tuple[int, float]:
    """Largest number of pairs, and the least total cost that many can have."""
    n_first, n_second = costs.shape
    for count in range(min(n_first, n_second), 0, -1):
        totals = [
            sum(costs[i, j] for i, j in zip(rows, columns))
            for rows in itertools.combinations(range(n_first), count)
            for columns in itertools.permutations(range(n_second), count)
            if all(allowed[i, j] for i, j in zip(rows, columns))
        ]
        if totals:
            return count, min(totals)
    return 0, 0.0


def total(found: Association, costs: FloatArray) -> float:
    return float(costs[found.first, found.second].sum())


@given(problems())
def test_pairs_are_allowed_one_to_one_and_nothing_is_lost(
    problem: tuple[FloatArray, BoolArray],
) -> None:
    costs, allowed = problem
    found = associate(costs, allowed)
    assert allowed[found.first, found.second].all()
    assert sorted([*found.first, *found.first_unmatched]) == list(range(costs.shape[0]))
    assert sorted([*found.second, *found.second_unmatched]) == list(range(costs.shape[1]))
    assert (np.diff(found.first) > 0).all()


@given(problems())
def test_no_association_has_more_pairs_or_less_cost(
    problem: tuple[FloatArray, BoolArray],
) -> None:
    costs, allowed = problem
    found = associate(costs, allowed)
    count, least = best_by_trying_all(costs, allowed)
    assert len(found.first) == count
    # Rounding is that of the largest cost, where costs differ by 18 orders of magnitude.
    assert total(found, costs) == pytest.approx(least, rel=1e-9, abs=1e-12 * costs.max(initial=0))


@given(problems(), st.integers(0, 2**32 - 1))
def test_the_order_of_the_rows_does_not_matter(
    problem: tuple[FloatArray, BoolArray], seed: int
) -> None:
    costs, allowed = problem
    rng = np.random.default_rng(seed)
    rows, columns = rng.permutation(costs.shape[0]), rng.permutation(costs.shape[1])
    found = associate(costs, allowed)
    shuffled = associate(costs[np.ix_(rows, columns)], allowed[np.ix_(rows, columns)])
    pairs = set(zip(found.first.tolist(), found.second.tolist()))
    pairs_again = set(zip(rows[shuffled.first].tolist(), columns[shuffled.second].tolist()))
    turned = associate(costs.T, allowed.T)
    pairs_turned = set(zip(turned.second.tolist(), turned.first.tolist()))
    assert len(pairs) == len(pairs_again) == len(pairs_turned)
    # With ties, or differences lost in rounding, several solutions may be equally good.
    if len(np.unique(costs)) == costs.size and costs.max(initial=0) <= 1:
        assert pairs == pairs_again == pairs_turned


def test_more_pairs_come_before_less_cost() -> None:
    costs = [[0.0, 100.0], [100.0, 7.0]]
    found = associate(costs, [[True, True], [True, False]])
    assert list(zip(found.first, found.second)) == [(0, 1), (1, 0)]


def test_rows_that_compete_for_too_few_partners_stay_alone() -> None:
    # Rows 0 and 1 want only column 0, and only row 2 wants columns 1 and 2: two pairs, not three.
    allowed = [[True, False, False], [True, False, False], [True, True, True]]
    found = associate([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 4.0, 3.0]], allowed)
    assert list(zip(found.first, found.second)) == [(1, 0), (2, 2)]
    assert (found.first_unmatched.tolist(), found.second_unmatched.tolist()) == ([0], [1])


def test_forbidden_costs_are_not_looked_at() -> None:
    found = associate([[np.nan, 1.0], [-5.0, np.inf]], [[False, True], [False, False]])
    assert list(zip(found.first, found.second)) == [(0, 1)]


@pytest.mark.parametrize("cost", [np.nan, np.inf, -1.0])
def test_impossible_costs_are_refused(cost: float) -> None:
    with pytest.raises(ValueError, match="negative or not finite"):
        associate([[cost]], [[True]])


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"costs \(1, 2\), allowed \(2, 1\)"):
        associate([[1.0, 2.0]], [[True], [True]])


def test_positions_pair_within_the_gate_and_not_beyond() -> None:
    found = associate_positions([[0, 0], [1, 0], [5, 5]], [[1, 0.25], [0, -0.25]], gate_m=0.25)
    assert list(zip(found.first, found.second)) == [(0, 1), (1, 0)]
    assert found.first_unmatched.tolist() == [2]
    assert len(associate_positions([[0, 0]], [[0, 0.26]], gate_m=0.25).first) == 0


def test_distances_past_the_largest_number_are_beyond_any_gate() -> None:
    far, near = [[1e308, 0.0], [1.0, 0.0]], [[-1e308, 0.0], [1.0, 0.0]]
    found = associate_positions(far, near, gate_m=1.0)
    assert list(zip(found.first, found.second)) == [(1, 1)]


def test_crowded_positions_give_way_to_each_other() -> None:
    # The nearest pair (0.1 apart) must not be taken: it would leave two rows alone.
    found = associate_positions([[0.0, 0.0], [0.3, 0.0]], [[0.2, 0.0], [0.55, 0.0]], gate_m=0.3)
    assert list(zip(found.first, found.second)) == [(0, 0), (1, 1)]


@pytest.mark.parametrize(("first", "second"), [(0, 0), (0, 3), (3, 0)])
def test_empty_sets_leave_the_other_alone(first: int, second: int) -> None:
    found = associate_positions(np.zeros((first, 2)), np.zeros((second, 2)), gate_m=1.0)
    assert len(found.first) == len(found.second) == 0
    assert (len(found.first_unmatched), len(found.second_unmatched)) == (first, second)


def test_mahalanobis_distance_is_that_of_whitened_differences() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(20, 2, 2))
    whitened = rng.normal(size=(20, 2))
    offset = np.einsum("nij,nj->ni", root, whitened)
    covariance = root @ root.transpose(0, 2, 1)
    np.testing.assert_allclose(
        squared_mahalanobis(offset, covariance), (whitened**2).sum(axis=1), rtol=1e-6
    )


def test_angles_wrap_to_half_a_turn() -> None:
    np.testing.assert_allclose(
        wrap_angle([0, np.pi, -np.pi, 3.5 * np.pi]), [0, -np.pi, -np.pi, -0.5 * np.pi]
    )
