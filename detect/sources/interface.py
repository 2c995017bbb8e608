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
from redetect.landmarks import Step


class Source(ABC):
    """Images in order, as frames of a run in which the robot does not move.

    Iterating again starts over (with a live camera: from then on).
    """

    name: str  # in messages
    output_base: Path  # results are called this, with an ending of their own
    ships_images = True  # it gives contents of images, not files
    expected: int | None = None  # approximate number of images, where it is known
    size: tuple[int, int] | None = None  # width and height, where they are known beforehand
    times_own = True  # images have times by themselves; of others, they can be named
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
