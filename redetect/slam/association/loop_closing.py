"""Closing the loops that were found: labels merged, and a path that starts where they say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from scipy.stats import chi2

from redetect.array_types import FloatArray, IntArray
from redetect.slam.association.loops import (
    SHARED_BY_ONE_PLACE,
    Match,
    Stretch,
    shared_landmarks,
    sightings,
)
from redetect.slam.models.motion import relative_pose, rotation

# Standard deviations of a step of the path and of a match of two stretches (rad, m).
_STEP_SIGMA = (0.005, 0.01)
_MATCH_SIGMA = (0.02, 0.05)
# Labels farther apart than this are not compared.
_FARTHEST_M = 0.35


def seen_together(frames: IntArray, labels: IntArray) -> set[tuple[int, int]]:
    """Pairs of labels that rows of one frame have: surely two landmarks, and never to be merged.

    Takes `frames, labels` (n,).
    """
    pairs: set[tuple[int, int]] = set()
    ends = np.flatnonzero(np.diff(frames)) + 1
    for group in np.split(labels, ends):
        here = np.unique(group).tolist()
        pairs.update((a, b) for n, a in enumerate(here) for b in here[n + 1 :])
    return pairs


def merge_labels(
    frames: IntArray, labels: IntArray, pairs: Iterable[tuple[int, int]]
) -> tuple[IntArray, int]:
    """Give labels that are one landmark the same number.

    Takes `frames, labels` (n,); returns `labels` (n,), `merged`.
    """
    count = int(labels.max(initial=-1)) + 1
    apart: list[set[int]] = [set() for _ in range(count)]
    for a, b in seen_together(frames, labels):
        apart[a].add(b)
        apart[b].add(a)
    root = list(range(count))

    def find(label: int) -> int:
        while root[label] != label:
            root[label] = root[root[label]]
            label = root[label]
        return label

    merged = 0
    for first, second in pairs:
        a, b = sorted((find(int(first)), find(int(second))))
        if a == b or b in apart[a]:
            continue
        root[b] = a
        apart[a] |= apart[b]
        for other in apart[b]:
            apart[other].add(a)
        merged += 1
    roots = np.array([find(label) for label in range(count)], dtype=np.int64)
    return in_order(roots[labels]), merged


def in_order(labels: IntArray) -> IntArray:
    """Number labels from 0 without gaps, in the order of their first rows; -1 stays.

    Takes `labels` (n,); returns (n,).
    """
    names, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    first[names < 0] = -1
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first)) - np.count_nonzero(names < 0)
    return rank[inverse]


def pairs_by_votes(matches: Sequence[Match]) -> list[tuple[int, int]]:
    """The pairs of labels of all matches, those that most matches agree on first."""
    votes: dict[tuple[int, int], int] = {}
    for match in matches:
        for a, b in match.pairs.tolist():
            key = (min(a, b), max(a, b))
            votes[key] = votes.get(key, 0) + 1
    return sorted(votes, key=lambda pair: (-votes[pair], pair))


def pairs_in_place(
    stretches: Sequence[Stretch], covariance: FloatArray, gate_probability: float
) -> list[tuple[int, int]]:
    """Pairs of labels that lie at the same position, in stretches known to be the same place.

    Takes `covariance` (M, 2, 2).
    """
    labels = np.unique(np.concatenate([np.zeros(0, np.int64), *(s.labels for s in stretches)]))
    if len(labels) < 2:
        return []
    xy = np.empty((int(labels[-1]) + 1, 2))
    for stretch in stretches:
        xy[stretch.labels] = stretch.xy
    near = KDTree(xy[labels]).query_pairs(_FARTHEST_M, output_type="ndarray")
    first, second = labels[near].T
    seen = csr_array(sightings(stretches), dtype=np.bool_)
    linked = csr_array(shared_landmarks(stretches) >= SHARED_BY_ONE_PLACE)
    one_place = np.asarray((linked @ seen[:, first]).multiply(seen[:, second]).sum(axis=0)) > 0
    apart = xy[first] - xy[second]
    both = covariance[first] + covariance[second]
    squared = np.sum(apart * np.linalg.solve(both, apart[..., None])[..., 0], axis=1)
    usable = np.flatnonzero(one_place & (squared <= chi2.ppf(gate_probability, 2)))
    ordered = usable[np.lexsort((second[usable], first[usable], squared[usable]))]
    return [(int(first[k]), int(second[k])) for k in ordered]


def closed_path(path: FloatArray, matches: Sequence[Match]) -> FloatArray:
    """A path that satisfies the matches: where least squares over everything may start from.

    Headings first, then places: each of the two problems is linear (L. Carlone, R. Aragues, J. A.
    Castellanos, B. Bona, "A fast and accurate approximation for planar pose graph optimization",
    International Journal of Robotics Research 33, 2014). So it does not matter how far off the path
    was.

    Takes `path` (N + 1, 3); returns (N + 1, 3).
    """
    count = len(path) - 1
    first = np.array([m.earlier_frame + 1 for m in matches], dtype=np.int64)
    second = np.array([m.later_frame + 1 for m in matches], dtype=np.int64)
    moved = path[second].copy()
    for k, match in enumerate(matches):
        moved[k, :2] = rotation(match.turn_rad) @ moved[k, :2] + match.shift
        moved[k, 2] += match.turn_rad
    before = np.concatenate([np.arange(count), first])
    after = np.concatenate([np.arange(1, count + 1), second])
    seen = relative_pose(
        np.concatenate([path[:-1], path[first]]), np.concatenate([path[1:], moved])
    )
    turns = np.concatenate([np.diff(path[:, 2]), moved[:, 2] - path[first, 2]])
    is_match = np.arange(len(before)) >= count
    weights = [1.0 / np.where(is_match, _MATCH_SIGMA[a], _STEP_SIGMA[a]) for a in (0, 1)]
    theta = path[0, 2] + _chained(before, after, turns[:, None], weights[0], count)[:, 0]
    offsets = np.einsum("nij,nj->ni", rotation(theta[before]), seen[:, :2])
    xy = path[0, :2] + _chained(before, after, offsets, weights[1], count)
    return np.concatenate([xy, theta[:, None]], axis=1)


def _chained(
    before: IntArray, after: IntArray, differences: FloatArray, weight: FloatArray, count: int
) -> FloatArray:
    """Values at nodes 0 (where they are 0) to count from weighted differences between nodes."""
    edges = np.arange(len(before))
    row = np.concatenate([edges, edges])
    column = np.concatenate([after, before]) - 1
    value = np.concatenate([weight, -weight])
    free = column >= 0
    matrix = csc_array((value[free], (row[free], column[free])), shape=(len(edges), count))
    solver = splu((matrix.T @ matrix).tocsc(), permc_spec="MMD_AT_PLUS_A")
    solved = solver.solve(np.asarray(matrix.T @ (differences * weight[:, None])))
    return np.concatenate([np.zeros((1, differences.shape[1])), solved])
