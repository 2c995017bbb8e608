"""Exceptions of the package `groundtruth`."""

from __future__ import annotations

import os

from redetect.storage.messages import OneLineError


class GroundTruthError(OneLineError, ValueError):
    """A session, calibration or setting that cannot be used.

    The message names the file, frame or setting, its value and what was expected.
    """


class StreamError(GroundTruthError):
    """A file of poses or times that cannot be read.

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
        place = os.fspath(file) if line is None else f"{os.fspath(file)}:{line}"
        super().__init__(f"{place}: {problem}")


class GeometryError(OneLineError, ValueError):
    """Observations from which no pose follows; it costs its frame only."""
