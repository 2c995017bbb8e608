"""What all sources of images have in common."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.errors import DetectError
from detect.sources.poses import PoseStream


@dataclass(frozen=True, slots=True)
class SourceImage:
    """One image of a source.

    Attributes
    ----------
    prefix : str
        The prefix of its STEP row.
    time_s : float or None
        When it was taken; what zero is, is the source's.
    path : path or None
        Its file, read by the process that works on it; or
    content : bytes or (H, W) uint8 array or None
        the encoded image, or its grey values.
    bits : int
        Significant bits of a file with more than 8.
    failure : str or None
        Why there is no image, although there should be.
    """

    prefix: str
    time_s: float | None = None
    path: Path | None = None
    content: bytes | NDArray[np.uint8] | None = None
    bits: int = 16
    failure: str | None = None


@dataclass(frozen=True, slots=True)
class Calibration:
    """A calibrated camera; `why_no_pose` says why its pose above the floor is not known, if so."""

    camera: Camera
    why_no_pose: str | None = None


class Source(ABC):
    """Images in order.

    Attributes
    ----------
    name : str
        Its name in messages.
    output_base : path
        Results are called this, with an ending of their own.
    ships_images : bool
        Whether it gives contents of images, not files.
    expected : int or None
        Approximate number of images; None if unknown.
    size : (int, int) or None
        Width and height of the images, where they are known beforehand.
    times_own : bool
        Whether images have times by themselves; of others, they can be named.
    has_times : bool
        Whether the times of images are known.
    """

    name: str
    output_base: Path
    ships_images = True
    expected: int | None = None
    size: tuple[int, int] | None = None
    times_own = True
    has_times = True

    @abstractmethod
    def images(self) -> Generator[SourceImage, None, None]:
        """The images, from the first one (of a live camera: from now)."""

    def calibration(self) -> Calibration | None:
        """The calibration beside it, or that it holds; None if there is none.

        Raises
        ------
        DetectError
            If there are several to choose from.
        camera.CameraError
            If it cannot be read.
        """
        return None

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry that it has itself: of a topic, or the only one; None if there is none.

        Raises
        ------
        DetectError
            If there is no such topic, or there are several to choose from.
        """
        if topic is not None:
            raise DetectError(f"{self.name}: holds no topic {topic}: only bags do")
        return None


def frame_prefix(name: str) -> str:
    """A name as allowed in a STEP row and a ``.times`` file: without characters that split it."""
    return re.sub(r'[\s,#"\\]', "_", name) or "_"


def numbered_prefix(stem: str, number: int) -> str:
    """The prefix of a frame that has no name, as the data set's are: ``e.0000``."""
    return f"{frame_prefix(stem)}.{number:04d}"


def only_calibration(folder: Path, stem: str) -> Calibration | None:
    """The ``.cam`` of a stem in a folder, or the only one there; None if there is none.

    Raises
    ------
    DetectError
        If there are several.
    camera.CameraError
        If it cannot be read.
    """
    own = folder / f"{stem}.cam"
    found = [own] if own.is_file() else sorted(folder.glob("*.cam"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise DetectError(f"{folder}: several calibrations ({names}): name one by --camera")
    return Calibration(read_camera(found[0])) if found else None
