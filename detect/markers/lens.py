"""Straight pixels: the image's positions with the lens's distortion removed.

Edges of markers are straight in a pinhole image only. Everything that is fitted to edges is
therefore fitted at *straight* positions, ``(scale x + offset)`` of the undistorted normalised
coordinates, and what comes out is bent back. Without a camera both are the same.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.noise import estimate_noise

FloatArray = NDArray[np.float64]

#: Rows of the image that its noise is estimated from.
_NOISE_ROWS = 64
#: Step of finite differences of the distortion, pixels.
_STEP_PX = 0.5


@dataclass(frozen=True, eq=False)
class Picture:
    """An image, its noise's standard deviation, and the camera that it was taken by, if known."""

    grey: NDArray[np.uint8]  # (H, W)
    noise: float
    camera: Camera | None
    straight: NDArray[np.float32]  # (H, W, 2) straight position of each pixel

    def straighten(self, pixels: FloatArray) -> FloatArray:
        """(N, 2) straight positions of (N, 2) pixels."""
        return pixels if self.camera is None else _straightened(self.camera, pixels)

    def bend(self, straight: FloatArray) -> FloatArray:
        """(N, 2) pixels of (N, 2) straight positions; NaN where there is none."""
        c = self.camera
        if c is None:
            return straight
        return c.distort((straight - [c.offset_x, c.offset_y]) / [c.scale_x, c.scale_y])

    def pixel_jacobians(self, pixels: FloatArray) -> FloatArray:
        """(N, 2, 2) d(pixel) / d(straight position) at (N, 2) pixels."""
        steps = _STEP_PX * np.eye(2)
        columns = [
            (self.straighten(pixels + step) - self.straighten(pixels - step)) / (2.0 * _STEP_PX)
            for step in steps
        ]
        return np.asarray(np.linalg.inv(np.stack(columns, axis=-1)))


def picture_of(image: NDArray[np.uint8], camera: Camera | None) -> Picture:
    """An image (H, W) with its noise and the lens that it was taken through.

    Raises FrameError if the image has not the camera's size, or the camera sees nothing at some of
    its pixels.
    """
    if camera is not None and image.shape != (camera.height, camera.width):
        raise FrameError(
            f"the image is {image.shape[1]}x{image.shape[0]} px: "
            f"the calibration is for {camera.width}x{camera.height}"
        )
    height, width = image.shape
    grey = np.ascontiguousarray(image)
    noise = estimate_noise(grey, _NOISE_ROWS)
    return Picture(grey, noise, camera, _straight_positions(camera, width, height))


@functools.lru_cache(maxsize=4)
def _straight_positions(camera: Camera | None, width: int, height: int) -> NDArray[np.float32]:
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    pixels = np.stack([u, v], axis=-1)
    straight = pixels if camera is None else _straightened(camera, pixels)
    if not np.all(np.isfinite(straight)):
        raise FrameError("the calibration leaves pixels of the image without a direction")
    return np.asarray(straight, np.float32)


def _straightened(camera: Camera, pixels: FloatArray) -> FloatArray:
    scale, offset = [camera.scale_x, camera.scale_y], [camera.offset_x, camera.offset_y]
    return np.asarray(np.add(camera.undistort(pixels) * scale, offset))
