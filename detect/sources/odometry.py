"""Combines images with steps: from poses over time, or from a file of STEP rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from detect.errors import DetectError
from detect.run import Frames, RunFrame
from detect.sources.image_names import NameIndex, last_part
from detect.sources.interface import Source
from detect.sources.poses import PosesOverTime, PoseStream, TimedPose, step_between
from landmarks import Step, read_steps


class _FramesAlong(ABC):
    """The frames of a source along its odometry."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.ships_images = source.ships_images
        self.expected = source.expected
        self.left_out = 0

    def __iter__(self) -> Generator[RunFrame, None, None]:
        self.left_out = 0
        with closing(iter(self._source)) as images:
            yield from self._framed(images)

    @abstractmethod
    def _framed(self, images: Iterator[RunFrame]) -> Iterator[RunFrame]: ...


class FramesAlongPoses(_FramesAlong):
    """The frames of a source whose robot's poses are known over time.

    The pose of an image is that between the two poses before and after it. Images without a pose
    at their time are no part of the run; the first one's step is zero.
    """

    def __init__(self, source: Source, poses: PoseStream) -> None:
        super().__init__(source)
        self._poses = poses
        self.why_left_out = f"images without a pose of {poses.name} at their time: left out"

    def _framed(self, images: Iterator[RunFrame]) -> Iterator[RunFrame]:
        with closing(self._poses.read()) as stream:
            poses = PosesOverTime(stream, self._poses.name)
            last: TimedPose | None = None
            for image in images:
                pose = None if image.time_s is None else poses.at(image.time_s)
                if pose is None:
                    self.left_out += 1
                    continue
                if last is not None:
                    image = replace(image, step=step_between(image.step.prefix, last, pose))
                yield image
                last = pose


class FramesAlongRows(_FramesAlong):
    """The frames of a source whose STEP rows are in a file, in the same order.

    A row belongs to the image whose name is the last part of its prefix. Images without a row are
    no part of the run; rows without an image are frames that cannot be worked on.
    """

    why_left_out = "images are not named by a STEP row: left out"

    def __init__(self, source: Source, path: Path) -> None:
        super().__init__(source)
        self._path = path
        self._names = NameIndex(_encoded(_image_name(step)) for step in read_steps(path))

    def _framed(self, images: Iterator[RunFrame]) -> Iterator[RunFrame]:
        steps = read_steps(self._path)
        for image in images:
            prefix = image.step.prefix
            if self._names.find(_encoded(prefix)) is None:
                self.left_out += 1
                continue
            for step in steps:
                if _image_name(step) == prefix:
                    yield replace(image, step=step)
                    break
                yield RunFrame(step, None)
            else:
                raise DetectError(
                    f"{self._path}: the row of {prefix} comes too early: "
                    "expected the STEP rows in the order of the images"
                )
        for step in steps:
            yield RunFrame(step, None)


class FirstFrames:
    """The first `count` frames of others."""

    def __init__(self, frames: Frames, count: int) -> None:
        self._frames = frames
        self._count = count
        self.ships_images = frames.ships_images
        self.expected = count if frames.expected is None else min(frames.expected, count)
        self.why_left_out = frames.why_left_out

    @property
    def left_out(self) -> int:
        """Images that are no part of the run, so far."""
        return self._frames.left_out

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with closing(iter(self._frames)) as frames:
            for number, frame in enumerate(frames, start=1):
                yield frame
                if number == self._count:
                    return


def _image_name(step: Step) -> str:
    return last_part(step.prefix.strip('"'))


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
