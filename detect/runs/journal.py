"""The journal of a run: the rows of each finished frame, in a text file beside the results.

It is locked during the run (`redetect.storage.parts`). Each line consists of a digest, of its
record and all before it, and the record in JSON: first what made the rows, then one record for each
frame, and finally one stating that the results are written. Lines that do not match their digest,
and all lines after them, are ignored.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detect.runs.outputs import Output
from detect.runs.plan import FramePlan, FrameRows, FrameTask
from detect.sources.interface import RunFrame
from redetect import __version__
from redetect.storage.parts import PartFile

#: Incremented with every change of the format of a journal or of the rows in it.
_JOURNAL_VERSION = 9

_DIGITS = 16
_LONGEST_LINE = 1 << 26
_COMPLETE = "complete"


class Journal:
    """A journal that this process has locked; the caller closes or removes its file."""

    def __init__(self, file: PartFile) -> None:
        self.file = file
        self._digest, self._end = hashlib.sha256(), 0

    def write(self, *records: object) -> None:
        """Append records."""
        self.file.stream.seek(self._end)
        for record in records:
            line = json.dumps(record, separators=(",", ":")).encode()
            self._digest.update(line)
            self._end += self.file.stream.write(self._check(self._digest) + line + b"\n")
        self.file.stream.flush()

    def write_frames(self, frames: Sequence[tuple[FrameTask, FrameRows]]) -> None:
        """Write the rows of finished frames."""
        self.write(*([task_digest(task), *rows] for task, rows in frames))

    def write_complete(self, parts: Sequence[int], *, overwrite: bool) -> None:
        """Record that the results are on disk, in these parts, and only have to be renamed."""
        self.write([_COMPLETE, parts, overwrite])
        self.file.sync()

    def is_by(self, made_by: str) -> bool:
        """Whether the first record has this digest."""
        return next(self._records(), None) == [made_by]

    def frames(self) -> Iterator[tuple[str, FrameRows]]:
        """The digest of the task and the rows of each frame.

        Requesting the next frame accepts the last one; `cut` discards it and all that follow.
        """
        records = self._records()
        next(records, None)
        for record in records:
            if record[0] != _COMPLETE:
                yield record[0], FrameRows(*record[1:])

    def complete(self) -> tuple[Sequence[int], bool] | None:
        """The record of `write_complete`, if there is one."""
        (last,) = deque(self._records(), maxlen=1) or [None]
        return (last[1], last[2]) if last and last[0] == _COMPLETE else None

    def cut(self) -> None:
        """Discard the records that were not accepted; the next one is written in their place."""
        self.file.stream.truncate(self._end)

    def _records(self) -> Iterator[list[Any]]:
        self._digest, self._end = hashlib.sha256(), 0
        self.file.stream.seek(0)
        while line := self.file.stream.readline(_LONGEST_LINE):
            digest = self._digest.copy()
            digest.update(line[_DIGITS + 1 : -1])
            if not line.endswith(b"\n") or not line.startswith(self._check(digest)):
                return
            record = json.loads(line[_DIGITS + 1 :])
            if not isinstance(record, list) or not record:
                return
            yield record
            self._digest, self._end = digest, self._end + len(line)

    @staticmethod
    def _check(digest: Any) -> bytes:
        return f"{digest.hexdigest()[:_DIGITS]} ".encode()


def made_by(outputs: Sequence[Output], plan: FramePlan) -> str:
    """A digest of everything that determines the rows, except the frames themselves."""
    values = (
        _JOURNAL_VERSION,
        __version__,
        # A process that delegates the work does not load the compiler, which takes long.
        (np.__version__, cv2.__version__, version("numba")),
        replace(plan, camera=None, working_folder=Path()),
        plan.camera and (plan.camera.content_hash, plan.camera.covariance),
        [(output.kind, output.head, output.tail, output.crlf) for output in outputs],
    )
    return _digest_of(repr(values))


def task_digest(task: FrameTask) -> str:
    """A digest of a frame's inputs: its step, its image and the prior data on it.

    An image file is identified by name, size and modification time.
    """
    frame = task.frame
    values = (frame.step, _file_of(frame), frame.time_s, frame.failure, frame.bit_depth, task.known)
    return _digest_of(repr(values), b"" if frame.content is None else bytes(frame.content))


def _digest_of(text: str, content: bytes = b"") -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape") + content).hexdigest()[:_DIGITS]


def _file_of(frame: RunFrame) -> object:
    """Identifies the current state of a frame's image file."""
    if frame.image is None:
        return None
    try:
        status = frame.image.stat()
    except (OSError, ValueError):
        return frame.image.name  # a missing file is a state as well
    return frame.image.name, status.st_size, status.st_mtime_ns
