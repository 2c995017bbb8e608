"""Where a vertical line stands, from two bearings of it: delayed initialisation of EKF-SLAM."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.measurement import bearing_jacobians, disc_in_map
from slam.motion import rotation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """A bearing that waits for a second one.

    Attributes
    ----------
    slot : int
        Where in the state the pose of that frame is kept.
    frame : int
        The frame.
    bearing_rad, sigma_rad : float
        The row.
    """

    slot: int
    frame: int
    bearing_rad: float
    sigma_rad: float


@dataclass(frozen=True, eq=False)
class Intersection:
    """A line found from two bearings.

    Attributes
    ----------
    xy : (2,) float64
        Where it stands in the map (m).
    parallax_rad : float
        Angle between both rays.
    """

    xy: FloatArray
    parallax_rad: float


def intersect(
    first_pose: ArrayLike,
    first_bearing_rad: float,
    second_pose: ArrayLike,
    second_bearing_rad: float,
    camera_xy: ArrayLike,
) -> Intersection | None:
    """Where two rays from the camera meet.

    Parameters
    ----------
    first_pose, second_pose : (3,) array_like
        Poses of the robot in the map.
    first_bearing_rad, second_bearing_rad : float
        Bearings from them (rad).
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m).

    Returns
    -------
    Intersection, or None
        None if the rays do not meet in front of the camera.
    """
    poses = np.array([first_pose, second_pose], dtype=np.float64)
    bearings = np.array([first_bearing_rad, second_bearing_rad])
    origin = disc_in_map(poses, np.asarray(camera_xy, dtype=np.float64))
    in_robot = np.stack([np.sin(bearings), -np.cos(bearings)], axis=-1)
    ray = np.einsum("nij,nj->ni", rotation(poses[:, 2]), in_robot)
    # origin_0 + s ray_0 = origin_1 + t ray_1
    cross = ray[0, 0] * ray[1, 1] - ray[0, 1] * ray[1, 0]
    if cross == 0.0:
        return None
    base = origin[1] - origin[0]
    s = (base[0] * ray[1, 1] - base[1] * ray[1, 0]) / cross
    t = (base[0] * ray[0, 1] - base[1] * ray[0, 0]) / cross
    if not (s > 0.0 and t > 0.0):
        return None
    angle = float(np.arctan2(abs(cross), ray[0] @ ray[1]))
    return Intersection(xy=origin[0] + s * ray[0], parallax_rad=angle)


def intersection_jacobians(
    first_pose: ArrayLike, second_pose: ArrayLike, line_xy: ArrayLike, camera_xy: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Jacobians of the line's place by the poses and by the bearings.

    The place l solves h(pose_i, l) = bearing_i, so that H_l dl = d bearing - H_pose d pose.

    Parameters
    ----------
    first_pose, second_pose : (3,) array_like
        The poses.
    line_xy : (2,) array_like
        Where the rays meet.
    camera_xy : (2,) array_like
        The camera's centre in the robot frame (m).

    Returns
    -------
    by_poses : (2, 6) float64
        By the first and then by the second pose.
    by_bearings : (2, 2) float64
    """
    poses = np.array([first_pose, second_pose], dtype=np.float64)
    by_pose, by_line = bearing_jacobians(poses, np.asarray(line_xy, dtype=np.float64), camera_xy)
    by_bearings = np.linalg.inv(by_line)
    by_poses = np.zeros((2, 6))
    by_poses[:, :3] = -by_bearings[:, :1] * by_pose[0]
    by_poses[:, 3:] = -by_bearings[:, 1:] * by_pose[1]
    return by_poses, np.asarray(by_bearings)
