"""Poses of the robot over time, and their conversion to the STEP rows of the data set.

A pose (x, y, theta) has X forward and Y left, as in ROS; a STEP has X left and Y backward, in the
robot's frame before the step. Rotations are the same in both. Poses come from TUM trajectories,
rows ``t x y z qx qy qz qw``: seconds, metres, unit quaternions; from wheel encoders, rows ``t left
right``; or from velocities. The robot moves on the floor, so only heading, x and y are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detect.errors import DetectError
from detect.sources.interface import Frames, RunFrame, Source
from redetect.array_types import FloatArray
from redetect.landmarks import Step, wrap_angle
from redetect.landmarks.records import STEP_NUMBERS
from redetect.plane import compose
from redetect.storage.bounded import rows_of_numbers

#: Limit of distances from the start (m), so that products of two remain finite.
FARTHEST = 1e12
#: Longest interval between poses that is interpolated (s), unless poses are slow:
LARGEST_GAP_S = 1.0
_USUAL_GAPS = 1.5  #: then it is this many times the interval before,
_SLOWEST_S = 2.0  #: and at most this (s).
#: Later times since 1970 are not in seconds.
_LATEST_S = 1e11
# A movement that is faster (m/s or rad/s), and this many times as far as the one before, is a jump
# of the odometry, as if it was reset. Steps over it have this covariance.
_FASTEST, _FARTHER = 50.0, 100.0
_LOST: dict[str, Any] = dict(zip(STEP_NUMBERS[3:], (1e6, 0.0, 1e6, 0.0, 0.0, 100.0)))
#: Maps (forward, left, turn) to (left, backward, turn).
DATASET_FROM_ROBOTICS: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

# A step's covariance is invalid if its smallest eigenvalue is below one of these shares:
_INDEFINITE = 1e-8  # of its largest
_ROUNDING = 1e-12  # of the pose's own covariance: rounding errors
# Variance of the rounding of a step's numbers, which files have with five decimals.
_DECIMALS, _ROUNDED = 5, 1e-10 / 12.0
_UNIT = 1e-2  # Tolerance of the length of a trajectory's quaternions.
# Times are written with six digits: the last image may seem to be later than the last pose.
_END_SLACK_S = 1e-3


@dataclass(frozen=True, slots=True)
class TimedPose:
    """A robot's pose: X forward, Y left (m), counterclockwise (rad), in a fixed frame.

    Over time, theta counts full turns: one wheel's counter that jumps turns the robot many times.
    The (3, 3) covariance is that of (x, y, theta) since the start; zero if unknown.
    """

    time_s: float
    x: float
    y: float
    theta: float
    covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    unknown: float = 0.0  #: Movements since the start whose covariance is unknown, not in it


class PoseStream(NamedTuple):
    """Poses of the robot over time: their name in messages, their file, and their reader.

    With `of_arcs`, poses assume arcs from row to row; over a long gap the movement is unknown.
    """

    name: str
    path: Path
    read: Callable[[], Generator[TimedPose, None, None]]
    of_arcs: bool = False


def step_between(prefix: str, before: TimedPose, after: TimedPose) -> Step:
    """The STEP row of a robot's movement from one pose to another.

    The covariances of poses are assumed to grow with the path: that of the later pose is that of
    the earlier one, propagated, plus that of the movement, independent of it. If that is missing
    or singular, or unknown in part, the covariance of the step is zero, which means unknown.
    """
    cos, sin = np.cos(before.theta), np.sin(before.theta)
    moved = np.array([after.x - before.x, after.y - before.y])
    turn = wrap_angle(after.theta - before.theta)
    robot_from_fixed = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    pose = DATASET_FROM_ROBOTICS @ np.array([*(robot_from_fixed[:2, :2] @ moved), turn])
    c = np.zeros((3, 3))
    grown = after.covariance - carried(before.covariance, before, after)
    smallest, _, largest = np.linalg.eigvalsh(grown)
    scale = float(np.abs(after.covariance).max())
    is_known = after.unknown == before.unknown
    if is_known and smallest > max(_INDEFINITE * largest, _ROUNDING * scale):
        to_dataset = DATASET_FROM_ROBOTICS @ robot_from_fixed
        c = to_dataset @ grown @ to_dataset.T + _ROUNDED * np.eye(3)
    return Step(prefix, *pose.tolist(), *c[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]].tolist())


def rounded(step: Step, reached: TimedPose, pose: TimedPose) -> tuple[Step, TimedPose]:
    """A step with as many decimals as in files, and the pose that it leads to.

    It begins where the steps before it lead to, so that their rounding does not add up.
    """
    rest = step_between(step.prefix, reached, pose)
    left, backward, turn = (round(value, _DECIMALS) for value in (rest.dx, rest.dy, rest.dphi))
    start = reached.x, reached.y, reached.theta
    x, y, theta = compose(start, (-backward, left, turn)).tolist()
    return replace(step, dx=left, dy=backward, dphi=turn), replace(pose, x=x, y=y, theta=theta)


def carried(
    covariance: FloatArray, before: TimedPose, after: TimedPose, share: float = 1.0
) -> FloatArray:
    """A pose's covariance, propagated by a share of an exact movement to another one."""
    carry = np.eye(3)  # an error of theta moves the positions after it
    carry[:2, 2] = share * (before.y - after.y), share * (after.x - before.x)
    return np.asarray(carry @ covariance @ carry.T)


