"""Reads the head of a file of rows: how they were made."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.runs.outputs import LEVEL, LEVELLED
from detect.settings import CircleSettings
from detect.tune.grid import parameter_value
from storage.messages import excerpt

# The head is what precedes the first row; real ones are much shorter.
_LONGEST_BYTES = 1 << 16
#: Settings that are several numbers.
_PAIRS, _LIST = "refine_steps_px", "blurred_widths"
_NUMBERS = re.compile(r"[^(),]+")


@dataclass(frozen=True)
class FileHead:
    """The head of a file of rows, as far as it is understood.

    Attributes
    ----------
    comments : tuple of str
        Its lines without the signs of comment.
    settings : tuple of (str, str)
        The effective settings: names and values, as they are written.
    level : bool
        Whether it says that positions of discs are corrected for the frames' tilts, or true ones
        in the level robot frame.
    name : str
        What messages call the file.
    """

    comments: tuple[str, ...] = ()
    settings: tuple[tuple[str, str], ...] = ()
    level: bool = False
    name: str = ""

    @property
    def circle_settings(self) -> CircleSettings:
        """The settings of discs, the defaults where the head does not give them.

        Raises
        ------
        DetectError
            If one has a value that none can have.
        """
        try:
            return CircleSettings(**_values(CircleSettings, self.settings))
        except DetectError as error:
            raise DetectError(f"{self.name}: {error}") from None

    @property
    def line_settings(self) -> LineSettings:
        """The settings of verticals; as `circle_settings`."""
        try:
            return LineSettings(**_line_values(self.settings))
        except DetectError as error:
            raise DetectError(f"{self.name}: {error}") from None


def read_head(path: Path) -> FileHead:
    """Read the head of a file of rows.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    FileHead

    Raises
    ------
    DetectError
        If the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            start = stream.read(_LONGEST_BYTES)
    except OSError as error:
        raise DetectError(f"{path}: cannot be read: {error.strerror}") from None
    comments: list[str] = []
    for line in start.decode("utf-8", "replace").splitlines():
        text = line.strip()
        if text and not text.startswith("#"):
            break
        comments.append(text.removeprefix("#").strip())
    settings = tuple(
        (name, value)
        for text in comments
        if text.startswith("settings ")
        for name, equals, value in (word.partition("=") for word in text.split()[1:])
        if equals
    )
    level = any(LEVELLED in text or LEVEL in text for text in comments)
    return FileHead(tuple(comments), settings, level, str(path))


def _line_values(settings: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """As `_values`, of `LineSettings`; of those that are several numbers, too."""
    entries = list(settings)
    singles = [entry for entry in entries if entry[0] not in (_PAIRS, _LIST)]
    values = _values(LineSettings, singles)
    for name, text in entries:
        if name not in (_PAIRS, _LIST):
            continue
        expected = "pairs of numbers" if name == _PAIRS else "numbers"
        try:
            numbers = tuple(float(word) for word in _NUMBERS.findall(text))
            pairs = zip(numbers[::2], numbers[1::2], strict=True)
            values[name] = tuple(pairs) if name == _PAIRS else numbers
        except ValueError:
            raise DetectError(f"{name} is {excerpt(text)}: expected {expected}") from None
    return values


def _values(kind: type, settings: Iterable[tuple[str, str]]) -> dict[str, Any]:
    """The settings that a detector has, converted to their types."""
    known = {field.name for field in fields(kind)}
    return {name: parameter_value(kind, name, text) for name, text in settings if name in known}
