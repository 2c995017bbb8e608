"""Measurements of discs by a tilted, differently mounted camera, with derivatives.

A landmark row is a pixel at which the camera *as mounted* (and tilted) saw a disc, put on the floor
by the camera *as calibrated*. `predict_pixels` computes the first half of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.calibration.model import cross_matrices
from redetect.slam.mounting import rotation_exp

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Geometry:
    """All unknowns of a run at once.

    Parameters
    ----------
    poses : (N, 3) float array
        x, y, theta after each step, in the map.
    disc_xy : (M, 2) float array
        Disc centres in the map, metres.
    rotation : (3, 3) float array
        Camera -> robot, as mounted.
    centre : (3,) float array
        The camera's centre in the robot frame, metres.
    tilt : (N, 2) float array
        Pitch and roll per frame: x and y of a rotation vector in the robot frame, radians.
    """

    poses: FloatArray
    disc_xy: FloatArray
    rotation: FloatArray
    centre: FloatArray
    tilt: FloatArray


@dataclass(frozen=True, eq=False)
class PixelJacobians:
    """Derivatives of n pixels by what they depend on.

    Parameters
    ----------
    pose : (n, 2, 3) float array
        By x, y, theta of the frame's pose.
    tilt : (n, 2, 2) float array
        By the frame's pitch and roll.
    disc : (n, 2, 2) float array
        By the disc's centre.
    mounting : (n, 2, 4) float array
        By a rotation vector in the robot frame, applied to the camera from the left, and by its
        height.
    """

    pose: FloatArray
    tilt: FloatArray
    disc: FloatArray
    mounting: FloatArray


def predict_pixels(
    camera: Camera, geometry: Geometry, frame: IntArray, disc: IntArray
) -> tuple[FloatArray, PixelJacobians]:
    """Pixels at which frames show discs, and their derivatives.

    Parameters
    ----------
    camera : Camera
        The lens; its mounting is not used.
    geometry : Geometry
        Poses, discs, mounting and tilt.
    frame, disc : (n,) int arrays
        Which pose sees which disc.

    Returns
    -------
    pixels : (n, 2) float array
        u, v; NaN where the disc is not in front of the camera.
    jacobians : PixelJacobians
        NaN at the same places.
    """
    pose, tilt = geometry.poses[frame], geometry.tilt[frame]
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    offset = geometry.disc_xy[disc] - pose[:, :2]
    robot_from_map = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    floor = np.einsum("nij,nj->ni", robot_from_map, offset)

    from_centre = np.concatenate([floor, np.zeros((len(floor), 1))], axis=1) - geometry.centre
    turn, left = rotation_exp(np.concatenate([tilt, np.zeros((len(tilt), 1))], axis=1))
    camera_from_robot = geometry.rotation.T @ np.swapaxes(turn, -1, -2)
    in_camera = np.einsum("nij,nj->ni", camera_from_robot, from_centre)
    pixels = camera.project(in_camera)

    by_camera = camera.project_jacobian(in_camera)
    by_robot = by_camera @ camera_from_robot
    by_floor = by_robot[:, :, :2]
    # d(Rot(theta)^T offset) / d theta: the floor point turns the other way.
    spin = np.stack([floor[:, 1], -floor[:, 0]], axis=-1)
    by_disc = by_floor @ robot_from_map
    by_pose = np.concatenate([-by_disc, (by_floor @ spin[:, :, None])], axis=2)
    by_tilt = (by_robot @ cross_matrices(from_centre) @ left)[:, :, :2]
    untilted = np.einsum("nji,nj->ni", turn, from_centre)
    by_mounting = np.concatenate(
        [by_camera @ geometry.rotation.T @ cross_matrices(untilted), -by_robot[:, :, 2:]], axis=2
    )
    return pixels, PixelJacobians(by_pose, by_tilt, by_disc, by_mounting)
