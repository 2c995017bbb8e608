"""Tracking the robot by fixed scanners, one set of scans after the other.

Per set: select the readings that are new against the background and within the robot's reach; run a
trimmed ICP of the outline from the predicted pose; refine the result to the most likely pose; check
that the beams agree. Errors of one set affect the next one's pose only through its start.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from scipy.ndimage import convolve1d
from scipy.stats import trim_mean

from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.lasers.acquisition import LEAST_READINGS, MOST_STEPS, ScanSets, acquire
from redetect.groundtruth.lasers.icp import fit_outline, nearest_on_segments
from redetect.groundtruth.lasers.outline import robot_body
from redetect.groundtruth.lasers.scanners import Robot, Scanner
from redetect.groundtruth.lasers.tracking_kernels import (
    GATE_SIGMA,
    BeamCounts,
    Body,
    FixedScanners,
    NewReadings,
    OutlinePose,
    explain_set,
    new_points,
    refine_outline,
)
from redetect.groundtruth.settings import LaserSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle
from redetect.plane import apply, compose, invert, pose_differences, rotation, with_heading

# Gains of the filter that predicts the start for the next set.
_POSE_GAIN, _MOTION_GAIN = 0.4, 0.08
# The ICP ends when its root mean square error changes by less (m).
_THRESHOLD_M = 1e-5
# The robot is lost after this time without a pose, and then searched for at this interval (s).
_COAST_S, _ACQUIRE_S = 0.25, 0.05
# The readings identify the front if the residuals differ by this many standard errors, in this many
# sets at least; otherwise it is known after the robot has driven this much farther forward than
# backward (m).
_FRONT_SIGMA, _FRONT_SETS, _FORWARD_M = 5.0, 5, 0.3
# Residuals over this time show whether covariances are too small (s).
_RESIDUALS_S = 0.48
# Velocities are from this time before and after, at least from this number of sets; the robot is
# lost without a pose in this number of sets at least.
_VELOCITY_WINDOW_S, _VELOCITY_SETS, _COASTED_SETS = 0.3, 2.01, 2.5
_LARGEST_CHI2 = 9.0
# Standard deviation of the start of a fit, by which undetermined directions are held (m).
_PRIOR_M = 0.02
# An outline is moved if readings are farther from it on average (m), or more than half of their
# standard deviation, and at most by this share of its radius.
_OUTLINE_M, _MOST_MOVED, _TRIMMED, _OUTLINE_ROUNDS = 0.003, 0.25, 0.1, 6
_SAMPLE = 60
# A scanner is suspect if the others contradict its pose by more, in standard deviations and in m
# and rad.
_SUSPECT_SIGMA, _SUSPECT_M, _SUSPECT_RAD = 5.0, 0.005, 0.002
# Sets farther apart than both, in seconds and in usual intervals, are not of one block.
_LARGEST_GAP_S, _GAP_INTERVALS = 0.05, 1.5
_AVERAGED_S = 0.08
# Velocities over a shorter time are unknown: the robot counts as at rest.
_LEAST_SPAN_S = 0.05
_DEFAULT = LaserSettings()


class SetStatus(IntEnum):
    """What a set of scans shows of the robot."""

    LOST = 0
    OK = 1
    UNDETERMINED_DIRECTION = 2
    REACQUIRED = 3  #: As `OK`, the first after it was lost
    COASTING = 4  #: There is no pose, but the robot is not lost yet
    FRONT_UNKNOWN = 5

    @property
    def words(self) -> str:
        """As files and messages have it."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, eq=False)
