"""Rigid motions: robot poses on the floor, tilt of the robot, and what the camera makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from camera import Camera
from tools.simulator.scene import FloatArray


def world_from_robot(pose: ArrayLike) -> FloatArray:
    """(4, 4) transform of a robot at (x, y, heading): metres, radians; level."""
    x, y, heading = np.asarray(pose, dtype=np.float64)
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def level_from_tilted(tilt_rad: ArrayLike) -> FloatArray:
    """(4, 4) rotation of a tilted robot about its origin on the floor.

    Parameters
    ----------
    tilt_rad : (2,) array
        (p, q): the rotation is exp([p, q, 0]x), about the axis (p, q, 0) of the robot frame by the
        angle |(p, q)|. p > 0 raises the robot's rear (its camera looks lower), q > 0 lowers its
        left side.

    Returns
    -------
    (4, 4) array
    """
    from scipy.spatial.transform import Rotation

    p, q = np.asarray(tilt_rad, dtype=np.float64)
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([p, q, 0.0]).as_matrix()
    return transform


def relative_pose(before: ArrayLike, after: ArrayLike) -> FloatArray:
    """Poses in the robot frames of other poses: what odometry measures.

    Parameters
    ----------
    before, after : (..., 3) arrays
        x, y (m) and heading (rad).

    Returns
    -------
    (..., 3) array
        dx, dy (m), dphi (rad) in (-pi, pi].
    """
    a, b = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    dphi = b[..., 2] - a[..., 2]
    dphi = np.pi - np.mod(np.pi - dphi, 2.0 * np.pi)
    return np.stack([c * dx + s * dy, -s * dx + c * dy, dphi], axis=-1)


def world_to_robot(pose: ArrayLike, world_xy: ArrayLike) -> FloatArray:
    """Points of the world's floor in the frame of a level robot.

    Parameters
    ----------
    pose : (3,) array
        x, y (m) and heading (rad) of the robot in the world.
    world_xy : (..., 2) array
        Points (m).

    Returns
    -------
    (..., 2) array
        Robot X (left), Y (backward), metres.
    """
    x, y, heading = np.asarray(pose, dtype=np.float64)
    c, s = np.cos(heading), np.sin(heading)
    off = np.asarray(world_xy, dtype=np.float64) - (x, y)
    return np.stack(
        [c * off[..., 0] + s * off[..., 1], -s * off[..., 0] + c * off[..., 1]], axis=-1
    )


def tilted_camera(camera: Camera, tilt_rad: ArrayLike) -> Camera:
    """The camera of a tilted robot, its pose relative to the level robot frame."""
    pose = np.vstack([np.array(camera.robot_from_camera), [0.0, 0.0, 0.0, 1.0]])
    return with_mounting(camera, (level_from_tilted(tilt_rad) @ pose)[:3])


def with_mounting(camera: Camera, robot_from_camera: ArrayLike) -> Camera:
    """The same camera mounted elsewhere: (3, 4) transform camera -> robot."""
    rows = tuple(
        (float(a), float(b), float(c), float(d))
        for a, b, c, d in np.asarray(robot_from_camera, dtype=np.float64)
    )
    return replace(camera, robot_from_camera=rows)
