"""A rig in the robot's frame: by markers whose place on the robot is known, or by known poses.

These become priors of a further adjustment in which all markers are free. So the covariance is that
in the robot's frame: markers far from those that define it are less certain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.geometry.covariance import mean_pose
from redetect.groundtruth.geometry.transforms import inverse, planar_transform
from redetect.groundtruth.markers.adjustment import adjust_bundle
from redetect.groundtruth.markers.bundle import PosePrior
from redetect.groundtruth.markers.calibration import Rig
from redetect.groundtruth.markers.rig_estimation import RigEstimate
from redetect.groundtruth.markers.settings import RigSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses

FloatArray = NDArray[np.float64]

# Exactly known poses are held to a micrometre and a microradian.
_EXACT = 1e-12
# Assumed deviations of a reference pose without covariance (m, rad), and of any one's level.
_REFERENCE_SIGMA_M, _REFERENCE_SIGMA_RAD = 0.005, 0.005


def rig_by_known_markers(estimate: RigEstimate, known: Rig, settings: RigSettings) -> RigEstimate:
    """Put a rig into the frame in which some of its markers are known.

    Parameters
    ----------
    estimate : RigEstimate
    known : Rig
        One or more of its markers in the robot's frame; their covariances, apart from each other,
        are their priors'.
    settings : RigSettings

    Returns
    -------
    RigEstimate

    Raises
    ------
    GroundTruthError
        If the rig has none of them.
    """
    ids = estimate.rig.ids
    common = [marker for marker in ids if marker in known.ids]
    if not common:
        raise GroundTruthError(f"the rig has markers {list(ids)}, none of {list(known.ids)}")
    priors, starts = [], []
    for marker in common:
        i, j = ids.index(marker), known.ids.index(marker)
        covariance = known.covariance[6 * j : 6 * j + 6, 6 * j : 6 * j + 6] + _EXACT * np.eye(6)
        priors.append(PosePrior("part", i, known.robot_from_marker[j], covariance))
        starts.append(known.robot_from_marker[j] @ inverse(estimate.rig.robot_from_marker[i]))
    start, _, _ = mean_pose(starts, np.tile(np.eye(6), (len(starts), 1, 1)))
    return _readjusted(estimate, start, tuple(priors), settings)


def rig_by_reference_poses(
    estimate: RigEstimate, reference: PlanarPoses, settings: RigSettings
) -> tuple[RigEstimate, int]:
    """Put a rig into the frame of a robot whose poses are known at some times.

    Parameters
    ----------
    estimate : RigEstimate
        Made with a network, whose world is that of the poses.
    reference : PlanarPoses
        The robot standing level.
    settings : RigSettings
        With the tolerance between a pose's time and an image's.

    Returns
    -------
    RigEstimate
    int
        How many times have a known pose.

    Raises
    ------
    GroundTruthError
        If none has one.
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
        priors.append(PosePrior("body", body, pose, covariance))
        starts.append(inverse(pose) @ bundle.world_from_body[body])
    if not priors:
        raise GroundTruthError(
            "no images show two markers of the rig at the time of any reference pose"
        )
    start, _, _ = mean_pose(starts, np.tile(np.eye(6), (len(starts), 1, 1)))
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
    seen = np.isin(np.arange(len(bundle.free_body)), bundle.seen.body)
    moved = replace(
        bundle,
        world_from_body=bundle.world_from_body @ inverse(robot_from_rig),
        body_from_part=robot_from_rig @ bundle.body_from_part,
        free_body=seen,
        free_part=np.ones(len(bundle.free_part), dtype=np.bool_),
        priors=(*(p for p in bundle.priors if p.kind == "camera"), *priors),
    )
    try:
        adjusted = adjust_bundle(
            moved, outlier_sigma=settings.outlier_sigma, outlier_px=settings.outlier_px
        )
    except GeometryError as error:
        raise GroundTruthError(f"the rig cannot be adjusted: {error}") from None
    rig = replace(
        estimate.rig,
        robot_from_marker=adjusted.bundle.body_from_part,
        covariance=adjusted.part_covariance * max(1.0, adjusted.reduced_cost),
    )
    return replace(estimate, rig=rig, adjusted=adjusted)
