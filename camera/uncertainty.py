"""Covariance of a calibration, and its effect on projections, positions and tilts.

The parameters are the intrinsics (`camera.calibration.model.INTRINSICS`) and the pose: position (m)
and a small rotation from the left about the robot's axes (rad). Errors of a calibration are the
same in all images: the common part of covariances, which does not average out over landmarks.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from camera.calibration.model import COUNT, project_points
from camera.model import PARAMETERS, Camera, Pose, points_on_floor
from camera.model_checks import checked_pose
from camera.rotations import cross_matrices
from redetect.array_types import FloatArray

IDENTITY: Pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
#: A camera without a pose, as a template for intrinsics.
UNPOSED = Camera(1, 1, 1.0, 1.0, 0.0, 0.0, (0.0,) * 5, IDENTITY, IDENTITY)

_COLUMNS, _ROWS = 49, 37
# Of a covariance, the lower triangle is stored.
_LOWER = np.tril_indices(PARAMETERS)
#: Directions of hypothetical verticals: bearings and elevations (rad).
_BEARINGS = np.linspace(-np.pi, np.pi, 145)
_ELEVATIONS = np.linspace(-0.7, 0.7, 57)


def coarse_pixel_grid(width: int, height: int) -> FloatArray:
    """(37 * 49, 2) pixels from corner to corner of an image, row by row."""
    columns, rows = np.linspace(0.0, width - 1.0, _COLUMNS), np.linspace(0.0, height - 1.0, _ROWS)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def intrinsics_of(camera: Camera) -> FloatArray:
    """(14,) numbers of a camera (`camera.calibration.model.INTRINSICS`)."""
    return np.array([*camera.pinhole, *camera.coef, *camera.tangential, *camera.polynomial])


def with_intrinsics(camera: Camera, intrinsics: FloatArray, **changes: Any) -> Camera:
    """The camera with other intrinsics, an array as of `intrinsics_of`, and other changes."""
    sx, sy, ox, oy, a2, a3, b1, b2, b3, p1, p2, k1, k2, k3 = (float(x) for x in intrinsics)
    changes |= {"coef": (a2, a3, b1, b2, b3), "tangential": (p1, p2), "polynomial": (k1, k2, k3)}
    return replace(camera, scale_x=sx, scale_y=sy, offset_x=ox, offset_y=oy, **changes)


def with_pose(camera: Camera, pose: FloatArray) -> Camera:
    """The camera at a (3, 4) pose `robot_from_camera`.

    A ``sensor2Tcp`` is kept, since that belongs to the mount; without one it is the identity.
    """
    rows = checked_pose("sensor2World", pose)
    return replace(camera, robot_from_camera=rows, sensor_to_tcp=camera.sensor_to_tcp or IDENTITY)


def projection_sigma(camera: Camera, covariance: FloatArray) -> FloatArray:
    """Standard deviation of the projection of directions, apart from a rotation of the camera.

    A small rotation has the same effect as a shift of the principal point, and the pose absorbs it;
    so the component equivalent to a rotation is removed, as in mrcal. Returns the root of the trace
    of covariances at (37, 49) pixels, from the intrinsics' (14, 14) covariance.
    """
    rays = camera.unproject(coarse_pixel_grid(camera.width, camera.height))
    _, by_intrinsics, by_point = project_points(intrinsics_of(camera), rays)
    J = by_intrinsics.reshape(-1, COUNT)
    turn = (-by_point @ cross_matrices(rays)).reshape(-1, 3)
    J = J - turn @ np.linalg.lstsq(turn, J, rcond=None)[0]
    variance = np.einsum("ni,ij,nj->n", J, covariance, J).reshape(-1, 2).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(_ROWS, _COLUMNS))


def with_covariance(camera: Camera, covariance: FloatArray) -> Camera:
    """The camera with the (20, 20) covariance of its parameters, rounded to seven digits."""
    return replace(camera, covariance=tuple(float(f"{x:.7g}") for x in covariance[_LOWER]))


def covariance_of(camera: Camera) -> FloatArray | None:
    """The (20, 20) covariance of a camera's parameters, if it has one."""
    if camera.covariance is None:
        return None
    lower = np.zeros((PARAMETERS, PARAMETERS))
    lower[_LOWER] = camera.covariance
    return np.asarray(lower + np.tril(lower, -1).T)


