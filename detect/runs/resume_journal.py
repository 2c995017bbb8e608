"""The journal of a run: which frames are done, so that a run that ended early can be continued.

A text file with a line of JSON for each frame, beside the results and locked while the run lasts.
Every line carries a digest of all before it and of the rows that it stands for: a line that was
torn, or whose rows did not get onto the disk, ends the part of the journal that counts.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

from detect.run import RunFrame
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan
from detect.runs.frame_rows import FrameRows, FrameTask
from detect.runs.growing_files import RunOutput
from storage.parts import named, new_locked, old_locked, write_all

#: Raised with every change of what a journal or the rows that it stands for look like.
_JOURNAL_VERSION = 3

_DIGITS = 16
_COMPLETE = b'"complete"\n'
_JSON = json.JSONEncoder(separators=(",", ":"))
_STEP = struct.Struct("<9d").pack
_LONGEST_LINE = 1 << 20
_MOST_PARTS = 16


@dataclass(frozen=True)
class JournalHead:
    """The first line of a journal.

    Attributes
    ----------
    made_by : str
        Digest of whatever decides the rows: program, settings, camera, heads of the files.
    parts : tuple of int
        Which parts the files of the run grow in (see `storage.parts`).
    overwrite : bool
        Whether the run may replace existing files.
    """

    made_by: str
    parts: tuple[int, ...]
    overwrite: bool


@dataclass(frozen=True)
class JournalLine:
    """What a line says of a frame.

    Attributes
    ----------
    lengths : tuple of int
        How many bytes the frame has in each of the files.
    task : str
        Digest of what was to be done.
    rows : FrameRows
        The frame's counts, without its rows.
    check : str
        Digest of all this, the rows, and all before.
    end : int
        Where the line ends in the journal.
    """

    lengths: tuple[int, ...]
    task: str
    rows: FrameRows
    check: str
    end: int


class Journal:
    """A journal that this process has locked."""

    def __init__(self, place: Path, handle: int) -> None:
        self.place = place
        self._handle = handle

    def begin(self, head: JournalHead) -> None:
        """Write the first line."""
        self._write(_JSON.encode([head.made_by, list(head.parts), head.overwrite]).encode() + b"\n")

    def write(self, lines: list[bytes]) -> None:
        """Write lines for frames (see `line_of_frame`)."""
        self._write(b"".join(lines))

    def complete(self) -> None:
        """Note that the files are complete and on the disk: they only have to take their places."""
        self._write(_COMPLETE)
        os.fsync(self._handle)

    def read(self) -> tuple[JournalHead | None, Iterator[JournalLine]]:
        """The first line, if it is one, and the lines that follow, as far as they are lines."""
        os.lseek(self._handle, 0, os.SEEK_SET)
        stream = open(self._handle, "rb", closefd=False)  # noqa: SIM115 - the descriptor stays
        first = stream.readline(_LONGEST_LINE)
        try:
            made_by, parts, overwrite = json.loads(first)
            if not (
                isinstance(made_by, str)
                and isinstance(parts, list)
                and len(parts) <= _MOST_PARTS
                and all(type(number) is int and 0 <= number < 1000 for number in parts)
            ):
                return None, iter(())
        except (ValueError, TypeError, RecursionError):
            return None, iter(())

        def lines() -> Iterator[JournalLine]:
            end = len(first)
            while text := stream.readline(_LONGEST_LINE):
                end += len(text)
                line = _parsed(text, end)
                if line is None:
                    return
                yield line

        return JournalHead(made_by, tuple(parts), overwrite is True), lines()

    def is_complete(self) -> bool:
        """Whether the last line says so."""
        end = b"\n" + _COMPLETE
        size = os.fstat(self._handle).st_size
        os.lseek(self._handle, max(0, size - len(end)), os.SEEK_SET)
        return os.read(self._handle, len(end)) == end

    def cut(self, end: int) -> None:
        """Forget all lines from a place on; the next is written there."""
        os.ftruncate(self._handle, end)
        os.lseek(self._handle, end, os.SEEK_SET)

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

    def _write(self, line: bytes) -> None:
        try:
            write_all(self._handle, line)
        except OSError as error:
            raise named(error, self.place) from None


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


def made_by(outputs: Sequence[RunOutput], plan: FramePlan, conduct: Conduct) -> str:
    """A digest of whatever decides the rows, besides the frames themselves."""
    import cv2
    import numpy as np

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
        [(output.part, output.head, output.tail, output.between) for output in outputs],
    )
    return hashlib.sha256(repr(values).encode("utf-8", "surrogateescape")).hexdigest()


def line_of_frame(
    before: str, lengths: tuple[int, ...], task: str, rows: FrameRows, content: list[bytes]
) -> tuple[str, bytes]:
    """The digest of a frame's line, as of `checked`, and the line."""
    values = _encoded(lengths, task, rows)
    check = _digest(before, values, content)
    return check, b'%b,"%b"]\n' % (values[:-1], check.encode())


