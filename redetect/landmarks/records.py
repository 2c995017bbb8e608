"""The rows of landmark files as values.

Robot frame: X left, Y backward (forward is -Y), origin on the floor below the robot's centre;
metres and radians. Values that could not be read back from a file raise `LandmarkError`: numbers
that are enormous or not finite, identifiers of more than 64 bits, names that are not one word.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from operator import attrgetter

from redetect.bounds import FINITE, LARGEST_NUMBER
from redetect.messages import OneLineError, excerpt

STEP_NUMBERS = ("dx", "dy", "dphi", "cxx", "cxy", "cyy", "cxphi", "cyphi", "cphiphi")
CIRCLE_NUMBERS = ("px", "py", "quality", "cxx", "cxy", "cyy")
LINE_NUMBERS = ("xtop", "ytop", "xbottom", "ybottom", "alpha", "beta", "quality", "sigma")
MARKER_CORNERS = ("top left", "top right", "bottom right", "bottom left")
MARKER_CORNER_NUMBERS = ("u", "v", "cuu", "cuv", "cvv")
_LARGEST_ID = 2**63 - 1
_WORD = re.compile(r"[^# \t\n\r\v\f][^ \t\n\r\v\f]*(?<!\\)")


class LandmarkError(OneLineError, ValueError):
    """An invalid record; the message names the quantity, its value and what was expected."""


class LandmarkFileError(LandmarkError):
    """A landmark file that cannot be read.

    Parameters
    ----------
    file : path
    line : int or None
        The line, counted from 1; None if the error concerns the whole file.
    problem : str
        What was found and what was expected.
    """

    def __init__(self, file: str | os.PathLike[str], line: int | None, problem: str) -> None:
        self.file = os.fspath(file)
        self.line = line
        self.problem = problem
        place = self.file if line is None else f"{self.file}:{line}"
        super().__init__(f"{place}: {problem}")


#: The numbers of a record as a tuple.
numbers_of_step = attrgetter(*STEP_NUMBERS)
numbers_of_circle = attrgetter(*CIRCLE_NUMBERS)
numbers_of_line = attrgetter(*LINE_NUMBERS)


@dataclass(frozen=True, slots=True)
class Step:
    """A motion of the robot and the image taken after it."""

    #: The image's name, usually without extension. Bytes of the file that are not UTF-8 are kept as
    #: surrogates, as in Python's file names.
    prefix: str
    #: Pose after the motion in the robot frame before it (m, m, rad)
    dx: float
    dy: float
    dphi: float
    #: Covariance of (dx, dy, dphi) (m^2, m rad, rad^2)
    cxx: float
    cxy: float
    cyy: float
    cxphi: float
    cyphi: float
    cphiphi: float

    def __post_init__(self) -> None:
        _demand_finite(STEP_NUMBERS, numbers_of_step(self))
        _demand_word(self.prefix, "image prefix")


@dataclass(frozen=True, slots=True)
class CircleLandmark:
    """A disc on the floor as seen in one image."""

    #: The disc's centre in the robot frame (m)
    px: float
    py: float
    quality: float  #: The detector's confidence, 0 (bad) to 1 (good)
    #: Covariance of (px, py) (m^2)
    cxx: float
    cxy: float
    cyy: float
    #: The disc's identifiers: usually one, -1 if it is unknown, empty if the row has none
    ids: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _demand_finite(CIRCLE_NUMBERS, numbers_of_circle(self))
        _demand_ids(self.ids)

    @property
    def identified(self) -> bool:
        """Whether the disc's identifier is known."""
        return any(identifier >= 0 for identifier in self.ids)


@dataclass(frozen=True, slots=True)
class LineLandmark:
    """A vertical line of the building as seen in one image."""

    #: The line's ends in undistorted normalised image coordinates
    xtop: float
    ytop: float
    xbottom: float
    ybottom: float
    alpha: float  #: Bearing of the line, 0 forward and positive to the left (rad)
    beta: float  #: Inclination of the plane through the camera's centre and the line (rad)
    quality: float  #: The detector's confidence; always 0 in the data set's own files
    sigma: float  #: Standard deviation of `alpha` (rad)
    ids: tuple[int, ...] = ()  #: The line's identifiers, as in `CircleLandmark`

    def __post_init__(self) -> None:
        _demand_finite(LINE_NUMBERS, numbers_of_line(self))
        _demand_ids(self.ids)

    @property
    def identified(self) -> bool:
        """Whether the line's identifier is known."""
        return any(identifier >= 0 for identifier in self.ids)


