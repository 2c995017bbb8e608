"""Reference poses refined by ICP of the on-board scanners' readings to the building.

The robot is at rest, so its readings are averaged first. The pose from distances is the prior: ICP
starts there, and the two results are combined by their covariances, unless the walls leave a
direction undetermined or the results disagree. If distances leave several poses, the walls decide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtrc

from redetect.array_types import FloatArray
from redetect.groundtruth.clocks.clock import ClockModel
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.lasers.icp import IcpResult, IcpSettings, icp_to_segments
from redetect.groundtruth.lasers.scanners import Scanner, Scans
from redetect.groundtruth.validation.reference_poses import DistancePose
from redetect.landmarks import wrap_angle
from redetect.plane import apply

ScanStatus = Literal["used", "undetermined", "disagrees", "moved", "no scans", "not asked"]

# Beams with fewer readings than this share near their median, as at edges, give no point.
_FEWEST_READINGS = 0.5
# Along a corridor only the beams to its ends change; a passer-by hides fewer than these.
_MOVED_SHARE = 0.25
_QUANTUM_M = 0.01
# The robot is at rest for this long before and after the distances' time; it has moved if a quarter
# of the beams change by more than this within that time.
_STILL_S = 0.5
_MOVED_M = 0.03
# Gates of successive ICPs, the share of the best matches that counts, and how well the walls must
# determine each direction.
_GATES_M = (0.2, 0.1, 0.05)
_KEPT = 0.95
_WEAK_SIGMA_M = 0.05
# Distances and walls disagree if right ones would by as much in less than this share.
_DISAGREEMENT_PROBABILITY = 1e-4
# The walls decide among several poses if at least this share of the points is on a wall, and the
# share at the next pose is smaller by at least this fraction.
_LEAST_SHARE = 0.5
_MOUNT_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Onboard:
    """A scanner on board and its scans, on the robot's clock."""

    scanner: Scanner  # Its pose is in the robot's frame
    scans: Scans


@dataclass(frozen=True, eq=False)
class StillPoints:
    """Readings of the on-board scanners while the robot was at rest."""

    scanner_points: tuple[FloatArray, ...]  # Averaged points in each scanner's frame (m)
    scanners: tuple[Scanner, ...]

    def robot_points(self, mounts: Sequence[FloatArray] | None = None) -> FloatArray:
        """(N, 2) all points in the robot's frame, by other mounts (x, y, theta) if given."""
        mounts = [scanner.pose for scanner in self.scanners] if mounts is None else mounts
        return np.concatenate([apply(m, p) for m, p in zip(mounts, self.scanner_points)])


@dataclass(frozen=True, eq=False)
class ReferencePose:
    """A reference pose, and how it came about."""

    distances: DistancePose
    pose: FloatArray  # (3,): x, y (m), theta (rad)
    covariance: FloatArray  # (3, 3)
    # `used`; `undetermined`: the walls leave a direction open; `disagrees`: with the distances;
    # `moved`: the robot was not at rest; `no scans`: too few readings are on walls; `not asked`.
    scans: ScanStatus
    note: str  # Remarks
    points: int = 0  # Points of the scans on walls that count
    rms_m: float = math.nan  # Of their distances from the walls; NaN without.
    still: StillPoints | None = None  # What the scanners on board saw, at rest

    @property
    def index(self) -> int:
        """Its number in the file of distances."""
        return self.distances.index

    @property
    def time_s(self) -> float:
        """When it was measured, on the ground truth's clock."""
        return self.distances.time_s


@dataclass(frozen=True)
class Refused:
    """A pose that is no reference, and why."""

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
    """Poses from distances, refined by scans where these help.

    Parameters
    ----------
    distances : sequence of DistancePose
        From `redetect.groundtruth.validation.reference_poses.poses_from_distances`.
    onboard : sequence of Onboard
        Scanners on board; without any, distances alone count.
    segments : (S, 4) array, optional
        The building's walls, needed with scanners.
    clock : ClockModel, optional
        Without it the robot's clock is assumed to be the ground truth's.

    Returns
    -------
    refused : list of Refused
        Those that distances leave ambiguous, undetermined or inconsistent.
    """
    references: list[ReferencePose] = []
    refused: list[Refused] = []
    for d in distances:
        reference, reason = None, d.reason
        if d.status in ("ok", "ambiguous") and onboard and segments is not None:
            time = d.time_s if clock is None else float(clock.robot_times([d.time_s])[0])
            reason = f"{d.reason}; the walls do not decide"
            try:
                reference = refine_pose(d, still_points(onboard, time), segments)
            except GeometryError as error:
                if d.status == "ok":
                    reference = _unrefined(d, "moved", str(error))
        elif d.status == "ok":
            reference = _unrefined(d, "not asked")
        if reference is None:
            refused.append(Refused(d.index, d.time_s, d.status, reason))
        else:
            references.append(reference)
    return references, refused


def _unrefined(
    d: DistancePose,
    scans: ScanStatus,
    reason: str = "",
    chosen: int = 0,
    still: StillPoints | None = None,
) -> ReferencePose:
    """The pose by distances alone."""
    note = "; ".join(part for part in (d.reason, reason) if part)
    pose, covariance = d.candidates[chosen], d.covariances[chosen]
    return ReferencePose(d, pose, covariance, scans, note, still=still)


