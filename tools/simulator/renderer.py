"""From a world and a camera pose to the light on the sensor, line by line of the full frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import lens_numbers
from tools.simulator.poses import world_from_robot
from tools.simulator.scene import FloatArray, Scene

_INVERSE_NODES = 16384
_RAYS_ACROSS_EDGES = 12
_EDGE_CONTRAST = 0.035
_MIRROR_STRIDE = 2
_MIRROR_BLUR = (1.5, 2.5)  # standard deviations along u and v, in strides


class Light(NamedTuple):
    """Light on the full, interlaced frame and what it comes from."""

    radiance: NDArray[np.float32]
    """(2 H, W) light on each pixel; 1 is white paper in good light."""
    seen: NDArray[np.int32]
    """(2 H, W) a number for what each pixel's centre sees."""
    depth: NDArray[np.float32]
    """(2 H, W) depth along the optical axis (m)."""


@dataclass(frozen=True)
class Optics:
    """The camera's projection as the ray caster takes it."""

    numbers: FloatArray
    """scaleX, scaleY, offsetX, offsetY, nodes of `inverse` per unit of squared radius, and
    `camera.kernels.lens_numbers`."""
    inverse: FloatArray
    """Undistorted over distorted radius at equal steps of the squared distorted radius, by the
    radial distortion."""


def optics_of(camera: Camera) -> Optics:
    """Tabulate the inverse of a camera's distortion over its image."""
    u = np.array([-1.0, camera.width]) - camera.offset_x
    v = np.array([-1.0, camera.height + 0.5]) - camera.offset_y
    reach = np.hypot(np.abs(u).max() / camera.scale_x, np.abs(v).max() / camera.scale_y)
    radius = np.sqrt(np.linspace(0.0, reach * reach, _INVERSE_NODES))
    pixels = np.stack(
        [camera.offset_x + camera.scale_x * radius, np.full_like(radius, camera.offset_y)], axis=-1
    )
    ratio = np.ones_like(radius)
    radial = replace(camera, tangential=(0.0, 0.0))
    ratio[1:] = radial.undistort(pixels)[1:, 0] / radius[1:]
    if np.isnan(ratio).any():
        raise ValueError("the camera's image reaches past the fold of its distortion")
    numbers = (camera.scale_x, camera.scale_y, camera.offset_x, camera.offset_y)
    per_unit = (_INVERSE_NODES - 1) / (reach * reach)
    return Optics(np.array([*numbers, per_unit, *lens_numbers(camera)]), ratio)


def camera_in_world(camera: Camera, pose: FloatArray) -> FloatArray:
    """(3, 4) pose in the world of a camera on a robot at (x, y, heading)."""
    mounting = np.vstack([np.array(camera.robot_from_camera), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray((world_from_robot(pose) @ mounting)[:3])


def render_light(scene: Scene, camera: Camera, pose: FloatArray) -> Light:
    """Cast the rays of one frame.

    Parameters
    ----------
    scene : Scene
        The world.
    camera : Camera
        The camera of the field image, mounted as it really is (tilt included).
    pose : (3,) array
        x, y (m) and heading (rad) of the robot in the world.

    Returns
    -------
    Light
        The full frame: line 2 v is row v of the camera's image.
    """
    from scipy.ndimage import gaussian_filter

    from tools.simulator.frame.kernels import render_mirrored, render_radiance

    optics = optics_of(camera)
    world_from_camera = camera_in_world(camera, pose)
    light, seen, mirrored, depth = render_radiance(
        scene, optics.numbers, optics.inverse, world_from_camera, camera.width, 2 * camera.height,
        _ray_offsets(_RAYS_ACROSS_EDGES), _EDGE_CONTRAST,
    )  # fmt: skip
    if mirrored.any():
        image, weight = render_mirrored(
            scene, optics.numbers, optics.inverse, world_from_camera, mirrored, _MIRROR_STRIDE
        )
        # A floor mirrors blurred; where it ends, nothing of the wall may be mixed in.
        blur = (_MIRROR_BLUR[1], _MIRROR_BLUR[0])
        share = np.maximum(gaussian_filter(weight, blur), 1e-6)
        image = gaussian_filter(image, blur) / share
        light = light * (1.0 - mirrored) + mirrored * _enlarged(image, light.shape)
    return Light(light, seen, depth)


def smeared(
    light: Light, camera: Camera, pose: FloatArray, pose_at_end: FloatArray
) -> NDArray[np.float32]:
    """Motion blur of an exposure that is at `pose` in its middle and at `pose_at_end` at its end.

    Both are robot poses (x, y, heading) in the world.
    """
    from tools.simulator.frame.kernels import smear

    optics = optics_of(camera)
    now, later = camera_in_world(camera, pose), camera_in_world(camera, pose_at_end)
    rotation = later[:, :3].T @ now[:, :3]
    shift = later[:, :3].T @ (now[:, 3] - later[:, 3])
    return np.asarray(
        smear(
            light.radiance, light.seen, light.depth, optics.numbers, optics.inverse,
            np.ascontiguousarray(np.column_stack([rotation, shift])),
        )
    )  # fmt: skip


def _ray_offsets(count: int) -> FloatArray:
    """(count, 2) places in a pixel, all at different columns and rows (a rank-1 lattice)."""
    k = np.arange(count)
    golden = 0.6180339887498949
    return np.stack([(k + 0.5) / count - 0.5, np.mod((k + 0.5) * golden, 1.0) - 0.5], axis=-1)


def _enlarged(image: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Bilinear enlargement of a raster of every `_MIRROR_STRIDE`-th pixel."""
    from scipy.ndimage import map_coordinates

    rows = np.arange(shape[0]) / _MIRROR_STRIDE
    columns = np.arange(shape[1]) / _MIRROR_STRIDE
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(map_coordinates(image, grid, order=1, mode="nearest"))
