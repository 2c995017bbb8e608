"""From pixels to the rays that are rendered, and from what these show to an image."""

from __future__ import annotations

import numpy as np

from camera import Camera
from redetect.array_types import ByteArray, FloatArray


def subpixel_grid(camera: Camera, across: int, down: int) -> FloatArray:
    """(down H, across W, 2) places in the image, `across` times `down` evenly in each pixel."""
    u = (np.arange(camera.width * across) + 0.5) / across - 0.5
    v = (np.arange(camera.height * down) + 0.5) / down - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def image_of(grey: FloatArray) -> ByteArray:
    """Grey values, rounded and within the range of an image."""
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def noisy_image(grey: FloatArray, noise: float, rng: np.random.Generator) -> ByteArray:
    """Grey values with a sensor's noise, whose standard deviation is given."""
    return image_of(grey + rng.normal(0.0, noise, grey.shape))
