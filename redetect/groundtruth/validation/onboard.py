"""Fit of the readings on board, at the reference poses, to the building's walls.

The robot is at rest, so its readings are averaged first. The fit starts at the pose from distances,
its prior; both are combined by their covariances, unless the walls leave a direction undetermined
or they disagree. All reference poses together give range errors and the scanners' mounts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.fusion.clock import ClockModel
from redetect.groundtruth.lasers.icp import nearest_on_segments
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.groundtruth.lasers.walls import (
    AveragedScan,
    MapProblem,
    WallCurves,
    averaged_scan,
    first_walls,
    wall_curves,
    walls_near,
)
from redetect.groundtruth.validation.reference_poses import DistancePose, DistanceStatus
from redetect.landmarks import wrap_angle
from redetect.plane import apply, compose, pose_differences, rotation

# The robot is assumed at rest for this long before and after the time of the distances.
_STILL_S = 0.5
# Of the fit to the walls (m): the standard deviations by which the gate narrows (to three times
# these), the largest standard deviation of a direction that is determined, and that by which the
# pose from distances holds the fit, before both are combined (m, rad).
_NARROWING_M = (0.2 / 3.0, 0.1 / 3.0, 0.05 / 3.0)
_WEAK_SIGMA_M = 0.05
_FREE_SIGMA = 0.5
# Distances and walls disagree if the probability of their difference is below this.
_DISAGREEMENT_PROBABILITY = 1e-4
#: Readings farther than this from the wall that their beam meets, and points farther from every
#: wall, are of other objects (m).
OF_A_WALL_M = 0.2
#: Ends of the bins of incidence (deg).
INCIDENCES_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0)
# Gates of the rounds in which mounts are refined, the least deviation of a point from a wall, and
# the largest root mean square of them: with a wrong mount, they fill the last gate.
_GATES_M = (*[0.4] * 10, *[0.2] * 6, 0.1, 0.1, *[0.05] * 4)
_LEAST_SIGMA_M, _LARGEST_RMS_M = 1e-3, 0.01


@dataclass(frozen=True, eq=False)
class Onboard:
    """A scanner on board and its scans, on the robot's clock."""

    scanner: Scanner  # Its pose is in the robot's frame
    scans: Scans


class AveragedScans(NamedTuple):
    """Averaged scans of the scanners on board while the robot is at rest."""

    scanners: tuple[Scanner, ...]
    scans: tuple[AveragedScan, ...]

    @property
    def mounts(self) -> FloatArray:
        """(scanners, 3) poses of the scanners in the robot's frame."""
        return np.stack([scanner.pose for scanner in self.scanners])

    def robot_points(self) -> FloatArray:
        """(N, 2) all points in the robot's frame (m)."""
        return np.concatenate([apply(m, s.points) for m, s in zip(self.mounts, self.scans)])


class ScanUse(StrEnum):
    """Whether scans on board refine a reference pose, and why not."""

    USED = "used"
    UNDETERMINED = "undetermined"  #: The walls do not determine a direction
    DISAGREES = "disagrees"  #: With the distances
    NO_SCANS = "no scans"  #: Too few readings match walls
    NOT_ASKED = "not asked"


@dataclass(frozen=True, eq=False)
class ReferencePose:
    """A reference pose, and how it was determined."""

    distances: DistancePose
    pose: FloatArray  # (3,): x, y (m), theta (rad)
    covariance: FloatArray  # (3, 3)
    scans: ScanUse
    note: str  # Why the scans are not used
    points: int = 0  # Number of points of the scans that are matched to walls
    rms_m: float = math.nan  # Of their distances from the walls; NaN without points
    averaged: AveragedScans | None = None  # The averaged scans of the scanners on board

    @property
    def index(self) -> int:
        """Its number in the file of distances."""
        return self.distances.index

    @property
    def time_s(self) -> float:
        """Time of the measurement, on the ground truth's clock."""
        return self.distances.time_s


@dataclass(frozen=True)
class Refused:
    """A pose that cannot serve as a reference, and why."""

    index: int
    time_s: float
    status: str
    reason: str


