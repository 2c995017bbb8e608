"""Exceptions of the package `detect`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from redetect.messages import OneLineError

#: Exit code if some frames could not be processed; the others were.
EXIT_FRAMES_FAILED = 3


class DetectError(OneLineError, ValueError):
    """A run or setting that cannot be processed.

    The message names the file or the setting, its value and what was expected.
    """


class FrameError(OneLineError, ValueError):
    """An image that cannot be processed; it affects its own frame only."""


class WorkerError(OneLineError, RuntimeError):
    """Worker processes or machines are missing or failed; the message states what is missing."""


@contextmanager
def imported_for(
    use: str, extra: str, otherwise: str = "", error: type[Exception] = DetectError
) -> Iterator[None]:
    """Import a package of an extra in a block; if missing, the error states how to install it."""
    try:
        yield
    except ImportError:
        raise error(f"{use}: install it by pip install 'redetect[{extra}]'{otherwise}") from None


class CompareError(OneLineError, ValueError):
    """Two runs that cannot be compared; the message names the file or frame and the reason."""
