"""Closes loops: merges labels, and solves for the resulting path and landmarks.

The least-squares problem is that of `slam map` with the labels as identifiers, under Huber's loss,
so that rows that contradict all others count less.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.special import chdtri

from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import squared_mahalanobis, wrap_angle
from redetect.least_squares.solver import Block, normal_equations, stack
from redetect.plane import apply, between, compose, invert, log_motion, rotation
from redetect.slam.association.loops import (
    SHARED_BY_ONE_PLACE,
    SUBMAP_FRAMES,
    SYSTEMATIC_SIGMAS,
    Match,
    Submap,
    shared_landmarks,
    sightings,
)
from redetect.slam.mapping.graph import Estimate, graph_of_recording, triangulate, with_lines
from redetect.slam.mapping.graph_terms import Weighting
from redetect.slam.mapping.solve import solve
from redetect.slam.recording import Recording

#: Share of the labels of one landmark that are compatible by position.
SAME_PLACE = 0.999
# Standard deviations of a step of the path and of a match of two submaps (rad, m).
_STEP_SIGMA = (0.005, 0.01)
_MATCH_SIGMA = (0.02, 0.05)
# Largest squared error of a loop with random errors of odometry.
_MOST_SQUARED = float(chdtri(3, 1e-6))
# Weight of a lost step: just enough to keep the equations solvable.
_LOST_WEIGHT = 1e-3
# Tolerance of least squares.
_TOLERANCE = 1e-4
# Poses of one place turned by less than this see the same discs (rad).
_ONE_VIEW_RAD = 0.4
# Labels farther apart than this are not compared.
_FARTHEST_M = 0.35


class LabelledMap(NamedTuple):
    """Path and landmarks."""

    path: FloatArray  # (N + 1, 3): start and pose after each step; theta is not wrapped
    circle_xy: FloatArray  # (M, 2), by label (m)
    line_xy: FloatArray  # (L, 2), by label (m); NaN if unknown
    cost: float  # of all errors, by the robust loss


def intersect_bearings(
    recording: Recording, path: FloatArray, labels: IntArray, *, camera_xy: ArrayLike = (0.0, 0.0)
) -> FloatArray:
    """(L, 2) positions of lines from the bearings of all rows with `labels` (n,), given the `path`
    (N + 1, 3) and `camera_xy` (2,).
    """
    lines, count = recording.lines, int(labels.max(initial=-1)) + 1
    poses = path[lines.frame + 1]
    met = triangulate(poses, lines.bearing_rad, lines.sigma_rad, labels, count, camera_xy)
    behind = np.bincount(labels, met.ahead_m < 0.0, minlength=count) > 0
    return np.where(behind[:, None], np.nan, met.xy)


def solve_path(
    recording: Recording,
    circle_labels: IntArray,
    line_labels: IntArray,
    path: FloatArray,
    line_xy: ArrayLike = (),
    *,
    camera_xy: ArrayLike = (0.0, 0.0),
    sigma_scale: float = 1.0,
) -> LabelledMap:
    """Least squares over all poses and landmarks, from a path (N + 1, 3) on.

    Labels count from 0 without gaps. Lines have their initial positions `line_xy` (L, 2) as priors;
    rows of lines without one, or with NaN, are ignored. `sigma_scale` is a factor on the discs'
    standard deviations.
    """
    circles, lines = recording.circles, recording.lines
    places = np.array(line_xy, dtype=np.float64).reshape(-1, 2)
    known = np.isfinite(places[:, 0])
    labelled = replace(
        recording,
        circles=replace(circles, ids=circle_labels, covariance=sigma_scale**2 * circles.covariance),
        lines=replace(lines, ids=tuple((int(k),) for k in line_labels)),
    )
    graph = with_lines(graph_of_recording(labelled), labelled.lines, np.flatnonzero(known))
    graph = replace(graph, camera_xy=np.asarray(camera_xy, np.float64), line_prior=places[known])
    seen = apply(path[graph.disc_pose], graph.disc_xy)
    totals = [np.bincount(graph.disc_index, seen[:, a], len(graph.disc_ids)) for a in (0, 1)]
    disc_xy = np.stack(totals, axis=-1) / graph.disc_row_counts[:, None]
    start = Estimate(path, disc_xy, places[known])
    minimum = solve(graph, start, Weighting(loss="huber"), tolerance=_TOLERANCE)
    found = minimum.at
    places[known] = found.line_xy
    return LabelledMap(found.poses, found.disc_xy, places, minimum.costs[-1])


def merge_labels(
    frames: IntArray, labels: IntArray, pairs: Iterable[tuple[int, int]], most_together: float = 0.0
) -> tuple[IntArray, int]:
    """Merge labels (n,) that are the same landmark; returns them (n,), and how many were merged.

    Labels with rows in the same `frames` (n,) are distinct landmarks, unless these are at most a
    share `most_together` of those of either: clutter beside a landmark, of one label with it.
    """
    seen: list[set[int]] = [set() for _ in range(int(labels.max(initial=-1)) + 1)]
    for frame, label in zip(frames.tolist(), labels.tolist()):
        seen[label].add(frame)
    same = DisjointSet(range(len(seen)))
    for first, second in pairs:
        a, b = same[int(first)], same[int(second)]
        together = len(seen[a] & seen[b])
        if a == b or together > most_together * min(len(seen[a]), len(seen[b])):
            continue
        same.merge(a, b)
        seen[same[a]] = seen[a] | seen[b]
    roots = np.array([same[label] for label in range(len(seen))], dtype=np.int64)
    return in_order(roots[labels]), len(seen) - same.n_subsets


def in_order(labels: IntArray) -> IntArray:
    """Renumber labels (n,) from 0 without gaps, in the order of their first rows; -1 stays."""
    names, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    first[names < 0] = -1
    rank = np.argsort(np.argsort(first)) - np.count_nonzero(names < 0)
    return rank[inverse]


def pairs_by_votes(matches: Iterable[IntArray]) -> list[tuple[int, int]]:
    """The pairs of labels (k, 2) of all matches, by decreasing number of matches."""
    votes = Counter((min(a, b), max(a, b)) for pairs in matches for a, b in pairs.tolist())
    return sorted(votes, key=lambda pair: (-votes[pair], pair))


def pairs_by_position(submaps: Sequence[Submap], covariance: FloatArray) -> list[tuple[int, int]]:
    """Pairs of labels at the same position, with some `covariance` (M, 2, 2), in submaps known to
    be the same place.
    """
    labels = np.unique(np.concatenate([np.zeros(0, np.int64), *(s.labels for s in submaps)]))
    if len(labels) < 2:
        return []
    xy = np.empty((int(labels[-1]) + 1, 2))
    for submap in submaps:
        xy[submap.labels] = submap.xy
    near = KDTree(xy[labels]).query_pairs(_FARTHEST_M, output_type="ndarray")
    first, second = labels[near].T
    seen = csr_array(sightings(submaps), dtype=np.bool_)
    linked = csr_array(shared_landmarks(submaps) >= SHARED_BY_ONE_PLACE)
    one_place = np.asarray((linked @ seen[:, first]).multiply(seen[:, second]).sum(axis=0)) > 0
    squared = squared_mahalanobis(xy[first] - xy[second], covariance[first] + covariance[second])
    usable = np.flatnonzero(one_place & (squared <= chdtri(2, 1.0 - SAME_PLACE)))
    ordered = usable[np.lexsort((second[usable], first[usable], squared[usable]))]
    return [(int(first[k]), int(second[k])) for k in ordered]


def consistent_matches(
    matches: Sequence[Match], closed: Sequence[Match], path: FloatArray, step_covariance: FloatArray
) -> list[Match]:
    """Matches that neither odometry nor other matches contradict, since places may look alike.

    Two loops form a third one: from the earlier frame of one to that of the other, across, and back
    along the later ones. It has to close as well as the odometry along it allows (J. G. Mangelson,
    D. Dominic, R. M. Eustice, R. Vasudevan, "Pairwise consistent measurement set maximization for
    robust multi-robot map merging", ICRA 2018), and so has each single loop. Matches are accepted
    in the order of their agreement with odometry, each if it is consistent with all accepted ones.

    Odometry may have systematic errors: two standard deviations in each step, in one direction.

    Takes new matches and those already `closed` in the path, `path` (N + 1, 3), `step_covariance`
    (N, 3, 3).
    """
    until = _accumulated(path, step_covariance)
    across = np.diag(np.square([_MATCH_SIGMA[1], _MATCH_SIGMA[1], _MATCH_SIGMA[0]]))

    both = [*closed, *matches]
    frames = np.array([(m.earlier_frame, m.later_frame) for m in both], dtype=np.int64)
    motion = np.array([m.motion for m in both])
    motion[: len(closed)] = 0.0

    def excess(k: int, other_frames: IntArray, other_motion: FloatArray) -> FloatArray:
        """Excess of the squared errors of the loops of match k with others over the bound."""
        low, high = np.minimum(frames[k], other_frames), np.maximum(frames[k], other_frames)
        # The loop begins and ends with the later frame.
        there = _about(path[frames[k, 1] + 1])
        spread = there @ (until[high] - until[low]).sum(axis=1) @ there.T + 2.0 * across
        gap = log_motion(compose(invert(other_motion), motion[k])) @ there.T
        systematic = SYSTEMATIC_SIGMAS**2 * (high - low).sum(axis=1)
        return np.asarray(squared_mahalanobis(gap, spread) - systematic - _MOST_SQUARED)

    # A single match forms a loop with the trivial one of its earlier frame with itself.
    alone = {
        k: excess(k, frames[[k]][:, [0, 0]], np.zeros((1, 3)))[0]
        for k in range(len(closed), len(both))
    }
    taken = np.arange(len(both)) < len(closed)
    for k in sorted(alone, key=alone.__getitem__):
        taken[k] = alone[k] <= 0.0 and np.all(excess(k, frames[taken], motion[taken]) <= 0.0)
    return [match for match, right in zip(matches, taken[len(closed) :]) if right]


def _accumulated(path: FloatArray, step_covariance: FloatArray) -> FloatArray:
    """(N, 3, 3) covariances of the motions about the origin by the errors of all steps so far.

    A step's error moves everything after it, and rotates it about the pose after the step.
    """
    by_error = np.zeros((len(path) - 1, 3, 3))
    by_error[:, :2, :2] = rotation(path[:-1, 2])
    by_error[:, :, 2] = np.stack([path[1:, 1], -path[1:, 0], np.ones(len(path) - 1)], axis=1)
    return np.asarray(np.cumsum(by_error @ step_covariance @ by_error.swapaxes(1, 2), axis=0))


def _about(pose: FloatArray) -> FloatArray:
    """(3, 3) turns a small motion about the origin into one about a pose."""
    return np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])


def unrecognised_return(
    recording: Recording, labels: IntArray, path: FloatArray
) -> tuple[int, int] | None:
    """Frames, the earlier first, between which the robot left a place and came back to it, by its
    path and the random errors of odometry, but around which it saw discs without a common label.

    It is at one place within half the median distance of discs and `_ONE_VIEW_RAD`, including two
    standard deviations of both. Takes `labels` (n,), -1 for none, and the `path` (N + 1, 3).
    """
    frames, numbers = recording.circles.frame[labels >= 0], labels[labels >= 0]
    until = _accumulated(path, recording.step_covariance)
    view = np.array([0.5 * np.median(np.hypot(*recording.circles.xy.T)), _ONE_VIEW_RAD])

    def seen(frame: int) -> IntArray:
        near = [frame - SUBMAP_FRAMES // 2, frame + SUBMAP_FRAMES // 2]
        return numbers[slice(*np.searchsorted(frames, near))]

    for later in range(0, len(path) - 1, SUBMAP_FRAMES // 5):
        off = path[1 : later + 1] - path[later + 1]
        apart = np.stack([np.hypot(*off[:, :2].T), np.abs(wrap_angle(off[:, 2]))], axis=1)
        away = (apart / view).max(axis=1)
        before = away[: np.flatnonzero(away > 2.0).max(initial=0)]
        if len(before) == 0:
            continue
        earlier = int(before.argmin())
        there = _about(path[later + 1])
        sigma = np.sqrt(np.diag(there @ (until[later] - until[earlier]) @ there.T))
        certain = apart[earlier] + 2.0 * np.array([np.hypot(*sigma[:2]), sigma[2]]) < view
        one, other = seen(earlier), seen(later)
        if certain.all() and len(one) and len(other) and not np.isin(one, other).any():
            return earlier, later
    return None


def closed_path(path: FloatArray, matches: Sequence[Match], lost: IntArray) -> FloatArray:
    """A path (N + 1, 3) that satisfies the matches, as a start for least squares over everything.

    Headings first, then positions: each of the two problems is linear (L. Carlone, R. Aragues,
    J. A. Castellanos, B. Bona, "A fast and accurate approximation for planar pose graph
    optimization", International Journal of Robotics Research 33, 2014). So the path before may be
    arbitrarily wrong, and its `lost` steps unknown.
    """
    count = len(path) - 1
    first = np.array([m.earlier_frame + 1 for m in matches], dtype=np.int64)
    second = np.array([m.later_frame + 1 for m in matches], dtype=np.int64)
    motion = np.array([m.motion for m in matches])
    moved = np.column_stack([apply(motion, path[second, :2]), path[second, 2] + motion[:, 2]])
    before = np.concatenate([np.arange(count), first])
    after = np.concatenate([np.arange(1, count + 1), second])
    seen = between(np.concatenate([path[:-1], path[first]]), np.concatenate([path[1:], moved]))
    turns = np.concatenate([np.diff(path[:, 2]), moved[:, 2] - path[first, 2]])
    weights = 1.0 / np.repeat([_STEP_SIGMA, _MATCH_SIGMA], [count, len(matches)], axis=0).T
    weights[:, lost] = _LOST_WEIGHT
    theta = path[0, 2] + _chained(before, after, turns[:, None], weights[0], count)[:, 0]
    offsets = np.einsum("nij,nj->ni", rotation(theta[before]), seen[:, :2])
    xy = path[0, :2] + _chained(before, after, offsets, weights[1], count)
    return np.concatenate([xy, theta[:, None]], axis=1)


def _chained(
    before: IntArray, after: IntArray, differences: FloatArray, weight: FloatArray, count: int
) -> FloatArray:
    """Values at nodes 0 (where they are 0) to count from weighted differences between nodes."""
    width = differences.shape[1]
    by = weight[:, None, None] * np.eye(width)
    edges = Block(
        -weight[:, None] * differences, [(width * (after - 1), by), (width * (before - 1), -by)]
    )
    solved, _ = normal_equations(stack([edges], width * count, shared=0)).step(damping=0.0)
    return np.concatenate([np.zeros((1, width)), solved.reshape(count, width)])
