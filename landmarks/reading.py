"""Reading landmark files: ``.circles``, ``.lines``, ``.markers``, and the STEP rows of ``.txt``.

A file is read row by row on demand, so that its size does not matter. Line ends may be
LF or CRLF. ``#`` at the start of a word begins a comment. A trailing backslash continues a row, but
not a comment: that would swallow the row after it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, TypeVar

from landmarks.errors import LandmarkError, LandmarkFileError, excerpt
from landmarks.records import (
    CIRCLE_NUMBERS,
    LINE_NUMBERS,
    MARKER_CORNER_NUMBERS,
    MARKER_CORNERS,
    STEP_NUMBERS,
    CircleLandmark,
    DetectorSettings,
    Frame,
    Landmark,
    LineLandmark,
    MarkerCorner,
    MarkerLandmark,
    Record,
    Row,
    Step,
)

T = TypeVar("T")

_LONGEST_ROW_BYTES = 1 << 16
_LONGEST_ID_DIGITS = 20
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"

# Narrower than `float`, which also takes nan, infinity and 1_000.
_NUMBER_PATTERN = rb"[+-]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?"
_NUMBER = re.compile(_NUMBER_PATTERN)
_NUMBERS = re.compile(rb"(?:%b )*+" % _NUMBER_PATTERN)
_WHOLE_NUMBER = re.compile(rb"[+-]?[0-9]+")
# A comment, so that other programs can read the file as well.
_LEVELLED = re.compile(rb"# levelled (%b) (%b)\r?\n?" % (_NUMBER_PATTERN, _NUMBER_PATTERN))
# A STEP as programs write it, in a line of its own, with finite numbers: the usual case.
_PLAIN_STEP = re.compile(
    rb"STEP ((?!#)[!-\[\]-~]{1,255}+)"
    + len(STEP_NUMBERS) * rb" {1,32}+(-?[0-9]{1,15}\.[0-9]{1,20})"
    + rb"\r?\n"
)


def read_rows(path: str | os.PathLike[str]) -> Iterator[Row]:
    """Read a landmark file row by row, comments and blank lines included.

    Written back with `write_rows`, unchanged rows are byte-identical.

    Parameters
    ----------
    path : path
        The file. It is opened when the first row is requested.

    Yields
    ------
    Row
        Each row with its record (None for comments and blank lines) and its text.

    Raises
    ------
    LandmarkFileError
        If the file cannot be opened, a row is malformed, or a landmark precedes the first STEP; the
        message names the file, the line and what was expected.
    """
    with _opened(path) as stream:
        yield from parse_rows(stream, name=os.fspath(path))


def read_frames(path: str | os.PathLike[str]) -> Iterator[Frame]:
    """Read a landmark file frame by frame: each STEP with the landmarks after it.

    Parameters, errors and laziness are those of `read_rows`.
    """
    return frames_of_rows(read_rows(path))


def read_steps(path: str | os.PathLike[str]) -> list[Step]:
    """Read a run's odometry: the STEP rows of a ``.txt``, ``.circles`` or ``.lines`` file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    list of Step
        In the file's order; landmarks are checked and left out.

    Raises
    ------
    LandmarkFileError
        As `read_rows`.
    """
    return list(iterate_steps(path))


def iterate_steps(path: str | os.PathLike[str]) -> Iterator[Step]:
    """Read a run's odometry step by step; parameters and errors are those of `read_steps`."""
    with _opened(path) as stream:
        for record, _, _ in _parsed(stream, os.fspath(path), _plain_step):
            if isinstance(record, Step):
                yield record


def iterate_prefixes(path: str | os.PathLike[str]) -> Iterator[str]:
    """The prefixes of a run's steps: the same errors, sooner than by the steps themselves."""
    with _opened(path) as stream:
        for record, _, _ in _parsed(stream, os.fspath(path), _plain_prefix):
            if isinstance(record, str):
                yield record
            elif isinstance(record, Step):
                yield record.prefix


def frames_of_rows(rows: Iterable[Row]) -> Iterator[Frame]:
    """Gather rows to frames; detector settings are left out, and comments but ``# levelled``."""
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
    for record, source, line in _parsed(stream, name, _plain_step):
        yield Row(record, source, line)