def pose_between(before: TimedPose, after: TimedPose, time_s: float) -> TimedPose:
    """The pose at a time between two, by linear interpolation, the heading the shorter way."""
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    grown = after.covariance - carried(before.covariance, before, after)
    return TimedPose(
        time_s,
        before.x + share * (after.x - before.x),
        before.y + share * (after.y - before.y),
        before.theta + share * float(wrap_angle(after.theta - before.theta)),
        carried(before.covariance, before, after, share)
        + share * carried(grown, before, after, share - 1.0),
        before.unknown + share * (after.unknown - before.unknown),
    )


class PosesOverTime:
    """Poses in order, read once; requests must be in order, too."""

    def __init__(self, poses: Iterator[TimedPose], stream: PoseStream) -> None:
        self._poses, self._name, self._of_arcs = poses, stream.name, stream.of_arcs
        self.jumps = self.jumped = False  # now, and since the last step
        self._distance_m = self._turn_rad = 0.0
        self._longest_s = LARGEST_GAP_S
        self._before: TimedPose | None = None
        self._after = next(poses, None)
        if self._after is None:
            raise DetectError(f"{self._name}: no pose in it: expected odometry, or --odometry none")
        self.first_s = self._after.time_s

    def at(self, time_s: float) -> TimedPose | None:
        """The pose at a time; None if unknown, or if a later one was requested before."""
        while self._after is not None and self._after.time_s < time_s:
            if self._before is not None:
                usual_s = _USUAL_GAPS * (self._after.time_s - self._before.time_s)
                self._longest_s = min(max(usual_s, LARGEST_GAP_S), _SLOWEST_S)
            self._before, self._after = self._after, next(self._poses, None)
            if self._after is None:
                break
            distance_m = math.hypot(self._after.x - self._before.x, self._after.y - self._before.y)
            turn_rad = abs(self._after.theta - self._before.theta)
            seconds = self._after.time_s - self._before.time_s
            if seconds < 0.0:
                raise DetectError(
                    f"{self._name}: the pose of {self._after.time_s:.6f} s comes after that of "
                    f"{self._before.time_s:.6f} s: expected times in order"
                )
            if not self._after.time_s < _LATEST_S:
                raise DetectError(
                    f"{self._name}: the time {self._after.time_s:.0f}: expected seconds, not "
                    "nanoseconds"
                )
            fastest = _FASTEST * max(seconds, 1e-3)
            is_reset = distance_m > max(fastest, _FARTHER * self._distance_m)
            is_reset |= turn_rad > max(fastest, _FARTHER * self._turn_rad)
            self.jumps = is_reset or (self._of_arcs and seconds > self._longest_s)
            self.jumped = self.jumped or self.jumps
            self._distance_m, self._turn_rad = distance_m, turn_rad
        before, after = self._before, self._after
        if before is None or after is None:  # before the first pose, or after the last one
            end = after or before
            return end if end and abs(end.time_s - time_s) <= _END_SLACK_S else None
        if after.time_s == time_s:
            return after
        if time_s < before.time_s or after.time_s - before.time_s > self._longest_s:
            return None
        return pose_between(before, after, time_s)


