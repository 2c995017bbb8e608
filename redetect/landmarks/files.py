"""Landmark files: ``.circles``, ``.lines``, ``.markers``, and the STEP rows of ``.txt``.

A file is read row by row on demand, so that its size does not matter. Line ends may be LF or CRLF.
``#`` at the start of a word begins a comment. A trailing backslash continues a row, but not a
comment, as the next row would be lost. Files are written in the data set's own layout.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO

from redetect.bounds import NUMBER
from redetect.landmarks.records import (
    CIRCLE_NUMBERS,
    LINE_NUMBERS,
    MARKER_CORNER_NUMBERS,
    STEP_NUMBERS,
    CircleLandmark,
    Frame,
    Landmark,
    LandmarkError,
    LandmarkFileError,
    LineLandmark,
    MarkerCorner,
    MarkerLandmark,
    Record,
    Row,
    Step,
    numbers_of_circle,
    numbers_of_line,
    numbers_of_step,
)
from redetect.messages import excerpt
from redetect.storage import write_whole
from redetect.storage.bounded import FilePath

#: Phrases in the head of files whose positions are true level ones, or corrected for the tilt.
LEVEL = "level robot frame"
LEVELLED = "corrected for the tilt of the frames that have one"

# The head is the part before the first row; real ones are much shorter.
_LONGEST_HEAD_BYTES = _LONGEST_ROW_BYTES = 1 << 16
_LONGEST_ID_DIGITS = 20
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"

_NUMBER = re.compile(NUMBER.encode())
_WHOLE_NUMBER = re.compile(rb"[+-]?[0-9]+")
# A comment, so that other programs can read the file as well.
_LEVELLED = re.compile(rf"# levelled ({NUMBER}) ({NUMBER})\r?\n?".encode())
_STEP_ROW = "STEP %s" + 3 * " %8.5f" + 6 * " %.12f"
_CIRCLE_ROW = "LANDMARK_C" + len(CIRCLE_NUMBERS) * " %g"
_LINE_ROW = "LANDMARK_L" + len(LINE_NUMBERS) * " %g"


@dataclass(frozen=True)
class FileHead:
    """The known parts of the comments at the head of a file of rows."""

    comments: tuple[str, ...] = ()  #: its lines without comment signs
    #: names and values of the detector's settings, as written
    settings: tuple[tuple[str, str], ...] = ()
    level: bool = False  #: positions are corrected for the frames' tilts, or true level ones
    name: str = ""  #: of the file, for messages

    @property
    def covers_tilt(self) -> bool:
        """Whether the covariances of discs include that of an unknown tilt."""
        settings = dict(self.settings)
        tilt = settings.get("tilt_sigma_deg", "0")
        return settings.get("refine") == "True" and tilt.strip("0.") != ""


def read_head(path: FilePath) -> FileHead:
    """Read the head of a file of rows; a LandmarkFileError if the file cannot be read."""
    with opened(path, "landmark file") as stream:
        start = stream.read(_LONGEST_HEAD_BYTES)
    lines = map(str.strip, start.decode("utf-8-sig", "replace").split("\n"))
    head = takewhile(lambda line: not line or line.startswith("#"), lines)
    comments = [line.removeprefix("#").strip() for line in head]
    settings = tuple(
        (name, value)
        for text in comments
        if text.startswith("settings ")
        for name, equals, value in (word.partition("=") for word in text.split()[1:])
        if equals
    )
    level = any(LEVELLED in text or LEVEL in text for text in comments)
    return FileHead(tuple(comments), settings, level, os.fspath(path))


def read_rows(path: FilePath) -> Iterator[Row]:
    """Read a landmark file row by row, comments and blank lines included.

    Written back with `write_rows`, unchanged rows are byte-identical.

    Parameters
    ----------
    path : path
        The file. It is opened when the first row is requested.

    Yields
    ------
    Row
        Each row with its text and its record: None for comments, blank lines and the settings of a
        detector at the head of the data set's files.

    Raises LandmarkFileError if the file cannot be opened, a row is malformed, or a landmark
    precedes the first STEP; the message names the file, the line and what was expected.
    """
    with opened(path, "landmark file") as stream:
        yield from parse_rows(stream, name=os.fspath(path))


def read_frames(path: FilePath) -> Iterator[Frame]:
    """Read a landmark file frame by frame: each STEP with the landmarks after it (`read_rows`)."""
    return frames_of_rows(read_rows(path))


def read_steps(path: FilePath) -> Iterator[Step]:
    """Read the STEP rows of a file of landmarks or odometry; errors as of `read_rows`."""
    return (row.record for row in read_rows(path) if isinstance(row.record, Step))


def frames_of_rows(rows: Iterable[Row]) -> Iterator[Frame]:
    """Group rows into frames; comments are skipped except ``# levelled``."""
    step: Step | None = None
    landmarks: list[Landmark] = []
    levelled_by: tuple[float, float] | None = None
    for row in rows:
        if isinstance(row.record, Step):
            if step is not None:
                yield Frame(step, tuple(landmarks), levelled_by)
            step, landmarks, levelled_by = row.record, [], None
        elif isinstance(row.record, Landmark):
            landmarks.append(row.record)
        elif row.source is not None and (found := _LEVELLED.fullmatch(row.source)):
            levelled_by = float(found[1]), float(found[2])
    if step is not None:
        yield Frame(step, tuple(landmarks), levelled_by)


