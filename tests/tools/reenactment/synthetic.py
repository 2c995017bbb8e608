"""A small run whose truth is known: twice round a ring of discs with a camera that looks lower."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.uncertainty import with_pose
from redetect.landmarks import Frame, Step, circle_landmarks
from redetect.plane import between
from redetect.slam.mapping.graph import Estimate, Graph, graph_of_recording
from redetect.slam.recording import recording_of_frames

FloatArray = NDArray[np.float64]

MOUNTING_VECTOR = np.array([-0.037, 0.011, 0.003])
MOUNTING_HEIGHT = -0.02
STEP_SIGMA = np.array([0.01, 0.01, 0.01])


@dataclass(frozen=True, eq=False)
class TrueRun:
    """Frames as they would be shipped, the same as a graph, and the truth they were made from."""

    frames: list[Frame]
    graph: Graph
    truth: Estimate


def make_run(camera: Camera, seed: int, *, tilt_deg: float = 0.0, noisy: bool = True) -> TrueRun:
    """Drive twice round; noise follows the covariances in the rows and steps."""
    rng = np.random.default_rng(seed)
    truth = _truth(camera, rng, tilt_deg)
    disc_ids = np.arange(len(truth.disc_xy), dtype=np.int64) * 3 + 5
    steps = between(truth.poses[:-1], truth.poses[1:])
    if noisy:
        steps = steps + rng.normal(size=steps.shape) * STEP_SIGMA
    frames = []
    for i, (dx, dy, dphi) in enumerate(steps):
        xy, covariance, seen = rows_of_pose(camera, truth, i + 1)
        if noisy:
            root = np.linalg.cholesky(covariance)
            xy = xy + np.einsum("nij,nj->ni", root, rng.normal(size=xy.shape))
        cxx, cyy, cphiphi = STEP_SIGMA**2
        step = Step(f"ring.{i:04d}", dx, dy, dphi, cxx, 0.0, cyy, 0.0, 0.0, cphiphi)
        rows = circle_landmarks(xy, np.full(len(xy), 0.9), covariance, disc_ids[seen])
        frames.append(Frame(step, rows))
    return TrueRun(frames, graph_of_recording(recording_of_frames(frames, "ring"), camera), truth)


def _truth(camera: Camera, rng: np.random.Generator, tilt_deg: float) -> Estimate:
    # Forward is -Y: turning left (phi grows) on a circle whose centre lies to the left, at +X.
    radius, per_round, rounds = 4.0, 60, 2
    theta = 2.0 * np.pi / per_round * np.arange(per_round * rounds + 1)
    poses = np.stack([radius * (1.0 - np.cos(theta)), -radius * np.sin(theta), theta], axis=1)
    around = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    away = radius + np.tile([-1.1, 0.3, 1.2], 12)
    disc_xy = np.stack([radius - away * np.cos(around), -away * np.sin(around)], axis=1)
    disc_xy = disc_xy + rng.uniform(-0.1, 0.1, disc_xy.shape)
    rotation = Rotation.from_rotvec(MOUNTING_VECTOR).as_matrix() @ camera.rotation
    mounting = np.column_stack([rotation, camera.centre + np.array([0.0, 0.0, MOUNTING_HEIGHT])])
    tilt = np.zeros((len(poses), 2))
    tilt[1:] = np.radians(tilt_deg) * rng.normal(size=tilt[1:].shape)
    return Estimate(poses, disc_xy, np.zeros((0, 2)), mounting, tilt)


def camera_at(camera: Camera, truth: Estimate, pose: int) -> Camera:
    """The camera as it is mounted and tilted at a pose."""
    assert truth.mounting is not None
    assert truth.tilt is not None
    turn = Rotation.from_rotvec([*truth.tilt[pose], 0.0]).as_matrix() @ truth.mounting[:, :3]
    return with_pose(camera, np.column_stack([turn, truth.mounting[:, 3]]))


def rows_of_pose(
    camera: Camera, truth: Estimate, pose: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """What is reported from a pose: rows, their covariances, and which discs they are."""
    x, y, theta = truth.poses[pose]
    map_from_robot = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    in_robot = (truth.disc_xy - [x, y]) @ map_from_robot
    pixels = camera_at(camera, truth, pose).project_floor(in_robot)
    u, v = pixels.T
    seen = (u > 12.0) & (u < 755.0) & (v > 115.0) & (v < 276.0)
    along = camera.floor_jacobian(pixels[seen])
    covariance = 0.02**2 * np.eye(2) + along @ np.swapaxes(along, 1, 2)
    return camera.floor_from_pixel(pixels[seen]), covariance, seen