def tum_poses(path: Path) -> Generator[TimedPose, None, None]:
    """The poses of a TUM trajectory."""
    theta = 0.0
    for place, row in rows_of_numbers(path, "TUM trajectory", "t x y z qx qy qz qw", DetectError):
        time_s, x, y, _, *quaternion = row
        if max(abs(x), abs(y)) > FARTHEST:
            raise DetectError(f"{place}: expected x and y of at most {FARTHEST:g} m")
        if abs(math.hypot(*quaternion) - 1.0) > _UNIT:
            raise DetectError(f"{place}: qx qy qz qw: expected a unit quaternion")
        theta += float(wrap_angle(heading_rad(*quaternion) - theta))
        yield TimedPose(time_s, x, y, theta)


def tick_poses(
    path: Path, wheel_base_m: float, metres_per_tick: float
) -> Generator[TimedPose, None, None]:
    """The poses of a differential-drive robot from wheel ticks; arcs from row to row."""

    def arcs() -> Iterator[_Arc]:
        rows = list(rows_of_numbers(path, "file of wheel ticks", "t left right", DetectError))
        driven = metres_per_tick * _ticks(np.reshape([row[1:] for _, row in rows], (-1, 2)))
        for (place, row), (left, right) in zip(rows, driven.tolist()):
            yield _Arc(place, row[0], 0.5 * (left + right), (right - left) / wheel_base_m)

    return _poses_along(arcs())


def velocity_poses(path: Path) -> Generator[TimedPose, None, None]:
    """The poses of a robot from its velocities (m/s, rad/s), each valid until the next row.

    Their noise is white and, for positions, the same in all directions; sigmas are the standard
    deviations of its integral over one second (DLR Spatial Cognition data set report, equation 1).
    """

    def arcs() -> Iterator[_Arc]:
        columns = "t v omega sigma_v sigma_omega"
        last: list[float] = []
        for place, row in rows_of_numbers(path, "file of velocities", columns, DetectError):
            if min(row[3:]) < 0.0:
                raise DetectError(f"{place}: expected sigmas of 0 or more")
            time_s, speed, turning, *sigmas = last or row
            seconds = row[0] - time_s
            deviations = (math.sqrt(max(seconds, 0.0)) * sigma for sigma in sigmas)
            yield _Arc(place, row[0], seconds * speed, seconds * turning, *deviations)
            last = row

    return _poses_along(arcs())


class _Arc(NamedTuple):
    """A movement along an arc, with the row that it is from and the time of its end."""

    place: str
    time_s: float
    distance_m: float
    turn_rad: float
    sigma_m: float = 0.0  # of either coordinate
    sigma_rad: float = 0.0  # of the heading


