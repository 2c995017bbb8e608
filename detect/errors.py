"""Exceptions of the package `detect`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from redetect.storage.messages import OneLineError

#: Exit code of a command of which some frames could not be worked on; the others were.
EXIT_FRAMES_FAILED = 3


class DetectError(OneLineError, ValueError):
    """A run or setting that cannot be worked on.

    The message names the file or the setting, its value and what was expected.
    """


class FrameError(OneLineError, ValueError):
    """One image that cannot be worked on; it costs its frame only."""


class WorkerError(OneLineError, RuntimeError):
    """Worker processes or machines cannot do the work; the message says what is missing."""


@contextmanager
def imported_for(
    use: str, extra: str, otherwise: str = "", error: type[Exception] = DetectError
) -> Iterator[None]:
    """Import a package of an extra in a block; where it is missing, an error says how to get it."""
    try:
        yield
    except ImportError:
        raise error(f"{use}: install it by pip install 'redetect[{extra}]'{otherwise}") from None


class CompareError(ValueError):
    """Two runs that cannot be compared; the message says which file or frame and why."""
