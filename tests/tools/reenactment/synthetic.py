"""A small run whose truth is known: twice round a ring of discs with a camera that looks lower."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from redetect.landmarks import Frame, Step, circle_landmarks
from tools.reenactment.fitting import odometry_residuals
from tools.reenactment.mounted_discs import Geometry

FloatArray = NDArray[np.float64]

MOUNTING_VECTOR = np.array([-0.037, 0.011, 0.003])
MOUNTING_HEIGHT = -0.02
STEP_SIGMA = np.array([0.01, 0.01, 0.01])


@dataclass(frozen=True, eq=False)
class TrueRun:
    """Frames as they would be shipped, and the geometry they were made from."""

    frames: list[Frame]
    geometry: Geometry
    disc_ids: NDArray[np.int64]


def make_run(camera: Camera, seed: int, *, tilt_deg: float = 0.0, noisy: bool = True) -> TrueRun:
    """Drive twice round; noise follows the covariances in the rows and steps."""
    rng = np.random.default_rng(seed)
    geometry = _geometry(camera, rng, tilt_deg)
    disc_ids = np.arange(len(geometry.disc_xy), dtype=np.int64) * 3 + 5
    nothing = np.zeros((len(geometry.poses), 3))
    steps = odometry_residuals(geometry.poses, nothing)
    if noisy:
        steps = steps + rng.normal(size=steps.shape) * STEP_SIGMA
    frames = []
    for i, (dx, dy, dphi) in enumerate(steps):
        xy, covariance, seen = rows_of_frame(camera, geometry, i)
        if noisy:
            root = np.linalg.cholesky(covariance)
            xy = xy + np.einsum("nij,nj->ni", root, rng.normal(size=xy.shape))
        cxx, cyy, cphiphi = STEP_SIGMA**2
        step = Step(f"ring.{i:04d}", dx, dy, dphi, cxx, 0.0, cyy, 0.0, 0.0, cphiphi)
        rows = circle_landmarks(xy, np.full(len(xy), 0.9), covariance, disc_ids[seen])
        frames.append(Frame(step, rows))
    return TrueRun(frames, geometry, disc_ids)


def _geometry(camera: Camera, rng: np.random.Generator, tilt_deg: float) -> Geometry:
    # Forward is -Y: turning left (phi grows) on a circle whose centre lies to the left, at +X.
    radius, per_round, rounds = 4.0, 60, 2
    theta = 2.0 * np.pi / per_round * np.arange(1, per_round * rounds + 1)
    poses = np.stack([radius * (1.0 - np.cos(theta)), -radius * np.sin(theta), theta], axis=1)
    around = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    away = radius + np.tile([-1.1, 0.3, 1.2], 12)
    disc_xy = np.stack([radius - away * np.cos(around), -away * np.sin(around)], axis=1)
    disc_xy = disc_xy + rng.uniform(-0.1, 0.1, disc_xy.shape)
    return Geometry(
        poses=poses,
        disc_xy=disc_xy,
        rotation=Rotation.from_rotvec(MOUNTING_VECTOR).as_matrix() @ camera.rotation,
        centre=camera.centre + np.array([0.0, 0.0, MOUNTING_HEIGHT]),
        tilt=np.radians(tilt_deg) * rng.normal(size=(len(poses), 2)),
    )


def rows_of_frame(
    camera: Camera, geometry: Geometry, i: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """What frame i reports: rows, their covariances, and which discs they are.

    Goes through a `Camera` of its own that is mounted as the true one, tilt included.
    """
    turn = Rotation.from_rotvec([*geometry.tilt[i], 0.0]).as_matrix() @ geometry.rotation
    mounting = np.concatenate([turn, geometry.centre[:, None]], axis=1)
    as_mounted = replace(camera, robot_from_camera=tuple(map(tuple, mounting.tolist())))
    x, y, theta = geometry.poses[i]
    map_from_robot = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    pixels = as_mounted.project_floor((geometry.disc_xy - [x, y]) @ map_from_robot)
    u, v = pixels.T
    seen = (u > 12.0) & (u < 755.0) & (v > 115.0) & (v < 276.0)
    along = camera.floor_jacobian(pixels[seen])
    covariance = 0.02**2 * np.eye(2) + along @ np.swapaxes(along, 1, 2)
    return camera.floor_from_pixel(pixels[seen]), covariance, seen
