"""How a command ends: its exit code, and one line on the terminal where something was wrong."""

from __future__ import annotations

import os
import select
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from redetect.storage.messages import OneLineError, one_line

#: The command could not be carried out.
EXIT_ERROR = 1
#: It was interrupted from the keyboard.
EXIT_INTERRUPTED = 130
#: The reader of its output has gone (``| head``); the code that system tools exit with then.
EXIT_UNREAD = 141

_NUMBAS_CACHING = os.path.join("numba", "core", "caching.py")  # noqa: PTH118 - part of a path
_ADVICE = (
    "free some disk space, delete those of another version of this program (*.nbi in __pycache__), "
    "or set the environment variable NUMBA_CACHE_DIR to another folder"
)


def exit_code_of(work: Callable[[], int]) -> int:
    """Run a command and report its errors on one line; returns its exit code, or one of those
    above.

    All packages raise `OneLineError`, the system raises OSErrors, libraries ValueErrors. Anything
    else is a bug and shows its traceback.
    """
    try:
        try:
            return work()
        finally:
            # Flushing can fail, too, if the output is a closed pipe.
            sys.stdout.flush()
    except KeyboardInterrupt:
        return say_interrupted()
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _is_unread():
            return EXIT_UNREAD
        if not isinstance(error, OneLineError | ValueError | OSError) and not _is_of_cache(error):
            raise
        print(f"error: {one_line(_message(error))}", file=sys.stderr)
        return EXIT_ERROR


def say_interrupted() -> int:
    """Say that there was an interrupt; returns the exit code."""
    print("interrupted", file=sys.stderr, flush=True)
    return EXIT_INTERRUPTED


def _is_unread() -> bool:
    """Whether standard output is a pipe without a reader; if so, redirect it to the null device."""
    try:
        descriptor = sys.stdout.fileno()
    except (AttributeError, OSError):
        return False
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    # Python itself flushes once more when it ends.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
    return True


def _message(error: Exception) -> str:
    """The error's message, with advice if a folder is missing or kernels cannot be cached."""
    if isinstance(error, FileNotFoundError) and isinstance(error.filename, str | os.PathLike):
        folder = Path(error.filename).parent
        if not folder.is_dir():
            return f"{error.filename}: no such folder: {folder}: make it first, or name another"
    if _is_of_cache(error):
        lost = "kept" if isinstance(error, OSError) else "loaded"
        return f"compiled kernels cannot be {lost}: {error}: {_ADVICE}"
    return str(error)


def _is_of_cache(error: Exception) -> bool:
    """Whether Numba raised it over its cache of compiled kernels, here or in a worker.

    There is no folder for it, no space left in it, or its index names classes of another version of
    the program: Numba's own words are no help.
    """
    return _NUMBAS_CACHING in "".join(traceback.format_exception(error))