def parse_rows(stream: BinaryIO, name: str = "<stream>") -> Iterator[Row]:
    """Read rows from a binary stream; errors name the file `name` (see `read_rows`)."""
    seen_step = False
    for words, source, line in rows_of_words(stream, name):
        try:
            record = _record(words)
        except LandmarkError as error:
            raise LandmarkFileError(name, line, str(error)) from None
        if isinstance(record, Step):
            seen_step = True
        elif isinstance(record, Landmark) and not seen_step:
            raise LandmarkFileError(name, line, "landmark before any STEP: expected a STEP first")
        yield Row(record, source, line)


@contextmanager
def opened(path: FilePath, kind: str) -> Iterator[BinaryIO]:
    """Open a file of some kind for reading; system errors become `LandmarkFileError`."""
    try:
        with Path(path).open("rb") as stream:
            yield stream
    except FileNotFoundError:
        raise LandmarkFileError(path, None, f"no such {kind}") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise LandmarkFileError(path, None, f"cannot be read as a {kind}: {reason}") from None


def rows_of_words(stream: BinaryIO, name: str) -> Iterator[tuple[list[bytes], bytes, int]]:
    """The words of each row of a file, its text and the number of its first line."""
    source = text = b""
    first, number = 1, 0
    while line := stream.readline(_LONGEST_ROW_BYTES + 1):
        number += 1
        source += line
        if len(source) > _LONGEST_ROW_BYTES:
            raise LandmarkFileError(
                name, number, f"longer than {_LONGEST_ROW_BYTES} bytes: expected a row of text"
            )
        text += line.rstrip(b"\r\n")
        if number == 1:
            text = text.removeprefix(_BYTE_ORDER_MARK)
        if text.endswith(b"\\") and not text.lstrip().startswith(b"#"):
            text = text[:-1]
            continue
        # Without the row's comment.
        words = takewhile(lambda word: not word.startswith(b"#"), text.split())
        yield list(words), source, first
        source = text = b""
        first = number + 1
    if source:
        raise LandmarkFileError(name, number, "ends with \\: expected a line to follow")


def decode(word: bytes) -> str:
    """A word of a file; bytes that are not UTF-8 become surrogates, as in Python's file names."""
    return word.decode("utf-8", "surrogateescape")


def _record(words: list[bytes]) -> Record | None:
    if not words:
        return None
    keyword = words[0]
    if keyword == b"STEP":
        _demand_count(words, 1 + len(STEP_NUMBERS), "prefix", *STEP_NUMBERS)
        return Step(decode(words[1]), *_numbers(words[2:], STEP_NUMBERS))
    # LANDMARK is the row's name in the comments at the head of the data set's files of circles.
    if keyword in (b"LANDMARK_C", b"LANDMARK", b"LANDMARK_L"):
        is_line = keyword == b"LANDMARK_L"
        names = LINE_NUMBERS if is_line else CIRCLE_NUMBERS
        if len(words) < 1 + len(names):
            raise LandmarkError(
                f"{decode(keyword)} with {len(words) - 1} values: expected at least {len(names)}: "
                f"{' '.join(names)} and any IDs"
            )
        kind: Any = LineLandmark if is_line else CircleLandmark
        found: Landmark = kind(*_numbers(words[1:], names), _ids(words[1 + len(names) :]))
        return found
    if keyword == b"LANDMARK_M":
        named = " ".join(MARKER_CORNER_NUMBERS)
        _demand_count(words, 23, "dictionary ID quality and four times", named)
        (identifier,), (quality,) = _ids(words[2:3]), _numbers(words[3:], ("quality",))
        first, second, third, fourth = (
            MarkerCorner(*_numbers(words[start:], MARKER_CORNER_NUMBERS))
            for start in range(4, 24, 5)
        )
        return MarkerLandmark(decode(words[1]), identifier, quality, (first, second, third, fourth))
    # The data set has ``CIRCLEMARKDETECTOR <camfile> nohalf|half <radius> <threshold>``.
    if keyword.endswith(b"DETECTOR"):
        return None
    raise LandmarkError(
        f"row starts with {excerpt(decode(keyword))}: expected STEP, LANDMARK_C, LANDMARK_L, "
        "LANDMARK_M or a # comment"
    )


