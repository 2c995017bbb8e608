"""Searches an image for discs as its camera is mounted: with its lean against the calibration.

Perspective determines the size and flatness of a disc in the image. With a calibration that is
wrong by two degrees, distant discs look like no discs, and to a low camera near ones as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from camera import Camera
from detect.circles import CircleDetections, detect_circles, disc_table
from detect.levelling import as_calibrated
from detect.lines import detect_lines
from detect.projection import Tilt, leaning_camera
from detect.settings import CircleSettings
from lut import DiscTable, VoteTable, cached_vertical_table
from redetect.array_types import GreyImage

#: Factor by which a search with a lean must find more evidence: a building itself may lean.
_MORE_EVIDENCE = 1.06
#: Largest standard deviation of tilts that show the camera's lean, for the size of its discs, and
#: the least lean that counts.
_SURE_RAD, _LEAST_LEAN_RAD = math.radians(0.5), math.radians(1.0)
#: Steps of the lean of a single image, and its least deviation from that of the camera.
_STEP_RAD = math.radians(1.0)


def lean_finds_more(leaning: float, evidence: float) -> bool:
    """Whether a search with the camera's lean finds clearly more evidence of discs."""
    return leaning > _MORE_EVIDENCE * evidence


def lean_of_image(tilt: Tilt, usual: Tilt | None = None) -> Tilt | None:
    """The lean for the search in an image with this tilt (rad), in steps: for few tables. None if
    it hardly differs from the `usual` one.
    """
    pitch, roll = usual or (0.0, 0.0)
    if max(abs(tilt[0] - pitch), abs(tilt[1] - roll)) < _STEP_RAD:
        return None
    pitch, roll = (_STEP_RAD * round(angle / _STEP_RAD) for angle in tilt)
    return pitch, roll


@lru_cache(maxsize=16)
def with_exact_tilt(settings: CircleSettings) -> CircleSettings:
    """The settings for positions whose covariances do not include an error of the tilt."""
    return replace(settings, tilt_sigma_deg=0.0)


def search_of(
    camera: Camera, settings: CircleSettings, lean: Tilt | None
) -> tuple[Camera, VoteTable | DiscTable]:
    """The camera with its lean, and its table for discs, made or loaded once per process."""
    return _search_of(camera, with_exact_tilt(settings), lean)


@lru_cache(maxsize=16)
def _search_of(
    camera: Camera, settings: CircleSettings, lean: Tilt | None
) -> tuple[Camera, VoteTable | DiscTable]:
    leaning = camera if lean is None else leaning_camera(camera, lean)
    return leaning, disc_table(leaning, settings)


def detect_leaning(
    image: GreyImage, camera: Camera, settings: CircleSettings, lean: Tilt | None
) -> CircleDetections:
    """The discs of an image, searched with a lean, at their places for the calibrated camera.

    Parameters and errors otherwise as for `detect.circles.detect_circles`.
    """
    leaning, table = search_of(camera, settings, lean)
    found = detect_circles(image, leaning, table, settings)
    return found if lean is None else as_calibrated(found, leaning, camera)


def detect_tilted(
    image: GreyImage, camera: Camera, settings: CircleSettings, tilt: Tilt,
    usual: Tilt | None = None,
) -> tuple[CircleDetections, Tilt | None]:  # fmt: skip
    """The discs of an image, searched with its own tilt (rad) if that finds more than the usual
    lean; and the lean that was used. See `detect_leaning`.
    """
    found, lean = detect_leaning(image, camera, settings, usual), lean_of_image(tilt, usual)
    if lean is not None and settings.refine:
        leaning = detect_leaning(image, camera, settings, lean)
        if lean_finds_more(leaning.evidence.sum(), found.evidence.sum()):
            return leaning, lean
    return found, usual


def leaning_as(
    images: Sequence[GreyImage], camera: Camera, otherwise: Tilt | None = None
) -> Camera:
    """The camera with the lean that the verticals show in most of some images, or `otherwise`.

    Discs look larger or smaller to a camera that leans.
    """
    table = cached_vertical_table(camera)
    tilts = (detect_lines(image, table).tilt for image in images)
    known = [
        (tilt.pitch_rad, tilt.roll_rad)
        for tilt in tilts
        if tilt is not None and np.diag(tilt.covariance).max() < _SURE_RAD**2
    ]
    if not known or 2 * len(known) < len(images):
        return camera if otherwise is None else leaning_camera(camera, otherwise)
    pitch, roll = np.median(known, axis=0).tolist()
    small = math.hypot(pitch, roll) < _LEAST_LEAN_RAD
    return camera if small else leaning_camera(camera, (pitch, roll))
