"""The calibrated camera: projection of points to pixels and back.

Frames and conventions
----------------------
pixel
    (u, v), u right, v down, (0, 0) the *centre* of the top-left pixel.
camera
    x right, y down, z forward; metres.
robot
    origin on the floor at the robot's centre, X left, Y backward, Z up; metres.
    The file calls the transform camera -> robot ``sensor2World``; here it is `robot_from_camera`.
"""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from camera import distortion
from camera import model_checks as checks
from camera.distortion import Brown, Coef, Lens, Polynomial, Tangential
from redetect.array_types import FloatArray

Pose = tuple[tuple[float, float, float, float], ...]

#: Number of a calibration's parameters: 14 intrinsics, position and rotation.
PARAMETERS = 20


@dataclass(frozen=True)
class Camera:
    """A calibrated camera on a robot, with its distortion. A value.

    Two cameras are equal, and have the same hash, if all their parameters are equal.

    Parameters
    ----------
    width, height : int
        Image size in pixels.
    scale_x, scale_y : float
        Focal lengths in pixels along u and v (different for single fields of interlaced frames).
    offset_x, offset_y : float
        Principal point in pixels.
    coef : 5 floats
        a2, a3, b1, b2, b3 of the distortion (see `camera.distortion`).
    robot_from_camera : 3 rows of 4 floats
        Rotation and translation camera -> robot (``sensor2World``), metres.
    sensor_to_tcp : 3 rows of 4 floats, optional
        The file's second transform, kept as it is.
    mount_index : int
        The file's ``mountIndex``.
    unknown : tuple of (key, text)
        Entries of a ``.cam`` file that mean nothing here; they survive reading and writing.
    tangential : 2 floats
        p1, p2 of the distortion (see `camera.distortion`); the data set's cameras have none.
    polynomial : 3 floats
        k1, k2, k3 of the distortion (see `camera.distortion`); the data set's cameras have none.
    covariance : tuple of float, optional
        Of the calibration's parameters (`camera.uncertainty`): the lower triangle, row by row.

    Raises
    ------
    CameraError
        If a number is not finite, a size or scale not positive, the rotation not a rotation, or the
        distortion folds so that less than half of the image sees anything; names are the file's.

    References
    ----------
    DLR Spatial Cognition data set report, camera calibration.
    """

    width: int
    height: int
    scale_x: float
    scale_y: float
    offset_x: float
    offset_y: float
    coef: Coef
    robot_from_camera: Pose
    sensor_to_tcp: Pose | None = None
    mount_index: int = 0
    unknown: tuple[tuple[str, str], ...] = field(default=())
    tangential: Tangential = (0.0, 0.0)
    polynomial: Polynomial = (0.0, 0.0, 0.0)
    covariance: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "mount_index"):
            object.__setattr__(self, name, checks.checked_whole(name, getattr(self, name)))
        object.__setattr__(self, "unknown", tuple((key, text) for key, text in self.unknown))
        for name in ("coef", "tangential", "polynomial"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        pose = checks.checked_pose("sensor2World", self.robot_from_camera)
        object.__setattr__(self, "robot_from_camera", pose)
        if self.sensor_to_tcp is not None:
            pose = checks.checked_pose("sensor2Tcp", self.sensor_to_tcp)
            object.__setattr__(self, "sensor_to_tcp", pose)
        if self.covariance is not None:
            covariance = checks.checked_covariance(self.covariance, PARAMETERS)
            object.__setattr__(self, "covariance", covariance)
        checks.check_numbers(self)
        checks.check_one_to_one(self)

    def __hash__(self) -> int:
        # By a digest that is kept: tables are looked up by the camera, image by image.
        return int(self.content_hash[:15], 16)

    # -- files ------------------------------------------------------------------------------

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Camera:
        """The camera of a `.cam` file (`camera.camfile.read_camera`)."""
        from camera.camfile import read_camera

        return read_camera(path)

    # -- the camera as arrays ---------------------------------------------------------------

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation camera -> robot; its columns are the camera's axes in the robot frame."""
        return _read_only(np.array(self.robot_from_camera)[:, :3])

    @cached_property
    def camera_from_robot(self) -> FloatArray:
        """(3, 3) inverse of `rotation`.

        Files give rotations in few digits, so this is not exactly the transpose; with it, what goes
        from pixel to floor comes back to the same pixel.
        """
        return _read_only(np.asarray(np.linalg.inv(self.rotation), dtype=np.float64))

    @cached_property
    def centre(self) -> FloatArray:
        """(3,) position of the camera's centre in the robot frame, metres."""
        return _read_only(np.array(self.robot_from_camera)[:, 3])

    @cached_property
    def r_max(self) -> float:
        """Undistorted radius up to which the projection is defined."""
        return distortion.one_to_one_radius(self.lens)

    @cached_property
    def seen_share(self) -> float:
        """Share of the image that sees anything: less than 1 where the distortion folds in it."""
        return checks.seen_share(self)

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Scales and principal point: fx, fy, cx, cy as others call them."""
        return self.scale_x, self.scale_y, self.offset_x, self.offset_y

    @cached_property
    def decentred(self) -> bool:
        """Whether there are tangential terms."""
        return any(self.tangential)

    @cached_property
    def lens(self) -> Lens:
        """All coefficients of the distortion."""
        return Lens(self.coef, self.polynomial, self.tangential)

    @property
    def brown(self) -> Brown:
        """k1, k2, p1, p2, k3 of the distortion, in OpenCV's order."""
        return self.lens.brown

    @cached_property
    def content_hash(self) -> str:
        """Hexadecimal digest of the parameters of projection and pose; the key of cached tables."""
        numbers = (
            self.width, self.height, *self.pinhole, *self.coef,
            *(x for row in self.robot_from_camera for x in row),
            *(self.tangential if self.decentred else ()),
            *(self.polynomial if any(self.polynomial) else ()),
        )  # fmt: skip
        # Adding 0 makes -0 the 0 that it is equal to.
        return hashlib.sha256(" ".join((n + 0.0).hex() for n in numbers).encode()).hexdigest()

    def __str__(self) -> str:
        pitch_deg = math.degrees(math.asin(max(-1.0, min(1.0, -float(self.rotation[2, 2])))))
        p1, p2 = self.tangential
        k1, k2, k3 = self.polynomial
        return (
            f"{self.width}x{self.height} px, scale {self.scale_x:g} x {self.scale_y:g} px, "
            f"centre {self.offset_x:g} {self.offset_y:g}, "
            + (f"tangential {p1:g} {p2:g}, " if self.decentred else "")
            + (f"polynomial {k1:g} {k2:g} {k3:g}, " if any(self.polynomial) else "")
            + f"{self.centre[2]:.3f} m above the floor, looking {pitch_deg:.1f} deg down"
        )

    # -- camera frame <-> pixels ------------------------------------------------------------

    def distort(self, normalised: ArrayLike) -> FloatArray:
        """(..., 2) pixels of (..., 2) undistorted coordinates px/pz, py/pz; NaN past the fold."""
        xy = distortion.before_fold(np.asarray(normalised, dtype=np.float64), self.lens)
        seen = distortion.distort(xy, self.lens)
        return np.asarray(seen * self.pinhole[:2] + self.pinhole[2:])

    def undistort(self, pixels: ArrayLike) -> FloatArray:
        """(..., 2) undistorted normalised coordinates of (..., 2) pixels; the inverse of `distort`.

        Pixels need not be inside the image; both are NaN where nothing is seen (past the fold).
        """
        seen = (np.asarray(pixels, dtype=np.float64) - self.pinhole[2:]) / self.pinhole[:2]
        if self.decentred:
            return distortion.undistort(seen, self.lens)
        distorted = np.hypot(seen[..., 0], seen[..., 1])
        radius = distortion.undistorted_radius(distorted, self.lens)
        factor = distortion.radial_factor(radius, self.lens)
        return np.asarray(seen / factor[..., None])

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """(..., 2) pixels of (..., 3) points in the camera frame (m).

        Both NaN for points not in front of the camera or past the distortion's fold.
        """
        return self.distort(normalised_points(points_camera)[0])

    def pixel_grid(self) -> FloatArray:
        """(H, W, 2) all pixels (u, v)."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        return np.stack([u, v], axis=-1)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """(..., 3) camera-frame directions (x, y, 1) of (..., 2) pixels; NaN past the fold."""
        xy = self.undistort(pixels)
        return np.concatenate([xy, np.where(np.isnan(xy[..., :1]), np.nan, 1.0)], axis=-1)

    # -- robot frame and floor --------------------------------------------------------------

    def robot_to_camera(self, points_robot: ArrayLike) -> FloatArray:
        """(..., 3) points of the robot frame in the camera frame, metres."""
        offset = np.asarray(points_robot, dtype=np.float64) - self.centre
        return np.asarray(offset @ self.camera_from_robot.T)

    def project_robot(self, points_robot: ArrayLike) -> FloatArray:
        """(..., 2) pixels of (..., 3) points in the robot frame; NaN as in `project`."""
        return self.project(self.robot_to_camera(points_robot))

    def project_floor(self, floor_xy: ArrayLike) -> FloatArray:
        """(..., 2) pixels of (..., 2) points on the floor (robot X, Y in metres)."""
        return self.project_robot(points_on_floor(floor_xy))

    def directions_robot(self, pixels: ArrayLike) -> FloatArray:
        """(..., 3) directions, in the robot frame and not normalised, that (..., 2) pixels see."""
        return self.unproject(pixels) @ self.rotation.T

    def floor_from_pixel(self, pixels: ArrayLike) -> FloatArray:
        """(..., 2) places X, Y in the robot frame (m) where rays of (..., 2) pixels meet the floor.

        NaN where the ray does not come down to the floor.
        """
        direction = self.directions_robot(pixels)
        down = np.where(direction[..., 2] * self.centre[2] < 0.0, direction[..., 2], np.nan)
        along = -self.centre[2] / down
        return np.asarray(self.centre[:2] + along[..., None] * direction[..., :2])

    # -- Jacobians --------------------------------------------------------------------------

    def distort_jacobian(self, normalised: ArrayLike) -> FloatArray:
        """(..., 2, 2) derivatives of `distort`'s (u, v) with respect to (x, y), analytic.

        NaN past the fold.
        """
        xy = distortion.before_fold(np.asarray(normalised, dtype=np.float64), self.lens)
        jacobian = distortion.distorted_jacobian(xy, self.lens)
        return np.asarray(jacobian * np.array([[self.scale_x], [self.scale_y]]))

    def project_jacobian(self, points_camera: ArrayLike) -> FloatArray:
        """(..., 2, 3) derivatives of `project` with respect to the (..., 3) points, analytic.

        Pixels per metre; NaN where the projection is undefined.
        """
        xy, depth = normalised_points(points_camera)
        perspective = np.zeros((*depth.shape, 2, 3))
        perspective[..., 0, 0] = perspective[..., 1, 1] = 1.0
        perspective[..., :, 2] = -xy
        perspective /= depth[..., None, None]
        return np.asarray(self.distort_jacobian(xy) @ perspective)

    def floor_jacobian(self, pixels: ArrayLike) -> FloatArray:
        """(..., 2, 2) derivatives of the floor's (X, Y) with respect to (..., 2) pixels.

        Metres per pixel; NaN where the pixel does not see the floor.
        """
        return self.floor_jacobian_at(self.floor_from_pixel(pixels))

    def floor_jacobian_at(self, floor_xy: ArrayLike) -> FloatArray:
        """`floor_jacobian` at the pixels that see (..., 2) places X, Y on the floor (m)."""
        return self._floor_jacobian(floor_xy, self.camera_from_robot)

    def floor_jacobian_published(self, pixels: ArrayLike) -> FloatArray:
        """d(floor X, Y) / d(u, v) as the data set's own detector has it.

        Its projection turns by the transpose of `rotation`, which differs from the inverse in the
        last digits that the file has. Shapes as in `floor_jacobian`.
        """
        return self._floor_jacobian(self.floor_from_pixel(pixels), self.rotation.T)

    def _floor_jacobian(self, floor_xy: ArrayLike, camera_from_robot: FloatArray) -> FloatArray:
        in_camera = (points_on_floor(floor_xy) - self.centre) @ camera_from_robot.T
        pixels_per_metre = self.project_jacobian(in_camera) @ camera_from_robot[:, :2]
        return inverse_2x2(pixels_per_metre)


def points_on_floor(floor_xy: ArrayLike) -> FloatArray:
    """(..., 3) points of the robot frame at (..., 2) places X, Y on the floor (m)."""
    xy = np.asarray(floor_xy, dtype=np.float64)
    return np.concatenate([xy, np.zeros_like(xy[..., :1])], axis=-1)


def normalised_points(points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """(..., 2) normalised coordinates of points in the camera frame, and (...) depths (m).

    NaN for points not in front of the camera.
    """
    p = np.asarray(points_camera, dtype=np.float64)
    depth = np.where(p[..., 2] > 0.0, p[..., 2], np.nan)
    with np.errstate(over="ignore"):  # a point all but beside the camera
        return p[..., :2] / depth[..., None], depth


def _read_only(array: FloatArray) -> FloatArray:
    array.setflags(write=False)
    return array


def inverse_2x2(m: FloatArray) -> FloatArray:
    """Inverse over the last two axes; NaN passes through (np.linalg.inv may raise on it)."""
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    adjugate = np.stack([d, -b, -c, a], axis=-1).reshape(m.shape)
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])
