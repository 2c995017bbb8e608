"""Markers before a camera, rendered with exact truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.rotations import rotation_of
from camera.uncertainty import IDENTITY
from detect.markers.dictionaries import marker_dictionary
from redetect.groundtruth.trajectories import se3
from tools.simulator.markers.rendering import Imaging, exact_grey, render_light
from tools.simulator.markers.surface import Surface, Texture, marker_texture, plain, square_corners

FloatArray = NDArray[np.float64]

# The card is so far behind its print, in widths of the marker.
_BEHIND = 1e-6
# One picture of a moving marker for each of these, pixels.
_STEP_PX = 0.25


def pinhole(width: int, height: int) -> Camera:
    """A camera that sees perspective like most, and needs no calibration."""
    middle = 0.5 * (width - 1), 0.5 * (height - 1)
    return Camera(width, height, 700.0, 700.0, *middle, (0.0, 0.0, 0.0, 0.0, 0.0), IDENTITY)


@dataclass(frozen=True)
class View:
    """How a marker is seen.

    `width` is the side's length in pixels if it were seen from the front; `slant_deg` the angle
    between its normal and the optical axis, about an axis in its plane at `axis_deg`; `roll_deg`
    turns the image.
    """

    width: float
    slant_deg: float = 0.0
    axis_deg: float = 0.0
    roll_deg: float = 0.0

    def pose(self, camera: Camera, middle: tuple[float, float]) -> FloatArray:
        """camera_from_marker of a marker of width 1 whose middle is seen at a pixel."""
        slant, axis, roll = np.radians([self.slant_deg, self.axis_deg, self.roll_deg])
        turn = rotation_of(np.array([0.0, 0.0, roll])) @ rotation_of(
            slant * np.array([math.cos(axis), math.sin(axis), 0.0])
        )
        place = np.append(camera.undistort(middle), 1.0) * camera.scale_x / self.width
        # y is up on a marker and down in the image.
        return se3.transform(turn @ np.diag([1.0, -1.0, -1.0]), place)


def corners_of(camera: Camera, pose: FloatArray) -> FloatArray:
    """(4, 2) pixels of a marker's corners, as they are printed from the top left clockwise."""
    return camera.project(se3.apply(pose, square_corners(1.0)))


def render(
    camera: Camera,
    markers: list[tuple[str, int, FloatArray]],
    *,
    dark: float = 40.0,
    light: float = 200.0,
    background: float | FloatArray = 120.0,
    quiet_cells: float = 1.5,
    blur: float = 0.0,
    motion: tuple[float, float] = (0.0, 0.0),
    gradient: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Grey values without noise and rounding.

    Parameters
    ----------
    markers : list of (dictionary, id, (4, 4) pose as `View` gives it)
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
    """
    surfaces = []
    for name, number, pose in markers:
        dictionary = marker_dictionary(name)
        white = marker_texture(dictionary, number, quiet_cells=0).values > 0.5
        printed = Texture(np.where(white, light, dark).astype(np.float32))
        card = 1.0 + 2.0 * quiet_cells * dictionary.cell
        behind = pose @ se3.transform(np.eye(3), [0.0, 0.0, -_BEHIND])
        surfaces += [Surface(pose, 1.0, 1.0, printed), Surface(behind, card, card, plain(light))]
    steps = math.ceil(math.hypot(*motion) / _STEP_PX) or 1
    exposures = []
    for part in (np.arange(steps) + 0.5) / steps - 0.5:
        way = part * np.array([*motion, 0.0]) / camera.scale_x
        exposures.append([s.moved(se3.transform(np.eye(3), s.pose[2, 3] * way)) for s in surfaces])
    ground = np.full((camera.height, camera.width), background, np.float32)
    imaging = Imaging(blur_px=blur, black_level=0.0, gain=1.0)
    seen = render_light(camera, exposures, ground, fine=imaging.fine)
    u = np.linspace(-0.5, 0.5, camera.width)
    v = np.linspace(-0.5, 0.5, camera.height)[:, None]
    lit = (1.0 + gradient[0] * u + gradient[1] * v).astype(np.float32)
    return exact_grey(seen, lit, imaging).astype(np.float64)


def exposed(image: FloatArray, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Grey values with noise, rounded to 8 bits."""
    noisy = image + rng.normal(0.0, noise, image.shape) if noise > 0.0 else image
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)
