"""Writes landmark files in the data set's own layout."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Literal

from redetect.landmarks.records import (
    CIRCLE_NUMBERS,
    LINE_NUMBERS,
    STEP_NUMBERS,
    CircleLandmark,
    Frame,
    MarkerLandmark,
    Record,
    Row,
    Step,
)
from redetect.storage import write_whole

LineEnd = Literal["\n", "\r\n"]


def format_record(record: Record) -> str:
    """Format a record as a row of a file, without line end.

    Poses of steps have 5 decimals and their covariances 12, as C's ``%8.5f`` and ``%.12f``;
    landmarks have 6 significant digits, as C's ``%g``; corners of markers, in pixels, 4 decimals.
    """
    if isinstance(record, Step):
        pose = [f"{getattr(record, name):8.5f}" for name in STEP_NUMBERS[:3]]
        covariance = [f"{getattr(record, name):.12f}" for name in STEP_NUMBERS[3:]]
        return " ".join(["STEP", record.prefix, *pose, *covariance])
    if isinstance(record, MarkerLandmark):
        corners = (f"{c.u:.4f} {c.v:.4f} {c.cuu:g} {c.cuv:g} {c.cvv:g}" for c in record.corners)
        head = f"LANDMARK_M {record.dictionary} {record.id:d} {record.quality:g}"
        return " ".join([head, *corners])
    is_circle = isinstance(record, CircleLandmark)
    names = CIRCLE_NUMBERS if is_circle else LINE_NUMBERS
    numbers = [f"{getattr(record, name):g}" for name in names]
    ids = [f"{identifier:d}" for identifier in record.ids]
    return " ".join(["LANDMARK_C" if is_circle else "LANDMARK_L", *numbers, *ids])


def format_levelling(levelled_by: tuple[float, float]) -> str:
    """The comment behind a STEP that says by which pitch and roll (rad) its discs were levelled."""
    pitch, roll = levelled_by
    return f"# levelled {pitch:.9f} {roll:.9f}"


def format_head(head: str, line_end: LineEnd = "\n") -> bytes:
    """A text as the comments at the head of a file: a ``#`` before each of its lines."""
    lines = head.split("\n") if head else []
    return b"".join(_encode(f"# {line}".rstrip() + line_end) for line in lines)


def format_frame(frame: Frame, line_end: LineEnd = "\n") -> bytes:
    """The rows of a frame in a file: its STEP, its levelling and its landmarks."""
    rows = [format_record(record) for record in (frame.step, *frame.landmarks)]
    if frame.levelled_by is not None:
        rows.insert(1, format_levelling(frame.levelled_by))
    return _encode("".join([row + line_end for row in rows]))


def write_frames(
    path: str | os.PathLike[str],
    frames: Iterable[Frame],
    *,
    head: str = "",
    line_end: LineEnd = "\n",
    overwrite: bool = False,
) -> None:
    """Write frames to a landmark file, whole or not at all.

    Parameters
    ----------
    path : path
    frames : iterable of Frame
        Written as they come: they need not be in memory at once.
    head : str
        Text to write above them, each line as a comment.
    line_end : str
        LF, or CRLF as in the data set's own files.
    overwrite : bool
        Whether an existing file may be replaced; else `redetect.storage.OutputExistsError` is
        raised.
    """
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(format_head(head, line_end))
        for frame in frames:
            stream.write(format_frame(frame, line_end))


def write_rows(
    path: str | os.PathLike[str], rows: Iterable[Row], *, overwrite: bool = False
) -> None:
    """Write rows to a landmark file, whole or not at all; unchanged ones byte by byte.

    Parameters
    ----------
    path : path
        May be the file that the rows are being read from.
    rows : iterable of Row
        Rows that have their text are copied; the others are laid out by `format_record` and end
        like the row before them.
    overwrite : bool
        As in `write_frames`.
    """
    line_end = b"\n"
    text = line_end
    with write_whole(path, overwrite=overwrite) as stream:
        for row in rows:
            if not text.endswith(b"\n"):  # the last line of the file that was read
                stream.write(line_end)
            if row.source is not None:
                text = row.source
            else:
                text = _encode("" if row.record is None else format_record(row.record)) + line_end
            if text.endswith(b"\n"):
                line_end = b"\r\n" if text.endswith(b"\r\n") else b"\n"
            stream.write(text)


def _encode(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
