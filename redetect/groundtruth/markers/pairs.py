"""Relative poses of two markers: estimates at each time at which both are seen, and a consensus.

A square has two solutions, so there are four estimates of a pair at each time. The right one is
the same at all times; wrong ones depend on the pose of the camera. The consensus is the estimate
that agrees best with the others, with the best of the four chosen at each time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import squared_mahalanobis

# Squared normalised distance (6 dof) above which an estimate disagrees.
_AGREES = 30.0
_HYPOTHESES = 60
# Added to covariances, since estimates are linearised.
_FLOOR = np.diag(np.square([0.002] * 3 + [0.005] * 3))


@dataclass(frozen=True, eq=False)
class MarkerPose:
    """A marker as seen at one time: its one or two solutions."""

    poses: FloatArray  # (K, 4, 4): `reference_from_marker`, the reference a camera or the world
    covariances: FloatArray  # (K, 6, 6): of the right perturbations
    costs: FloatArray  # (K,): squared normalised residuals


@dataclass(frozen=True, eq=False)
class PairConsensus:
    """The pose of one marker relative to another."""

    a_from_b: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6)
    estimates: FloatArray  # (T, 4, 4): each time's estimate that is closest to the consensus
    agrees: BoolArray  # (T,): which of them agree with it
    first: BoolArray  # (T,): whether these are the solutions that fit the image best

    @property
    def support(self) -> int:
        """Number of times at which the estimate agrees."""
        return int(self.agrees.sum())


def pair_estimates(a: MarkerPose, b: MarkerPose) -> MarkerPose:
    """Estimates of `a_from_b` from all combinations of both markers' solutions at one time."""
    poses = se3.inverse(a.poses)[:, None] @ b.poses
    moved = se3.adjoint(se3.inverse(poses))
    own = moved @ a.covariances[:, None] @ np.swapaxes(moved, -1, -2)
    covariances = own + b.covariances
    costs = np.add.outer(a.costs, b.costs).ravel()
    return MarkerPose(poses.reshape(-1, 4, 4), covariances.reshape(-1, 6, 6), costs)


def joined(estimates: Sequence[MarkerPose]) -> MarkerPose:
    """All estimates of one time as alternatives; costs above the least of each."""
    return MarkerPose(
        np.concatenate([e.poses for e in estimates]),
        np.concatenate([e.covariances for e in estimates]),
        np.concatenate([e.costs - e.costs.min() for e in estimates]),
    )


def pair_consensus(times: Sequence[MarkerPose]) -> PairConsensus:
    """The transform with which most times agree, each with its estimates from `pair_estimates`."""
    poses = np.concatenate([time.poses for time in times])
    covariances = np.concatenate([time.covariances for time in times])
    costs = np.concatenate([time.costs - time.costs.min() for time in times])
    owner = np.repeat(np.arange(len(times)), [len(time.poses) for time in times])

    def nearest(pose: FloatArray, covariance: FloatArray) -> tuple[FloatArray, IntArray]:
        """Each time's estimate nearest to a pose: squared normalised distance, and its index."""
        apart = se3.log(se3.inverse(pose) @ poses)
        distance = squared_mahalanobis(apart, covariances + covariance + _FLOOR) + costs
        order = np.lexsort((distance, owner))
        best = order[np.searchsorted(owner[order], np.arange(len(times)))]
        return distance[best], best

    # Hypotheses are the most certain estimates: of markers seen large and at an angle.
    spread = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2)
    surest = np.argsort(spread, kind="stable")[:_HYPOTHESES]
    totals = []
    for hypothesis in surest:
        distance, _ = nearest(poses[hypothesis], covariances[hypothesis])
        totals.append(np.sum(np.minimum(distance, _AGREES)))
    chosen = surest[int(np.argmin(totals))]
    consensus, covariance = poses[chosen], covariances[chosen]
    for _ in range(10):
        distance, best = nearest(consensus, covariance)
        agreeing = best[distance < _AGREES]
        if not len(agreeing):  # not even the hypothesis itself
            agreeing = np.array([chosen])
        new, covariance = se3.mean_pose(poses[agreeing], covariances[agreeing] + _FLOOR)
        moved = float(np.abs(se3.log(se3.inverse(consensus) @ new)).max())
        consensus = new
        if moved < 1e-10:
            break
    distance, best = nearest(consensus, covariance)
    first = np.array([costs[b] <= costs[owner == t].min() for t, b in enumerate(best)])
    return PairConsensus(consensus, covariance, poses[best], distance < _AGREES, first)


def chained_poses(
    relative: Mapping[tuple[int, int], FloatArray],
    support: Mapping[tuple[int, int], int],
    count: int,
    root: int,
) -> FloatArray:
    """(count, 4, 4) poses of markers, or cameras, in the root's frame; NaN if not connected.

    Chained along the spanning tree of the best supported pairs. `relative`: `a_from_b` of pairs
    (a, b); `support`: number of times that each was seen.
    """
    first, second = np.array(list(support), dtype=np.int64).reshape(-1, 2).T
    weights = coo_array((-np.array(list(support.values()), float), (first, second)), (count, count))
    # With negative weights: the tree with the most support.
    order, parents = breadth_first_order(minimum_spanning_tree(weights), root, directed=False)
    poses = np.full((count, 4, 4), np.nan)
    poses[root] = np.eye(4)
    for number in order[1:].tolist():
        parent = int(parents[number])
        known = relative.get((parent, number))
        if known is None:
            known = se3.inverse(relative[number, parent])
        poses[number] = poses[parent] @ known
    return poses
