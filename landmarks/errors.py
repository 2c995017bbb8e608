"""Exceptions of the package `landmarks`."""

from __future__ import annotations

import os

from storage.messages import OneLineError

_LONGEST_EXCERPT = 40


class LandmarkError(OneLineError, ValueError):
    """An invalid record; the message names the quantity, its value and what was expected."""


class LandmarkFileError(LandmarkError):
    """A landmark file that cannot be read.

    Parameters
    ----------
    file : path
        The file.
    line : int or None
        The wrong line, counted from 1; None where the file as a whole is.
    problem : str
        What was found and what was expected.
    """

    def __init__(self, file: str | os.PathLike[str], line: int | None, problem: str) -> None:
        self.file = os.fspath(file)
        self.line = line
        self.problem = problem
        place = self.file if line is None else f"{self.file}:{line}"
        super().__init__(f"{place}: {problem}")


def excerpt(text: bytes) -> str:
    """Show text of unknown origin on one line: ASCII, escaped, at most 40 characters and quotes."""
    # Escapes make a text longer, never shorter: text past the limit is never shown.
    shown = text[: _LONGEST_EXCERPT + 1].decode("latin-1").encode("unicode_escape").decode("ascii")
    if len(shown) > _LONGEST_EXCERPT:
        shown = shown[: _LONGEST_EXCERPT - 3] + "..."
    return f"'{shown}'"
