"""Combines images with steps: from poses over time, from a file of STEP rows, or none."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing
from pathlib import Path

from detect.errors import DetectError
from detect.run import Frames, RunFrame
from detect.sources.image_names import NameIndex
from detect.sources.interface import Source, SourceImage
from detect.sources.poses import (
    PoseStream,
    TimedPose,
    movement_between,
    pose_between,
    step_of,
)
from landmarks import Step, iterate_prefixes, iterate_steps

#: Between poses farther apart than this (s), nothing is made up.
LARGEST_GAP_S = 1.0

# Times are written with six digits: the last image may seem to be later than the last pose.
_END_SLACK_S = 1e-3


class SourceFrames:
    """The frames of a source without odometry: their steps are zeros.

    Parameters
    ----------
    source : Source
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.ships_images = source.ships_images
        self.left_out = 0
        self.why_left_out = "images are left out"

    @property
    def expected(self) -> int | None:
        """Approximate number of frames; None if unknown."""
        return self._source.expected

    def __iter__(self) -> Generator[RunFrame, None, None]:
        self.left_out = 0
        with closing(self._source.images()) as images:
            yield from self._framed(images)

    def _framed(self, images: Iterator[SourceImage]) -> Iterator[RunFrame]:
        for image in images:
            yield _frame(image, step_of(image.prefix, None))


class FramesAlongPoses(SourceFrames):
    """The frames of a source whose robot's poses are known over time.

    The pose of an image is that between the two poses before and after it. Images without a pose
    at their time are no part of the run; the first one's step is zero.

    Parameters
    ----------
    source : Source
    poses : PoseStream
    """

    def __init__(self, source: Source, poses: PoseStream) -> None:
        super().__init__(source)
        self._poses = poses
        self.why_left_out = f"images without a pose of {poses.name} at their time: left out"

    def _framed(self, images: Iterator[SourceImage]) -> Iterator[RunFrame]:
        with closing(iter(self._poses)) as poses:
            track = _Track(poses, self._poses.name)
            last: TimedPose | None = None
            for image in images:
                pose = None if image.time_s is None else track.at(image.time_s)
                if pose is None:
                    self.left_out += 1
                    continue
                movement = None if last is None else movement_between(last, pose)
                yield _frame(image, step_of(image.prefix, movement))
                last = pose


class FramesAlongRows(SourceFrames):
    """The frames of a source whose STEP rows are in a file, in the same order.

    A row belongs to the image whose name is the last part of its prefix. Images without a row are
    no part of the run; rows without an image are frames that cannot be worked on.

    Parameters
    ----------
    source : Source
    path : path
        The file.
    """

    def __init__(self, source: Source, path: Path) -> None:
        super().__init__(source)
        self.why_left_out = "images are not named by a STEP row: left out"
        self._path = path
        self._names = NameIndex(_bytes(_image_name(prefix)) for prefix in iterate_prefixes(path))

    def _framed(self, images: Iterator[SourceImage]) -> Iterator[RunFrame]:
        steps = iterate_steps(self._path)
        for image in images:
            if self._names.find(_bytes(image.prefix)) is None:
                self.left_out += 1
                continue
            for step in steps:
                if _image_name(step.prefix) == image.prefix:
                    yield _frame(image, step)
                    break
                yield RunFrame(step, None)
            else:
                raise DetectError(
                    f"{self._path}: the row of {image.prefix} comes too early: "
                    "expected the STEP rows in the order of the images"
                )
        for step in steps:
            yield RunFrame(step, None)


class FirstFrames:
    """The first frames of others.

    Parameters
    ----------
    frames : Frames
    count : int
        How many.
    """

    def __init__(self, frames: Frames, count: int) -> None:
        self._frames = frames
        self._count = count
        self.ships_images = frames.ships_images

    @property
    def expected(self) -> int | None:
        """About how many frames there will be."""
        expected = self._frames.expected
        return self._count if expected is None else min(expected, self._count)

    @property
    def left_out(self) -> int:
        """Images that are no part of the run, so far."""
        return self._frames.left_out

    @property
    def why_left_out(self) -> str:
        """Why frames were left out; printed after their number."""
        return self._frames.why_left_out

    def __len__(self) -> int:
        return self.expected or self._count

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with closing(iter(self._frames)) as frames:
            for number, frame in enumerate(frames, start=1):
                yield frame
                if number == self._count:
                    return


class _Track:
    """Poses in order, read once."""

    def __init__(self, poses: Iterator[TimedPose], name: str) -> None:
        self._poses = poses
        self._name = name
        self._before: TimedPose | None = None
        self._after: TimedPose | None = next(poses, None)
        if self._after is None:
            raise DetectError(f"{name}: no pose in it: expected odometry, or --odometry none")

    def at(self, time_s: float) -> TimedPose | None:
        """The pose at a time; None if unknown, or if a later one was requested before."""
        while self._after is not None and self._after.time_s < time_s:
            self._advance(self._after)
        before, after = self._before, self._after
        if after is not None and after.time_s - time_s <= (_END_SLACK_S if before is None else 0.0):
            return after
        if after is None:
            late = before is not None and time_s - before.time_s <= _END_SLACK_S
            return before if late else None
        if before is None or time_s < before.time_s:
            return None
        if after.time_s - before.time_s > LARGEST_GAP_S:
            return None
        return pose_between(before, after, time_s)

    def _advance(self, passed: TimedPose) -> None:
        self._before, self._after = passed, next(self._poses, None)
        if self._after is not None and self._after.time_s < passed.time_s:
            raise DetectError(
                f"{self._name}: the pose of {self._after.time_s:.6f} s comes after that of "
                f"{passed.time_s:.6f} s: expected times in order"
            )


def _frame(image: SourceImage, step: Step) -> RunFrame:
    return RunFrame(
        step, image.path, image.content, image.time_s, bits=image.bits, failure=image.failure
    )


def _image_name(prefix: str) -> str:
    return prefix.strip('"').replace("\\", "/").rsplit("/", 1)[-1]


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