def floor_by_parameters(camera: Camera, floor_xy: FloatArray) -> FloatArray:
    """Derivatives of pixels' positions on the floor with respect to the camera's parameters.

    Parameters
    ----------
    camera : Camera
    floor_xy : (N, 2) float64
        Positions on the floor (m).

    Returns
    -------
    (N, 2, 20) float64
        Of the position assigned to the same pixel.
    """
    offset = points_on_floor(floor_xy) - camera.centre
    in_camera = offset @ camera.camera_from_robot.T
    _, by_intrinsics, by_point = project_points(intrinsics_of(camera), in_camera)
    by_place = by_point @ camera.camera_from_robot
    by_turn = by_place @ cross_matrices(offset)
    by_parameters = np.concatenate([by_intrinsics, -by_place, by_turn], axis=-1)
    return np.asarray(-np.linalg.solve(by_place[:, :, :2], by_parameters))


def tilt_by_parameters(camera: Camera) -> FloatArray:
    """(2, 20) derivatives of pitch and roll, estimated from verticals all over the image.

    With a wrong calibration, verticals seem to lean: the tilt is fitted by least squares.
    """
    bearing, elevation = np.meshgrid(_BEARINGS, _ELEVATIONS, indexing="ij")
    ray = np.stack([np.sin(bearing), -np.cos(bearing), np.tan(elevation)], axis=-1)
    pixel = camera.project(ray @ camera.camera_from_robot.T)
    end = np.array([camera.width, camera.height]) - 0.5
    seen = np.all((pixel > -0.5) & (pixel < end), axis=-1)
    usable = seen.sum(axis=1) >= 2
    ray, seen = ray[usable], seen[usable]
    if len(ray) < 2:
        return np.zeros((2, PARAMETERS))
    rows, last = np.arange(len(ray)), len(_ELEVATIONS) - 1
    lower, upper = ray[rows, seen.argmax(axis=1)], ray[rows, last - seen[:, ::-1].argmax(axis=1)]
    normal = np.cross(lower, upper)
    turned = np.zeros((len(ray), PARAMETERS))
    for end, other, sign in ((lower, upper, 1.0), (upper, lower, -1.0)):
        moved = _ray_by_parameters(camera, end)
        # (moved x other)_z, and its negative for the second of the two rays.
        turned += sign * (moved[:, 0] * other[:, 1:2] - moved[:, 1] * other[:, :1])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # n_z + pitch n_y - roll n_x = 0 (`detect.verticals.tilt`).
    level = np.column_stack([normal[:, 1], -normal[:, 0]]) / length
    return np.asarray(-np.linalg.lstsq(level, turned / length, rcond=None)[0])


def _ray_by_parameters(camera: Camera, ray: FloatArray) -> FloatArray:
    """(N, 3, 20) derivatives of the (N, 3) directions assigned to pixels, in the robot frame."""
    in_camera = ray @ camera.camera_from_robot.T
    depth = in_camera[:, 2:]
    _, by_intrinsics, by_point = project_points(intrinsics_of(camera), in_camera / depth)
    by_parameters = np.zeros((len(ray), 3, PARAMETERS))
    moved = -np.linalg.solve(by_point[:, :, :2], by_intrinsics) * depth[..., None]
    by_parameters[:, :, :COUNT] = camera.rotation[:, :2] @ moved
    by_parameters[:, :, COUNT + 3 :] = -cross_matrices(ray)
    return by_parameters
