"""Motion and measurement models of a robot on the floor, with Jacobians, and odometry noise.

A pose is (x, y, theta): the robot's origin in the map (m), and the rotation of its axes against the
map's (rad, counter-clockwise). An odometry step (dx, dy, dphi) is the pose after a movement in the
robot frame before it. Robot frame: X left, Y backward, so a bearing is atan2(x, -y): 0 forward,
positive to the left. Everything is vectorised over leading axes. f and J1 to J6: see the report.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray
from redetect.bounds import Bounded, NotNegative, Positive
from redetect.plane import apply, apply_inverse, between, rotation, with_heading
from redetect.slam.errors import SlamError

#: Typical height of the camera above the floor (m).
CAMERA_HEIGHT_M = 1.5


@dataclass(frozen=True)
class OdometryNoise(Bounded, error=SlamError):
    """Standard deviations of odometry steps without a covariance."""

    per_metre: NotNegative = 0.05  # of the distance, relative to it
    per_radian: NotNegative = 0.05  # of the turn, relative to it
    turn_per_metre: NotNegative = 0.03  # of the turn due to the distance, radians per metre
    least_m: Positive = 0.005  # lower bound for the distance, metres
    least_rad: Positive = 0.002  # lower bound for the turn, radians

    def covariance(self, steps: FloatArray) -> FloatArray:
        """(N, 3, 3) covariances of (N, 3) steps dx, dy (m), dphi (rad)."""
        distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
        of_distance = (self.per_metre * distance) ** 2 + self.least_m**2
        of_turn = (self.per_radian * turn) ** 2 + (self.turn_per_metre * distance) ** 2
        diagonal = np.stack([of_distance, of_distance, of_turn + self.least_rad**2], axis=-1)
        return np.asarray(diagonal[:, :, None] * np.eye(3))

    def sentence(self) -> str:
        """Description of the assumed noise."""
        return (
            f"{100.0 * self.per_metre:g} % of distance, {100.0 * self.per_radian:g} % of the turn "
            f"and {self.turn_per_metre:g} rad per metre, at least {self.least_m:g} m and "
            f"{self.least_rad:g} rad"
        )


def move(pose: ArrayLike, step: ArrayLike) -> FloatArray:
    """Motion model f: the pose after an odometry step; theta is not wrapped.

    Takes `pose` (..., 3), `step` (..., 3); returns (..., 3).
    """
    before, moved = np.broadcast_arrays(pose, step)
    xy, theta = apply(before, moved[..., :2]), (before + moved)[..., 2:]
    return np.concatenate([xy, theta], axis=-1, dtype=np.float64)


def in_turned_axes(covariance: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Covariances (N, 3, 3) of steps in axes rotated by angles (N,).

    Rotated by their own dphi, they are in the axes at the end, as errors of SE(2) edges.
    """
    turn = with_heading(np.swapaxes(rotation(angle_rad), 1, 2))
    turned = turn @ covariance @ np.swapaxes(turn, 1, 2)
    return np.asarray(0.5 * (turned + np.swapaxes(turned, 1, 2)))


def move_jacobians(pose: ArrayLike, step: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `move` with respect to the pose (J1) and to the step (J2).

    Takes `pose, step` (..., 3); returns `by_pose, by_step` (..., 3, 3).
    """
    before, moved = np.broadcast_arrays(pose, step)
    turn = rotation(before[..., 2])
    shift = np.einsum("...ij,...j->...i", turn, moved[..., :2])
    by_pose = with_heading(np.broadcast_to(np.eye(2), turn.shape))
    by_pose[..., 0, 2], by_pose[..., 1, 2] = -shift[..., 1], shift[..., 0]
    return by_pose, with_heading(turn)


def between_jacobians(first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `between` with respect to the first (J3) and to the second pose (J4).

    Takes `first, second` (..., 3); returns `by_first, by_second` (..., 3, 3).
    """
    before, _ = np.broadcast_arrays(first, second)
    step = between(first, second)
    by_second = with_heading(np.swapaxes(rotation(before[..., 2]), -1, -2))
    by_first = -by_second
    by_first[..., 0, 2], by_first[..., 1, 2] = step[..., 1], -step[..., 0]
    return by_first, by_second


def disc_in_robot(pose: ArrayLike, disc_xy: ArrayLike) -> FloatArray:
    """Measurement model of a disc: its centre in the robot frame.

    Takes `pose` (..., 3) of the robot and `disc_xy` (..., 2), both in the map; returns (..., 2).
    """
    return apply_inverse(pose, disc_xy)


def disc_jacobians(pose: ArrayLike, disc_xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `disc_in_robot` with respect to the pose (J5) and to the disc's centre (J6).

    Returns `by_pose` (..., 2, 3), `by_disc` (..., 2, 2).
    """
    seen = disc_in_robot(pose, disc_xy)
    turn = np.swapaxes(rotation(np.asarray(pose)[..., 2]), -1, -2)
    by_disc = np.array(np.broadcast_to(turn, (*seen.shape, 2)))
    turned = np.stack([seen[..., 1], -seen[..., 0]], axis=-1)
    return np.concatenate([-by_disc, turned[..., None]], axis=-1), by_disc


def tilt_jacobian(disc_xy: FloatArray, height_m: float = CAMERA_HEIGHT_M) -> FloatArray:
    """(n, 2, 2) derivatives of apparent floor positions (n, 2) with respect to a small tilt."""
    x, y = disc_xy.T
    rows = (x * y / height_m, -height_m - x**2 / height_m)
    others = (height_m + y**2 / height_m, -x * y / height_m)
    return np.stack([np.stack(rows, -1), np.stack(others, -1)], axis=1)


def common_tilt_jacobian(disc_xy: FloatArray) -> FloatArray:
    """Derivative of apparent floor positions with respect to a tilt about the robot's origin.

    As `tilt_jacobian`, but for a tilt that stays: the place below the robot is its origin.
    """
    return tilt_jacobian(disc_xy) - tilt_jacobian(np.zeros((1, 2)))


def bearing_of_vertical(pose: ArrayLike, line_xy: ArrayLike, camera_xy: ArrayLike) -> FloatArray:
    """Measurement model of a vertical line: the bearing under which the camera sees it.

    Takes `pose` (..., 3), `line_xy` (..., 2), both in the map, and `camera_xy` (2,), the camera's
    centre in the robot frame; returns (...) in [-pi, pi].
    """
    seen = disc_in_robot(pose, line_xy) - np.asarray(camera_xy, dtype=np.float64)
    return np.asarray(np.arctan2(seen[..., 0], -seen[..., 1]))


def bearing_jacobians(
    pose: ArrayLike, line_xy: ArrayLike, camera_xy: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `bearing_of_vertical` with respect to the pose and to the line's position.

    Returns `by_pose` (..., 3), `by_line` (..., 2).
    """
    seen = disc_in_robot(pose, line_xy) - np.asarray(camera_xy, dtype=np.float64)
    squared = np.sum(seen**2, axis=-1)
    # d atan2(x, -y) = (-y dx + x dy) / (x^2 + y^2)
    by_seen = np.stack([-seen[..., 1], seen[..., 0]], axis=-1) / squared[..., None]
    by_pose, by_line = (
        np.asarray(np.einsum("...i,...ij->...j", by_seen, by))
        for by in disc_jacobians(pose, line_xy)
    )
    return by_pose, by_line
