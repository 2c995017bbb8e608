"""Files with a row per frame: its tilt, by the building's verticals, or its time (docs/formats.md).

Pitch and roll (radians) are the rotation vector (pitch, roll, 0) about the robot's X and Y axes
that levels measured directions. A frame with too few verticals has a NOTILT row. A TILT_D row after
either is the same frame's tilt from the outlines of discs; readers of tilts skip it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass

from redetect.bounds import number_in, whole_number_in
from redetect.landmarks.files import decode, opened, rows_of_words
from redetect.landmarks.records import LandmarkFileError
from redetect.messages import excerpt

#: The first line of written files.
TIMES_HEAD = "Times of the frames: <image> <seconds>, as their source gives them."


@dataclass(frozen=True, slots=True)
class FrameTilt:
    """The tilt of one frame."""

    prefix: str  #: The frame's image
    #: Rotation vector about the robot's X and Y that levels measured directions (rad)
    pitch: float
    roll: float
    #: Its covariance (rad^2)
    cpp: float
    cpr: float
    crr: float
    lines: int  #: Number of verticals that agree with it, or of discs used


def format_tilt(tilt: FrameTilt) -> str:
    """The row of a frame with a tilt, without line end."""
    return (
        f"TILT {tilt.prefix} {tilt.pitch:.6f} {tilt.roll:.6f} "
        f"{tilt.cpp:.6g} {tilt.cpr:.6g} {tilt.crr:.6g} {tilt.lines}"
    )


def format_outline_tilt(tilt: FrameTilt) -> str:
    """The row of a frame's tilt from the outlines of discs, without line end."""
    return f"TILT_D{format_tilt(tilt).removeprefix('TILT')}"


def format_no_tilt(prefix: str, lines: int) -> str:
    """The row of a frame without a tilt, without line end."""
    return f"NOTILT {prefix} {lines}"


def tilt_as_written(tilt: FrameTilt) -> FrameTilt:
    """The tilt rounded to the digits of its row."""
    pitch, roll, cpp, cpr, crr = map(float, format_tilt(tilt).rsplit(" ", 6)[1:-1])
    return FrameTilt(tilt.prefix, pitch, roll, cpp, cpr, crr, tilt.lines)


def read_tilts(path: str | os.PathLike[str]) -> dict[str, FrameTilt]:
    """Read a tilt file.

    Parameters
    ----------
    path : path

    Returns
    -------
    dict
        The tilts by image prefix; frames without a tilt are omitted.

    Raises
    ------
    LandmarkFileError
        If the file cannot be read or a row is malformed; names file and line.
    """
    return {tilt.prefix: tilt for _, tilt in numbered_tilts(path)}


def numbered_tilts(path: str | os.PathLike[str]) -> Iterator[tuple[int, FrameTilt]]:
    """The tilts of a file with the numbers of their frames, counted from 0; see `read_tilts`."""
    frame = -1
    name = os.fspath(path)
    with opened(path, "tilt file") as stream:
        for words, _, line in rows_of_words(stream, name):
            if not words or words[0] == b"TILT_D":
                continue
            frame += 1
            if words[0] != b"NOTILT":
                yield frame, _tilt([decode(word) for word in words], name, line)


def _tilt(words: list[str], name: str, line: int) -> FrameTilt:
    if words[0] != "TILT" or len(words) != 8:
        found = f"{excerpt(' '.join(words))}: expected TILT, an image, 5 numbers and a count"
        raise LandmarkFileError(name, line, found)
    try:
        pitch, roll, cpp, cpr, crr = numbers = [number_in(word) for word in words[2:7]]
        lines = whole_number_in(words[7])
    except ValueError:
        numbers, lines = [math.nan], 0
    if not all(map(math.isfinite, numbers)) or not 0 <= lines < 1 << 31:
        raise LandmarkFileError(name, line, "expected 5 finite numbers and a whole one")
    if not (cpp > 0.0 and crr > 0.0 and cpp * crr > cpr * cpr):
        raise LandmarkFileError(name, line, "the tilt's covariance is not positive definite")
    return FrameTilt(words[1], pitch, roll, cpp, cpr, crr, lines)


def read_times(path: str | os.PathLike[str]) -> dict[str, float]:
    """The times of images (s) by prefix; rows are separated by blanks or a comma.

    Raises LandmarkFileError if the file cannot be read, a row is malformed or an image has two.
    """
    times: dict[str, float] = {}
    with opened(path, "file of times") as stream:
        for row, _, line in rows_of_words(stream, os.fspath(path)):
            if len(row) != 2:  # of two words, the first may contain commas
                row = b" ".join(row).replace(b",", b" ").split()
            words = [decode(word).strip(",") for word in row]
            if not words:
                continue
            try:
                prefix, seconds = words[0], number_in(words[1])
            except (IndexError, ValueError):
                prefix, seconds = "", math.nan
            if len(words) != 2 or not math.isfinite(seconds):
                found = f"{excerpt(' '.join(words))}: expected an image's prefix and seconds"
                raise LandmarkFileError(path, line, found)
            if prefix in times:
                raise LandmarkFileError(path, line, f"{excerpt(prefix)} is listed a second time")
            times[prefix] = seconds
    return times


def format_time(prefix: str, time_s: float) -> str:
    """The row of an image, without line end."""
    return f"{prefix} {time_s:.6f}"
