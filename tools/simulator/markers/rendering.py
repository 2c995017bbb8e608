"""From surfaces to light: what every quarter of a pixel of a camera sees, edges exact.

Every pixel that an edge crosses is integrated over by many rays; all others see one texel. Truth
needs no rendering: corners are projected by `camera.Camera`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from tools.simulator.markers.kernels import mark_edges, shade
from tools.simulator.markers.surface import FloatArray, Surface, Texture, plain

#: Rays in each quarter of a pixel that an edge crosses.
SAMPLES = 16

# Smooth textures are reduced until a pixel sees about this many texels across.
_TEXELS_PER_PIXEL = 1.5


@lru_cache(maxsize=16)
def pixel_rays(camera: Camera) -> FloatArray:
    """What each pixel's centre sees, and how that changes across the pixel.

    Parameters
    ----------
    camera : Camera
        The camera.

    Returns
    -------
    (H, W, 6) float64
        Normalised coordinates x, y and the derivatives dx/du, dx/dv, dy/du, dy/dv (1/px), by
        central differences over a pixel.
    """
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1)
    rays = np.empty((camera.height, camera.width, 6))
    rays[..., :2] = camera.undistort(pixels)
    for axis in range(2):
        step = np.array([0.5, 0.0]) if axis == 0 else np.array([0.0, 0.5])
        change = camera.undistort(pixels + step) - camera.undistort(pixels - step)
        rays[..., 2 + axis], rays[..., 4 + axis] = change[..., 0], change[..., 1]
    rays.setflags(write=False)
    return rays


def render_light(
    camera: Camera,
    exposures: Sequence[Sequence[Surface]],
    background: NDArray[np.float32],
    *,
    fine: bool = True,
    samples: int = SAMPLES,
) -> NDArray[np.float32]:
    """What a camera sees, before optics and electronics.

    Parameters
    ----------
    camera : Camera
        The camera; its pose on a robot does not matter.
    exposures : sequence of sequences of Surface
        The surfaces in the camera frame, at each of some equally spaced instants while the shutter
        is open. The nearest surface is seen.
    background : (H, W) float32
        Reflectance that is seen where there is no surface.
    fine : bool
        Whether the result is on a grid of half pixels, for optics that blur less than a pixel.
    samples : int
        Rays in each quarter of a pixel that an edge crosses, a power of two; they are shared among
        the exposures.

    Returns
    -------
    (2 H, 2 W) or (H, W) float32
        Mean reflectance over each quarter of a pixel, or each pixel.

    Raises
    ------
    ValueError
        If the background's shape is not the camera's, or `samples` is no power of two.
    """
    if background.shape != (camera.height, camera.width):
        raise ValueError(
            f"the background is {background.shape}: expected the camera's "
            f"{camera.height} x {camera.width}"
        )
    if samples < 1 or samples & (samples - 1):
        raise ValueError(f"{samples} rays: expected a power of two")
    rays, numbers = pixel_rays(camera), camera_numbers(camera)
    light = background.copy()
    if fine:
        light = np.repeat(np.repeat(background, 2, axis=0), 2, axis=1)
    each = samples
    while each > 4 and each * len(exposures) > 2 * samples:
        each //= 2
    for surfaces in exposures:
        arrays = SurfaceArrays(camera, surfaces)
        crossed = np.zeros((2 * camera.height, 2 * camera.width), np.uint8)
        boxes = np.empty((len(arrays.sizes), 4), np.int64)
        mark_edges(
            crossed, boxes, numbers, arrays.from_texel, arrays.sizes, arrays.starts,
            arrays.texels, arrays.smooth,
        )  # fmt: skip
        shade(
            light, 1.0 / len(exposures), crossed, rays, boxes, arrays.to_texel,
            arrays.sizes, arrays.starts, arrays.texels, arrays.smooth, each, background,
        )  # fmt: skip
    return light


class SurfaceArrays:
    """Surfaces as the kernels take them; those that turn their back and have none are left out."""

    def __init__(self, camera: Camera, surfaces: Sequence[Surface]) -> None:
        matrices, sizes, starts, texels, smooth = [], [], [], [], []
        self.index: list[int] = []
        start = 0
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
            self.index.append(number)
            matrices.append(matrix)
            sizes.append((rows, columns))
            starts.append(start)
            texels.append(texture.values.ravel())
            smooth.append(texture.smooth)
            start += rows * columns
        self.from_texel: FloatArray = np.array(matrices).reshape(-1, 3, 3)
        self.to_texel: FloatArray = np.asarray(np.linalg.inv(self.from_texel), dtype=np.float64)
        self.sizes = np.array(sizes, dtype=np.int64).reshape(-1, 2)
        self.starts = np.array(starts, dtype=np.int64)
        self.texels = np.concatenate([*texels, np.zeros(0, np.float32)])
        self.smooth = np.array(smooth, dtype=np.uint8)


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
    import cv2

    rows, columns = texture.values.shape
    size = max(1, round(columns / factor)), max(1, round(rows / factor))
    values = cv2.resize(texture.values, size, interpolation=cv2.INTER_AREA)
    return Texture(np.asarray(values, dtype=np.float32), smooth=True)
