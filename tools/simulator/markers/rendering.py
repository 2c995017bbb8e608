"""From surfaces to light, edges exact, and from light to grey values.

Every pixel that an edge crosses is integrated over by many rays; all others see one texel. Truth
needs no rendering: corners are projected by `camera.Camera`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from camera import Camera
from camera.kernels import camera_numbers
from camera.uncertainty import with_pose
from redetect.array_types import ByteArray, Float32Array, FloatArray
from tools.simulator.markers.kernels import SurfaceArrays, mark_edges, shade
from tools.simulator.markers.surface import Surface, Texture, plain

#: Rays in each quarter of a pixel that an edge crosses.
SAMPLES = 16

# Smooth textures are reduced until a pixel sees about this many texels across.
_TEXELS_PER_PIXEL = 1.5


@lru_cache(maxsize=16)
def pixel_rays(camera: Camera) -> FloatArray:
    """What each pixel's centre sees, and how that changes across the pixel. Returns (H, W, 6)."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1)
    rays = np.empty((camera.height, camera.width, 6))
    rays[..., :2] = camera.undistort(pixels)
    for axis, step in enumerate(0.5 * np.eye(2)):
        change = camera.undistort(pixels + step) - camera.undistort(pixels - step)
        rays[..., 2 + axis], rays[..., 4 + axis] = change[..., 0], change[..., 1]
    rays.setflags(write=False)
    return rays


def render_light(
    camera: Camera,
    exposures: Sequence[Sequence[Surface]],
    background: Float32Array,
    *,
    fine: bool = True,
    samples: int = SAMPLES,
) -> Float32Array:
    """What a camera sees, before optics and electronics.
    `background` (H, W); returns (2 H, 2 W).
    """
    if background.shape != (camera.height, camera.width):
        raise ValueError(
            f"the background is {background.shape}: expected the camera's "
            f"{camera.height} x {camera.width}"
        )
    if samples < 1 or samples & (samples - 1):
        raise ValueError(f"{samples} rays: expected a power of two")
    # Surfaces are in the camera frame, wherever it is mounted.
    rays, numbers = pixel_rays(camera), camera_numbers(with_pose(camera, np.eye(3, 4)))
    light = background.copy()
    if fine:
        light = np.repeat(np.repeat(background, 2, axis=0), 2, axis=1)
    each = samples
    while each > 4 and each * len(exposures) > 2 * samples:
        each //= 2
    for surfaces in exposures:
        arrays = surface_arrays(camera, surfaces)
        crossed = np.zeros((2 * camera.height, 2 * camera.width), np.uint8)
        boxes = np.empty((len(arrays.sizes), 4), np.int64)
        mark_edges(crossed, boxes, numbers, arrays)
        shade(light, 1.0 / len(exposures), crossed, rays, boxes, arrays, each, background)
    return light


def surface_arrays(camera: Camera, surfaces: Sequence[Surface]) -> SurfaceArrays:
    """Surfaces as the kernels take them; those that turn their back and have none are left out."""
    matrices, sizes, texels, smooth, index = [], [], [], [], []
    for number, surface in enumerate(surfaces):
        texture = surface.texture
        if surface.pose[:3, 2] @ surface.pose[:3, 3] >= 0.0:
            if np.isnan(surface.back):
                continue
            texture = _back_of(surface)
        elif texture.smooth:
            texture = _reduced(texture, _pixels_across(camera, surface))
        rows, columns = texture.values.shape
        matrix = np.empty((3, 3))
        matrix[:, 0] = surface.pose[:3, 0] * (surface.width_m / columns)
        matrix[:, 1] = -surface.pose[:3, 1] * (surface.height_m / rows)
        matrix[:, 2] = surface.corners()[0]
        if abs(np.linalg.det(matrix)) < 1e-15 * np.abs(matrix).max() ** 3:
            continue  # seen exactly from the side
        index.append(number)
        matrices.append(matrix)
        sizes.append((rows, columns))
        texels.append(texture.values.ravel())
        smooth.append(texture.smooth)
    from_texel = np.array(matrices).reshape(-1, 3, 3)
    ends = np.cumsum([0, *(len(values) for values in texels)])
    return SurfaceArrays(
        from_texel=from_texel,
        to_texel=np.asarray(np.linalg.inv(from_texel), dtype=np.float64),
        sizes=np.array(sizes, dtype=np.int64).reshape(-1, 2),
        starts=ends[:-1].astype(np.int64),
        texels=np.concatenate([*texels, np.zeros(0, np.float32)]),
        smooth=np.array(smooth, dtype=np.uint8),
        given=np.array(index, dtype=np.int64),
    )


def _back_of(surface: Surface) -> Texture:
    """What a surface shows from behind: its outline and holes, mirrored by being the same plane."""
    values = surface.texture.values
    if not surface.texture.smooth and np.isnan(values).any():
        return Texture(np.where(np.isnan(values), values, np.float32(surface.back)))
    return plain(surface.back)


