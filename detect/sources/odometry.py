"""Combines images with steps: from poses over time, or from a file of STEP rows."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from detect.errors import DetectError
from detect.run import Frames, RunFrame
from detect.sources.image_names import NameIndex, last_part
from detect.sources.interface import Source
from detect.sources.poses import PosesOverTime, PoseStream, TimedPose, step_between
from redetect.landmarks import Step, read_steps


class FramesAlong:
    """The frames of a source along its odometry, as one of the functions below gives them."""

    def __init__(
        self,
        source: Source,
        framed: Callable[[Iterator[RunFrame]], Generator[RunFrame | None, None, None]],
        why_left_out: str,
    ) -> None:
        self._source, self._framed = source, framed
        self.ships_images, self.expected = source.ships_images, source.expected
        self.left_out, self.why_left_out = 0, why_left_out

    def __iter__(self) -> Generator[RunFrame, None, None]:
        self.left_out = 0
        with closing(iter(self._source)) as images, closing(self._framed(images)) as frames:
            for frame in frames:
                if frame is None:
                    self.left_out += 1
                else:
                    yield frame


def frames_along_poses(source: Source, stream: PoseStream) -> FramesAlong:
    """The frames of a source whose robot's poses are known over time.

    The pose of an image is that between the two poses before and after it. Images without a pose
    at their time are no part of the run; the first one's step is zero.
    """

    def framed(images: Iterator[RunFrame]) -> Generator[RunFrame | None, None, None]:
        with closing(stream.read()) as read:
            poses = PosesOverTime(read, stream.name)
            last: TimedPose | None = None
            for image in images:
                pose = None if image.time_s is None else poses.at(image.time_s)
                if pose is None:
                    yield None
                    continue
                if last is not None:
                    image = replace(image, step=step_between(image.step.prefix, last, pose))
                yield image
                last = pose

    why = f"images without a pose of {stream.name} at their time: left out"
    return FramesAlong(source, framed, why)


def frames_along_rows(source: Source, path: Path) -> FramesAlong:
    """The frames of a source whose STEP rows are in a file, in the same order.

    A row belongs to the image whose name is the last part of its prefix. Images without a row are
    no part of the run; rows without an image are frames that cannot be worked on.
    """
    names = NameIndex(_encoded(_image_name(step)) for step in read_steps(path))

    def framed(images: Iterator[RunFrame]) -> Generator[RunFrame | None, None, None]:
        steps = read_steps(path)
        for image in images:
            prefix = image.step.prefix
            if names.find(_encoded(prefix)) is None:
                yield None
                continue
            for step in steps:
                if _image_name(step) == prefix:
                    yield replace(image, step=step)
                    break
                yield RunFrame(step, None)
            else:
                raise DetectError(
                    f"{path}: the row of {prefix} comes too early: "
                    "expected the STEP rows in the order of the images"
                )
        for step in steps:
            yield RunFrame(step, None)

    return FramesAlong(source, framed, "images are not named by a STEP row: left out")


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