class LaserTrack:
    """Result for every set of scans."""

    times_s: FloatArray  # (N,)
    status: IntArray  # (N,): of `SetStatus`
    visit: IntArray  # (N,): number of the set's acquisition; -1 if the robot is lost
    poses: FloatArray  # (N, 3): x, y (m), theta (rad); NaN without a pose.
    covariances: FloatArray  # (N, 3, 3): from the readings' noise and the scanners' poses
    noise: FloatArray  # (N, 3, 3): the part from the readings' noise, independent from set to set
    motion: FloatArray  # (N, 3): velocity (m/s) and turn (rad/s) in the world
    readings: IntArray  # (N,): number of readings used for the pose
    rms_m: FloatArray  # (N,): their root mean square distance from the outline
    chi2_per_dof: FloatArray  # (N,): their squared normalised residuals per degree of freedom
    beams: FloatArray  # (N, 6): as in `BeamCounts`
    weakest: FloatArray  # (N, 3): least determined direction of x, y, theta times the radius
    reasons: dict[int, str]  # Why a set has no pose, where the robot was expected
    corrections: FloatArray  # (scanners, 3): of their poses, as their residuals suggest
    correction_sigma: FloatArray  # (scanners, 3)
    fronts: dict[int, str]  # How the front was found, by visit
    outline_moved_m: float = 0.0  # By how much its faces were moved outward to fit (m)
    # Standard deviation of its faces from the readings (m), where it is noticed; else 0
    outline_sigma_m: float = 0.0

    @property
    def is_determined(self) -> BoolArray:
        """(N,) whether the pose is valid in all directions."""
        return np.isin(self.status, (SetStatus.OK, SetStatus.REACQUIRED))

    @property
    def seen_through(self) -> float:
        """Share of the beams that should meet the robot, but see the background behind it."""
        counts = BeamCounts(*np.sum(self.beams[self.is_determined], axis=0).astype(int).tolist())
        return counts.through / max(counts.expected, 1)


