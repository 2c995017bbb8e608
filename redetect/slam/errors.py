"""Exceptions of the package `slam`."""

from __future__ import annotations

from redetect.messages import OneLineError


class SlamError(OneLineError, ValueError):
    """A run, map or setting that cannot be used.

    The message names the file, step, landmark or setting, its value and what was expected.
    """


class UnregisteredError(SlamError):
    """Frames of a run, from number `frame` on, have no certain place among the others."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message)
        self.frame = frame
