"""A run, its frames, and the base classes of all image sources.

A frame is a STEP row, of zeros without odometry, with its image; frames are made on demand.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from camera import Camera, camera_in
from detect.errors import DetectError
from redetect.landmarks import Step

if TYPE_CHECKING:
    from detect.sources.poses import PoseStream


@dataclass(frozen=True, slots=True)
class RunFrame:
    """One frame of a run: its STEP row, and the image taken after it."""

    step: Step
    image: Path | None  # its file, if it has one
    #: The encoded image or (H, W) grey values, uint8 or uint16, if it has no file of its own.
    content: bytes | NDArray[Any] | None = field(default=None, compare=False, repr=False)
    time_s: float | None = None  # time of the image, if known
    failure: str | None = None  # why there is no image, although there should be
    #: Of values that are stored in 16 bits; None: the lowest that holds those of the image.
    bit_depth: int | None = None


class Frames(ABC):
    """The frames of a run, made on demand; iterating again starts over, unless they are live."""

    images_in_memory = True  # yields contents of images, not files
    expected: int | None = None  # approximate number of frames, if known
    is_recorded = True  # iterating again yields the same frames
    left_out = 0  # number of images, so far, that are not part of the run
    why_left_out = "images are left out"

    @abstractmethod
    def __iter__(self) -> Generator[RunFrame, None, None]: ...


class SomeFrames(Frames):
    """Every n-th of the first `count` frames of another source (0: of all).

    With a `bit_depth`, images have that one instead of one found from each.
    """

    def __init__(
        self, frames: Frames, count: int = 0, every: int = 1, bit_depth: int | None = None
    ) -> None:
        self._frames, self._count, self._every = frames, count, every
        self._bit_depth = bit_depth
        self.images_in_memory, self.why_left_out = frames.images_in_memory, frames.why_left_out
        self.is_recorded = frames.is_recorded
        known = [number for number in (frames.expected, count or None) if number is not None]
        self.expected = -(-min(known) // every) if known else None

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with closing(iter(self._frames)) as frames:
            for frame in islice(frames, 0, self._count or None, self._every):
                yield replace(frame, bit_depth=self._bit_depth) if self._bit_depth else frame
            self.left_out = self._frames.left_out


def spread_frames(frames: Frames, count: int, farthest: int | None = None) -> SomeFrames:
    """About `count` frames spread over a source, or over its beginning: the first ones if its
    length is not known, or ones that are `farthest` apart.
    """
    every = max((frames.expected or 0) // count, 1)
    every = every if farthest is None else min(every, farthest)
    return SomeFrames(frames, every * count, every)


class Source(Frames):
    """Images in order, as frames of a run in which the robot does not move."""

    name: str  # in messages
    output_base: Path  # path of results without their extensions
    beside: tuple[Path, str] | None = None  # folder and stem of a ``.cam`` file beside it
    has_times = True  # whether the times of the images are known
    is_8_bit = False  # whether no image can have more

    def calibration(self, *, posed: bool) -> Camera | None:
        """The calibration beside the source, or contained in it; None if there is none.

        Several are an error; if `posed`, a calibration without a pose above the floor is ignored.
        """
        return None if self.beside is None else camera_in(*self.beside)

    def poses(self, topic: str | None) -> PoseStream | None:
        """The source's own odometry: of a topic, or the only one; None if there is none."""
        if topic is not None:
            raise DetectError(f"{self.name}: has no topic {topic}: only bags do")
        return None


def frame_prefix(name: str) -> str:
    """A name as allowed in STEP rows and ``.times`` files: without separators."""
    return re.sub(r'[\s,#"\\]', "_", name) or "_"


def numbered_prefix(stem: str, number: int) -> str:
    """The prefix of an unnamed frame, in the data set's form: ``e.0000``."""
    return f"{frame_prefix(stem)}.{number:04d}"


def still(prefix: str) -> Step:
    """The STEP row of a robot that does not move."""
    return Step(prefix, *[0.0] * 9)


@dataclass(frozen=True)
class ImageRun:
    """A run whose files were found and read, with or without a calibration."""

    folder: Path  # for sources other than folders, the one that contains them
    frames: Frames
    odometry: Path | None  # source of the STEP rows
    output_base: Path  # results are called this, with an ending of their own
    has_times: bool = False  # whether times of frames are known, and written beside the results
    bit_depth: int | None = None  # of all frames, if their values are stored in 16 bits

    @property
    def name(self) -> str:
        """The recording's own name, or the folder's."""
        recording = self.output_base.name.removesuffix(".detected")
        return self.folder.resolve().name if recording == "detected" else recording

    def output(self, kind: str) -> Path:
        """The file for a kind of result."""
        return self.output_base.with_name(f"{self.output_base.name}.{kind}")


@dataclass(frozen=True)
class Run(ImageRun):
    """A run with a calibration."""

    camera: Camera = field(kw_only=True)
