"""Tilt files: pitch and roll of each frame, as the building's verticals show it.

One row per frame, ``#`` comments and blank lines skipped:

    TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>
    NOTILT <image> <lines>
    TILT_D <image> <pitch> <roll> <cPP> <cPR> <cRR> <discs>

Pitch and roll (radians) are the rotation vector (pitch, roll, 0) about the robot's X and Y axes
that turns measured directions level; then its covariance and the number of verticals that agree
with it. A frame with too few of them has a NOTILT row. A TILT_D row after either is what the
outlines of discs show of the same frame; readers of tilts skip it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from landmarks.errors import LandmarkFileError

_LARGEST_ROW = 65536


@dataclass(frozen=True, slots=True)
class FrameTilt:
    """The tilt of one frame.

    Attributes
    ----------
    prefix : str
        The frame's image.
    pitch, roll : float
        Rotation vector about the robot's X and Y that turns measured directions level (rad).
    cpp, cpr, crr : float
        Its covariance (rad^2).
    lines : int
        Verticals that agree with it, or discs that show it.
    """

    prefix: str
    pitch: float
    roll: float
    cpp: float
    cpr: float
    crr: float
    lines: int


def format_tilt(tilt: FrameTilt) -> str:
    """The row of a frame that has a tilt, without line end."""
    return (
        f"TILT {tilt.prefix} {tilt.pitch:.6f} {tilt.roll:.6f} "
        f"{tilt.cpp:.6g} {tilt.cpr:.6g} {tilt.crr:.6g} {tilt.lines}"
    )


def format_outline_tilt(tilt: FrameTilt) -> str:
    """The row of the tilt by the outlines of a frame's discs, without line end."""
    return f"TILT_D{format_tilt(tilt).removeprefix('TILT')}"


def format_no_tilt(prefix: str, lines: int) -> str:
    """The row of a frame that has none, without line end."""
    return f"NOTILT {prefix} {lines}"


def tilt_as_written(tilt: FrameTilt) -> FrameTilt:
    """The tilt rounded to the digits that its row has."""
    _, _, *numbers, _ = format_tilt(tilt).split()
    pitch, roll, cpp, cpr, crr = map(float, numbers)
    return FrameTilt(tilt.prefix, pitch, roll, cpp, cpr, crr, tilt.lines)


def read_tilts(path: str | os.PathLike[str]) -> dict[str, FrameTilt]:
    """Read a tilt file.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    dict
        The frames that have a tilt, by their image prefix.

    Raises
    ------
    LandmarkFileError
        If the file cannot be read or a row is malformed; names file and line.
    """
    return {tilt.prefix: tilt for tilt in iterate_tilts(path)}


def iterate_tilts(path: str | os.PathLike[str]) -> Iterator[FrameTilt]:
    """Read a tilt file row by row; parameters and errors are those of `read_tilts`."""
    return (tilt for _, tilt in numbered_tilts(path))


def numbered_tilts(path: str | os.PathLike[str]) -> Iterator[tuple[int, FrameTilt]]:
    """The tilts of a file with the numbers of their frames, counted from 0; see `read_tilts`."""
    frame = -1
    try:
        with Path(path).open("rb") as stream:
            number = 0
            while source := stream.readline(_LARGEST_ROW + 1):
                number += 1
                if len(source) > _LARGEST_ROW:
                    raise LandmarkFileError(str(path), number, "the row is too long")
                line = source.decode("utf-8", "surrogateescape")
                words = line.partition("#")[0].split()
                if not words or words[0] == "TILT_D":
                    continue
                frame += 1
                if words[0] != "NOTILT":
                    yield frame, _tilt(words, str(path), number)
    except FileNotFoundError:
        raise LandmarkFileError(str(path), None, "no such tilt file") from None
    except OSError as error:
        raise LandmarkFileError(str(path), None, f"cannot be read: {error.strerror}") from None


def _tilt(words: list[str], name: str, number: int) -> FrameTilt:
    if words[0] != "TILT" or len(words) != 8:
        found = ascii(" ".join(words)[:40])
        raise LandmarkFileError(
            name, number, f"{found}: expected TILT, an image, 5 numbers and a count"
        )
    try:
        values = [float(word) for word in words[2:7]]
        lines = int(words[7])
    except ValueError:
        values, lines = [math.nan], 0
    if not all(math.isfinite(value) for value in values) or not 0 <= lines < 1 << 31:
        raise LandmarkFileError(name, number, "expected 5 finite numbers and a whole one")
    pitch, roll, cpp, cpr, crr = values
    if not (cpp > 0.0 and crr > 0.0 and cpp * crr > cpr * cpr):
        raise LandmarkFileError(name, number, "the tilt's covariance is not positive definite")
    return FrameTilt(words[1], pitch, roll, cpp, cpr, crr, lines)