def still_points(onboard: Sequence[Onboard], time_s: float) -> StillPoints:
    """Average the readings of the on-board scanners about a time.

    `time_s`: on the robot's clock.
    """
    clouds, changes = [], [np.zeros(0)]
    for board in onboard:
        ranges = board.scans.ranges_mm[np.abs(board.scans.times_s - time_s) <= _STILL_S]
        if not len(ranges):
            clouds.append(np.zeros((0, 2)))
            continue
        metres = np.where(board.scanner.has_return(ranges), 1e-3 * ranges, np.nan)
        middle = _median(metres)
        half = len(metres) // 2
        if half >= 2:
            changes.append(np.abs(_median(metres[half:]) - _median(metres[:half])))
        # Readings of passers-by and at edges of objects are far from the beam's median.
        near = np.abs(metres - middle) <= 4.0 * board.scanner.sigma_m + _QUANTUM_M
        steady = np.mean(near, axis=0) >= _FEWEST_READINGS
        mean = np.where(near, metres, 0.0).sum(axis=0)[steady] / near.sum(axis=0)[steady]
        angles = board.scanner.angles_rad[steady]
        clouds.append(np.column_stack([mean * np.cos(angles), mean * np.sin(angles)]))
    change = np.concatenate(changes)
    change = change[np.isfinite(change)]
    if len(change) and (typical := float(np.quantile(change, 1.0 - _MOVED_SHARE))) > _MOVED_M:
        raise GeometryError(
            f"moved: a quarter of the beams change by more than {typical:.3f} m: expected a robot "
            f"at rest for {2.0 * _STILL_S:g} s"
        )
    return StillPoints(tuple(clouds), tuple(board.scanner for board in onboard))


def refine_pose(
    distances: DistancePose, points: StillPoints, segments: FloatArray
) -> ReferencePose | None:
    """Combine what distances and walls say of a pose.

    Parameters
    ----------
    distances : DistancePose
        Of status `ok`, or `ambiguous`: then the walls decide, or nothing does.
    segments : (S, 4) array
        The building's walls (m).

    Returns
    -------
    ReferencePose or None
        None if several poses fit and the walls do not decide.
    """
    cloud = points.robot_points()
    chosen = 0
    if distances.status == "ambiguous":
        decided = _decided(distances, cloud, segments)
        if decided is None:
            return None
        chosen = decided
    prior, covariance = distances.candidates[chosen], distances.covariances[chosen]
    try:
        found = _aligned(cloud, segments, prior)
    except (GeometryError, GroundTruthError) as error:
        return _unrefined(distances, "no scans", str(error), chosen)
    if len(found.undetermined) or not np.isfinite(found.covariance).all():
        reason = "the walls leave a direction open"
        return _unrefined(distances, "undetermined", reason, chosen, points)
    own = found.covariance + _mount_covariance(points, segments, found)
    apart = found.pose - prior
    apart[2] = wrap_angle(apart[2])
    misfit = float(apart @ np.linalg.solve(own + covariance, apart))
    if chdtrc(3, misfit) < _DISAGREEMENT_PROBABILITY:
        reason = (
            f"{1e3 * math.hypot(apart[0], apart[1]):.0f} mm and {math.degrees(apart[2]):.2f} deg "
            "from the pose by distances, more than both allow"
        )
        return _unrefined(distances, "disagrees", reason, chosen, points)
    gain = np.linalg.solve(own + covariance, covariance).T
    pose = prior + gain @ apart
    pose[2] = wrap_angle(pose[2])
    # Joseph's form stays symmetric and positive.
    rest = np.eye(3) - gain
    combined = rest @ covariance @ rest.T + gain @ own @ gain.T
    points_used = int(found.used.sum())
    return ReferencePose(
        distances, pose, combined, "used", distances.reason, points_used, found.rms_m, points
    )


def _aligned(cloud: FloatArray, segments: FloatArray, start: FloatArray) -> IcpResult:
    if not len(cloud):
        raise GeometryError("no readings of a scanner on board about this time")
    found: IcpResult | None = None
    for gate in _GATES_M:
        settings = IcpSettings(gate, _KEPT, weak_sigma_m=_WEAK_SIGMA_M)
        found = icp_to_segments(cloud, segments, start, settings)
        start = found.pose
    assert found is not None
    return found


def _mount_covariance(points: StillPoints, segments: FloatArray, found: IcpResult) -> FloatArray:
    """(3, 3) what the scanners' mounts, known only so well, do to the pose."""
    total = np.zeros((3, 3))
    mounts = [scanner.pose for scanner in points.scanners]
    for k, scanner in enumerate(points.scanners):
        if not scanner.covariance.any():
            continue
        effect = np.zeros((3, 3))
        for axis in range(3):
            ends = []
            for sign in (1.0, -1.0):
                other = [mount.copy() for mount in mounts]
                other[k][axis] += sign * _MOUNT_STEP
                cloud = points.robot_points(other)
                ends.append(_aligned(cloud, segments, found.pose).pose)
            change = ends[0] - ends[1]
            change[2] = wrap_angle(change[2])
            effect[:, axis] = change / (2.0 * _MOUNT_STEP)
        total += effect @ scanner.covariance @ effect.T
    return total


def _decided(distances: DistancePose, cloud: FloatArray, segments: FloatArray) -> int | None:
    """Which candidate's points are on walls, if those of one only are."""
    shares = []
    for pose in distances.candidates:
        try:
            shares.append(float(_aligned(cloud, segments, pose).used.mean()))
        except (GeometryError, GroundTruthError):
            shares.append(0.0)
    order = np.argsort(shares)[::-1]
    best, next_best = shares[order[0]], shares[order[1]]
    if best < _LEAST_SHARE or next_best > (1.0 - _LEAST_SHARE) * best:
        return None
    return int(order[0])


def _median(metres: FloatArray) -> FloatArray:
    """(readings,) medians of each beam's returns; NaN where most scans had none."""
    enough = np.mean(np.isfinite(metres), axis=0) >= _FEWEST_READINGS
    middle = np.full(metres.shape[1], np.nan)
    middle[enough] = np.nanmedian(metres[:, enough], axis=0)
    return middle
