"""Measurements of landmarks in the map from a pose, with Jacobians (the report's J5, J6).

Robot frame: X left, Y backward, so a bearing is atan2(x, -y): 0 forward, positive to the left.
Everything is vectorised over leading axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray


def disc_in_robot(pose: ArrayLike, disc_xy: ArrayLike) -> FloatArray:
    """Measurement model of a disc: its centre in the robot frame.

    Parameters
    ----------
    pose : (..., 3) array_like
        x, y (m), theta (rad) of the robot in the map.
    disc_xy : (..., 2) array_like
        The disc's centre in the map (m).

    Returns
    -------
    (..., 2) float64
        The centre in the robot frame (m).
    """
    robot = np.asarray(pose, dtype=np.float64)
    offset = np.asarray(disc_xy, dtype=np.float64) - robot[..., :2]
    cos, sin = np.cos(robot[..., 2]), np.sin(robot[..., 2])
    return np.stack(
        [
            cos * offset[..., 0] + sin * offset[..., 1],
            -sin * offset[..., 0] + cos * offset[..., 1],
        ],
        axis=-1,
    )


def disc_jacobians(pose: ArrayLike, disc_xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `disc_in_robot` by the pose (J5) and by the disc's centre (J6).

    Returns `by_pose` (..., 2, 3), `by_disc` (..., 2, 2).
    """
    robot = np.asarray(pose, dtype=np.float64)
    seen = disc_in_robot(pose, disc_xy)
    cos, sin = np.cos(robot[..., 2]), np.sin(robot[..., 2])
    by_disc = np.zeros((*seen.shape, 2))
    by_disc[..., 0, 0] = by_disc[..., 1, 1] = cos
    by_disc[..., 0, 1], by_disc[..., 1, 0] = sin, -sin
    by_pose = np.zeros((*seen.shape, 3))
    by_pose[..., :2] = -by_disc
    by_pose[..., 0, 2], by_pose[..., 1, 2] = seen[..., 1], -seen[..., 0]
    return by_pose, by_disc


def disc_in_map(pose: ArrayLike, seen_xy: ArrayLike) -> FloatArray:
    """Inverse measurement model of a disc: where in the map it lies.

    Takes `pose` (..., 3), `seen_xy` (..., 2); returns (..., 2).
    """
    robot = np.asarray(pose, dtype=np.float64)
    seen = np.asarray(seen_xy, dtype=np.float64)
    cos, sin = np.cos(robot[..., 2]), np.sin(robot[..., 2])
    return np.stack(
        [
            robot[..., 0] + cos * seen[..., 0] - sin * seen[..., 1],
            robot[..., 1] + sin * seen[..., 0] + cos * seen[..., 1],
        ],
        axis=-1,
    )


def bearing_of_vertical(pose: ArrayLike, line_xy: ArrayLike, camera_xy: ArrayLike) -> FloatArray:
    """Measurement model of a vertical line: the bearing under which the camera sees it.

    Parameters
    ----------
    pose : (..., 3) array_like
        The robot's pose in the map.
    line_xy : (..., 2) array_like
        Position of the line in the map (m).
    camera_xy : (2,) array_like
        (cx, cy): the camera's centre in the robot frame (m), from `sensor2World`.

    Returns
    -------
    (...) float64
        Bearing (rad) in [-pi, pi].
    """
    seen = disc_in_robot(pose, line_xy) - np.asarray(camera_xy, dtype=np.float64)
    return np.asarray(np.arctan2(seen[..., 0], -seen[..., 1]))


def bearing_jacobians(
    pose: ArrayLike, line_xy: ArrayLike, camera_xy: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Jacobians of `bearing_of_vertical` by the pose and by the line's place (chain rule).

    Returns `by_pose` (..., 3), `by_line` (..., 2).
    """
    seen = disc_in_robot(pose, line_xy) - np.asarray(camera_xy, dtype=np.float64)
    squared = np.sum(seen**2, axis=-1)
    # d atan2(x, -y) = (-y dx + x dy) / (x^2 + y^2)
    by_seen = np.stack([-seen[..., 1], seen[..., 0]], axis=-1) / squared[..., None]
    by_pose, by_line = disc_jacobians(pose, line_xy)
    return (
        np.asarray(np.einsum("...i,...ij->...j", by_seen, by_pose)),
        np.asarray(np.einsum("...i,...ij->...j", by_seen, by_line)),
    )
