"""From a scene and a camera pose to grey values: light on the sensor, optics, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import lens_numbers
from redetect.groundtruth.trajectories.transforms import planar_transform
from tools.arrays import ByteArray, Float32Array, FloatArray
from tools.simulator.scene import Scene

_INVERSE_NODES = 16384
_RAYS_ACROSS_EDGES = 12
_EDGE_CONTRAST = 0.035
_MIRROR_STRIDE = 2
_MIRROR_BLUR = (1.5, 2.5)  # standard deviations along u and v, in strides


class Light(NamedTuple):
    """Light on the full, interlaced frame and what it comes from."""

    radiance: Float32Array  # (2 H, W) light on each pixel; 1 is white paper in good light.
    seen: NDArray[np.int32]  # (2 H, W) a number for what each pixel's centre sees.
    depth: Float32Array  # (2 H, W) depth along the optical axis (m).


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
    return np.asarray((planar_transform(*pose) @ mounting)[:3])


def render_light(scene: Scene, camera: Camera, pose: FloatArray) -> Light:
    """Cast the rays of one frame. `pose` (3,)."""
    from scipy.ndimage import gaussian_filter

    from tools.simulator.frame_kernels import render_mirrored, render_radiance

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
) -> Float32Array:
    """Motion blur of an exposure that is at `pose` in its middle and at `pose_at_end` at its end.

    Both are robot poses (x, y, heading) in the world.
    """
    from tools.simulator.frame_kernels import smear

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


def _enlarged(image: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Bilinear enlargement of a raster of every `_MIRROR_STRIDE`-th pixel."""
    from scipy.ndimage import map_coordinates

    rows = np.arange(shape[0]) / _MIRROR_STRIDE
    columns = np.arange(shape[1]) / _MIRROR_STRIDE
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(map_coordinates(image, grid, order=1, mode="nearest"))


@dataclass(frozen=True)
class Sensor:
    """How the camera turns light into grey values."""

    blur_px: float = 0.9  # Blur of the optics, standard deviation in pixels of the full frame.
    video_blur_px: float = 0.5
    """Further blur along the lines: the bandwidth of analog video (pixels)."""
    glare: float = 0.03  # Share of the light that the lens scatters widely.
    vignetting: float = 0.25  # Loss of light in the image's corners.
    target: float = 0.42  # Mean grey value that the automatic gain aims at, as a share of white.
    gain_jitter: float = 0.06  # Standard deviation of the gain's logarithm from frame to frame.
    gamma: float = 0.8  # Exponent from light to grey value.
    noise_grey: float = 2.0  # Standard deviation of the noise in the dark, grey values.
    shot_noise_grey: float = 1.5
    """Standard deviation of the further noise at white, grey values; grows as the square root."""
    exposure: float = 0.03  # Time of exposure as a share of the time between frames.
    jpeg_quality: int = 80


def grey_values(radiance: Float32Array, sensor: Sensor, rng: np.random.Generator) -> ByteArray:
    """The field image that the camera gives of a frame's light.
    `radiance` (2 H, W); returns (H, W).
    """
    light = _through_lens(radiance, sensor)[::2]
    rows, columns = light.shape
    bright = np.clip(light, 0.0, 1.5).mean()
    gain = (sensor.target / max(float(bright), 1e-3)) ** 0.8
    gain *= np.exp(sensor.gain_jitter * rng.standard_normal())
    x = np.linspace(-1.0, 1.0, columns)[None, :]
    y = np.linspace(-1.0, 1.0, rows)[:, None] * 0.75
    falloff = 1.0 - sensor.vignetting * (x * x + y * y) / (1.0 + 0.75**2)
    exposed = np.clip(gain * falloff * light, 0.0, None)
    grey = 255.0 * exposed**sensor.gamma
    sigma = np.sqrt(
        sensor.noise_grey**2 + sensor.shot_noise_grey**2 * np.minimum(grey, 255.0) / 255.0
    )
    noisy = np.minimum(grey, 255.0) + sigma * rng.standard_normal(grey.shape)
    # Past saturation noise no longer shows.
    noisy = np.where(grey > 262.0, 255.0, noisy)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _through_lens(radiance: Float32Array, sensor: Sensor) -> FloatArray:
    import cv2

    light: NDArray[Any] = radiance.astype(np.float64)
    across = float(np.hypot(sensor.blur_px, sensor.video_blur_px))
    if across > 0.0:
        light = cv2.GaussianBlur(
            light, (0, 0), sigmaX=across, sigmaY=max(sensor.blur_px, 1e-3),
            borderType=cv2.BORDER_REPLICATE,
        )  # fmt: skip
    if sensor.glare > 0.0:
        small = cv2.resize(light, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
        wide = cv2.GaussianBlur(small, (0, 0), sigmaX=4.0, borderType=cv2.BORDER_REFLECT)
        scattered = cv2.resize(wide, light.shape[::-1], interpolation=cv2.INTER_LINEAR)
        light = (1.0 - sensor.glare) * light + sensor.glare * scattered
    return np.asarray(light)
