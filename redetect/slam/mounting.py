"""Rows as written by a differently mounted camera, with derivatives.

A row is a pixel projected to the floor through the camera as calibrated. If the camera's true
mounting is different, the same pixel's ray meets the floor elsewhere.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.calibration.model import COUNT
from camera.model import points_on_floor
from camera.rotations import cross_matrices, rotation_of
from camera.uncertainty import covariance_of, with_covariance, with_pose
from redetect.array_types import FloatArray
from redetect.slam.errors import SlamError


def rows_through_mounting(
    camera: Camera, floor_xy: FloatArray, mounting: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Intersections of rows' rays with the floor for a different mounting of the camera.

    Takes `floor_xy` (n, 2) of the rows, and robot_from_camera as mounted (3, 4). Returns
    `floor_xy` (n, 2) in the robot frame (m), NaN if a ray does not go down, and `by_mounting`
    (n, 2, 6): derivatives with respect to a rotation vector in the robot frame, applied to the
    mounting from the left, and to the camera's position.
    """
    turn = mounting[:, :3] @ np.linalg.inv(camera.rotation)
    centre = mounting[:, 3]
    ray = (points_on_floor(floor_xy) - camera.centre) @ turn.T
    slope, by_ray = _on_floor(ray, centre[2])
    across = np.broadcast_to(np.eye(2), (len(ray), 2, 2))
    turning = -by_ray @ cross_matrices(ray)
    by_mounting = np.concatenate([turning, across, -slope[:, :, None]], axis=2)
    return centre[:2] - centre[2] * slope, by_mounting


def _on_floor(ray: FloatArray, height_m: float) -> tuple[FloatArray, FloatArray]:
    """Slopes (n, 2) of rays (n, 3), NaN if one does not go down, and the derivatives (n, 2, 3) by
    the rays of their points on the floor, ``-height_m * slope``.
    """
    ray = np.where(ray[:, 2:] < 0.0, ray, np.nan)
    slope = ray[:, :2] / ray[:, 2:]
    by_ray = np.zeros((len(ray), 2, 3))
    by_ray[:, 0, 0] = by_ray[:, 1, 1] = -height_m / ray[:, 2]
    by_ray[:, :, 2] = height_m * slope / ray[:, 2:]
    return slope, by_ray


def rows_as_recorded(
    camera: Camera, floor_xy: FloatArray, mounting: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rows, written with the calibration, of discs seen by the camera as mounted.

    The lens cancels: the ray of a disc meets the floor as from the camera's calibrated pose.

    Takes `floor_xy` (n, 2) in the robot frame and `mounting` (3, 4); returns `rows_xy` (n, 2), and
    its derivatives `by_floor` (n, 2, 2) and `by_mounting` (n, 2, 6), the latter as in
    `rows_through_mounting`.
    """
    unturn = np.linalg.inv(mounting[:, :3] @ np.linalg.inv(camera.rotation))
    from_centre = points_on_floor(floor_xy) - mounting[:, 3]
    height = float(camera.centre[2])
    slope, by_ray = _on_floor(from_centre @ unturn.T, height)
    by_robot = by_ray @ unturn
    by_mounting = np.concatenate([by_robot @ cross_matrices(from_centre), -by_robot], axis=2)
    return camera.centre[:2] - height * slope, by_robot[:, :, :2], by_mounting


def levelled_camera(camera: Camera, levelled_by: tuple[float, float]) -> Camera:
    """The camera as rows show it that a pitch and roll (rad) have levelled."""
    turn = rotation_of(np.array([*levelled_by, 0.0]))
    return with_pose(camera, turn @ np.array(camera.robot_from_camera))


def mounting_change(camera: Camera, mounting: FloatArray) -> FloatArray:
    """(6,) rotation vector in the robot frame (rad) and position (m) of a mounting (3, 4), true
    minus calibrated.
    """
    turn = mounting[:, :3] @ np.linalg.inv(camera.rotation)
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), mounting[:, 3] - camera.centre])


def mounted_camera(camera: Camera, mounting: FloatArray, covariance: FloatArray) -> Camera:
    """The camera as mounted, with the mounting's covariance if the camera has a covariance.

    Takes `mounting` (3, 4), and the `covariance` (6, 6) of its change.
    """
    mounted = with_pose(camera, mounting)
    stated = covariance_of(camera)
    if stated is None:
        return mounted
    stated[COUNT:] = stated[:, COUNT:] = 0.0
    # In a calibration, the position precedes the rotation.
    stated[COUNT:, COUNT:] = np.roll(covariance, 3, axis=(0, 1))
    return with_covariance(mounted, stated)


def check_rows_fit_camera(camera: Camera, floor_xy: FloatArray) -> None:
    """Check that rows can be from a camera at all."""
    outside = ~np.all(np.isfinite(camera.project_floor(floor_xy)), axis=-1)
    if np.any(outside):
        x, y = floor_xy[np.flatnonzero(outside)[0]]
        raise SlamError(
            f"--calibrate: {int(np.sum(outside))} rows, the first at ({x:g}, {y:g}), are not "
            "visible to the camera as calibrated: expected the calibration used to make the rows"
        )
