"""Estimates the poses of markers on a robot, from images that show several of them.

The steps: pairs of markers seen together, a consensus for each pair, a tree over the best supported
pairs (markers never seen together are connected by a third), and one bundle adjustment of all
markers and all times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.markers import adjustment
from redetect.groundtruth.markers.pairs import (
    MarkerPose,
    PairConsensus,
    chained_poses,
    joined,
    pair_consensus,
    pair_estimates,
)
from redetect.groundtruth.markers.poses import view_poses
from redetect.groundtruth.markers.refinement import chain_points, pose_problem, refined_poses
from redetect.groundtruth.markers.session import MarkerFrame, Network, Rig, View, rig_views
from redetect.groundtruth.settings import PoseSettings, RigSettings
from redetect.groundtruth.trajectories import se3

# Standard deviations of exactly known poses: a micrometre and a microradian.
_EXACT = 1e-12
# Bound of a wrong solution's cost, when a time's pose is chosen among its markers' solutions.
_WRONG_PX = 20.0


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """An estimated rig, and the views used."""

    # In the robot's frame if markers were known in it, else in that of the reference; the
    # covariance is scaled by the residuals if they are larger than implied by the corners'.
    rig: Rig
    reference: int  # The marker from which the others were chained
    pairs: dict[tuple[int, int], PairConsensus]  # By indices of the rig
    adjusted: adjustment.AdjustedBundle
    views: tuple[View, ...]  # The bundle's views
    times: int  # Number of times (images, without a network) used
    left_out: dict[int, str]  # Markers that were found but are not in the rig, with the reason
    # Width that would fit the images best, and its standard deviation (m): infinite if the cameras'
    # poses relative to each other are not known
    fitting_width_m: tuple[float, float]


def estimate_rig(
    groups: Sequence[Sequence[MarkerFrame]],
    network: Network,
    width_m: float,
    settings: RigSettings,
    *,
    reference: int | None = None,
    known: Rig | None = None,
) -> RigEstimate:
    """Estimate a rig, in the frame of one of its markers or in that in which some are known.

    Parameters
    ----------
    groups : sequence of sequences of MarkerFrame
        Images taken at one time; single ones where the cameras are not calibrated to each other.
    network : Network
        The cameras; their poses are ignored if they are not calibrated to each other. If it has a
        covariance, that is a prior of the cameras' adjustment.
    width_m : float
        Width of the markers.
    reference : int, optional
        The marker whose frame is the rig's; by default the one with the most support.
    known : Rig, optional
        One or more of the markers in the robot's frame, which is the rig's then; their
        covariances, apart from each other, are those of priors.

    Raises
    ------
    GroundTruthError
        If markers of several dictionaries or of none were found, no two markers were seen together
        often enough, the reference was not, or none of the known markers is in the rig, or they are
        of another dictionary or width.
    """
    markers = [marker for group in groups for frame in group for marker in frame.markers]
    dictionaries = sorted({marker.dictionary for marker in markers})
    if len(dictionaries) != 1:
        found = f"markers of the dictionaries {dictionaries}" if dictionaries else "no markers"
        raise GroundTruthError(f"{found} in the images: expected markers of one dictionary")
    # Pairs of markers seen together, and a consensus for each pair.
    ids = tuple(sorted({marker.id for marker in markers}))
    candidates = _bare_rig(dictionaries[0], ids, width_m)
    seen = [rig_views(group, candidates) for group in groups]
    solved = [
        [(v, _solutions(v, candidates, network, settings)) for v in views]
        for views in seen
        if len({view.rig_index for view in views}) > 1
    ]
    pairs = _consensus_of_pairs(solved)
    support = {pair: c.support for pair, c in pairs.items() if c.support >= settings.least_support}
    if not support:
        raise GroundTruthError(
            f"no two markers were seen together {settings.least_support} times in agreement: "
            "expected images that show two or more markers of the rig"
        )
    # Start: markers chained from the root, without those it is not connected to.
    root = _root(ids, support, reference)
    relative = {pair: consensus.a_from_b for pair, consensus in pairs.items()}
    start = chained_poses(relative, support, len(ids), root)
    kept = np.flatnonzero(np.isfinite(start[:, 0, 0]))
    start = start[kept]
    seen_at = [sum(any(v.rig_index == k for v in views) for views in seen) for k in range(len(ids))]
    left_out = {
        ids[k]: f"seen at {seen_at[k]} times, but not {settings.least_support} times in agreement "
        "with a marker of the rig"
        for k in np.setdiff1d(np.arange(len(ids)), kept).tolist()
    }
    renumbered = {old: new for new, old in enumerate(kept.tolist())}
    pairs = {
        (renumbered[a], renumbered[b]): c
        for (a, b), c in pairs.items()
        if a in renumbered and b in renumbered
    }
    kept_ids = tuple(ids[i] for i in kept)
    rig = _bare_rig(dictionaries[0], kept_ids, width_m)
    priors: tuple[adjustment.PosePrior, ...] = ()
    if known is not None:
        start, priors = _in_known_frame(rig, start, known, len(network.cameras))
    # One bundle adjustment of all markers and all times.
    bundle, views, times = _bundle(solved, rig, renumbered, start, network, settings)
    free = bundle.free.copy()
    free[len(network.cameras) + renumbered[root]] = known is not None
    if np.any(network.covariance):
        # The cameras are free, each with its own covariance as a prior.
        seen_by = np.unique(bundle.seen.camera).tolist()
        free[seen_by] = True
        priors += tuple(_prior(c, bundle.poses[c], network.covariance, c) for c in seen_by)
    bundle = replace(bundle, free=free, priors=priors)
    try:
        adjusted = adjustment.adjust_bundle(
            bundle, outlier_sigma=settings.outlier_sigma, outlier_px=settings.outlier_px
        )
    except GeometryError as error:
        raise GroundTruthError(f"the rig cannot be adjusted: {error}") from None
    covariance = adjusted.part_covariance * max(1.0, adjusted.chi2_per_dof)
    poses = adjusted.bundle.chain.body_from_part
    rig = replace(rig, robot_from_marker=poses, covariance=covariance)
    factor, sigma = adjustment.size_of_parts(adjusted)
    fitting = width_m * factor, width_m * sigma
    return RigEstimate(rig, ids[root], pairs, adjusted, views, times, left_out, fitting)


def _in_known_frame(
    rig: Rig, rig_from_marker: FloatArray, known: Rig, cameras: int
) -> tuple[FloatArray, tuple[adjustment.PosePrior, ...]]:
    """Markers (M, 4, 4) moved to where some are known, and priors of these behind the cameras."""
    common = [marker for marker in rig.ids if marker in known.ids]
    if not common:
        raise GroundTruthError(f"the rig has markers {list(rig.ids)}, none of {list(known.ids)}")
    priors, starts = [], []
    for marker in common:
        i, j = rig.ids.index(marker), known.ids.index(marker)
        is_like = np.isclose(known.widths_m[j], rig.widths_m[i], atol=0.0)
        if not is_like or known.dictionary != rig.dictionary:
            raise GroundTruthError(
                f"the known marker {marker} of {known.dictionary} is {known.widths_m[j]:g} m wide: "
                f"expected {rig.dictionary} and {rig.widths_m[i]:g} m, as those found"
            )
        priors.append(_prior(cameras + i, known.robot_from_marker[j], known.covariance, j))
        starts.append(known.robot_from_marker[j] @ se3.inverse(rig_from_marker[i]))
    robot_from_rig, _ = se3.mean_pose(starts, np.tile(np.eye(6), (len(starts), 1, 1)))
    return robot_from_rig @ rig_from_marker, tuple(priors)


def _bare_rig(dictionary: str, ids: tuple[int, ...], width_m: float) -> Rig:
    count = len(ids)
    poses, exact = np.tile(np.eye(4), (count, 1, 1)), np.zeros((6 * count, 6 * count))
    return Rig(dictionary, ids, np.full(count, width_m), poses, exact)


def _solutions(view: View, rig: Rig, network: Network, settings: RigSettings) -> MarkerPose | None:
    """Both poses of a marker in an image, refined; None if it has none."""
    exact = replace(network, covariance=np.zeros_like(network.covariance))
    # The rig's poses are identities: the marker itself is the body.
    floor = PoseSettings(corner_floor_px=settings.corner_floor_px)
    problem = pose_problem([view], rig, exact, floor)
    found = refined_poses(problem, view_poses(problem, 0))
    if not found:
        return None
    poses, covariances, costs = zip(*((r.world_from_robot, r.covariance, r.cost) for r in found))
    return MarkerPose(np.stack(poses), np.stack(covariances), np.array(costs))


def _consensus_of_pairs(
    solved: Sequence[Sequence[tuple[View, MarkerPose | None]]],
) -> dict[tuple[int, int], PairConsensus]:
    estimates: dict[tuple[int, int], list[MarkerPose]] = {}
    for views in solved:
        # Those of one time are alternatives: they share its errors, and count once.
        here: dict[tuple[int, int], list[MarkerPose]] = {}
        for (view_a, a), (view_b, b) in product(views, repeat=2):
            pair = (view_a.rig_index, view_b.rig_index)
            if a is not None and b is not None and pair[0] < pair[1]:
                here.setdefault(pair, []).append(pair_estimates(a, b))
        for pair, found in here.items():
            estimates.setdefault(pair, []).append(joined(found))
    return {pair: pair_consensus(times) for pair, times in sorted(estimates.items())}


def _root(
    ids: tuple[int, ...], support: Mapping[tuple[int, int], int], reference: int | None
) -> int:
    total = np.zeros(len(ids), dtype=np.int64)
    for pair, count in support.items():
        total[list(pair)] += count
    if reference is None:
        return int(np.argmax(total))
    if reference not in ids or not total[ids.index(reference)]:
        raise GroundTruthError(
            f"marker {reference} cannot be the reference: it was not seen with others often enough"
        )
    return ids.index(reference)


def _bundle(
    solved: Sequence[Sequence[tuple[View, MarkerPose | None]]],
    rig: Rig,
    renumbered: Mapping[int, int],
    start: FloatArray,
    network: Network,
    settings: RigSettings,
) -> tuple[adjustment.Bundle, tuple[View, ...], int]:
    """The bundle, its views, and the number of times, each of which is a body."""
    views: list[View] = []
    bodies: list[int] = []
    poses: list[FloatArray] = []
    for group in solved:
        own = [
            (replace(view, rig_index=renumbered[view.rig_index]), solutions)
            for view, solutions in group
            if view.rig_index in renumbered and solutions is not None
        ]
        if len({view.rig_index for view, _ in own}) < 2:
            continue
        pose = _best_start(own, rig, start, network, settings)
        if pose is not None:
            views += [view for view, _ in own]
            bodies += [len(poses)] * len(own)
            poses.append(pose)
    points = chain_points(views, rig, settings.corner_floor_px)
    points = replace(points, body=np.repeat(bodies, 4).astype(np.int64))
    together = np.concatenate([network.world_from_camera, start, poses])
    free = np.arange(len(together)) >= len(network.cameras)
    view = np.repeat(np.arange(len(views)), 4)
    bundle = adjustment.Bundle(network.cameras, len(start), together, free, points, view)
    return bundle, tuple(views), len(poses)


def _prior(
    index: int, pose: FloatArray, covariance: FloatArray, among: int
) -> adjustment.PosePrior:
    """The prior of one pose of a bundle, which is one `among` several with a covariance."""
    own = slice(6 * among, 6 * among + 6)
    return adjustment.PosePrior(index, pose, covariance[own, own] + _EXACT * np.eye(6))


def _best_start(
    own: Sequence[tuple[View, MarkerPose]],
    rig: Rig,
    start: FloatArray,
    network: Network,
    settings: RigSettings,
) -> FloatArray | None:
    """The pose of the rig, among its markers' solutions, that explains most of a time's views."""
    points = chain_points([view for view, _ in own], rig, settings.corner_floor_px)
    best, least = None, np.inf
    for view, solutions in own:
        for pose in solutions.poses @ se3.inverse(start[view.rig_index]):
            chain = adjustment.Chain(network.cameras, network.world_from_camera, pose[None], start)
            pixels = adjustment.project_chain(chain, points)
            squares = np.sum((pixels - points.pixels) ** 2, axis=1).reshape(-1, 4).mean(axis=1)
            if not np.all(np.isfinite(squares)):
                continue
            total = float(np.sum(np.minimum(squares, _WRONG_PX**2)))
            if total < least:
                best, least = pose, total
    return best
