"""A hall with cameras under its ceiling and a box-shaped robot with markers, as exact numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from redetect.groundtruth.markers.adjustment import Chain, ChainPoints, project_chain
from redetect.groundtruth.markers.refinement import PoseProblem
from redetect.groundtruth.markers.session import MarkerFrame, Network, Rig
from redetect.groundtruth.settings import PoseSettings
from redetect.groundtruth.trajectories import se3
from redetect.landmarks import MarkerCorner, MarkerLandmark
from tools.simulator.driving import planar_transform
from tools.simulator.markers.room import looking_at

FloatArray = NDArray[np.float64]

#: A mild barrel distortion, so that no test passes by ignoring the lens.
COEF = (-0.02, -0.08, 0.1, 0.1, 0.0)
NO_MOUNTING = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


SETTINGS = PoseSettings()


def lens(scale_px: float = 900.0, coef: tuple[float, ...] = COEF) -> Camera:
    a2, a3, b1, b2, b3 = coef
    return Camera(
        1280, 960, scale_px, scale_px * 1.01, 640.0, 470.0, (a2, a3, b1, b2, b3), NO_MOUNTING
    )


def hall_cameras(count: int) -> FloatArray:
    corners = np.array([[-3.0, -3.0, 2.6], [3.2, -2.8, 2.5], [2.9, 3.1, 2.7], [-3.1, 2.9, 2.4]])
    return np.stack([looking_at(corner, np.array([0.0, 0.0, 0.4])) for corner in corners[:count]])


def box_rig(count: int = 6, width_m: float = 0.24) -> Rig:
    """Markers round a box of 0.5 x 0.4 m: four on its sides, two, tilted, above its edges."""
    poses = []
    for yaw, distance, height, tilt in (
        (0.0, 0.25, 0.5, 0.0),
        (np.pi / 2, 0.2, 0.45, 0.05),
        (np.pi, 0.25, 0.5, -0.05),
        (-np.pi / 2, 0.2, 0.55, 0.0),
        (0.3, 0.1, 0.8, 0.7),
        (np.pi + 0.2, 0.1, 0.85, 0.8),
    ):
        out = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)])
        right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        rotation = np.stack([right, np.cross(out, right), out], axis=1)
        centre = [distance * np.cos(yaw), distance * np.sin(yaw), height]
        poses.append(se3.transform(rotation, centre))
    ids = tuple(range(31, 31 + count))
    return Rig(
        "rawseeds",
        ids,
        np.full(count, width_m),
        np.stack(poses[:count]),
        np.zeros((6 * count,) * 2),
    )


def visible(
    cameras: tuple[Camera, ...],
    world_from_camera: FloatArray,
    world_from_robot: FloatArray,
    rig: Rig,
    *,
    steepest_deg: float = 75.0,
) -> list[tuple[int, int]]:
    """Which markers (index) which cameras (index) see from the front and whole."""
    found = []
    for c, camera in enumerate(cameras):
        for m in range(len(rig.ids)):
            camera_from_marker = (
                se3.inverse(world_from_camera[c]) @ world_from_robot @ rig.robot_from_marker[m]
            )
            centre = camera_from_marker[:3, 3]
            towards = -camera_from_marker[:3, 2] @ centre / np.linalg.norm(centre)
            if towards < np.cos(np.radians(steepest_deg)):
                continue
            pixels = camera.project(se3.apply(camera_from_marker, rig.corners[m]))
            if np.all((pixels > 2) & (pixels < [camera.width - 3, camera.height - 3])):
                found.append((c, m))
    return found


def points_of(
    pairs: list[tuple[int, int]],
    cameras: tuple[Camera, ...],
    world_from_camera: FloatArray,
    world_from_robot: FloatArray,
    rig: Rig,
    *,
    sigma_px: float = 0.1,
    noise: np.random.Generator | None = None,
) -> tuple[ChainPoints, NDArray[np.int64]]:
    camera = np.repeat([c for c, _ in pairs], 4).astype(np.int64)
    part = np.repeat([m for _, m in pairs], 4).astype(np.int64)
    points = rig.corners[[m for _, m in pairs]].reshape(-1, 3) if pairs else np.zeros((0, 3))
    empty = ChainPoints(
        camera, np.zeros(len(camera), np.int64), part, points,
        np.zeros((len(camera), 2)), np.tile(np.eye(2) * sigma_px**2, (len(camera), 1, 1)),
    )  # fmt: skip
    chain = Chain(cameras, world_from_camera, world_from_robot[None], rig.robot_from_marker)
    pixels = project_chain(chain, empty)
    if noise is not None:
        pixels = pixels + noise.normal(0.0, sigma_px, pixels.shape)
    seen = ChainPoints(camera, empty.body, part, points, pixels, empty.covariances)
    return seen, np.repeat(np.arange(len(pairs)), 4)


def pose_problem(
    world_from_robot: FloatArray,
    *,
    cameras: int = 4,
    markers: int = 6,
    pairs: list[tuple[int, int]] | None = None,
    sigma_px: float = 0.1,
    noise: np.random.Generator | None = None,
    camera_covariance: FloatArray | None = None,
    marker_covariance: FloatArray | None = None,
    settings: PoseSettings = SETTINGS,
    rig: Rig | None = None,
    scale_px: float = 900.0,
) -> PoseProblem:
    """What the cameras of the hall see of the robot."""
    lenses = (lens(scale_px),) * cameras
    world_from_camera = hall_cameras(cameras)
    rig = box_rig(markers) if rig is None else rig
    if pairs is None:
        pairs = visible(lenses, world_from_camera, world_from_robot, rig)
    seen, view = points_of(
        pairs, lenses, world_from_camera, world_from_robot, rig, sigma_px=sigma_px, noise=noise
    )
    if marker_covariance is not None:
        rig = replace(rig, covariance=marker_covariance)
    network = network_of(world_from_camera, camera_covariance, scale_px)
    return PoseProblem(network, rig, seen, view, settings)


def network_of(
    poses: FloatArray, covariance: FloatArray | None = None, scale_px: float = 900.0
) -> Network:
    """Cameras at poses, exactly known unless they have a covariance."""
    names = tuple("abcdefgh"[: len(poses)])
    exact = np.zeros((6 * len(poses), 6 * len(poses)))
    lenses = (lens(scale_px),) * len(poses)
    return Network(names, lenses, names, poses, exact if covariance is None else covariance)


def robot_pose(generator: np.random.Generator, extent_m: float = 1.0) -> FloatArray:
    """A pose on the floor, a little tilted."""
    x, y = generator.uniform(-extent_m, extent_m, 2)
    level = planar_transform(float(x), float(y), float(generator.uniform(-np.pi, np.pi)))
    tilt = np.concatenate([[0, 0, generator.normal(0, 0.01)], generator.normal(0, 0.01, 2), [0]])
    return np.asarray(level @ se3.exp(tilt))


def marker_rows(
    rig: Rig, pairs: list[tuple[int, int]], camera: int, seen: ChainPoints
) -> tuple[MarkerLandmark, ...]:
    """The rows that a detector would write for one camera's image."""
    rows = []
    for view, (c, m) in enumerate(pairs):
        if c == camera:
            four = slice(4 * view, 4 * view + 4)
            a, b, d, e = (
                MarkerCorner(
                    float(u), float(v), float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])
                )
                for (u, v), cov in zip(seen.pixels[four], seen.covariances[four])
            )
            rows.append(MarkerLandmark(rig.dictionary, rig.ids[m], 1.0, (a, b, d, e)))
    return tuple(rows)


def frames_of(
    times_s: FloatArray,
    poses: FloatArray,
    *,
    cameras: int = 4,
    rig: Rig | None = None,
    sigma_px: float = 0.1,
    seed: int = 1,
    scale_px: float = 900.0,
) -> list[MarkerFrame]:
    """What a detector finds in the images of all cameras while the robot stands at poses."""
    generator = np.random.default_rng(seed)
    rig = box_rig() if rig is None else rig
    lenses = (lens(scale_px),) * cameras
    world_from_camera = hall_cameras(cameras)
    frames = []
    for i, (time_s, pose) in enumerate(zip(times_s, poses)):
        pairs = visible(lenses, world_from_camera, pose, rig)
        seen, _ = points_of(
            pairs, lenses, world_from_camera, pose, rig, sigma_px=sigma_px, noise=generator
        )
        for camera in range(cameras):
            rows = marker_rows(rig, pairs, camera, seen)
            frames.append(MarkerFrame(camera, f"{i:04d}", float(time_s), rows))
    return frames
