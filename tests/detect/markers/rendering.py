"""Markers rendered with exact truth: many samples per pixel through a homography."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.dictionaries import templates_of
from detect.markers.geometry import square_homography

FloatArray = NDArray[np.float64]

#: Samples per pixel and axis.
SAMPLES = 8


@dataclass(frozen=True)
class View:
    """How a marker is seen.

    `width` is the side's length in pixels if it were seen from the front; `slant_deg` the angle
    between its normal and the line of sight, about an axis in its plane at `axis_deg`; `roll_deg`
    turns the image. `focal` (px) decides the perspective.
    """

    width: float
    slant_deg: float = 0.0
    axis_deg: float = 0.0
    roll_deg: float = 0.0
    focal: float = 700.0


def view_corners(view: View, centre: tuple[float, float]) -> FloatArray:
    """(4, 2) corners, top left first, clockwise in the image."""
    square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    slant, axis, roll = np.radians([view.slant_deg, view.axis_deg, view.roll_deg])
    direction = np.array([math.cos(axis), math.sin(axis), 0.0])
    rotation, _ = cv2.Rodrigues(slant * direction)
    spin, _ = cv2.Rodrigues(roll * np.array([0.0, 0.0, 1.0]))
    points = square @ np.asarray(spin @ rotation).T
    depth = view.focal / view.width + points[:, 2]
    return np.asarray(view.focal * points[:, :2] / depth[:, None] + np.array(centre))


@njit(cache=True, error_model="numpy")
def _paint(
    canvas: NDArray[np.float32],
    inverse: NDArray[np.float64],
    lines: NDArray[np.float64],
    black: NDArray[np.float64],
    quiet: float,
    dark: float,
    light: float,
    samples: int,
) -> None:
    """Paint the marker with its quiet zone over a canvas of `samples` per pixel."""
    n = len(lines) - 1
    for row in range(canvas.shape[0]):
        v = (row + 0.5) / samples - 0.5
        for column in range(canvas.shape[1]):
            u = (column + 0.5) / samples - 0.5
            q = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
            if q <= 0.0:
                continue
            x = (inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]) / q
            y = (inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]) / q
            if x < -quiet or y < -quiet or x > 1.0 + quiet or y > 1.0 + quiet:
                continue
            value = light
            if 0.0 <= x < 1.0 and 0.0 <= y < 1.0:
                i = np.searchsorted(lines, x, side="right") - 1
                j = np.searchsorted(lines, y, side="right") - 1
                if black[min(j, n - 1), min(i, n - 1)] > 0.5:
                    value = dark
            canvas[row, column] = value


def render(
    size: tuple[int, int],
    markers: list[tuple[str, int, FloatArray]],
    *,
    dark: float = 40.0,
    light: float = 200.0,
    background: float | FloatArray = 120.0,
    quiet_cells: float = 1.5,
    blur: float = 0.0,
    motion: tuple[float, float] = (0.0, 0.0),
    gradient: tuple[float, float] = (0.0, 0.0),
    samples: int = SAMPLES,
) -> FloatArray:
    """Grey values without noise and rounding.

    Parameters
    ----------
    size : (int, int)
        Width and height.
    markers : list of (dictionary, id, corners)
        Corners (4, 2) as `view_corners` gives them.
    dark, light : float
        Grey levels of the print.
    background : float or (H, W) array
        What is round the markers and their quiet zones.
    quiet_cells : float
        Width of the white round a marker, cells.
    blur : float
        Standard deviation of the optics' Gaussian, pixels.
    motion : (float, float)
        Way of the image during the exposure, pixels.
    gradient : (float, float)
        Relative change of the light across the image's width and height.
    samples : int
        Per pixel and axis.
    """
    width, height = size
    canvas = np.empty((height * samples, width * samples), np.float32)
    if isinstance(background, float):
        canvas[:] = background
    else:
        canvas[:] = np.repeat(np.repeat(background, samples, axis=0), samples, axis=1)
    for name, number, corners in markers:
        templates = templates_of(name, (number,))
        inverse = np.asarray(np.linalg.inv(square_homography(corners)), np.float64)
        quiet = quiet_cells * templates.dictionary.cell
        _paint(
            canvas, inverse, templates.lines, templates.blackness(0), quiet, dark, light, samples
        )
    if blur > 0.0:
        canvas = np.asarray(cv2.GaussianBlur(canvas, (0, 0), blur * samples), np.float32)
    length = math.hypot(*motion)
    if length > 0.0:
        steps = max(2, math.ceil(length * samples))
        total = np.zeros_like(canvas)
        for k in range(steps):
            part = (k + 0.5) / steps - 0.5
            shift = np.array([[1.0, 0.0, part * motion[0] * samples],
                              [0.0, 1.0, part * motion[1] * samples]])  # fmt: skip
            total += cv2.warpAffine(
                canvas, shift, canvas.shape[::-1], borderMode=cv2.BORDER_REPLICATE
            )
        canvas = total / np.float32(steps)
    image = canvas.reshape(height, samples, width, samples).mean(axis=(1, 3), dtype=np.float64)
    if any(gradient):
        u = np.linspace(-0.5, 0.5, width)[None, :]
        v = np.linspace(-0.5, 0.5, height)[:, None]
        image *= 1.0 + gradient[0] * u + gradient[1] * v
    return np.asarray(image)


def exposed(image: FloatArray, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Grey values with noise, rounded to 8 bits."""
    noisy = image + rng.normal(0.0, noise, image.shape) if noise > 0.0 else image
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)