@dataclass(frozen=True, slots=True)
class MarkerCorner:
    """A corner of a square marker in an image."""

    #: Its distorted position in the image (px; the top left pixel's centre is 0, 0)
    u: float
    v: float
    #: Covariance of (u, v) (px^2)
    cuu: float
    cuv: float
    cvv: float

    def __post_init__(self) -> None:
        numbers = (self.u, self.v, self.cuu, self.cuv, self.cvv)
        _demand_finite(MARKER_CORNER_NUMBERS, numbers)


@dataclass(frozen=True, slots=True)
class MarkerLandmark:
    """A square marker as seen in one image."""

    dictionary: str  #: The set of markers that defines the identifier
    id: int  #: The marker's number in that set
    quality: float  #: Agreement of the marker's cells with the pattern; 1 is perfect
    #: Top left, top right, bottom right, bottom left of the marker as printed
    corners: tuple[MarkerCorner, MarkerCorner, MarkerCorner, MarkerCorner]

    def __post_init__(self) -> None:
        _demand_word(self.dictionary, "dictionary of markers")
        if not 0 <= self.id <= _LARGEST_ID:
            raise LandmarkError(f"marker's ID is {excerpt(self.id)}: expected 0 or more, 64 bits")
        _demand_finite(("quality",), (self.quality,))
        if len(self.corners) != len(MARKER_CORNERS):
            raise LandmarkError(f"marker has {len(self.corners)} corners: expected 4")


Landmark = CircleLandmark | LineLandmark | MarkerLandmark
Record = Step | Landmark


@dataclass(frozen=True, slots=True)
class Frame:
    """A step and the landmarks in the image taken after it."""

    step: Step
    landmarks: tuple[Landmark, ...] = ()
    #: Pitch and roll (rad) by which its discs' positions were levelled; None if they were not
    levelled_by: tuple[float, float] | None = None

    @property
    def circles(self) -> tuple[CircleLandmark, ...]:
        """The discs among the landmarks, in the file's order."""
        return tuple(row for row in self.landmarks if isinstance(row, CircleLandmark))

    @property
    def lines(self) -> tuple[LineLandmark, ...]:
        """The lines among the landmarks, in the file's order."""
        return tuple(row for row in self.landmarks if isinstance(row, LineLandmark))

    @property
    def markers(self) -> tuple[MarkerLandmark, ...]:
        """The square markers among the landmarks, in the file's order."""
        return tuple(row for row in self.landmarks if isinstance(row, MarkerLandmark))


@dataclass(frozen=True, slots=True)
class Row:
    """A row of a landmark file with its text."""

    record: Record | None  #: None for comments, blank lines and settings of a detector
    #: The row's text in the file, including continuation lines and line end; None for a row that
    #: was not read from a file, or was changed
    source: bytes | None = None
    #: The number of the row's first line in its file, counted from 1; 0 without a file
    line: int = 0

    def with_record(self, record: Record) -> Row:
        """The row with another record; its text is kept if the record is equal."""
        return self if record == self.record else Row(record, line=self.line)


def _demand_finite(names: tuple[str, ...], values: tuple[float, ...]) -> None:
    if not all(map(LARGEST_NUMBER.__ge__, map(abs, values))):
        name, value = next(p for p in zip(names, values) if not abs(p[1]) <= LARGEST_NUMBER)
        raise LandmarkError(f"{name} is {value}: expected {FINITE.expected}")


def _demand_word(word: str, name: str) -> None:
    """Reject text that would not be read back from a file as one word."""
    if not _WORD.fullmatch(word):
        raise LandmarkError(
            f"{name} is {excerpt(word)}: expected one word that starts with no # and ends with no "
            "backslash"
        )


def _demand_ids(ids: tuple[int, ...]) -> None:
    for identifier in ids:
        if not -_LARGEST_ID <= identifier <= _LARGEST_ID:
            raise LandmarkError(f"ID is {excerpt(identifier)}: expected at most 64 bits")
