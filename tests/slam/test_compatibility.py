"""Compatibility of rows and landmarks against all hypotheses written out, and its laws."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from redetect.array_types import FloatArray
from redetect.slam.association.compatibility import (
    chi_squared_gates,
    compatible,
)

Case = tuple[FloatArray, FloatArray, FloatArray]


def _covariances(rng: np.random.Generator, count: int, width: int, scale: float) -> FloatArray:
    root = rng.normal(0.0, scale, (count, width, width))
    return root @ root.swapaxes(1, 2) + 0.05 * scale**2 * np.eye(width)


def _case(seed: int, n: int, m: int, width: int) -> Case:
    """A small case with correlated predictions in which some rows show some landmarks."""
    rng = np.random.default_rng(seed)
    noise = _covariances(rng, n, width, 0.3)
    # All predictions share the error of one pose.
    shared = rng.normal(size=(m * width, 3))
    predicted = shared @ shared.T * 0.4 + 0.02 * np.eye(m * width)
    places = rng.uniform(-2.0, 2.0, (m, width))
    error = (np.linalg.cholesky(predicted) @ rng.normal(size=m * width)).reshape(m, width)
    shown = rng.permutation(max(n, m))[:n] % m if m else np.zeros(n, dtype=int)
    seen = rng.uniform(-2.0, 2.0, (n, width))
    for i in range(n if m else 0):
        if rng.random() < 0.7:
            seen[i] = places[shown[i]] + rng.multivariate_normal(np.zeros(width), noise[i])
    return seen[:, None] - (places + error)[None], predicted, noise


def _joint_distance(case: Case, partner: tuple[int, ...]) -> float:
    innovations, predicted, noise = case
    width = innovations.shape[2]
    rows = [i for i, j in enumerate(partner) if j >= 0]
    if not rows:
        return 0.0
    index = np.concatenate([partner[i] * width + np.arange(width) for i in rows])
    covariance = predicted[np.ix_(index, index)].copy()
    for k, i in enumerate(rows):
        block = slice(k * width, (k + 1) * width)
        covariance[block, block] += noise[i]
    innovation = np.concatenate([innovations[i, partner[i]] for i in rows])
    return float(innovation @ np.linalg.solve(covariance, innovation))


def _best_by_enumeration(case: Case, probability: float) -> tuple[int, float]:
    n, m, width = case[0].shape
    best = (0, 0.0)
    for partner in product(range(-1, m), repeat=n):
        pairs = [(i, j) for i, j in enumerate(partner) if j >= 0]
        if len({j for _, j in pairs}) < len(pairs):
            continue
        gate = chi2.ppf(probability, width)
        alone = [tuple(j if k == i else -1 for k in range(n)) for i, j in pairs]
        if any(_joint_distance(case, one) > gate for one in alone):
            continue
        distance = _joint_distance(case, partner)
        if distance > chi2.ppf(probability, width * max(len(pairs), 1)):
            continue
        if (len(pairs), -distance) > (best[0], -best[1]):
            best = (len(pairs), distance)
    return best


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 4),
    m=st.integers(0, 4),
    width=st.integers(1, 2),
    probability=st.sampled_from([0.5, 0.95, 0.999]),
)
def test_branch_and_bound_finds_what_trying_everything_finds(
    seed: int, n: int, m: int, width: int, probability: float
) -> None:
    case = _case(seed, n, m, width)
    found = compatible("joint", *case, probability)
    count, distance = _best_by_enumeration(case, probability)
    assert np.sum(found >= 0) == count
    assert _joint_distance(case, tuple(found)) == pytest.approx(distance, rel=1e-9, abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 6), m=st.integers(1, 6))
def test_order_of_rows_and_landmarks_does_not_matter_to_joint_compatibility(
    seed: int, n: int, m: int
) -> None:
    innovations, predicted, noise = _case(seed, n, m, 2)
    rng = np.random.default_rng(seed)
    rows, landmarks = rng.permutation(n), rng.permutation(m)
    index = (2 * landmarks[:, None] + np.arange(2)).reshape(-1)
    found = compatible("joint", innovations, predicted, noise)
    turned = (innovations[np.ix_(rows, landmarks)], predicted[np.ix_(index, index)], noise[rows])
    again = compatible("joint", *turned)
    assert np.sum(again >= 0) == np.sum(found >= 0)
    first = _joint_distance((innovations, predicted, noise), tuple(found))
    second = _joint_distance(turned, tuple(again))
    assert second == pytest.approx(first, rel=1e-6, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 6), m=st.integers(0, 6))
def test_nearest_pairs_are_gated_one_to_one_and_nothing_near_is_left(
    seed: int, n: int, m: int
) -> None:
    case = _case(seed, n, m, 2)
    gate = chi2.ppf(0.99, 2)
    found = compatible("nearest", *case, 0.99)
    paired = found[found >= 0]
    assert len(set(paired.tolist())) == len(paired)
    for i in range(n):
        for j in range(m):
            alone = tuple(j if k == i else -1 for k in range(n))
            distance = _joint_distance(case, alone)
            if found[i] == j:
                assert distance <= gate * (1 + 1e-9)
            elif distance < gate * (1 - 1e-9):  # then a nearer pair took one of the two
                rivals = [(i, found[i])] + [(k, j) for k in range(n) if found[k] == j]
                assert any(
                    landmark >= 0
                    and _joint_distance(case, tuple(landmark if q == k else -1 for q in range(n)))
                    <= distance
                    for k, landmark in rivals
                )


def test_joint_compatibility_sees_through_a_shift_that_misleads_the_nearest_neighbour() -> None:
    """Landmarks 1 m apart in a row, all rows shifted by 0.6 m: known pose error along the row."""
    places = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.4, 0.0]])
    seen = places + np.array([0.6, 0.0])
    innovations = seen[:, None] - places[None]
    shift = np.tile([1.0, 0.0], 4)
    predicted = 0.5**2 * np.outer(shift, shift) + 1e-6 * np.eye(8)
    noise = np.tile(0.02**2 * np.eye(2), (4, 1, 1))
    assert compatible("joint", innovations, predicted, noise).tolist() == [0, 1, 2, 3]
    assert compatible("nearest", innovations, predicted, noise).tolist() != [0, 1, 2, 3]


def test_what_bounded_work_finds_is_compatible() -> None:
    rng = np.random.default_rng(3)
    innovations = rng.normal(0.0, 0.1, (9, 9, 2))
    predicted, noise = 0.5 * np.eye(18), np.tile(np.eye(2), (9, 1, 1))
    cut = compatible("joint", innovations, predicted, noise, most_nodes=20)
    assert 0 < np.sum(cut >= 0) <= 9
    pairs = np.sum(cut >= 0)
    distance = _joint_distance((innovations, predicted, noise), tuple(cut))
    assert distance <= chi2.ppf(0.999, 2 * pairs)


def test_gates_are_quantiles_and_right_sets_pass_with_their_probability() -> None:
    assert chi_squared_gates(0.95, 2, 3) == pytest.approx([0.0, *chi2.ppf(0.95, [2, 4, 6])])
    rng = np.random.default_rng(1)
    case = _case(5, 3, 3, 2)
    covariance = case[1] + np.kron(np.eye(3), np.zeros((2, 2)))
    for i in range(3):
        covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += case[2][i]
    errors = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)
    passed = np.mean(squared <= chi_squared_gates(0.9, 2, 3)[3])
    assert passed == pytest.approx(0.9, abs=4 * np.sqrt(0.09 / 4000))


def test_a_pair_without_positive_definite_covariance_is_never_made() -> None:
    innovations = np.zeros((1, 2, 2))
    predicted = np.diag([-1.0, 1.0, 1.0, 1.0])
    noise = np.zeros((1, 2, 2))
    assert compatible("joint", innovations, predicted, noise).tolist() == [1]
    assert compatible("nearest", innovations, predicted, noise).tolist() == [1]
