"""Results against references: paths and maps of the same run, and labels found for its rows."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from redetect.array_types import IntArray
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.landmarks.map_file import LandmarkMap, Path2D
from redetect.slam.association.run import RunAssociation
from redetect.slam.errors import SlamError
from redetect.slam.recording import UNKNOWN_ID, Recording


def path_distance(path: Path2D, reference: ArrayLike, name: str = "") -> dict[str, float]:
    """Distance of a path from another one of the same run in the same map, `reference` (N, 3).

    Rms, median and largest distance of positions (m) and headings (rad), and those of the last
    pose. Raises `SlamError`, beginning with `name`, if their numbers of poses differ.
    """
    other = np.asarray(reference, dtype=np.float64)
    if len(other) != len(path.poses):
        raise SlamError(f"{name}{len(other)} poses: expected {len(path.poses)}, as in this run")
    position = np.hypot(*(path.poses[:, :2] - other[:, :2]).T)
    heading = np.abs(wrap_angle(path.poses[:, 2] - other[:, 2]))
    return {
        f"{name}_{figure}_{unit}": float(value)
        for name, unit, distance in (("position", "m", position), ("heading", "rad", heading))
        for figure, value in (
            ("rms", math.sqrt(float(np.mean(distance**2)))),
            ("median", np.median(distance)),
            ("max", np.max(distance)),
            ("last", distance[-1]),
        )
    }


def map_distance(landmark_map: LandmarkMap, reference: LandmarkMap) -> dict[str, float]:
    """Distance of landmarks from those of another map with the same identifiers."""
    offsets, covariances = [], []
    kinds = (landmark_map.discs, reference.discs), (landmark_map.lines, reference.lines)
    for some, others in kinds:
        _, own, other = np.intersect1d(some.ids, others.ids, return_indices=True)
        offsets.append(some.xy[own] - others.xy[other])
        covariances.append(some.covariance[own])
    offset, covariance = np.concatenate(offsets), np.concatenate(covariances)
    if not len(offset):
        raise SlamError("no landmark is in both maps: expected some of the same identifiers")
    distance = np.hypot(*offset.T)
    return {
        "landmarks": float(len(distance)),
        "rms_m": math.sqrt(float(np.mean(distance**2))),
        "median_m": float(np.median(distance)),
        "max_m": float(np.max(distance)),
        "normalised": float(np.mean(squared_mahalanobis(offset, covariance))) / 2.0,
    }


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
