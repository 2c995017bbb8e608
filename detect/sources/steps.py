"""From poses in a fixed frame to the STEP rows of the data set.

A pose (x, y, theta) has the robot's X forward and Y left, as in ROS; a STEP its X left and Y
backward, in the robot's frame before it. Turning by the same angle is the same in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.sources.interface import TimedPose
from landmarks import Step, wrap_angle

FloatArray = NDArray[np.float64]

#: Takes (forward, left, turn) to (left, backward, turn).
DATASET_FROM_ROBOTICS: FloatArray = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

# A covariance of a step that is less definite than this, against that of the pose, is none.
_INDEFINITE = 1e-9


@dataclass(frozen=True)
class Movement:
    """A movement in the data set's axes: (3,) left, backward, turn; (3, 3) covariance or None."""

    pose: FloatArray
    covariance: FloatArray | None


def movement_between(before: TimedPose, after: TimedPose) -> Movement:
    """How a robot moved from one pose to another.

    The covariances of poses are assumed to grow with the path: that of the later pose is that
    of the earlier, carried along, plus that of the movement, independent of it. Where they have
    not (a driver that publishes the same covariance all the time), nothing is known of the
    movement's.

    Parameters
    ----------
    before, after : TimedPose

    Returns
    -------
    Movement
    """
    cos, sin = np.cos(before.theta), np.sin(before.theta)
    robot_from_fixed = np.array([[cos, sin], [-sin, cos]])
    moved = np.array([after.x - before.x, after.y - before.y])
    turn = wrap_angle(after.theta - before.theta)
    pose = DATASET_FROM_ROBOTICS @ np.array([*(robot_from_fixed @ moved), turn])
    if before.covariance is None or after.covariance is None:
        return Movement(pose, None)
    carried = np.eye(3)
    carried[:2, 2] = (-moved[1], moved[0])  # effect of an error of theta on the position
    grown = after.covariance - carried @ before.covariance @ carried.T
    scale = float(np.abs(after.covariance).max())
    if float(np.linalg.eigvalsh(grown).min()) < -_INDEFINITE * scale:
        return Movement(pose, None)
    rotation = np.eye(3)
    rotation[:2, :2] = robot_from_fixed
    to_dataset = DATASET_FROM_ROBOTICS @ rotation
    return Movement(pose, to_dataset @ grown @ to_dataset.T)


def pose_between(before: TimedPose, after: TimedPose, time_s: float) -> TimedPose:
    """The pose at a time between two: linear, the heading the shorter way round.

    Parameters
    ----------
    before, after : TimedPose
    time_s : float
        From the first one's time to the second one's, which are not the same.

    Returns
    -------
    TimedPose
    """
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    covariance = None
    if before.covariance is not None and after.covariance is not None:
        covariance = (1.0 - share) * before.covariance + share * after.covariance
    return TimedPose(
        time_s,
        before.x + share * (after.x - before.x),
        before.y + share * (after.y - before.y),
        before.theta + share * float(wrap_angle(after.theta - before.theta)),
        covariance,
    )


def step_of(prefix: str, movement: Movement | None) -> Step:
    """A STEP row; unknown values (the movement, its covariance) are zero."""
    if movement is None:
        return Step(prefix, *[0.0] * 9)
    c = np.zeros((3, 3)) if movement.covariance is None else movement.covariance
    dx, dy, dphi = (float(value) for value in movement.pose)
    entries = (c[0, 0], c[0, 1], c[1, 1], c[0, 2], c[1, 2], c[2, 2])
    return Step(prefix, dx, dy, dphi, *(float(value) for value in entries))
