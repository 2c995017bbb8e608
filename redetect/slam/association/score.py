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
    known = [k for k, listed in enumerate(ids) if listed]
    names = {name: k for k, name in enumerate(sorted({i for k in known for i in ids[k]}))}
    given = np.asarray(labels, dtype=np.int64)[known]
    unlabelled = given < 0
    given = np.where(unlabelled, given.max(initial=0) + 1 + np.arange(len(given)), given)
    _, label = np.unique(given, return_inverse=True)
    row = np.array([n for n, k in enumerate(known) for _ in ids[k]], dtype=np.int64)
    column = np.array([names[i] for k in known for i in ids[k]], dtype=np.int64)
    count = len(known)
    found = int(label.max()) + 1 if count else 0

    listed = csr_array((np.ones(len(row)), (row, column)), shape=(count, len(names)))
    labelled = csr_array((np.ones(count), (np.arange(count), label)), shape=(count, found))
    of_landmark, of_label, right = _pairs(ids, known, label, found)

    # What each row counts as: the ID of its own that most rows of its label have.
    votes = np.asarray((labelled.T @ listed).todense()).reshape(found, len(names))
    chosen = np.zeros(count, dtype=np.int64)
    for n, k in enumerate(known):
        own = sorted(names[i] for i in ids[k])
        chosen[n] = own[int(np.argmax(votes[label[n], own]))]
    cells = np.zeros((found, len(names)), dtype=np.int64)
    np.add.at(cells, (label[~unlabelled], chosen[~unlabelled]), 1)
    matched = linear_sum_assignment(cells, maximize=True)
    return AssociationScore(
        rows=count,
        unlabelled_rows=int(np.count_nonzero(unlabelled)),
        true_landmarks=len(set(chosen.tolist())),
        found_landmarks=found - int(np.count_nonzero(unlabelled)),
        pair_precision=right / of_label if of_label else 1.0,
        pair_recall=right / of_landmark if of_landmark else 1.0,
        right_rows=float(cells[matched].sum() / count) if count else 1.0,
        wrong_merges=int(np.sum(np.maximum(np.count_nonzero(cells, axis=1) - 1, 0))),
        splits=int(np.sum(np.maximum(np.count_nonzero(cells, axis=0) - 1, 0))),
    )


def _pairs(
    ids: Sequence[tuple[int, ...]], known: list[int], label: IntArray, found: int
) -> tuple[int, int, int]:
    """Pairs of rows that show one landmark, that have one label, and both.

    Rows with the same IDs are counted together: pairs of rows themselves are too many in long runs.
    """
    kinds: dict[frozenset[int], int] = {}
    kind = np.array(
        [kinds.setdefault(frozenset(ids[k]), len(kinds)) for k in known], dtype=np.int64
    )
    names = {name: k for k, name in enumerate(sorted({i for some in kinds for i in some}))}
    row = np.array([n for n, some in enumerate(kinds) for _ in some], dtype=np.int64)
    column = np.array([names[i] for some in kinds for i in some], dtype=np.int64)
    listed = csr_array(
        (np.ones(len(row), dtype=np.int64), (row, column)), shape=(len(kinds), len(names))
    )
    alike = ((listed @ listed.T) > 0).astype(np.int64)
    cells = csr_array(
        (np.ones(len(kind), dtype=np.int64), (kind, label)), shape=(len(kinds), found)
    )
    rows = np.bincount(kind, minlength=len(kinds))
    of_label = np.bincount(label, minlength=found)
    totals = rows @ (alike @ rows), of_label @ of_label, (alike @ cells).multiply(cells).sum()
    # Each pair was counted twice, and each row with itself.
    of_landmark, of_one_label, of_both = ((int(total) - len(known)) // 2 for total in totals)
    return of_landmark, of_one_label, of_both
