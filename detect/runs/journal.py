"""The journal of a run: which frames are complete, so that an interrupted run can be resumed.

An append-only text file beside the results, locked while the run lasts. Each line has a digest, of
the line itself and of all before it, and a record in JSON: the run's (`JournalHead`), then one for
each frame (`JournalFrame`: how many bytes of each file are its, and their digest), and finally one
that marks the files as complete. Lines that do not fit their digest, and all that follow, are
ignored.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from detect.run import RunFrame
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan, FrameTask
from detect.runs.outputs import Output
from storage.parts import named, new_locked, old_locked, write_all

#: Incremented with every change of the format of a journal or of the rows that it records.
_JOURNAL_VERSION = 4

_DIGITS = 16
_COMPLETE = "complete"
_JSON = json.JSONEncoder(separators=(",", ":"))
_LONGEST_LINE = 1 << 20


class JournalHead(NamedTuple):
    """Content of the first line."""

    made_by: str  #: Digest of whatever decides the rows: program, settings, camera, heads of files.
    parts: Sequence[int]  #: Which parts the files of the run grow in (see `storage.parts`).
    overwrite: bool  #: Whether the run may replace existing files.


class JournalFrame(NamedTuple):
    """Record of a frame."""

    lengths: Sequence[int]  #: How many bytes the frame has in each of the files.
    content: str  #: Digest of them.
    task: str  #: Digest of the task.
    found: Mapping[str, int]  #: This and what follows: see `detect.runs.rows.FrameRows`.
    rejected: Mapping[str, int]
    error: str | None


class Journal:
    """A journal that this process has locked."""

    def __init__(self, place: Path, handle: int) -> None:
        self.place = place
        self._handle = handle
        self._check, self._end = "", 0

    def write(self, records: Iterable[Sequence[Any] | str]) -> None:
        """Write lines behind those that are there."""
        lines = []
        for record in records:
            line = self._line(_JSON.encode(record).encode())
            self._check = line[:_DIGITS].decode()
            lines.append(line)
        try:
            write_all(self._handle, b"".join(lines))
        except OSError as error:
            raise named(error, self.place) from None

    def complete(self) -> None:
        """Note that the files are complete and on the disk: they only have to take their places."""
        self.write([_COMPLETE])
        os.fsync(self._handle)

    def is_complete(self) -> bool:
        """Whether the last line says so."""
        end = f' "{_COMPLETE}"\n'.encode()
        os.lseek(self._handle, max(0, os.fstat(self._handle).st_size - len(end)), os.SEEK_SET)
        return os.read(self._handle, len(end)) == end

    def head(self) -> JournalHead | None:
        """Content of the first line, if it is valid."""
        first = next(self._records(), None)
        return JournalHead(*first) if isinstance(first, list) else None

    def frames(self) -> Iterator[JournalFrame]:
        """The valid lines behind the head.

        Requesting the next one takes it over; `cut` discards the last one and all that follow.
        """
        records = self._records()
        next(records, None)
        for record in records:
            if isinstance(record, list):
                yield JournalFrame(*record)

    def cut(self) -> None:
        """Discard the lines that were not taken over; the next line is written there."""
        os.ftruncate(self._handle, self._end)
        os.lseek(self._handle, self._end, os.SEEK_SET)

    def remove(self) -> None:
        """Remove it."""
        if self._handle >= 0:
            self.place.unlink(missing_ok=True)
            self.close()

    def close(self) -> None:
        """Leave it for a run that resumes."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _records(self) -> Iterator[Any]:
        os.lseek(self._handle, 0, os.SEEK_SET)
        self._check, self._end = "", 0
        with open(self._handle, "rb", closefd=False) as stream:
            while line := stream.readline(_LONGEST_LINE):
                record = line[_DIGITS + 1 : -1]
                if line != self._line(record):
                    return
                yield json.loads(record)
                self._check, self._end = line[:_DIGITS].decode(), self._end + len(line)

    def _line(self, record: bytes) -> bytes:
        return f"{digest_of([self._check.encode(), record])} ".encode() + record + b"\n"


def digest_of(content: Iterable[bytes]) -> str:
    """A short digest of some bytes, one behind the other."""
    return hashlib.sha256(b"".join(content)).hexdigest()[:_DIGITS]


def journal_place(log: Path) -> Path:
    """Where the journal of the run with a log is."""
    return log.with_name(f".{log.name.removesuffix('.log.json')}.journal")


def new_journal(place: Path) -> Journal | None:
    """A new journal; None if there is one already that is in use, or may be."""
    try:
        handle = new_locked(place)
    except OSError as error:
        raise named(error, place) from None
    return None if handle is None else Journal(place, handle)


def left_journal(place: Path) -> Journal | None:
    """The journal that an ended run left; None if there is none or it is in use."""
    handle = old_locked(place)
    return None if handle is None else Journal(place, handle)


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
        [(output.kind, output.head, output.tail, output.between) for output in outputs],
    )
    return digest_of([repr(values).encode("utf-8", "surrogateescape")])


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
