"""Exceptions of the package `detect`."""

from __future__ import annotations

from redetect.messages import OneLineError

EXIT_FRAMES_FAILED = 3  #: Exit code if some frames could not be processed; the others were.


class DetectError(OneLineError, ValueError):
    """An invalid run or setting; the message names file or setting, value and what was expected."""


class FrameError(OneLineError, ValueError):
    """An image that cannot be processed; it affects its own frame only."""


class WorkerError(OneLineError, RuntimeError):
    """Worker processes or machines are missing or failed; the message states what is missing."""


class CompareError(OneLineError, ValueError):
    """Two runs that cannot be compared; the message names the file or frame and the reason."""
