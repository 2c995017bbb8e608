"""From a point on a marker to a pixel, through three poses, with all Jacobians.

    point in the part's frame --body_from_part--> body --world_from_body--> world
          --inverse of world_from_camera--> camera --projection--> pixel

Every estimation here is of this form. A robot's pose: the body is the robot, its parts are the
markers. A rig: the same with the parts unknown. A network of cameras: bodies are the boards held
before the cameras, their parts the two faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera import Camera
from redetect.array_types import BoolArray, FloatArray, IntArray
from redetect.groundtruth.trajectories.transforms import apply, hat, inverse


@dataclass(frozen=True, eq=False)
class ChainPoints:
    """Points seen in images."""

    # `camera`, `body`, `part`: (N,): which camera, body and part each point belongs to
    camera: IntArray
    body: IntArray
    part: IntArray
    points: FloatArray  # (N, 3): in the part's frame (m)
    pixels: FloatArray  # (N, 2): where they were seen, lens distortion included (px)
    covariances: FloatArray  # (N, 2, 2): of the pixels (px^2), positive definite

    def __len__(self) -> int:
        return len(self.camera)

    def only(self, chosen: BoolArray | IntArray) -> ChainPoints:
        """The chosen ones."""
        return ChainPoints(
            self.camera[chosen],
            self.body[chosen],
            self.part[chosen],
            self.points[chosen],
            self.pixels[chosen],
            self.covariances[chosen],
        )


@dataclass(frozen=True, eq=False)
class ChainProjection:
    """Pixels of points and how they move with right perturbations of the three poses."""

    # (N, 2): naN where a point is not in front of its camera or past the distortion's fold
    pixels: FloatArray
    # `by_camera`, `by_body`, `by_part`: (N, 2, 6): d(u, v) / d(translation m, rotation rad)
    by_camera: FloatArray
    by_body: FloatArray
    by_part: FloatArray


def project_chain(
    cameras: Sequence[Camera],
    world_from_camera: FloatArray,
    world_from_body: FloatArray,
    body_from_part: FloatArray,
    seen: ChainPoints,
) -> FloatArray:
    """(N, 2) pixels at which the points would be seen (see `ChainProjection.pixels`).

    `cameras`: their lenses; the mounting that a `Camera` holds is not used. `world_from_camera`,
    `world_from_body`, `body_from_part` (C | B | P, 4, 4). `seen`: its pixels are not used.
    """
    in_body = apply(body_from_part[seen.part], seen.points)
    in_world = apply(world_from_body[seen.body], in_body)
    in_camera = apply(inverse(world_from_camera)[seen.camera], in_world)
    pixels = np.empty((len(seen), 2))
    for index in np.unique(seen.camera):
        chosen = seen.camera == index
        pixels[chosen] = cameras[index].project(in_camera[chosen])
    return pixels


def project_chain_with_jacobians(
    cameras: Sequence[Camera],
    world_from_camera: FloatArray,
    world_from_body: FloatArray,
    body_from_part: FloatArray,
    seen: ChainPoints,
) -> ChainProjection:
    """Pixels and Jacobians; parameters as in `project_chain`."""
    camera_from_world = inverse(world_from_camera)[seen.camera]
    camera_from_body = camera_from_world @ world_from_body[seen.body]
    in_body = apply(body_from_part[seen.part], seen.points)
    in_camera = apply(camera_from_body, in_body)
    pixels = np.empty((len(seen), 2))
    by_point = np.empty((len(seen), 2, 3))
    for index in np.unique(seen.camera):
        chosen = seen.camera == index
        pixels[chosen] = cameras[index].project(in_camera[chosen])
        by_point[chosen] = cameras[index].project_jacobian(in_camera[chosen])
    by_body_point = by_point @ camera_from_body[:, :3, :3]
    by_part_point = by_body_point @ body_from_part[seen.part][:, :3, :3]
    return ChainProjection(
        pixels,
        -_by_tangent(by_point, in_camera),
        _by_tangent(by_body_point, in_body),
        _by_tangent(by_part_point, seen.points),
    )


def _by_tangent(by_point: FloatArray, points: FloatArray) -> FloatArray:
    """Chain d(u, v) / d(point) with d(point) / d(v, w) = [I, -[point]x]."""
    return np.concatenate([by_point, -(by_point @ hat(points))], axis=-1)