def _demand_count(words: list[bytes], count: int, *names: str) -> None:
    if len(words) != 1 + count:
        raise LandmarkError(
            f"{decode(words[0])} with {len(words) - 1} values: expected {count}: {' '.join(names)}"
        )


def _numbers(words: list[bytes], names: tuple[str, ...]) -> list[float]:
    """The numbers at the beginning of a row's words, one for each name."""
    for word, name in zip(words, names):
        if not _NUMBER.fullmatch(word):
            raise LandmarkError(f"{name} is {excerpt(decode(word))}: expected a finite number")
    return [float(word) for word in words[: len(names)]]


def _ids(words: list[bytes]) -> tuple[int, ...]:
    for word in words:
        if not _WHOLE_NUMBER.fullmatch(word) or len(word) > _LONGEST_ID_DIGITS:
            raise LandmarkError(
                f"ID is {excerpt(decode(word))}: expected a whole number, -1 if unknown"
            )
    return tuple(map(int, words))


def format_record(record: Record, *, exact: bool = False) -> str:
    """Format a record as a row of a file, without line end.

    Poses of steps have 5 decimals and their covariances 12, as C's ``%8.5f`` and ``%.12f``;
    landmarks have 6 significant digits, as C's ``%g``; corners of markers, in pixels, 4 decimals.
    If `exact`, steps and discs have as many digits as are needed to read the same numbers.
    """
    if exact and isinstance(record, Step):
        return " ".join(["STEP", record.prefix, *map(repr, numbers_of_step(record))])
    if exact and isinstance(record, CircleLandmark):
        return " ".join(
            ["LANDMARK_C", *map(repr, numbers_of_circle(record)), *map(str, record.ids)]
        )
    if isinstance(record, Step):
        return _STEP_ROW % (record.prefix, *numbers_of_step(record))
    if isinstance(record, MarkerLandmark):
        corners = (f"{c.u:.4f} {c.v:.4f} {c.cuu:g} {c.cuv:g} {c.cvv:g}" for c in record.corners)
        head = f"LANDMARK_M {record.dictionary} {record.id:d} {record.quality:g}"
        return " ".join([head, *corners])
    if isinstance(record, CircleLandmark):
        row = _CIRCLE_ROW % numbers_of_circle(record)
    else:
        row = _LINE_ROW % numbers_of_line(record)
    return " ".join([row, *map(str, record.ids)])


def format_levelling(levelled_by: tuple[float, float]) -> str:
    """The comment after a STEP with the pitch and roll (rad) by which its discs were levelled."""
    pitch, roll = levelled_by
    return f"# levelled {pitch:.9f} {roll:.9f}"


def format_head(head: str) -> bytes:
    """A text as comments at the head of a file, with a ``#`` before each line."""
    lines = head.split("\n") if head else []
    return b"".join(_encode(f"# {line}".rstrip() + "\n") for line in lines)


def format_frame(frame: Frame, *, exact: bool = False) -> bytes:
    """The rows of a frame in a file: its STEP, its levelling and its landmarks."""
    rows = [format_record(record, exact=exact) for record in (frame.step, *frame.landmarks)]
    if frame.levelled_by is not None:
        rows.insert(1, format_levelling(frame.levelled_by))
    return _encode("".join(f"{row}\n" for row in rows))


def write_frames(
    path: FilePath, frames: Iterable[Frame], *, head: str = "", overwrite: bool = False,
    exact: bool = False,
) -> None:  # fmt: skip
    """Write frames to a landmark file, whole or not at all, with a text as comments at its head.

    They are written as they are iterated; `exact` as for `format_record`. OutputExistsError if it
    exists, unless `overwrite`.
    """
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(format_head(head))
        for frame in frames:
            stream.write(format_frame(frame, exact=exact))


def write_rows(path: FilePath, rows: Iterable[Row], *, overwrite: bool = False) -> None:
    """Write rows to a landmark file, whole or not at all; unchanged ones are byte-identical.

    Rows with their text are copied; others are formatted by `format_record`, with the line end of
    the previous row. The path may be that of the file from which the rows are read.
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
