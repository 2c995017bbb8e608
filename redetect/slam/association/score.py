"""How well labels found for a run's rows agree with the IDs that the file has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array

from redetect.array_types import IntArray


@dataclass(frozen=True)
class AssociationScore:
    """Labels against the file's IDs; rows without ID are left out."""

    rows: int  # rows that were scored
    # Of these, rows without a label: they count as landmarks seen once, and as no splits.
    unlabelled_rows: int
    # Different IDs, and different labels, among them.
    true_landmarks: int
    found_landmarks: int
    # Of the pairs of rows with one label, the share that shows one landmark; 1 without pairs.
    pair_precision: float
    # Of the pairs of rows of one landmark, the share that has one label; 1 without pairs.
    pair_recall: float
    # Share of rows whose label is that of their landmark, where labels and landmarks are matched
    # one to one so that this share is largest. A row with several IDs may be any of them.
    right_rows: float
    # Labels in excess: for each label how many landmarks it has taken in besides its first.
    wrong_merges: int
    splits: int  # for each landmark how many labels its rows have besides the first


def score_association(labels: IntArray, ids: Sequence[tuple[int, ...]]) -> AssociationScore:
    """Score labels.

    Two rows show one landmark where they have an ID in common. For `wrong_merges` and `splits`, and
    for the one-to-one matching, a row with several IDs counts as the one among them that most rows
    of its label have.

    Takes `labels` (n,).
    """
    known = np.array([len(listed) > 0 for listed in ids], dtype=np.bool_)
    given = np.asarray(labels, dtype=np.int64)[known]
    unlabelled = given < 0
    given = np.where(unlabelled, given.max(initial=0) + 1 + np.arange(len(given)), given)
    found, label = np.unique(given, return_inverse=True)
    # Rows with the same IDs are counted together: pairs of rows are too many in long runs.
    sets = [frozenset(listed) for listed in ids if listed]
    kinds = {some: k for k, some in enumerate(dict.fromkeys(sets))}
    kind = np.array([kinds[some] for some in sets], dtype=np.int64)
    names = sorted(frozenset().union(*kinds))
    shows = np.array([[name in some for name in names] for some in kinds], dtype=np.int64)
    shows = shows.reshape(len(kinds), len(names))
    one = np.ones(len(sets), dtype=np.int64)
    cells = csr_array((one, (kind, label)), shape=(len(kinds), len(found)))

    alike = (csr_array(shows) @ csr_array(shows.T) > 0).astype(np.int64)
    rows, of_label = np.bincount(kind), np.bincount(label)
    totals = rows @ (alike @ rows), of_label @ of_label, (alike @ cells).multiply(cells).sum()
    # Each pair was counted twice, and each row with itself.
    same_landmark, same_label, both = ((int(total) - len(sets)) // 2 for total in totals)

    # A row counts as the one of its IDs that most rows of its label have.
    votes = cells.T @ shows
    counted = cells.tocoo()
    of_kind, of_found = counted.row, counted.col
    chosen = np.where(shows[of_kind] > 0, votes[of_found], -1).argmax(axis=1) if names else of_kind
    table = np.zeros((len(found), len(names)), dtype=np.int64)
    np.add.at(table, (of_found, chosen), counted.data)
    table[label[unlabelled]] = 0
    matched = linear_sum_assignment(table, maximize=True)
    return AssociationScore(
        rows=len(sets),
        unlabelled_rows=int(np.count_nonzero(unlabelled)),
        true_landmarks=len(np.unique(chosen)),
        found_landmarks=len(found) - int(np.count_nonzero(unlabelled)),
        pair_precision=both / same_label if same_label else 1.0,
        pair_recall=both / same_landmark if same_landmark else 1.0,
        right_rows=float(table[matched].sum() / len(sets)) if len(sets) else 1.0,
        wrong_merges=int(np.sum(np.maximum(np.count_nonzero(table, axis=1) - 1, 0))),
        splits=int(np.sum(np.maximum(np.count_nonzero(table, axis=0) - 1, 0))),
    )
