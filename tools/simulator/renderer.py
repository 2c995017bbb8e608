"""From a scene and a camera pose to grey values: light on the sensor, optics, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from camera import Camera
from camera.uncertainty import IDENTITY
from redetect.array_types import BoolArray, ByteArray, Float32Array, FloatArray
from tools.simulator.driving import planar_transform
from tools.simulator.pixels import image_of
from tools.simulator.ray_kernels import SKY, light_along
from tools.simulator.scene import Scene

_RAYS_ACROSS_EDGES = 12
_EDGE_CONTRAST = 0.035
_MIRROR_STRIDE = 2
_MIRROR_BLUR = (1.5, 2.5)  # standard deviations along u and v, in strides
_ABOVE_FLOOR_M = 1e-4
_SKY_M = 1e4


class Light(NamedTuple):
    """Light on the full, interlaced frame, and its sources."""

    radiance: Float32Array  # (2 H, W) light on each pixel; 1 is white paper in good light.
    seen: NDArray[np.int32]  # (2 H, W) number of what each pixel's centre sees.
    depth: Float32Array  # (2 H, W) depth along the optical axis (m).


@lru_cache(maxsize=4)
def _pixel_rays(lens: Camera) -> FloatArray:
    """(2 H, W, 3) directions in the camera frame that the pixels of the full frame see."""
    places = np.meshgrid(np.arange(lens.width), 0.5 * np.arange(2 * lens.height))
    return _rays(lens, np.stack(places, axis=-1))


def _rays(camera: Camera, pixels: FloatArray) -> FloatArray:
    rays = camera.unproject(pixels)
    if np.isnan(rays).any():
        raise ValueError("the camera's image reaches past the fold of its distortion")
    return rays


def camera_in_world(camera: Camera, pose: FloatArray) -> FloatArray:
    """(3, 4) pose in the world of a camera on a robot at (x, y, heading)."""
    mounting = np.vstack([np.array(camera.robot_from_camera), [0.0, 0.0, 0.0, 1.0]])
    return np.asarray((planar_transform(*pose) @ mounting)[:3])


def render_light(scene: Scene, camera: Camera, pose: FloatArray) -> Light:
    """Cast the rays of one frame, more of them through pixels across an edge. `pose` (3,)."""
    world_from_camera = camera_in_world(camera, pose)
    eye, angle = world_from_camera[:, 3], 1.0 / camera.scale_x

    def cast(rays: FloatArray) -> list[Any]:
        directions = (rays @ world_from_camera[:, :3].T).reshape(-1, 3)
        found = light_along(scene, np.tile(eye, (len(directions), 1)), directions, angle)
        return [values.reshape(rays.shape[:-1]) for values in found]

    rays = _pixel_rays(replace(camera, robot_from_camera=IDENTITY))
    light, seen, mirrored, depth = cast(rays)
    edges = _across_edges(light, seen)
    line, u = np.nonzero(edges)
    offsets = _ray_offsets(_RAYS_ACROSS_EDGES)
    places = u[:, None] + offsets[:, 0], 0.5 * (line[:, None] + offsets[:, 1])
    several, _, glossy, _ = cast(_rays(camera, np.stack(places, axis=-1)))
    light[edges], mirrored[edges] = several.mean(axis=1), glossy.mean(axis=1)
    coarse = slice(None, None, _MIRROR_STRIDE)
    directions = rays[coarse, coarse] @ world_from_camera[:, :3].T
    reflecting = (mirrored[coarse, coarse] > 0.0) & (directions[..., 2] < 0.0)
    if reflecting.any():
        down = directions[reflecting]
        floor = eye - (eye[2] / down[:, 2:]) * down
        floor[:, 2] = _ABOVE_FLOOR_M
        weight = reflecting.astype(np.float32)
        image = np.zeros_like(weight)
        image[reflecting] = light_along(scene, floor, down * [1.0, 1.0, -1.0], 8.0 * angle)[0]
        # A floor reflects blurred; at its end, the wall must not be mixed in.
        blur = (_MIRROR_BLUR[1], _MIRROR_BLUR[0])
        share = np.maximum(gaussian_filter(weight, blur), 1e-6)
        image = gaussian_filter(image, blur) / share
        light = light * (1.0 - mirrored) + mirrored * _enlarged(image, light.shape)
    return Light(light, seen, depth)


def _across_edges(light: Float32Array, seen: NDArray[np.int32]) -> BoolArray:
    """Which pixels differ from a neighbour in what they see, or in its light."""
    across = np.zeros(light.shape, dtype=np.bool_)
    for first, second in ((np.s_[:-1, :], np.s_[1:, :]), (np.s_[:, :-1], np.s_[:, 1:])):
        a, b = light[first], light[second]
        differ = (seen[first] != seen[second]) | (np.abs(a - b) > _EDGE_CONTRAST * (a + b))
        across[first] |= differ
        across[second] |= differ
    return across


def smeared(
    light: Light, camera: Camera, pose: FloatArray, pose_at_end: FloatArray
) -> Float32Array:
    """Motion blur of an exposure that is at `pose` in its middle and at `pose_at_end` at its end:
    the mean along each pixel's path.

    Both are robot poses (x, y, heading) in the world.
    """
    now, later = camera_in_world(camera, pose), camera_in_world(camera, pose_at_end)
    rays = _pixel_rays(replace(camera, robot_from_camera=IDENTITY))
    depth = np.where(light.seen == SKY, _SKY_M, light.depth)
    points = (rays * depth[..., None]) @ now[:, :3].T + now[:, 3]
    ends = camera.project((points - later[:, 3]) @ later[:, :3])
    places = np.indices(depth.shape).reshape(2, -1)
    # What leaves the field of view stays where it is.
    way = np.nan_to_num((ends[..., ::-1] * [2.0, 1.0]).reshape(-1, 2).T - places)
    steps = np.ceil(2.0 * np.hypot(*way)).astype(np.int64)
    total = light.radiance.ravel().astype(np.float64)
    for step in range(1, steps.max() + 1):
        moving = steps >= step
        off = (step / steps[moving]) * way[:, moving]
        for side in (-off, off):
            total[moving] += map_coordinates(
                light.radiance, places[:, moving] + side, order=1, mode="nearest"
            )
    return np.asarray((total / (2 * steps + 1)).reshape(depth.shape), dtype=np.float32)


def _ray_offsets(count: int) -> FloatArray:
    """(count, 2) places in a pixel, all at different columns and rows (a rank-1 lattice)."""
    k = np.arange(count)
    golden = 0.6180339887498949
    return np.stack([(k + 0.5) / count - 0.5, np.mod((k + 0.5) * golden, 1.0) - 0.5], axis=-1)


def _enlarged(image: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Bilinear enlargement of a raster of every `_MIRROR_STRIDE`-th pixel."""
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
    jpeg_quality: int = 80  # Of the images, 0 to 100.


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
    return image_of(noisy)


def _through_lens(radiance: Float32Array, sensor: Sensor) -> FloatArray:
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