def parse_record(text: str) -> Record | None:
    """Make a record of one row's text; None for a comment or a blank line.

    Raises
    ------
    LandmarkError
        If the row is malformed; the message says what was expected.
    """
    return _parse(text.encode("utf-8", "surrogateescape"))


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a landmark file for reading; errors of the system become `LandmarkFileError`s."""
    try:
        with Path(path).open("rb") as stream:
            yield stream
    except FileNotFoundError:
        raise LandmarkFileError(path, None, "no such landmark file") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise LandmarkFileError(
            path, None, f"cannot be read as a landmark file: {reason}"
        ) from None


def _parsed(
    stream: BinaryIO, name: str, plain: Callable[[re.Match[bytes]], T]
) -> Iterator[tuple[Record | T | None, bytes, int]]:
    """Each row's record, its text in the file and the number of its first line.

    Of a plain STEP, the record is what `plain` makes of its words.
    """
    number = 0  # of the last line
    seen_step = False
    while source := stream.readline(_LONGEST_ROW_BYTES + 1):
        number += 1
        found = _PLAIN_STEP.fullmatch(source)
        if found is not None:
            seen_step = True
            yield plain(found), source, number
            continue
        first = number
        source, text, number = _logical_line(stream, name, source, number)
        try:
            record = _parse(text)
        except LandmarkError as error:
            raise LandmarkFileError(name, first, str(error)) from None
        if isinstance(record, Step):
            seen_step = True
        elif isinstance(record, Landmark) and not seen_step:
            raise LandmarkFileError(name, first, "landmark before any STEP: expected a STEP first")
        yield record, source, first


def _plain_step(found: re.Match[bytes]) -> Step:
    prefix, *numbers = found.groups()
    return Step(prefix.decode(), *map(float, numbers))


def _plain_prefix(found: re.Match[bytes]) -> str:
    return found[1].decode()


def _logical_line(
    stream: BinaryIO, name: str, source: bytes, number: int
) -> tuple[bytes, bytes, int]:
    """A row from its first line: its text in the file, the same joined to one line, its last line.

    `number` is that of the first line.
    """
    _demand_row_length(source, name, number)
    text = source.rstrip(b"\r\n")
    if number == 1:
        text = text.removeprefix(_BYTE_ORDER_MARK)
    if text.lstrip().startswith(b"#"):
        text = b""
    while text.endswith(b"\\"):
        following = stream.readline(_LONGEST_ROW_BYTES + 1)
        if not following:
            raise LandmarkFileError(name, number, "ends with \\: expected a line to follow")
        number += 1
        source += following
        _demand_row_length(source, name, number)
        text = text[:-1] + following.rstrip(b"\r\n")
    return source, text, number


def _demand_row_length(source: bytes, name: str, line: int) -> None:
    if len(source) > _LONGEST_ROW_BYTES:
        raise LandmarkFileError(
            name, line, f"longer than {_LONGEST_ROW_BYTES} bytes: expected a row of text"
        )


def _parse(text: bytes) -> Record | None:
    words = text.split()
    if b"#" in text:
        comment = next((i for i, word in enumerate(words) if word.startswith(b"#")), len(words))
        words = words[:comment]
    if not words:
        return None
    keyword = words[0]
    parse = _PARSERS.get(keyword)
    if parse is not None:
        return parse(words)
    if keyword.endswith(b"DETECTOR"):
        return DetectorSettings(_decode(keyword), tuple(map(_decode, words[1:])))
    raise LandmarkError(
        f"row starts with {excerpt(keyword)}: expected STEP, LANDMARK_C, LANDMARK_L, "
        "LANDMARK_M or a # comment"
    )


def _parse_step(words: list[bytes]) -> Step:
    if len(words) != 2 + len(STEP_NUMBERS):
        raise LandmarkError(
            f"STEP with {len(words) - 1} values: expected {1 + len(STEP_NUMBERS)}: "
            f"prefix {' '.join(STEP_NUMBERS)}"
        )
    return Step(_decode(words[1]), *_numbers(words[2:], STEP_NUMBERS))


def _parse_circle(words: list[bytes]) -> CircleLandmark:
    numbers, ids = _numbers_and_ids(words, CIRCLE_NUMBERS)
    px, py, quality, cxx, cxy, cyy = numbers
    return CircleLandmark(px, py, quality, cxx, cxy, cyy, ids)


def _parse_line(words: list[bytes]) -> LineLandmark:
    numbers, ids = _numbers_and_ids(words, LINE_NUMBERS)
    xtop, ytop, xbottom, ybottom, alpha, beta, quality, sigma = numbers
    return LineLandmark(xtop, ytop, xbottom, ybottom, alpha, beta, quality, sigma, ids)


def _parse_marker(words: list[bytes]) -> MarkerLandmark:
    expected = 3 + len(MARKER_CORNERS) * len(MARKER_CORNER_NUMBERS)
    if len(words) != 1 + expected:
        raise LandmarkError(
            f"LANDMARK_M with {len(words) - 1} values: expected {expected}: dictionary ID quality "
            f"and four times {' '.join(MARKER_CORNER_NUMBERS)}"
        )
    (quality,) = _numbers(words[3:4], ("quality",))
    per_corner = len(MARKER_CORNER_NUMBERS)
    first, second, third, fourth = (
        MarkerCorner(*_numbers(words[start : start + per_corner], MARKER_CORNER_NUMBERS))
        for start in range(4, 1 + expected, per_corner)
    )
    return MarkerLandmark(
        _decode(words[1]), _identifier(words[2]), quality, (first, second, third, fourth)
    )


_PARSERS: dict[bytes, Callable[[list[bytes]], Record]] = {
    b"STEP": _parse_step,
    b"LANDMARK_C": _parse_circle,
    # Name of the row in the comments at the head of the data set's files of circles.
    b"LANDMARK": _parse_circle,
    b"LANDMARK_L": _parse_line,
    b"LANDMARK_M": _parse_marker,
}


def _numbers_and_ids(
    words: list[bytes], names: tuple[str, ...]
) -> tuple[list[float], tuple[int, ...]]:
    if len(words) < 1 + len(names):
        raise LandmarkError(
            f"{_decode(words[0])} with {len(words) - 1} values: expected at least {len(names)}: "
            f"{' '.join(names)} and any IDs"
        )
    numbers = _numbers(words[1 : 1 + len(names)], names)
    return numbers, tuple(map(_identifier, words[1 + len(names) :]))


def _numbers(words: list[bytes], names: tuple[str, ...]) -> list[float]:
    if not _NUMBERS.fullmatch(b" ".join([*words, b""])):
        for word, name in zip(words, names):
            if not _NUMBER.fullmatch(word):
                raise LandmarkError(f"{name} is {excerpt(word)}: expected a finite number")
    return [float(word) for word in words]


def _identifier(word: bytes) -> int:
    if not _WHOLE_NUMBER.fullmatch(word) or len(word) > _LONGEST_ID_DIGITS:
        raise LandmarkError(f"ID is {excerpt(word)}: expected a whole number, -1 if unknown")
    return int(word)


def _decode(word: bytes) -> str:
    return word.decode("utf-8", "surrogateescape")