def _pixels_across(camera: Camera, surface: Surface) -> float:
    """Least extent of a surface in the image, pixels; infinite where part of it is not seen."""
    pixels = camera.project(surface.corners())
    sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1)
    if np.isnan(sides).any():
        return float("inf")
    # Top and bottom are the sides 1 and 3, left and right 0 and 2.
    rows, columns = surface.texture.values.shape
    across = max(sides[1], sides[3]) / columns
    upward = max(sides[0], sides[2]) / rows
    return float(min(across, upward) * max(rows, columns))


def _reduced(texture: Texture, pixels: float) -> Texture:
    """A texture of which a pixel does not see too many texels."""
    factor = max(texture.values.shape) / max(_TEXELS_PER_PIXEL * pixels, 1.0)
    if factor <= 1.0:
        return texture
    rows, columns = texture.values.shape
    size = max(1, round(columns / factor)), max(1, round(rows / factor))
    values = cv2.resize(texture.values, size, interpolation=cv2.INTER_AREA)
    return Texture(np.asarray(values, dtype=np.float32), smooth=True)


# Wider blurs, pixels, are applied to whole pixels: cheaper, and nearly the same.
_FINE_BELOW_PX = 1.0
_COARSE = 4


@dataclass(frozen=True)
class Imaging:
    """How light becomes grey values."""

    blur_px: float = 0.7  # Standard deviation of the optics' Gaussian blur, pixels.
    black_level: float = 10.0  # Grey value of no light at all.
    gain: float = 220.0  # Grey levels per reflectance in full light.
    noise_grey: float = 2.0  # Standard deviation of the noise, grey levels.

    @property
    def fine(self) -> bool:
        """Whether the blur is so narrow that light is needed on a grid of half pixels."""
        return self.blur_px < _FINE_BELOW_PX


def grey_image(
    light: Float32Array,
    illumination: Float32Array | float,
    imaging: Imaging,
    rng: np.random.Generator,
) -> ByteArray:
    """The image that a camera gives. `light` (2 H, 2 W); `illumination` (H, W); returns (H, W)."""
    grey = exact_grey(light, illumination, imaging)
    noise = rng.standard_normal(grey.shape, dtype=np.float32)
    noisy = grey + np.float32(imaging.noise_grey) * noise + np.float32(0.5)
    return np.clip(noisy, 0.0, 255.0).astype(np.uint8)


def exact_grey(
    light: Float32Array, illumination: Float32Array | float, imaging: Imaging
) -> Float32Array:
    """(H, W) float32 grey values before noise and rounding; parameters as in `grey_image`."""
    sigma = imaging.blur_px
    pixels = light
    if imaging.fine:
        # Sampled at whole pixels, so narrow a kernel would not be Gaussian.
        rows, columns = light.shape
        blurred = _blurred(light, 2.0 * sigma) if sigma > 0.0 else light
        size = columns // 2, rows // 2
        pixels = np.asarray(cv2.resize(blurred, size, interpolation=cv2.INTER_AREA))
    else:
        pixels = _blurred(light, sigma)
    grey = np.asarray(pixels, dtype=np.float32) * np.float32(imaging.gain)
    grey *= illumination
    grey += np.float32(imaging.black_level)
    return grey


def _blurred(image: Float32Array, sigma: float) -> Float32Array:
    reach = int(np.ceil(4.5 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel /= kernel.sum()
    return np.asarray(
        cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    )


def uneven_light(
    rng: np.random.Generator, width: int, height: int, strength: float, shadows: int
) -> Float32Array:
    """Light that falls off over the image, with soft shadows and vignetting.
    Returns (height, width).
    """
    rows, columns = -(-height // _COARSE), -(-width // _COARSE)
    y, x = np.mgrid[-1.0 : 1.0 : rows * 1j, -1.0 : 1.0 : columns * 1j].astype(np.float32)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slope = 0.55 * strength * rng.uniform(0.3, 1.0)
    light = np.exp(slope * (np.cos(direction) * x + np.sin(direction) * y))
    light *= 1.0 - 0.3 * strength * rng.random() * (x * x + y * y) / 2.0
    for _ in range(shadows):
        # The edge of a shadow: a line, or a disc's rim.
        softness = rng.uniform(0.02, 0.3)
        if rng.random() < 0.5:
            angle, offset = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.7, 0.7)
            inside = np.cos(angle) * x + np.sin(angle) * y - offset
        else:
            centre, radius = rng.uniform(-0.8, 0.8, 2), rng.uniform(0.15, 0.6)
            inside = radius - np.hypot(x - centre[0], y - centre[1])
        depth = rng.uniform(0.2, 0.65)
        light *= 1.0 - depth / (1.0 + np.exp(-np.clip(inside / (0.25 * softness), -30.0, 30.0)))
    light = (light / light.max()).astype(np.float32)
    fine = cv2.resize(light, (columns * _COARSE, rows * _COARSE), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width], dtype=np.float32)