def checked(
    before: str, lengths: tuple[int, ...], task: str, rows: FrameRows, content: list[bytes]
) -> str:
    """The digest of a frame's line, the frame's rows and all before."""
    return _digest(before, _encoded(lengths, task, rows), content)


def _digest(before: str, values: bytes, content: list[bytes]) -> str:
    return hashlib.sha256(b"".join([before.encode(), values, *content])).hexdigest()[:_DIGITS]


def task_digest(task: FrameTask) -> str:
    """A digest of what is to be done with a frame: its step, image, tilt and known rows.

    Of an image file, name, size and time of change count.
    """
    frame = task.frame
    s = frame.step  # numbers in words, or a record's own representation, would take longer than all
    numbers = _STEP(s.dx, s.dy, s.dphi, s.cxx, s.cxy, s.cyy, s.cxphi, s.cyphi, s.cphiphi)
    beside = (
        s.prefix,
        _file_of(frame),
        frame.time_s,
        frame.bits,
        frame.failure,
        task.tilt,
        task.known,
    )
    digest = hashlib.sha256(numbers + repr(beside).encode("utf-8", "surrogateescape"))
    if frame.content is not None:
        content = frame.content
        digest.update(content if isinstance(content, bytes) else content.tobytes())
    return digest.hexdigest()[:_DIGITS]


def _file_of(frame: RunFrame) -> object:
    """What tells a frame's image file, as it is now, from others."""
    if frame.image is None:
        return None
    if frame.stamp is not None:
        return (frame.image.name, *frame.stamp)
    try:
        status = os.stat(frame.image)  # noqa: PTH116 - that of a Path takes longer
    except (OSError, ValueError):
        return frame.image.name  # nothing there: that counts as well
    return frame.image.name, status.st_size, status.st_mtime_ns


def _encoded(lengths: tuple[int, ...], task: str, rows: FrameRows) -> bytes:
    if rows.error is None and not rows.rejected:  # the same, sooner
        return (
            f'[[{",".join(map(str, lengths))}],"{task}",{rows.disc_count},{rows.line_count},'
            f"{rows.marker_count},{int(rows.has_tilt)},[],null]"
        ).encode()
    values = [
        lengths,
        task,
        rows.disc_count,
        rows.line_count,
        rows.marker_count,
        int(rows.has_tilt),
        rows.rejected,
        rows.error,
    ]
    return _JSON.encode(values).encode()


def _parsed(text: bytes, end: int) -> JournalLine | None:
    """A line; None if it is none, or torn."""
    try:
        lengths, task, discs, lines, markers, tilt, rejected, error, check = json.loads(text)
        counts = [*lengths, discs, lines, markers, tilt, *[count for _, count in rejected]]
        words = [task, check, error or "", *[cause for cause, _ in rejected]]
    except (ValueError, TypeError, RecursionError):
        return None
    if not text.endswith(b"\n") or not all(type(count) is int and count >= 0 for count in counts):
        return None
    if not all(isinstance(word, str) for word in words):
        return None
    rows = FrameRows(
        disc_count=discs,
        line_count=lines,
        marker_count=markers,
        has_tilt=bool(tilt),
        rejected=tuple((cause, count) for cause, count in rejected),
        error=error,
    )
    return JournalLine(tuple(lengths), task, rows, check, end)