def reference_poses(
    distances: Sequence[DistancePose],
    onboard: Sequence[Onboard] = (),
    segments: FloatArray | None = None,
    clock: ClockModel | None = None,
) -> tuple[list[ReferencePose], list[Refused]]:
    """Poses from distances, refined by scans if possible.

    Parameters
    ----------
    distances : sequence of DistancePose
        From `redetect.groundtruth.validation.reference_poses.poses_from_distances`.
    onboard : sequence of Onboard
        Scanners on board; without any, only distances are used.
    segments : (S, 4) array, optional
        The building's walls, needed with scanners.
    clock : ClockModel, optional
        Without it, the robot's clock is assumed to be that of the ground truth.

    Returns
    -------
    refused : list of Refused
        Poses with ambiguous, undetermined or inconsistent distances.
    """
    references: list[ReferencePose] = []
    refused: list[Refused] = []
    refined = None
    if segments is not None:
        refined = partial(refined_by_walls, segments=segments, curves=wall_curves(segments))
    for d in distances:
        if d.status != DistanceStatus.OK:
            refused.append(Refused(d.index, d.time_s, d.status, d.reason))
        elif onboard and refined is not None:
            time = d.time_s if clock is None else float(clock.robot_times([d.time_s])[0])
            references.append(refined(d, averaged_scans(onboard, time)))
        else:
            references.append(
                _unrefined(d, ScanUse.NOT_ASKED if segments is None else ScanUse.NO_SCANS)
            )
    return references, refused


def walls_in_view(
    segments: FloatArray, distances: Sequence[DistancePose], onboard: Sequence[Onboard]
) -> FloatArray:
    """Those walls (S, 4) that scanners on board may see from poses by distances."""
    poses = [d.pose for d in distances if d.status == DistanceStatus.OK]
    reach = [b.scanner.max_range_m + float(np.hypot(*b.scanner.pose[:2])) for b in onboard]
    return walls_near(segments, np.stack(poses), max(reach)) if poses and reach else segments[:0]


def _unrefined(
    d: DistancePose, scans: ScanUse, reason: str = "", averaged: AveragedScans | None = None
) -> ReferencePose:
    """The pose from distances alone."""
    return ReferencePose(d, d.pose, d.covariance, scans, reason, averaged=averaged)


def averaged_scans(onboard: Sequence[Onboard], time_s: float) -> AveragedScans:
    """Average the readings of the scanners on board around a time on the robot's clock."""
    scans = []
    for board in onboard:
        during = np.abs(board.scans.times_s - time_s) <= _STILL_S
        scans.append(averaged_scan(board.scanner, board.scans.ranges_mm[during]))
    return AveragedScans(tuple(board.scanner for board in onboard), tuple(scans))


def refined_by_walls(
    distances: DistancePose, averaged: AveragedScans, segments: FloatArray, curves: WallCurves
) -> ReferencePose:
    """Combine a pose from distances with a fit to the walls (S, 4) (m), some of them `curves`."""
    prior, covariance = distances.pose, distances.covariance
    try:
        free = np.eye(3) / _FREE_SIGMA**2
        problem = MapProblem(averaged.scans, prior[None], free, segments, curves, averaged.mounts)
        found = problem.fit(prior[None], _NARROWING_M, _WEAK_SIGMA_M)
    except GeometryError as error:
        return _unrefined(distances, ScanUse.NO_SCANS, str(error))
    if found.undetermined_directions[0]:
        reason = "the walls do not determine a direction"
        return _unrefined(distances, ScanUse.UNDETERMINED, reason, averaged)
    of_mounts = block_diag(*(scanner.covariance for scanner in averaged.scanners))
    own = found.covariance + found.by_mounts @ of_mounts @ found.by_mounts.T
    apart = pose_differences(found.poses[0], prior)
    misfit = float(apart @ np.linalg.solve(own + covariance, apart))
    if chdtrc(3, misfit) < _DISAGREEMENT_PROBABILITY:
        reason = (
            f"{1e3 * math.hypot(apart[0], apart[1]):.0f} mm and {math.degrees(apart[2]):.2f} deg "
            "from the pose by distances, more than the covariances allow"
        )
        return _unrefined(distances, ScanUse.DISAGREES, reason, averaged)
    gain = np.linalg.solve(own + covariance, covariance).T
    pose = prior + gain @ apart
    pose[2] = wrap_angle(pose[2])
    # Joseph's form remains symmetric and positive definite.
    rest = np.eye(3) - gain
    combined = rest @ covariance @ rest.T + gain @ own @ gain.T
    points, rms_m = int(found.used[0]), float(found.rms_m[0])
    return ReferencePose(distances, pose, combined, ScanUse.USED, "", points, rms_m, averaged)


class RefinedMounts(NamedTuple):
    """Poses of those M scanners on the robot that have readings on walls."""

    scanners: tuple[Scanner, ...]
    poses: FloatArray  # (M, 3): in the robot's frame
    covariance: FloatArray  # (3 M, 3 M)