def _poses_along(arcs: Iterator[_Arc]) -> Generator[TimedPose, None, None]:
    pose = TimedPose(0.0, 0.0, 0.0, 0.0)
    for place, time_s, *movement in arcs:
        if not max(map(abs, movement)) <= FARTHEST:
            raise DetectError(f"{place}: expected distance and turn of at most {FARTHEST:g}")
        distance_m, turn_rad, sigma_m, sigma_rad = movement
        chord = distance_m * float(np.sinc(turn_rad / math.tau))
        middle = pose.theta + 0.5 * turn_rad
        dx, dy = chord * math.cos(middle), chord * math.sin(middle)
        after = TimedPose(time_s, pose.x + dx, pose.y + dy, pose.theta + turn_rad)
        # Errors of the heading arise all along the way: the mean of their effects, and its scatter.
        by_heading = np.array([[-0.5 * dy, 0.5 * dx, 1.0], [-dy, dx, 0.0] / np.sqrt(12.0)])
        errors = np.vstack([sigma_m * np.eye(2, 3), sigma_rad * by_heading])
        covariance = carried(pose.covariance, pose, after) + errors.T @ errors
        pose = replace(after, covariance=covariance)
        yield pose


def _ticks(counts: FloatArray) -> FloatArray:
    """(N, 2) ticks since the row before; counters of 8 to 32 bits may overflow in between.

    They are of the fewest bits, signed or not, that all counts of the file fit in. Only counters
    that usually change by little overflow: a fast one may jump as far without.
    """
    ticks = np.diff(counts, axis=0, prepend=counts[:1])
    for turn in (2.0**8, 2.0**10, 2.0**12, 2.0**14, 2.0**16, 2.0**24, 2.0**32):
        for least in (0.0, -0.5 * turn):
            if np.all((counts >= least) & (counts < least + turn)):
                over = np.where(np.abs(ticks) > 0.75 * turn, np.copysign(turn, ticks), 0.0)
                if turn < 2.0**16:  # so few counts may also be those of a short drive
                    usual = np.abs(ticks[over == 0.0]).max(initial=0.0)
                    over[np.abs(ticks - over) > 2.0 * usual] = 0.0
                shorter = ticks - over
                moves = np.abs(shorter[shorter != 0.0])
                return shorter if np.median(np.append(moves, 0.0)) < 0.25 * turn else ticks
    return ticks


def heading_rad(qx: float, qy: float, qz: float, qw: float) -> float:
    """The heading of a quaternion: direction of the robot's X axis, seen from above (rad)."""
    return math.atan2(2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)


class FramesAlongPoses(Frames):
    """The frames of a source with known poses of the robot over time.

    The pose of an image is interpolated between those before and after it. Images without a pose at
    their time are not part of the run; the first one's step is zero.
    """

    def __init__(self, source: Source, stream: PoseStream) -> None:
        self._source, self._stream = source, stream
        self.images_in_memory, self.expected = source.images_in_memory, source.expected
        self.is_recorded = source.is_recorded
        self.why_left_out = (
            f"images without a time or a pose of {stream.name}, or not in order, or between poses "
            "far apart: left out"
        )

    def __iter__(self) -> Generator[RunFrame, None, None]:
        self.left_out = 0
        with closing(iter(self._source)) as images, closing(self._stream.read()) as read:
            poses = PosesOverTime(read, self._stream)
            last: tuple[TimedPose, TimedPose] | None = None  # and the one to which its steps lead
            missed_s = math.nan
            for image in images:
                pose = None if image.time_s is None else poses.at(image.time_s)
                if pose is None:
                    self.left_out += 1
                    missed_s = missed_s if image.time_s is None else image.time_s
                    continue
                reached = pose
                if last is not None:
                    step = step_between(image.step.prefix, last[0], pose)
                    if poses.jumped:
                        step = replace(step, **_LOST)
                    else:
                        step, reached = rounded(step, last[1], pose)
                    image = replace(image, step=step)
                poses.jumped = poses.jumps
                yield image
                last = pose, reached
            if self.left_out and last is None:
                raise DetectError(
                    f"{self._stream.name}: no pose at the time of any image; the first pose is of "
                    f"{poses.first_s:.3f} s, the last image of {missed_s:.3f} s: expected seconds "
                    "of one clock, in order"
                )
