"""Where the markers sit on a robot, from images that show several of them.

Pairs of markers seen together, a consensus for each pair, a tree over the best supported pairs
(markers never seen together are bridged by a third), and one bundle adjustment of all markers and
all times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.markers.adjustment import (
    AdjustedBundle,
    Bundle,
    Chain,
    PosePrior,
    adjust_bundle,
    project_chain,
)
from redetect.groundtruth.markers.pairs import (
    MarkerPose,
    PairConsensus,
    chained_poses,
    pair_consensus,
    pair_estimates,
    spanning_tree,
)
from redetect.groundtruth.markers.poses import view_poses
from redetect.groundtruth.markers.refinement import PoseProblem, chain_points, refine_pose
from redetect.groundtruth.markers.session import MarkerFrame, Network, Rig, View, rig_views
from redetect.groundtruth.settings import PoseSettings, RigSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.groundtruth.trajectories.transforms import inverse, mean_pose, planar_transform

# Where a time's pose is chosen among its markers' solutions, a wrong one counts no more than this.
_WRONG_PX = 20.0


@dataclass(frozen=True, eq=False)
class RigEstimate:
    """A rig in the frame of one of its markers, and what it was made from."""

    # `robot_from_marker` is `reference_from_marker` here; the covariance is scaled by the residuals
    # where those are larger than the corners' covariances say.
    rig: Rig
    reference: int  # The marker whose frame it is
    pairs: dict[tuple[int, int], PairConsensus]  # By indices of the rig
    adjusted: AdjustedBundle
    views: tuple[View, ...]  # The bundle's views
    times: int  # How many times (images, without a network) were used
    left_out: dict[int, str]  # Markers that were found but are not in the rig, with the reason


def estimate_rig(
    groups: Sequence[Sequence[MarkerFrame]],
    network: Network,
    dictionary: str,
    widths_m: Mapping[int, float],
    settings: RigSettings,
    *,
    reference: int | None = None,
) -> RigEstimate:
    """Estimate a rig.

    Parameters
    ----------
    groups : sequence of sequences of MarkerFrame
        Images taken at one time; single ones where the cameras are not calibrated to each other.
    network : Network
        The cameras; their places mean nothing where they are not calibrated to each other. If it
        has a covariance, that is a prior of the cameras' adjustment.
    widths_m : mapping of int to float
        Widths of the markers that may be in the rig, by ID.
    reference : int, optional
        The marker whose frame is the rig's; by default the one with the most support.

    Raises
    ------
    GroundTruthError
        If no two markers were seen together often enough, or the reference was not.
    """
    ids = tuple(sorted(widths_m))
    candidates = _bare_rig(dictionary, ids, widths_m)
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
    root = _root(ids, support, reference)
    parents = spanning_tree(support, len(ids), root)
    kept = [i for i in range(len(ids)) if parents[i] >= 0]
    left_out = _reasons(ids, parents, seen, settings)
    renumbered = {old: new for new, old in enumerate(kept)}
    tree = [renumbered[parents[i]] for i in kept]
    pairs = {
        (renumbered[a], renumbered[b]): c
        for (a, b), c in pairs.items()
        if a in renumbered and b in renumbered
    }
    relative = {pair: consensus.a_from_b for pair, consensus in pairs.items()}
    start = chained_poses(relative, tree, renumbered[root])
    kept_ids = tuple(ids[i] for i in kept)
    rig = _bare_rig(dictionary, kept_ids, widths_m)
    bundle, views, times = _bundle(
        solved, rig, renumbered, start, network, renumbered[root], settings
    )
    if np.any(network.covariance):
        bundle = _with_free_cameras(bundle, network.covariance)
    adjusted, rig = _adjusted(bundle, rig, settings)
    return RigEstimate(rig, ids[root], pairs, adjusted, views, times, left_out)


def _adjusted(bundle: Bundle, rig: Rig, settings: RigSettings) -> tuple[AdjustedBundle, Rig]:
    """The bundle at its minimum, and the rig that it makes."""
    try:
        adjusted = adjust_bundle(
            bundle, outlier_sigma=settings.outlier_sigma, outlier_px=settings.outlier_px
        )
    except GeometryError as error:
        raise GroundTruthError(f"the rig cannot be adjusted: {error}") from None
    covariance = adjusted.part_covariance * max(1.0, adjusted.reduced_cost)
    poses = adjusted.bundle.body_from_part
    return adjusted, replace(rig, robot_from_marker=poses, covariance=covariance)


def _bare_rig(dictionary: str, ids: tuple[int, ...], widths_m: Mapping[int, float]) -> Rig:
    count = len(ids)
    return Rig(
        dictionary,
        ids,
        np.array([widths_m[marker] for marker in ids]),
        np.tile(np.eye(4), (count, 1, 1)),
        np.zeros((6 * count, 6 * count)),
    )


def _solutions(view: View, rig: Rig, network: Network, settings: RigSettings) -> MarkerPose | None:
    """Both poses of a marker in an image, refined; None if it has none."""
    problem = PoseProblem(
        replace(network, covariance=np.zeros_like(network.covariance)),
        rig,  # with identities: the marker itself is the body
        chain_points([view], rig, settings.corner_floor_px),
        np.zeros(4, dtype=np.int64),
        PoseSettings(loss="linear"),
    )
    found = []
    for start in view_poses(problem, 0):
        try:
            found.append(refine_pose(problem, start))
        except GeometryError:
            continue
    if not found:
        return None
    found.sort(key=lambda refined: refined.cost)
    return MarkerPose(
        np.stack([refined.world_from_robot for refined in found]),
        np.stack([refined.covariance for refined in found]),
        np.array([refined.cost for refined in found]),
    )


def _consensus_of_pairs(
    solved: Sequence[Sequence[tuple[View, MarkerPose | None]]],
) -> dict[tuple[int, int], PairConsensus]:
    estimates: dict[tuple[int, int], list[MarkerPose]] = {}
    for views in solved:
        for view_a, a in views:
            for view_b, b in views:
                pair = (view_a.rig_index, view_b.rig_index)
                if a is not None and b is not None and pair[0] < pair[1]:
                    estimates.setdefault(pair, []).append(pair_estimates(a, b))
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


def _reasons(
    ids: tuple[int, ...],
    parents: Sequence[int],
    seen: Sequence[Sequence[View]],
    settings: RigSettings,
) -> dict[int, str]:
    reasons = {}
    for index, marker in enumerate(ids):
        alone = sum(any(v.rig_index == index for v in views) for views in seen)
        if parents[index] < 0 and alone:
            reasons[marker] = (
                f"seen at {alone} times, but not {settings.least_support} times in agreement with "
                "a marker of the rig"
            )
    return reasons


def _bundle(
    solved: Sequence[Sequence[tuple[View, MarkerPose | None]]],
    rig: Rig,
    renumbered: Mapping[int, int],
    start: FloatArray,
    network: Network,
    root: int,
    settings: RigSettings,
) -> tuple[Bundle, tuple[View, ...], int]:
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
        if pose is None:
            continue
        views += [view for view, _ in own]
        bodies += [len(poses)] * len(own)
        poses.append(pose)
    points = chain_points(views, rig, settings.corner_floor_px)
    cameras = len(network.cameras)
    free = np.arange(cameras + len(start) + len(poses)) >= cameras
    free[cameras + root] = False
    bundle = Bundle(
        network.cameras,
        len(start),
        np.concatenate([network.world_from_camera, start, poses]),
        free,
        replace(points, body=np.repeat(bodies, 4).astype(np.int64)),
        np.repeat(np.arange(len(views)), 4),
    )
    return bundle, tuple(views), len(poses)


def _with_free_cameras(bundle: Bundle, covariance: FloatArray) -> Bundle:
    """The bundle with its cameras free, each with its own covariance as a prior."""
    seen = np.unique(bundle.seen.camera)
    free = bundle.free.copy()
    free[seen] = True
    priors = tuple(
        PosePrior(int(c), bundle.poses[c], _block(covariance, c) + _EXACT * np.eye(6)) for c in seen
    )
    return replace(bundle, free=free, priors=priors)


def _block(covariance: FloatArray, index: int) -> FloatArray:
    """The (6, 6) covariance of one of several poses."""
    return covariance[6 * index : 6 * index + 6, 6 * index : 6 * index + 6]


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
        for pose in solutions.poses @ inverse(start[view.rig_index]):
            chain = Chain(network.cameras, network.world_from_camera, pose[None], start)
            pixels = project_chain(chain, points)
            squares = np.sum((pixels - points.pixels) ** 2, axis=1).reshape(-1, 4).mean(axis=1)
            if not np.all(np.isfinite(squares)):
                continue
            total = float(np.sum(np.minimum(squares, _WRONG_PX**2)))
            if total < least:
                best, least = pose, total
    return best


# Exactly known poses are held to a micrometre and a microradian.
_EXACT = 1e-12
# Assumed deviations of a reference pose without covariance (m, rad), and of any one's level.
_REFERENCE_SIGMA_M, _REFERENCE_SIGMA_RAD = 0.005, 0.005


def rig_by_known_markers(estimate: RigEstimate, known: Rig, settings: RigSettings) -> RigEstimate:
    """Put a rig into the frame in which some of its markers are known.

    `known` has one or more of its markers in the robot's frame; their covariances, apart from each
    other, are their priors'. Raises `GroundTruthError` if the rig has none of them.
    """
    ids = estimate.rig.ids
    common = [marker for marker in ids if marker in known.ids]
    if not common:
        raise GroundTruthError(f"the rig has markers {list(ids)}, none of {list(known.ids)}")
    priors, starts = [], []
    for marker in common:
        i, j = ids.index(marker), known.ids.index(marker)
        covariance = _block(known.covariance, j) + _EXACT * np.eye(6)
        cameras = len(estimate.adjusted.bundle.cameras)
        priors.append(PosePrior(cameras + i, known.robot_from_marker[j], covariance))
        starts.append(known.robot_from_marker[j] @ inverse(estimate.rig.robot_from_marker[i]))
    start, _ = mean_pose(starts, np.tile(np.eye(6), (len(starts), 1, 1)))
    return _readjusted(estimate, start, tuple(priors), settings)


def rig_by_reference_poses(
    estimate: RigEstimate, reference: PlanarPoses, settings: RigSettings
) -> tuple[RigEstimate, int]:
    """Put a rig into the frame of a robot whose poses, standing level, are known at some times.

    The estimate was made with a network, whose world is that of the poses. Returns how many times
    have a known pose as well; raises `GroundTruthError` if none has one.
    """
    bundle = estimate.adjusted.bundle
    body_of_view = bundle.seen.body[np.searchsorted(bundle.view, np.arange(len(estimate.views)))]
    priors, starts = [], []
    for body in range(len(bundle.world_from_body)):
        times = [view.frame.time_s for view, b in zip(estimate.views, body_of_view) if b == body]
        k = int(np.argmin(np.abs(reference.times_s - np.mean(times))))
        if abs(reference.times_s[k] - float(np.mean(times))) > settings.time_tolerance_s:
            continue
        x, y, theta = reference.poses[k]
        pose = planar_transform(float(x), float(y), float(theta))
        covariance = _reference_covariance(reference, k, pose)
        priors.append(PosePrior(bundle.shared + body, pose, covariance))
        starts.append(inverse(pose) @ bundle.world_from_body[body])
    if not priors:
        raise GroundTruthError(
            "no images show two markers of the rig at the time of any reference pose"
        )
    start, _ = mean_pose(starts, np.tile(np.eye(6), (len(starts), 1, 1)))
    return _readjusted(estimate, start, tuple(priors), settings), len(priors)


def _reference_covariance(reference: PlanarPoses, k: int, pose: FloatArray) -> FloatArray:
    """(6, 6) covariance of a known pose's right perturbation."""
    covariance = np.diag(np.square([_REFERENCE_SIGMA_M] * 3 + [_REFERENCE_SIGMA_RAD] * 3))
    if reference.covariances is not None:
        turn = np.eye(3)
        turn[:2, :2] = pose[:2, :2].T
        planar = turn @ reference.covariances[k] @ turn.T
        covariance[np.ix_([0, 1, 5], [0, 1, 5])] = planar + _EXACT * np.eye(3)
    return covariance


def _readjusted(
    estimate: RigEstimate,
    robot_from_rig: FloatArray,
    priors: tuple[PosePrior, ...],
    settings: RigSettings,
) -> RigEstimate:
    bundle = estimate.adjusted.bundle
    cameras = len(bundle.cameras)
    free = bundle.free.copy()
    free[cameras : bundle.shared] = True
    free[bundle.shared :] = np.isin(np.arange(len(bundle.world_from_body)), bundle.seen.body)
    moved = replace(
        bundle,
        poses=np.concatenate(
            [
                bundle.world_from_camera,
                robot_from_rig @ bundle.body_from_part,
                bundle.world_from_body @ inverse(robot_from_rig),
            ]
        ),
        free=free,
        priors=(*(p for p in bundle.priors if p.index < cameras), *priors),
    )
    adjusted, rig = _adjusted(moved, estimate.rig, settings)
    return replace(estimate, rig=rig, adjusted=adjusted)
