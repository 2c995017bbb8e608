"""The journal of a run: the rows of each frame that is done, so that a run can be resumed.

An append-only text file beside the results, locked while the run lasts. Each line has a digest, of
the line itself and of all before it, and a record in JSON: the run's (`JournalHead`), then one for
each frame (`JournalFrame`), and finally one that says that the results are written. Lines that do
not fit their digest, and all that follow, are ignored.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import cv2
import numpy as np

from detect.run import RunFrame
from detect.runs.frame import FramePlan, FrameTask
from detect.runs.outputs import Conduct, Output
from detect.runs.rows import FrameRows
from storage.parts import is_at, named, new_locked, old_locked

#: Incremented with every change of the format of a journal or of the rows in it.
_JOURNAL_VERSION = 5

_DIGITS = 16
_JSON = json.JSONEncoder(separators=(",", ":"))
_LONGEST_LINE = 1 << 26


class JournalHead(NamedTuple):
    """Content of the first line."""

    made_by: str  #: Digest of whatever decides the rows: program, settings, camera, heads of files.
    overwrite: bool  #: Whether the run may replace existing files.


class JournalFrame(NamedTuple):
    """Record of a frame."""

    task: str  #: Digest of the task.
    rows: Mapping[str, str]  #: This and what follows: see `detect.runs.rows.FrameRows`.
    found: Mapping[str, int]
    rejected: Mapping[str, int]
    error: str | None

    def frame_rows(self) -> FrameRows:
        """The result of the frame."""
        rows = {kind: text.encode("utf-8", "surrogateescape") for kind, text in self.rows.items()}
        return FrameRows(rows, self.found, self.rejected, error=self.error)


class Journal:
    """A journal that this process has locked; without a place, one that nobody else sees.

    Parameters
    ----------
    handle : int
        Its descriptor.
    place : path or None
    result : path
        The file that errors name: the journal's own name means nothing to a reader.
    """

    def __init__(self, handle: int, place: Path | None, result: Path) -> None:
        self.place = place
        self._handle, self._result = handle, result
        self._check, self._end = "", 0

    def write(self, *records: Sequence[Any]) -> None:
        """Write lines behind those that are there."""
        lines = []
        for record in records:
            lines.append(self._line(_JSON.encode(record).encode()))
            self._check = lines[-1][:_DIGITS].decode()
        try:
            os.lseek(self._handle, 0, os.SEEK_END)
            left = memoryview(b"".join(lines))
            while left:
                left = left[os.write(self._handle, left) :]
        except OSError as error:
            raise named(error, self._result) from None

    def complete(self, parts: Sequence[int]) -> None:
        """Note that the results are on the disk, in these parts, and only have to be renamed."""
        self.write(["complete", parts])
        os.fsync(self._handle)

    def head(self) -> JournalHead | None:
        """Content of the first line, if it is valid."""
        first = next(self._records(), None)
        known = first is not None and len(first) == len(
            JournalHead._fields
        )  # not an earlier format
        return JournalHead(*first) if first is not None and known else None

    def frames(self) -> Iterator[JournalFrame]:
        """The valid lines behind the head.

        Requesting the next one takes it over; `cut` discards the last one and all that follow.
        """
        records = self._records()
        next(records, None)
        for record in records:
            if record[0] != "complete":
                yield JournalFrame(*record)

    def parts(self) -> Sequence[int] | None:
        """The parts that the results are in, if they are complete."""
        last = deque(self._records(), maxlen=1)
        return last[0][1] if last and last[0][0] == "complete" else None

    def cut(self) -> None:
        """Discard the lines that were not taken over; the next line is written there."""
        os.ftruncate(self._handle, self._end)

    def is_in_place(self) -> bool:
        """Whether it has a place and is there: it may have gone with its folder."""
        return self.place is not None and is_at(self._handle, self.place)

    def remove(self) -> None:
        """Remove it."""
        if self._handle >= 0:
            if self.place is not None:
                self.place.unlink(missing_ok=True)
            self.close()

    def close(self) -> None:
        """Leave it for a run that resumes."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _records(self) -> Iterator[Sequence[Any]]:
        os.lseek(self._handle, 0, os.SEEK_SET)
        self._check, self._end = "", 0
        with open(self._handle, "rb", closefd=False) as stream:
            while line := stream.readline(_LONGEST_LINE):
                record = line[_DIGITS + 1 : -1]
                if line != self._line(record):
                    return
                content = json.loads(record)
                if not isinstance(content, list) or not content:
                    return
                yield content
                self._check, self._end = line[:_DIGITS].decode(), self._end + len(line)

    def _line(self, record: bytes) -> bytes:
        return f"{digest_of([self._check.encode(), record])} ".encode() + record + b"\n"


