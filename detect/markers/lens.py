"""Straight pixels: the image's positions with the lens's distortion removed.

Edges of markers are straight in a pinhole image only. Everything that is fitted to edges is
therefore fitted at *straight* positions, ``(scale x + offset)`` of the undistorted normalised
coordinates, and what comes out is bent back. Without a camera both are the same.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.noise import estimate_noise

FloatArray = NDArray[np.float64]

#: Spacing for bilinear interpolation; the error is an eighth of its square times the curvature.
_STEP_PX = 2.0
_NEWTON_STEPS = 20
_CLOSE_ENOUGH = 1e-7
#: Rows of the image that its noise is estimated from.
_NOISE_ROWS = 64


class Lens(NamedTuple):
    """Where pixels are in an image without distortion."""

    grid: FloatArray  # (H, W, 2) straight position of pixel (step_u * i, step_v * j) at [j, i]
    step_u: float
    step_v: float

    def straighten(self, pixels: FloatArray) -> FloatArray:
        """(N, 2) straight positions of (N, 2) pixels."""
        return np.asarray(_straighten_points(self, pixels))

    def bend(self, straight: FloatArray) -> FloatArray:
        """(N, 2) pixels of (N, 2) straight positions; NaN where there is none."""
        return np.asarray(_bend_points(self, straight))

    def pixel_jacobian(self, pixel: FloatArray) -> FloatArray:
        """(2, 2) d(pixel) / d(straight position) at a pixel (2,)."""
        _, _, xu, xv, yu, yv = straightened(self, pixel[0], pixel[1])
        return np.asarray(np.linalg.inv(np.array([[xu, xv], [yu, yv]])))


class Picture(NamedTuple):
    """An image (H, W) uint8, the lens that it was taken through, its noise's standard deviation."""

    grey: NDArray[np.uint8]
    lens: Lens
    noise: float


#: A grid of one cell, which is continued.
NO_LENS = Lens(np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 1.0]]]), 1.0, 1.0)


def picture_of(image: NDArray[np.uint8], camera: Camera | None) -> Picture:
    """An image with its lens and its noise; errors as of `lens_of`."""
    lens = lens_of(camera, image)
    image = np.ascontiguousarray(image)
    return Picture(image, lens, estimate_noise(image, _NOISE_ROWS))


def lens_of(camera: Camera | None, image: NDArray[np.uint8]) -> Lens:
    """The lens that an image (H, W) was taken through.

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
    undistorted = not (any(camera.coef[:2]) or any(camera.brown))
    if undistorted or min(camera.width, camera.height) < 2:  # a row of pixels shows no marker
        return NO_LENS
    u, step_u = _nodes(camera.width)
    v, step_v = _nodes(camera.height)
    normalised = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    grid = normalised * [camera.scale_x, camera.scale_y] + [camera.offset_x, camera.offset_y]
    if not np.all(np.isfinite(grid)):
        raise FrameError("the calibration leaves pixels of the image without a direction")
    return Lens(grid, step_u, step_v)


def _nodes(size: int) -> tuple[FloatArray, float]:
    """Positions from the first to the last of `size` pixels, and their distance."""
    count = math.ceil((size - 1) / _STEP_PX) + 1
    return np.linspace(0.0, size - 1.0, count), (size - 1.0) / (count - 1)


@njit(cache=True, error_model="numpy")
def straightened(lens: Lens, u: float, v: float) -> tuple[float, float, float, float, float, float]:
    """Straight position of a pixel and its derivatives: x, y, dx/du, dx/dv, dy/du, dy/dv.

    Bilinear interpolation in the grid; beyond its border its outermost cells are continued.
    """
    grid = lens.grid
    fu, fv = u / lens.step_u, v / lens.step_v
    i = min(max(math.floor(fu), 0), grid.shape[1] - 2)
    j = min(max(math.floor(fv), 0), grid.shape[0] - 2)
    a, b = fu - i, fv - j
    x00, x01, x10, x11 = grid[j, i, 0], grid[j, i + 1, 0], grid[j + 1, i, 0], grid[j + 1, i + 1, 0]
    y00, y01, y10, y11 = grid[j, i, 1], grid[j, i + 1, 1], grid[j + 1, i, 1], grid[j + 1, i + 1, 1]
    x = (1.0 - b) * ((1.0 - a) * x00 + a * x01) + b * ((1.0 - a) * x10 + a * x11)
    y = (1.0 - b) * ((1.0 - a) * y00 + a * y01) + b * ((1.0 - a) * y10 + a * y11)
    xu = ((1.0 - b) * (x01 - x00) + b * (x11 - x10)) / lens.step_u
    xv = ((1.0 - a) * (x10 - x00) + a * (x11 - x01)) / lens.step_v
    yu = ((1.0 - b) * (y01 - y00) + b * (y11 - y10)) / lens.step_u
    yv = ((1.0 - a) * (y10 - y00) + a * (y11 - y01)) / lens.step_v
    return x, y, xu, xv, yu, yv


@njit(cache=True, error_model="numpy")
def bent(lens: Lens, x: float, y: float) -> tuple[float, float]:
    """The pixel whose straight position is (x, y), by Newton's method; NaN if none is found."""
    u, v = x, y
    for _ in range(_NEWTON_STEPS):
        at_x, at_y, xu, xv, yu, yv = straightened(lens, u, v)
        determinant = xu * yv - xv * yu
        dx, dy = x - at_x, y - at_y
        du = (yv * dx - xv * dy) / determinant
        dv = (xu * dy - yu * dx) / determinant
        u += du
        v += dv
        if abs(du) + abs(dv) < _CLOSE_ENOUGH:
            return u, v
    return math.nan, math.nan


@njit(cache=True, error_model="numpy")
def _straighten_points(lens: Lens, pixels: FloatArray) -> FloatArray:
    result = np.empty_like(pixels)
    for k in range(len(pixels)):
        result[k, 0], result[k, 1], _, _, _, _ = straightened(lens, pixels[k, 0], pixels[k, 1])
    return result


@njit(cache=True, error_model="numpy")
def _bend_points(lens: Lens, straight: FloatArray) -> FloatArray:
    result = np.empty_like(straight)
    for k in range(len(straight)):
        result[k, 0], result[k, 1] = bent(lens, straight[k, 0], straight[k, 1])
    return result
