"""What all sources of images have in common."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Generator
from pathlib import Path

from camera import Camera, read_camera
from detect.errors import DetectError
from detect.run import RunFrame
from detect.sources.poses import PoseStream
from landmarks import Step


class Source(ABC):
    """Images in order, as frames of a run in which the robot does not move.

    Iterating again starts over (with a live camera: from then on).

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
    left_out = 0
    why_left_out = "images are left out"

    @abstractmethod
    def __iter__(self) -> Generator[RunFrame, None, None]: ...

    def calibration(self, *, posed: bool) -> Camera | None:
        """The calibration beside it, or that it holds; None if there is none.

        One of several is refused, and, if `posed`, one whose pose above the floor is not known.
        """
        return None

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry that it has itself: of a topic, or the only one; None if there is none."""
        if topic is not None:
            raise DetectError(f"{self.name}: holds no topic {topic}: only bags do")
        return None


def frame_prefix(name: str) -> str:
    """A name as allowed in a STEP row and a ``.times`` file: without characters that split it."""
    return re.sub(r'[\s,#"\\]', "_", name) or "_"


def numbered_prefix(stem: str, number: int) -> str:
    """The prefix of a frame that has no name, as the data set's are: ``e.0000``."""
    return f"{frame_prefix(stem)}.{number:04d}"


def still(prefix: str) -> Step:
    """The STEP row of a robot that does not move."""
    return Step(prefix, *[0.0] * 9)


def only_calibration(folder: Path, stem: str) -> Camera | None:
    """The ``.cam`` of a stem in a folder, or the only one there; None if there is none."""
    own = folder / f"{stem}.cam"
    found = [own] if own.is_file() else sorted(folder.glob("*.cam"))
    if len(found) > 1:
        names = ", ".join(path.name for path in found[:4])
        raise DetectError(f"{folder}: several calibrations ({names}): name one by --camera")
    return read_camera(found[0]) if found else None