def digest_of(content: Iterable[bytes]) -> str:
    """A short digest of some bytes, one behind the other."""
    return hashlib.sha256(b"".join(content)).hexdigest()[:_DIGITS]


def journal_place(log: Path) -> Path:
    """Where the journal of the run with a log is."""
    return log.with_name(f".{log.name.removesuffix('.log.json')}.journal")


def new_journal(place: Path, result: Path) -> Journal | None:
    """A new journal; None if there is one already that is in use, or may be."""
    try:
        handle = new_locked(place)
    except OSError as error:
        raise named(error, result) from None
    return None if handle is None else Journal(handle, place, result)


def unnamed_journal(result: Path) -> Journal:
    """A journal in the folder of a result that is gone when the process ends."""
    try:
        with TemporaryFile(dir=result.parent) as file:
            return Journal(os.dup(file.fileno()), None, result)
    except OSError as error:
        raise named(error, result) from None


def left_journal(place: Path, result: Path) -> Journal | None:
    """The journal that an ended run left; None if there is none or it is in use."""
    handle = old_locked(place)
    return None if handle is None else Journal(handle, place, result)


def made_by(outputs: Sequence[Output], plan: FramePlan, conduct: Conduct) -> str:
    """A digest of whatever decides the rows, besides the frames themselves."""
    settings = [
        None if values is None else asdict(values)
        for values in (plan.circles, plan.lines, plan.markers)
    ]
    values = (
        _JOURNAL_VERSION,
        conduct.version,
        # A process that has others do the work does not load the compiler, which takes long.
        (np.__version__, cv2.__version__, version("numba")),
        settings,
        None if plan.camera is None else plan.camera.content_hash,
        (plan.json, plan.drawing, plan.draw_response, plan.levelling),
        [(output.kind, output.head, output.tail, output.crlf) for output in outputs],
    )
    return digest_of([repr(values).encode("utf-8", "surrogateescape")])


def record_of(task: FrameTask, rows: FrameRows, kinds: Iterable[str]) -> JournalFrame:
    """What the journal notes of a frame: its rows of the kinds that there are files of."""
    texts = {
        kind: rows.rows[kind].decode("utf-8", "surrogateescape")
        for kind in kinds
        if rows.rows.get(kind)
    }
    return JournalFrame(task_digest(task), texts, rows.found, rows.rejected, rows.error)


def task_digest(task: FrameTask) -> str:
    """A digest of the work on a frame: its step, its image and the prior data on it.

    Of an image file, name, size and time of change count.
    """
    frame = task.frame
    beside = (frame.step, _file_of(frame), frame.time_s, frame.bits, frame.failure, task.known)
    content = b"" if frame.content is None else bytes(frame.content)
    return digest_of([repr(beside).encode("utf-8", "surrogateescape"), content])


def _file_of(frame: RunFrame) -> object:
    """What identifies the current state of a frame's image file."""
    if frame.image is None:
        return None
    if frame.stamp is not None:
        return (frame.image.name, *frame.stamp)
    try:
        status = frame.image.stat()
    except (OSError, ValueError):
        return frame.image.name  # nothing there: that counts as well
    return frame.image.name, status.st_size, status.st_mtime_ns
