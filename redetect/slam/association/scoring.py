"""Scores of the labels found for a run's rows, against the identifiers in its file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from redetect.array_types import IntArray
from redetect.slam.association.run import RunAssociation
from redetect.slam.recording import UNKNOWN_ID, Recording


@dataclass(frozen=True)
class AssociationScore:
    """Scores of labels against the file's IDs; rows without ID are ignored."""

    rows: int  # number of rows scored
    unlabelled_rows: int  # of these, without a label: landmarks seen once, and no splits
    true_landmarks: int  # different IDs among them
    found_landmarks: int  # different labels among them
    pair_precision: float  # share of pairs of rows with one label that show one landmark
    pair_recall: float  # share of pairs of rows of one landmark with one label; 1 without pairs
    # Share of rows whose label is that of their landmark, where labels and landmarks are matched
    # one to one so that this share is largest. A row with several IDs may be any of them.
    right_rows: float
    wrong_merges: int  # sum over labels of the number of their landmarks besides the first
    splits: int  # sum over landmarks of the number of labels of their rows besides the first


#: Scores of each kind's rows, before and after the map level.
Scores = dict[str, dict[str, AssociationScore]]


def score_run(recording: Recording, found: RunAssociation) -> Scores:
    """Score the association with the file's own IDs: ``scores["circles"]["local"]`` and so on.

    Kinds are those with any ID in the file; stages ``local`` and, after the map level, ``map``.
    """
    discs = [(int(i),) if i != UNKNOWN_ID else () for i in recording.circles.ids]
    scores: Scores = {}
    for kind, ids, local, final in (
        ("circles", discs, found.local_circle_labels, found.circle_labels),
        ("lines", list(recording.lines.ids), found.local_line_labels, found.line_labels),
    ):
        if any(ids):
            scores[kind] = {"local": score_association(local, ids)}
            if found.path is not None:
                scores[kind]["map"] = score_association(final, ids)
    return scores


def score_association(labels: IntArray, ids: Sequence[tuple[int, ...]]) -> AssociationScore:
    """Score labels (n,).

    A row with several IDs counts as the one among them that most rows of its label have.
    """
    known = np.array([len(listed) > 0 for listed in ids], dtype=np.bool_)
    given = np.asarray(labels, dtype=np.int64)[known]
    unlabelled = given < 0
    given = np.where(unlabelled, given.max(initial=0) + 1 + np.arange(len(given)), given)
    found, label = np.unique(given, return_inverse=True)
    listed = [numbers for numbers in ids if numbers]
    votes = Counter((k, i) for k, numbers in zip(label.tolist(), listed) for i in set(numbers))
    chosen = [max(n, key=lambda i: (votes[k, i], -i)) for k, n in zip(label.tolist(), listed)]
    landmarks, landmark = np.unique(np.array(chosen, dtype=np.int64), return_inverse=True)
    table = np.zeros((len(found), len(landmarks)), dtype=np.int64)
    np.add.at(table, (label, landmark), 1)

    def pairs(counts: IntArray) -> int:
        return int(np.sum(counts * (counts - 1))) // 2

    same_label, same_landmark, both = map(pairs, (table.sum(axis=1), table.sum(axis=0), table))
    table[label[unlabelled]] = 0
    matched = linear_sum_assignment(table, maximize=True)
    rows = len(listed)
    return AssociationScore(
        rows=rows,
        unlabelled_rows=int(np.count_nonzero(unlabelled)),
        true_landmarks=len(landmarks),
        found_landmarks=len(found) - int(np.count_nonzero(unlabelled)),
        pair_precision=both / same_label if same_label else 1.0,
        pair_recall=both / same_landmark if same_landmark else 1.0,
        right_rows=float(table[matched].sum() / rows) if rows else 1.0,
        wrong_merges=int(np.sum(np.maximum(np.count_nonzero(table, axis=1) - 1, 0))),
        splits=int(np.sum(np.maximum(np.count_nonzero(table, axis=0) - 1, 0))),
    )
