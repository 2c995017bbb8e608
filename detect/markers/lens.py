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
from detect.markers.lens_kernels import bend_points, straighten_points, straightened

FloatArray = NDArray[np.float64]

#: Spacing for bilinear interpolation; the error is an eighth of its square times the curvature.
_STEP_PX = 2


@dataclass(frozen=True, eq=False)
class Lens:
    """Where pixels are in an image without distortion.

    Attributes
    ----------
    grid : (H, W, 2) float64
        Straight position of every so manieth pixel; empty without distortion.
    step : float
        Distance of the grid's pixels.
    """

    grid: FloatArray
    step: float

    def straighten(self, pixels: FloatArray) -> FloatArray:
        """(N, 2) straight positions of (N, 2) pixels."""
        return np.asarray(straighten_points(self.grid, self.step, pixels))

    def bend(self, straight: FloatArray, guess: FloatArray) -> FloatArray:
        """(N, 2) pixels of (N, 2) straight positions; NaN where there is none.

        `guess` (2,) is a pixel not far away.
        """
        return np.asarray(bend_points(self.grid, self.step, straight, guess))

    def pixel_jacobian(self, pixel: FloatArray) -> FloatArray:
        """(2, 2) d(pixel) / d(straight position) at a pixel (2,)."""
        _, _, xu, xv, yu, yv = straightened(self.grid, self.step, pixel[0], pixel[1])
        return np.asarray(np.linalg.inv(np.array([[xu, xv], [yu, yv]])))


NO_LENS = Lens(np.empty((0, 0, 2)), 1.0)


def lens_of(camera: Camera | None, image: NDArray[np.uint8]) -> Lens:
    """The lens that an image was taken through.

    Parameters
    ----------
    camera : Camera or None
        The calibration; without one, straight edges are straight in the image.
    image : (H, W) uint8
        The image.

    Returns
    -------
    Lens

    Raises
    ------
    FrameError
        If the image has not the camera's size, or the camera sees nothing at some of its pixels.
    """
    if camera is None:
        return NO_LENS
    if image.shape != (camera.height, camera.width):
        raise FrameError(
            f"the image is {image.shape[1]}x{image.shape[0]} px: "
            f"the calibration is for {camera.width}x{camera.height}"
        )
    return _cached_lens(camera)


@functools.lru_cache(maxsize=8)
def _cached_lens(camera: Camera) -> Lens:
    if not (any(camera.coef[:2]) or any(camera.brown)):
        return NO_LENS
    if min(camera.width, camera.height) < 2:
        return NO_LENS  # a row of pixels shows no marker
    # The last cell may reach past the border, where the distortion need not be defined.
    u = np.minimum(np.arange(0, camera.width - 1 + _STEP_PX, _STEP_PX), camera.width - 1.0)
    v = np.minimum(np.arange(0, camera.height - 1 + _STEP_PX, _STEP_PX), camera.height - 1.0)
    u_there, v_there = np.arange(len(u)) * _STEP_PX, np.arange(len(v)) * _STEP_PX
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    scale = np.array([camera.scale_x, camera.scale_y])
    grid = camera.undistort(pixels) * scale + np.array([camera.offset_x, camera.offset_y])
    if not np.all(np.isfinite(grid)):
        raise FrameError("the calibration leaves pixels of the image without a direction")
    # Continue the last cells to where they would have ended.
    grid[:, -1] += (grid[:, -1] - grid[:, -2]) * ((u_there[-1] - u[-1]) / (u[-1] - u[-2]))
    grid[-1] += (grid[-1] - grid[-2]) * ((v_there[-1] - v[-1]) / (v[-1] - v[-2]))
    return Lens(np.ascontiguousarray(grid), float(_STEP_PX))
