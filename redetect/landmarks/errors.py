"""Exceptions of the package `landmarks`."""

from __future__ import annotations

import os

from redetect.storage.messages import OneLineError


class LandmarkError(OneLineError, ValueError):
    """An invalid record; the message names the quantity, its value and what was expected."""


class LandmarkFileError(LandmarkError):
    """A landmark file that cannot be read.

    Parameters
    ----------
    file : path
    line : int or None
        The wrong line, counted from 1; None if the error concerns the whole file.
    problem : str
        What was found and what was expected.
    """

    def __init__(self, file: str | os.PathLike[str], line: int | None, problem: str) -> None:
        self.file = os.fspath(file)
        self.line = line
        self.problem = problem
        place = self.file if line is None else f"{self.file}:{line}"
        super().__init__(f"{place}: {problem}")