def range_errors(
    references: Sequence[ReferencePose], segments: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors of the averaged readings at reference poses that were refined by scans.

    Returns, for N readings on walls, the angles between beam and normal of the wall (N,) (0 to
    pi/2), and the readings minus the walls' distances along the beams (N,) (m).
    """
    angles, errors = [np.zeros(0)], [np.zeros(0)]
    for reference in references:
        if reference.averaged is None or reference.scans != ScanUse.USED:
            continue
        for mount, scan in zip(reference.averaged.mounts, reference.averaged.scans):
            pose = compose(reference.pose, mount)
            far, _, cosines = first_walls(pose[:2], scan.direction @ rotation(pose[2]).T, segments)
            of_a_wall = np.abs(scan.range_m - far) < OF_A_WALL_M
            angles.append(np.arccos(np.minimum(cosines, 1.0))[of_a_wall])
            errors.append((scan.range_m - far)[of_a_wall])
    return np.concatenate(angles), np.concatenate(errors)


def refine_mounts(
    references: Sequence[ReferencePose], segments: FloatArray
) -> RefinedMounts | None:
    """Mounts of the scanners on board for which readings fit the walls at all reference poses.

    Least squares over the mounts and all poses. Only the poses from distances, with their
    covariances, tie the mounts to the robot's frame; the measured mounts are not a prior.
    None if fewer than three poses have both distances and scans, or readings determine no mount.
    Raises `GeometryError` if the readings do not fit the walls in the end.
    """
    # With wrong mounts, scans disagree with distances: those are used, too.
    accepted = [r for r in references if r.distances.status == DistanceStatus.OK]
    used = [r for r in accepted if r.scans in (ScanUse.USED, ScanUse.DISAGREES)]
    every = [r.averaged for r in used if r.averaged is not None]
    if len(every) < 3:
        return None
    priors = np.stack([r.distances.pose for r in used])
    of_priors = np.linalg.inv(np.stack([r.distances.covariance for r in used]))
    mounts = every[0].mounts
    poses, count = np.stack([r.pose for r in used]), len(mounts)
    along = segments[:, 2:] - segments[:, :2]
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    normals /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-12)[:, None]
    # The unknowns are the mounts, then the poses.
    unknowns, of_poses = 3 * (count + len(used)), 3 * (count + np.arange(len(used)))
    for gate in _GATES_M:
        information, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        squares, readings = 0.0, 0
        for r, averaged in enumerate(every):
            for m, scan in enumerate(averaged.scans):
                world = apply(compose(poses[r], mounts[m]), scan.points)
                target, index, squared = nearest_on_segments(world, segments)
                near = squared <= gate * gate
                normal, world = normals[index[near]], world[near]
                error = np.sum(normal * (world - target[near]), axis=1)
                about_mount = _moment(world - apply(poses[r], mounts[m, :2]), normal)
                by_mount = np.column_stack([normal @ rotation(poses[r, 2]), about_mount])
                by_pose = np.column_stack([normal, _moment(world - poses[r, :2], normal)])
                jacobian = np.hstack([by_mount, by_pose])
                own = np.r_[3 * m : 3 * m + 3, of_poses[r] : of_poses[r] + 3]
                information[np.ix_(own, own)] += jacobian.T @ jacobian
                gradient[own] += jacobian.T @ error
                squares, readings = squares + error @ error, readings + len(error)
        variance = max(squares / max(readings, 1), _LEAST_SIGMA_M**2)
        information /= variance
        gradient /= variance
        for at, prior, missing in zip(of_poses, of_priors, pose_differences(poses, priors)):
            information[at : at + 3, at : at + 3] += prior
            gradient[at : at + 3] += prior @ missing
        seen = np.diagonal(information)[: 3 * count].reshape(-1, 3).min(axis=1) > 0.0
        # The mounts of others stay as they are.
        information[np.arange(3 * count), np.arange(3 * count)] += np.repeat(~seen, 3)
        try:
            covariance = np.asarray(np.linalg.inv(information), np.float64)
        except np.linalg.LinAlgError:
            return None
        step = -covariance @ gradient
        mounts = mounts + step.reshape(-1, 3)[:count]
        poses = poses + step.reshape(-1, 3)[count:]
    if (rms_m := math.sqrt(squares / max(readings, 1))) > _LARGEST_RMS_M:
        raise GeometryError(
            f"mounts are not refined: readings on walls are {1e3 * rms_m:.0f} mm off (rms); are "
            "the scanners mounted as stated, within some centimetres and degrees?"
        )
    scanners = tuple(s for s, there in zip(every[0].scanners, seen) if there)
    own = np.flatnonzero(np.repeat(seen, 3))
    return RefinedMounts(scanners, mounts[seen], covariance[np.ix_(own, own)])


def _moment(arms: FloatArray, normals: FloatArray) -> FloatArray:
    """(N,) derivatives of points along the normals by a rotation of their arms (m/rad)."""
    return np.asarray(arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0])
