"""Scores of labels on cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.slam.association.scoring import score_association


def test_everything_right_whatever_the_labels_are_called() -> None:
    score = score_association(np.array([5, 5, 2, 2, 9]), [(1,), (1,), (2,), (2,), (3,)])
    assert (score.rows, score.true_landmarks, score.found_landmarks) == (5, 3, 3)
    assert (score.pair_precision, score.pair_recall, score.right_rows) == (1.0, 1.0, 1.0)
    assert (score.wrong_merges, score.splits) == (0, 0)


def test_a_split_costs_recall_and_a_merge_costs_precision() -> None:
    # Landmark 1 has labels 0, 0, 0, 1; landmark 2 has label 2 twice, landmark 3 joins it.
    labels = np.array([0, 0, 0, 1, 2, 2, 2])
    score = score_association(labels, [(1,), (1,), (1,), (1,), (2,), (2,), (3,)])
    # Pairs with one label: 3 + 0 + 3, of which 3 + 1 right; pairs of one landmark: 6 + 1 + 0.
    assert score.pair_precision == pytest.approx(4 / 6)
    assert score.pair_recall == pytest.approx(4 / 7)
    assert score.right_rows == pytest.approx(5 / 7)
    assert (score.wrong_merges, score.splits) == (1, 1)


def test_a_row_with_several_ids_is_right_with_any_of_them() -> None:
    score = score_association(np.array([0, 0, 1, 1, 0]), [(1,), (1, 2), (2,), (2, 1), (1,)])
    assert score.right_rows == 1.0
    assert (score.wrong_merges, score.splits) == (0, 0)
    # It counts as what its label's rows show: landmarks are rows 0, 1, 4 and rows 2, 3.
    assert (score.pair_precision, score.pair_recall) == (1.0, 1.0)


def test_rows_without_id_are_left_out() -> None:
    score = score_association(np.array([0, 0, 0]), [(1,), (), (1,)])
    assert score.rows == 2
    assert score.pair_precision == 1.0
    empty = score_association(np.array([0, 1]), [(), ()])
    assert (empty.rows, empty.right_rows, empty.found_landmarks) == (0, 1.0, 0)


def test_rows_without_label_cost_recall_alone() -> None:
    score = score_association(np.array([0, 0, -1, -1]), [(1,), (1,), (1,), (2,)])
    assert (score.rows, score.unlabelled_rows) == (4, 2)
    assert (score.true_landmarks, score.found_landmarks) == (2, 1)
    assert score.pair_precision == 1.0
    assert score.pair_recall == pytest.approx(1 / 3)
    assert (score.right_rows, score.wrong_merges, score.splits) == (0.5, 0, 0)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=14))
def test_pairs_are_counted_as_one_by_one(rows: list[tuple[int, int]]) -> None:
    labels = np.array([label for label, _ in rows], dtype=np.int64)
    score = score_association(labels, [(true,) for _, true in rows])
    pairs = [(a, b) for n, a in enumerate(rows) for b in rows[n + 1 :]]
    one_label = [a[0] == b[0] for a, b in pairs]
    one_landmark = [a[1] == b[1] for a, b in pairs]
    both = sum(x and y for x, y in zip(one_label, one_landmark))
    assert score.pair_precision == pytest.approx(both / sum(one_label) if any(one_label) else 1.0)
    assert score.pair_recall == pytest.approx(
        both / sum(one_landmark) if any(one_landmark) else 1.0
    )
    cells = set(rows)
    assert score.wrong_merges == len(cells) - len({label for label, _ in cells})
    assert score.splits == len(cells) - len({true for _, true in cells})


def test_a_run_of_a_hundred_thousand_rows_needs_no_pair_of_them() -> None:
    """One landmark in half of them: five billion pairs, which are counted, not listed."""
    ids = np.arange(100_000) % 2 * (np.arange(100_000) % 500)
    score = score_association(np.zeros(len(ids), dtype=np.int64), [(i,) for i in ids.tolist()])
    counts = np.bincount(ids)
    pairs = int(np.sum(counts * (counts - 1)))
    assert score.pair_precision == pairs / (len(ids) * (len(ids) - 1))
    assert score.pair_recall == 1.0
