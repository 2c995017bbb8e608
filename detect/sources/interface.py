"""Interface of sources of images."""

from __future__ import annotations

import re
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.errors import DetectError

#: Limit of distances from the start (m), such that products of two remain finite.
FARTHEST = 1e12


@dataclass(frozen=True, slots=True)
class SourceImage:
    """One image of a source.

    Attributes
    ----------
    prefix : str
        What its STEP row is called.
    time_s : float or None
        When it was taken; what zero is, is the source's.
    path : path or None
        Its file, read by the process that works on it; or
    content : bytes or (H, W) uint8 array or None
        the encoded image, or its grey values.
    bits : int
        Significant bits, where the file has more than 8.
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
    """A calibrated camera.

    Attributes
    ----------
    camera : Camera
    why_no_pose : str or None
        Why its pose above the floor is not known, where it is not.
    """

    camera: Camera
    why_no_pose: str | None = None


class PoseStream(Protocol):
    """Poses of the robot over time, as recorded; iterating again starts over."""

    #: What messages call it.
    name: str
    #: The file that it is read from, which heads of files name.
    path: Path

    def __iter__(self) -> Generator[TimedPose, None, None]: ...


class Source(Protocol):
    """Images in order."""

    #: What messages call it.
    name: str
    #: Results are called this, with an ending of their own.
    output_base: Path
    #: Whether it gives contents of images, not files.
    ships_images: bool

    @property
    def expected(self) -> int | None:
        """Approximate number of images; None if unknown."""
        ...

    def images(self) -> Generator[SourceImage, None, None]:
        """The images, from the first one (of a live camera: from now)."""
        ...

    def calibration(self) -> Calibration | None:
        """The calibration beside it, or that it holds; None if there is none.

        Raises
        ------
        DetectError
            If there are several to choose from.
        camera.CameraError
            If it cannot be read.
        """
        ...

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry that it has itself: of a topic, or the only one; None if there is none.

        Raises
        ------
        DetectError
            If there is no such topic, or there are several to choose from.
        """
        ...


@dataclass(frozen=True, slots=True)
class TimedPose:
    """Where a robot was: X forward, Y left, counterclockwise, in a fixed frame.

    Attributes
    ----------
    time_s : float
    x, y : float
        Metres.
    theta : float
        Radians.
    covariance : (3, 3) float64 or None
        Of (x, y, theta) in the fixed frame, since the start; None if nothing is known.
    """

    time_s: float
    x: float
    y: float
    theta: float
    covariance: NDArray[np.float64] | None = None


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
    if own.is_file():
        return Calibration(read_camera(own))
    found = sorted(folder.glob("*.cam"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise DetectError(f"{folder}: several calibrations ({names}): name one by --camera")
    return Calibration(read_camera(found[0])) if found else None