class Tracker:
    """Follows the robot, which moves no faster than a speed (m/s), through sets of scans."""

    def __init__(
        self, sets: ScanSets, fixed: FixedScanners, body: Body, largest_speed_m_s: float,
        settings: LaserSettings,
    ) -> None:  # fmt: skip
        self.sets, self.fixed, self.body = sets, fixed, body
        self.speed, self.settings = largest_speed_m_s, settings
        n, scanners = len(sets), len(fixed.origins)
        self.track = LaserTrack(
            sets.times_s,
            status=np.full(n, SetStatus.LOST), visit=np.full(n, -1),
            poses=np.full((n, 3), np.nan), covariances=np.full((n, 3, 3), np.nan),
            noise=np.full((n, 3, 3), np.nan), motion=np.zeros((n, 3)),
            readings=np.zeros(n, dtype=np.int64), rms_m=np.full(n, np.nan),
            chi2_per_dof=np.full(n, np.nan), beams=np.zeros((n, 6)), weakest=np.zeros((n, 3)),
            reasons={},
            corrections=np.full((scanners, 3), np.nan),
            correction_sigma=np.full((scanners, 3), np.nan), fronts={},
        )  # fmt: skip
        self.prior_m = np.full(n, _PRIOR_M)
        self.information, self.gradient = np.zeros((scanners, 3, 3)), np.zeros((scanners, 3))

    def run(self) -> LaserTrack:
        """Track, resolve the front, and compute the poses again with their motion known."""
        pose, motion = np.zeros(3), np.zeros(3)
        # Times of the last set, the last pose, the last one determined in all directions, and the
        # last search.
        before_s = posed_s = determined_s = searched_s = -math.inf
        visit, begun, tracked = -1, 0, False
        coast_s = max(_COAST_S, _COASTED_SETS * _interval_s(self.sets.times_s))
        for i, t in enumerate(self.sets.times_s.tolist()):
            tracked = tracked and t - posed_s <= coast_s
            if not tracked:
                if t - searched_s < _ACQUIRE_S:
                    continue
                searched_s = t
                # From the scans of this set alone, if they show the robot.
                found = acquire(self.sets[i], self.fixed, self.body, self.settings)
                if found is None:
                    continue
                with suppress(GeometryError):
                    pose, motion = self._fit(i, found, np.zeros(3), 0.0), np.zeros(3)
                    if self.track.status[i] == SetStatus.OK:
                        self.track.status[i] = SetStatus.REACQUIRED
                    visit, begun, tracked = visit + 1, i, True
                    posed_s = before_s = determined_s = t
                    self.track.visit[i] = visit
                continue
            step, before_s = t - before_s, t
            predicted = pose + motion * step
            self.track.visit[i] = visit
            # Undetermined directions: as uncertain as the motion since they were last determined.
            self.prior_m[i] = _PRIOR_M + 0.5 * self.speed * (t - determined_s)
            try:
                fitted = self._fit(i, predicted, motion, t - posed_s)
            except GeometryError as reason:
                self.track.reasons[i] = str(reason)
                self.track.status[i], pose = SetStatus.COASTING, predicted
                continue
            error = pose_differences(fitted, predicted)
            # At first the motion is unknown, and follows the poses more quickly.
            young = max(0.0, 1.0 - (i - begun) / 12.0)
            pose = predicted + (_POSE_GAIN + (1.0 - _POSE_GAIN) * young) * error
            if step > 0.0:
                motion = motion + (_MOTION_GAIN + 0.3 * young) / step * error
            posed_s = t
            determined_s = t if self.track.status[i] == SetStatus.OK else determined_s
        return self._finished()

    def _fit(
        self, i: int, predicted: FloatArray, motion: FloatArray, unseen_s: float
    ) -> FloatArray:
        """Pose of set i near a prediction over `unseen_s` without poses, or a `GeometryError`."""
        seen = self._points(i, predicted, motion, unseen_s)
        if len(seen.points) < LEAST_READINGS:
            raise GeometryError(f"{len(seen.points)} new readings where the robot should be")
        start, count = self._aligned(seen, predicted)
        if count < LEAST_READINGS:
            gate_m = self.settings.gate_m
            raise GeometryError(f"{count} readings within {gate_m:g} m of the outline")
        # People beside the robot pull the ICP, so the prediction is refined, too, and the pose that
        # more readings fit is taken.
        found = min(
            (self._refined(seen, at, self.prior_m[i]) for at in (start, predicted)),
            key=lambda one: one.chi2 - GATE_SIGMA**2 * one.used,
        )
        pose, used, chi2 = found.pose, found.used, found.chi2
        if used < LEAST_READINGS:
            raise GeometryError(f"{used} readings on the outline")
        if chi2 > _LARGEST_CHI2 * (used - 3.0):
            raise GeometryError(f"squared normalised residuals {chi2:.0f} of {used} readings")
        far = math.hypot(pose[0] - predicted[0], pose[1] - predicted[1])
        if far > 0.1 + 2.0 * self.speed * unseen_s:
            raise GeometryError(f"{far:.2f} m from where the robot should be")
        beams = explain_set(self.sets[i], self.fixed, self.body, pose)
        if beams.through > 0.25 * (beams.agree + beams.through) + 2.0:
            raise GeometryError(
                f"{beams.through} beams see through the robot, {beams.agree} see it"
            )
        self._store(i, found, beams)
        return pose

    def _aligned(self, seen: NewReadings, start: FloatArray) -> tuple[FloatArray, int]:
        """Pose by the trimmed ICP from a start, and the number of readings used."""
        s = self.settings
        pose, _, count = fit_outline(
            seen.points, self.body.faces, start, s.gate_m, s.keep, _THRESHOLD_M, MOST_STEPS
        )
        return pose, count

    def _points(self, i: int, pose: FloatArray, motion: FloatArray, unseen_s: float) -> NewReadings:
        """New readings of set i where the robot may be."""
        centre = apply(pose, self.body.middle)
        reach = self.body.radius_m + self.settings.gate_m + self.speed * unseen_s
        return new_points(self.sets[i], self.fixed, centre, reach, motion, pose[:2])

    def _refined(self, seen: NewReadings, start: FloatArray, prior_m: float) -> OutlinePose:
        return refine_outline(seen, self.body, start, self.fixed, self.settings.gate_m, prior_m)

    def _store(self, i: int, found: OutlinePose, beams: BeamCounts) -> None:
        calibration = found.by_scanner @ self.fixed.covariance @ found.by_scanner.T
        self.track.noise[i] = found.covariance
        self.track.covariances[i] = found.covariance + calibration
        self.track.weakest[i] = found.weakest
        self.track.poses[i] = found.pose
        self.track.poses[i, 2] = wrap_angle(found.pose[2])
        self.track.readings[i], self.track.rms_m[i] = found.used, found.rms_m
        self.track.chi2_per_dof[i] = found.chi2 / max(found.used - 3.0, 1.0)
        self.track.beams[i] = beams
        undetermined = found.undetermined_directions
        self.track.status[i] = SetStatus.UNDETERMINED_DIRECTION if undetermined else SetStatus.OK

    def _finished(self) -> LaserTrack:
        good = np.flatnonzero(np.isfinite(self.track.poses[:, 0]))
        for visit in np.unique(self.track.visit[good]).tolist():
            rows = good[self.track.visit[good] == visit]
            velocity = _velocities(self.sets.times_s[rows], self.track.poses[rows])
            self.track.fronts[visit] = self._front(rows, velocity)
            velocity = _velocities(self.sets.times_s[rows], self.track.poses[rows])
            self.track.motion[rows] = velocity
            for row, motion in zip(rows.tolist(), velocity):
                self._again(row, motion)
        good = good[np.isfinite(self.track.poses[good, 0])]
        scale = self._scales(good)
        for covariances in (self.track.covariances, self.track.noise):
            covariances[good] *= scale[:, None, None]
        # Corrections of the scanners' poses, by all residuals.
        for k, information in enumerate(self.information):
            values, vectors = np.linalg.eigh(information)
            if values[0] > 1e-9 * max(values[2], 1e-9):
                covariance = (vectors / values) @ vectors.T
                self.track.corrections[k] = -covariance @ self.gradient[k]
                self.track.correction_sigma[k] = np.sqrt(np.diag(covariance))
        return self.track

    def _again(self, i: int, motion: FloatArray) -> None:
        """The pose once more, from the motion before *and* after it."""
        status = int(self.track.status[i])
        seen = self._points(i, self.track.poses[i], motion, 0.0)
        found = self._refined(seen, self.track.poses[i], self.prior_m[i])
        if found.used < LEAST_READINGS:
            self.track.reasons[i] = f"{found.used} readings on the outline"
            self.track.status[i], self.track.poses[i] = SetStatus.COASTING, np.nan
            return
        self._store(i, found, explain_set(self.sets[i], self.fixed, self.body, found.pose))
        # Keeps the result of the whole visit, or of its first set.
        was_reacquired = status == SetStatus.REACQUIRED and self.track.status[i] == SetStatus.OK
        if was_reacquired or status == SetStatus.FRONT_UNKNOWN:
            self.track.status[i] = status
        self.information += found.information
        self.gradient += found.gradient

    def outline_errors(self) -> tuple[float, float, FloatArray]:
        """Errors of the outline, from the readings' distances from it in a sample of the sets.

        The mean of most, outward, and the deviation of the halves of its faces (m), of which poses
        have a covariance (3, 3), in the robot's frame.
        """
        rows = np.flatnonzero(self.track.is_determined)
        faces, normals = self.body.faces, self.body.normals
        off, halves = [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
        for i in rows[np.linspace(0, len(rows) - 1, min(len(rows), _SAMPLE)).astype(np.int64)]:
            pose = self.track.poses[i]
            seen = apply(invert(pose), self._points(i, pose, self.track.motion[i], 0.0).points)
            nearest, face, squared = nearest_on_segments(seen, faces)
            near = squared < self.settings.gate_m**2
            off.append(np.sum((seen - nearest) * normals[face], axis=1)[near])
            to_ends = [np.hypot(*(nearest - faces[face, k : k + 2]).T) for k in (0, 2)]
            halves.append((2 * face + (to_ends[0] > to_ends[1]))[near])
        whole, half = np.concatenate(off), np.concatenate(halves)
        used = np.flatnonzero(np.bincount(half, minlength=2 * len(faces)) >= _SAMPLE)
        if len(used) <= 4:
            return float(trim_mean(whole, _TRIMMED)) if len(whole) else 0.0, 0.0, np.zeros((3, 3))
        face, end = np.divmod(used, 2)
        at = faces[face, :2] + (0.25 + 0.5 * end)[:, None] * (faces[face, 2:] - faces[face, :2])
        turn = at[:, 0] * normals[face, 1] - at[:, 1] * normals[face, 0]
        design = np.column_stack([normals[face], turn, np.ones(len(used))])
        values = np.array([np.median(whole[half == k]) for k in used])
        rest = values - design @ np.linalg.lstsq(design, values)[0]
        sigma_m = math.sqrt(float(rest @ rest) / (len(used) - 4))
        covariance = sigma_m**2 * np.linalg.pinv(design[:, :3].T @ design[:, :3])
        return float(trim_mean(whole, _TRIMMED)), sigma_m, covariance

    def _front(self, rows: IntArray, velocity: FloatArray) -> str:
        """Choose among the poses that the outline hardly distinguishes; returns the criterion.

        First by the readings themselves, in a sample of the sets; if they are ambiguous, by the
        motion: robots drive forward.
        """
        if len(self.body.symmetries) == 0:
            return "outline"
        choices = [np.zeros(3), *self.body.symmetries]
        sample = rows[np.unique(np.linspace(0, len(rows) - 1, _SAMPLE).astype(np.int64))]
        costs = np.array([[self._cost(i, choice) for choice in choices] for i in sample.tolist()])
        best = int(np.argmin(costs.mean(axis=0)))
        worse = np.delete(costs, best, axis=1) - costs[:, best : best + 1]
        sigmas = 0.0
        if len(sample) >= _FRONT_SETS:
            error = worse.std(axis=0, ddof=1) / math.sqrt(len(sample)) + 1e-9
            sigmas = float(np.min(worse.mean(axis=0) / error))
        by = f"outline, by {sigmas:.0f} sigma"
        if sigmas < _FRONT_SIGMA:
            ahead = self._ahead(rows, velocity, choices)
            order = np.argsort(ahead)[::-1]
            best = int(order[0])
            by = f"driven forward, {ahead[best]:.2f} m"
            if ahead[best] - ahead[int(order[1])] < 2.0 * _FORWARD_M:
                self.track.status[rows] = SetStatus.FRONT_UNKNOWN
                return "unknown: the outline does not show it and the robot hardly drove"
        if best > 0:
            self.track.poses[rows] = compose(self.track.poses[rows], choices[best])
            for i in rows.tolist():
                seen = self._points(i, self.track.poses[i], np.zeros(3), 0.0)
                self.track.poses[i], _ = self._aligned(seen, self.track.poses[i])
        return by

    def _cost(self, i: int, choice: FloatArray) -> float:
        """Squared normalised residuals of set i from a choice of its front, those gated at most."""
        start = compose(self.track.poses[i], choice)
        seen = self._points(i, start, np.zeros(3), 0.0)
        start, _ = self._aligned(seen, start)
        found = self._refined(seen, start, _PRIOR_M)
        beams = explain_set(self.sets[i], self.fixed, self.body, found.pose)
        wrong = beams.through + beams.hidden + beams.beside
        return float(found.chi2 + GATE_SIGMA**2 * wrong)

    def _ahead(
        self, rows: IntArray, velocity: FloatArray, choices: list[FloatArray]
    ) -> list[float]:
        """Distance that the robot drove forward, for every choice of its front (m)."""
        times, poses = self.sets.times_s[rows], self.track.poses[rows]
        step = np.diff(times, append=times[-1])
        ahead = []
        for choice in choices:
            heading = poses[:, 2] + choice[2]
            # The same motion at the point that would be the robot's origin.
            arm = compose(poses, np.broadcast_to(choice, poses.shape))[:, :2] - poses[:, :2]
            vx = velocity[:, 0] - velocity[:, 2] * arm[:, 1]
            vy = velocity[:, 1] + velocity[:, 2] * arm[:, 0]
            ahead.append(float(np.sum((np.cos(heading) * vx + np.sin(heading) * vy) * step)))
        return ahead

    def _scales(self, good: IntArray) -> FloatArray:
        """Factors on covariances if residuals exceed noise, over half a second: a set has few."""
        dof = np.maximum(self.track.readings[good] - 3.0, 1.0)
        sets = 2 * round(0.5 * _RESIDUALS_S / max(_interval_s(self.sets.times_s), 1e-3)) + 1
        total, squared = (
            convolve1d(values, np.ones(sets), mode="constant")
            for values in (dof, self.track.chi2_per_dof[good] * dof)
        )
        # A ratio above 1 within its own scatter is not significant.
        ratio = squared / total
        return np.where(ratio > 1.0 + 4.0 * np.sqrt(2.0 / total), ratio, 1.0)


def _interval_s(times_s: FloatArray) -> float:
    """The usual time between sets (s)."""
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


def _velocities(times_s: FloatArray, poses: FloatArray) -> FloatArray:
    """(n, 3) mean velocities in the robot's frame around each time, turned to the world."""
    heading = np.unwrap(poses[:, 2])
    steps = np.diff(poses[:, 0] + 1j * poses[:, 1]) * np.exp(-0.5j * (heading[1:] + heading[:-1]))
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    window_s = max(_VELOCITY_WINDOW_S, _VELOCITY_SETS * _interval_s(times_s))
    first = np.searchsorted(times_s, times_s - window_s)
    last = np.searchsorted(times_s, times_s + window_s, side="right") - 1
    span_s = times_s[last] - times_s[first]
    span_s[span_s < _LEAST_SPAN_S] = np.inf
    ahead = (driven[last] - driven[first]) / span_s * np.exp(1j * heading)
    return np.column_stack([ahead.real, ahead.imag, (heading[last] - heading[first]) / span_s])


def track_by_lasers(
    sets: ScanSets, fixed: FixedScanners, robot: Robot, settings: LaserSettings = _DEFAULT
) -> LaserTrack:
    """Follow the robot through sets of scans (see `redetect.groundtruth.lasers.tracking`).

    If the readings are outside or inside of the outline on all sides, it was drawn too small or too
    large: then its faces are moved, as `outline_moved_m` says.
    """
    allowed_m, moved_m = max(_OUTLINE_M, 0.3 * float(np.max(fixed.sigmas_m))), 0.0
    for _ in range(_OUTLINE_ROUNDS):
        body = robot_body(robot.outline, moved_m)
        tracker = Tracker(sets, fixed, body, robot.largest_speed_m_s, settings)
        track = replace(tracker.run(), outline_moved_m=moved_m)
        off_m, sigma_m, by_outline = tracker.outline_errors()
        if abs(off_m) <= allowed_m or abs(moved_m + off_m) > _MOST_MOVED * body.radius_m:
            break
        moved_m += off_m
    if sigma_m > 0.5 * allowed_m:
        turned = with_heading(rotation(track.poses[:, 2]))
        covariances = track.covariances + turned @ by_outline @ np.swapaxes(turned, 1, 2)
        track = replace(track, outline_sigma_m=sigma_m, covariances=covariances)
    return track


def track_without_suspects(
    sets: ScanSets, fixed: FixedScanners, robot: Robot, scanners: tuple[Scanner, ...],
    settings: LaserSettings = _DEFAULT,
) -> tuple[LaserTrack, dict[str, FloatArray]]:  # fmt: skip
    """Follow the robot, excluding scanners whose readings disagree with the others'.

    The worst is excluded first, while three or more remain. Returns the track and, for the excluded
    ones, the shift that their readings suggest and its standard deviations (2, 3).
    """
    left_out: dict[str, FloatArray] = {}
    while True:
        track = track_by_lasers(sets, fixed, robot, settings)
        excess = excess_shifts(track, scanners)
        worst = int(np.argmax(excess))
        if len(scanners) - len(left_out) < 3 or excess[worst] <= 1.0:
            return track, left_out
        suggested = (track.corrections[worst], track.correction_sigma[worst])
        left_out[scanners[worst].name] = np.stack(suggested)
        sets = replace(sets, rows=np.where(np.arange(len(scanners)) == worst, -1, sets.rows))


def excess_shifts(track: LaserTrack, scanners: tuple[Scanner, ...]) -> FloatArray:
    """(scanners,) ratio of their shifts to the allowed ones; above 1 is suspect."""
    least = np.array([_SUSPECT_M, _SUSPECT_M, _SUSPECT_RAD])
    given = np.array([np.diag(scanner.covariance) for scanner in scanners])
    allowed = _SUSPECT_SIGMA * np.sqrt(track.correction_sigma**2 + given)
    excess = np.max(np.abs(track.corrections) / np.maximum(allowed, least), axis=1)
    return np.where(np.isfinite(track.corrections).all(axis=1), excess, 0.0)


def usual_sets_per_pose(track: LaserTrack) -> int:
    """Number of consecutive sets that are close enough to average, at least 1.

    If the robot speeds up or begins to turn, the mean over a time T is off by a T^2/24: less than
    the noise over this time only.
    """
    interval_s = _interval_s(track.times_s)
    return max(1, round(_AVERAGED_S / interval_s)) if interval_s > 0.0 else 1


def combined_poses(track: LaserTrack, sets_per_pose: int = 1) -> PlanarPoses:
    """Poses of a track, each from `sets_per_pose` consecutive sets; 1: every set separately.

    The sets' poses are propagated to their mean time with the robot's motion and averaged. Every
    set is in one pose only, so that the readings' errors in different poses are independent; those
    of the scanners' poses are common to all and are not averaged out. A block is shorter at the end
    of a visit, and if sets have no determined pose.

    Sets with an undetermined direction become poses of their own, with a matching covariance; those
    with an unknown front are dropped.
    """
    determined = track.is_determined
    rows = np.flatnonzero(determined | (track.status == SetStatus.UNDETERMINED_DIRECTION))
    if not len(rows):
        return PlanarPoses(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    times = track.times_s[rows]
    # A new block begins with a visit, after a gap, and before and after an undetermined set.
    parted = np.ones(len(rows), dtype=np.bool_)
    parted[1:] = (
        (track.visit[rows[1:]] != track.visit[rows[:-1]])
        | (np.diff(times) > max(_LARGEST_GAP_S, _GAP_INTERVALS * _interval_s(track.times_s)))
        | ~determined[rows[1:]]
        | ~determined[rows[:-1]]
    )
    first = np.flatnonzero(parted)
    within = np.arange(len(rows)) - first[np.cumsum(parted) - 1]
    begins = np.flatnonzero(within % sets_per_pose == 0)
    size = np.diff(begins, append=len(rows))
    block = np.repeat(np.arange(len(begins)), size)

    def mean_of(values: FloatArray) -> FloatArray:
        """Means of the sets of each block."""
        return np.asarray((np.add.reduceat(values, begins).T / size).T)

    origin = times[0]
    middle = mean_of(times - origin)
    lead = track.poses[rows[begins]]
    moved = track.poses[rows] + track.motion[rows] * (middle[block] - (times - origin))[:, None]
    # Equal weights: information computed at a wrong pose would favour wrong poses, and with equal
    # weights at the mean time an error of the motion cancels.
    poses = lead + mean_of(pose_differences(moved, lead[block]))
    poses[:, 2] = wrap_angle(poses[:, 2])
    noise = mean_of(track.noise[rows]) / size[:, None, None]
    covariances = noise + mean_of((track.covariances - track.noise)[rows])
    covariances = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    return PlanarPoses(middle + origin, poses, covariances)
