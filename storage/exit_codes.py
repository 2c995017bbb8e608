"""How a command ends: its exit code, and one line on the terminal where something was wrong."""

from __future__ import annotations

import os
import select
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from storage.messages import one_line

#: The command could not be carried out.
EXIT_ERROR = 1
#: It was interrupted from the keyboard.
EXIT_INTERRUPTED = 130
#: Nobody reads on what it prints (``| head``): what the system's own tools end with then.
EXIT_UNREAD = 141


def exit_code_of(work: Callable[[], int]) -> int:
    """Do what a command is for; say what is wrong on one line.

    Typed errors of all rooms are ValueErrors, and those of the system OSErrors: anything else is a
    fault of the program and shows its traceback.

    Parameters
    ----------
    work : callable
        Carries the command out; returns the exit code.

    Returns
    -------
    int
        The exit code of `work`, `EXIT_ERROR`, `EXIT_INTERRUPTED` or `EXIT_UNREAD`.
    """
    try:
        try:
            return work()
        finally:
            # What is still to be printed is part of the work: nobody may be reading it.
            sys.stdout.flush()
    except KeyboardInterrupt:
        return say_interrupted()
    except (ValueError, OSError) as error:
        return say_error(error)


def say_error(error: BaseException | str) -> int:
    """Say what was wrong; returns the exit code.

    That nobody reads on what is printed is nothing to speak of.
    """
    if isinstance(error, BrokenPipeError) and _is_unread():
        return EXIT_UNREAD
    print(f"error: {one_line(_said(error))}", file=sys.stderr)
    return EXIT_ERROR


def say_interrupted() -> int:
    """Say that there was an interrupt; returns the exit code."""
    print("interrupted", file=sys.stderr, flush=True)
    return EXIT_INTERRUPTED


def _is_unread() -> bool:
    """Whether standard output is a pipe that nobody reads; if so, it is led nowhere."""
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


def _said(error: BaseException | str) -> str:
    """The error in words; and what to do where a folder is not there, or kernels find no room."""
    if isinstance(error, FileNotFoundError) and isinstance(error.filename, str | os.PathLike):
        folder = Path(error.filename).parent
        if not folder.is_dir():
            return f"{error.filename}: no such folder: {folder}: make it first, or name another"
    if isinstance(error, OSError) and _while_kernels_were_kept(error):
        return (
            f"compiled kernels cannot be kept: {error}: make room for them, or name another folder "
            "by the environment variable NUMBA_CACHE_DIR"
        )
    return str(error)


def _while_kernels_were_kept(error: OSError) -> bool:
    """Whether Numba raised it while it wrote its cache: it names no file."""
    frames = traceback.walk_tb(error.__traceback__)
    return any(frame.f_globals.get("__name__") == "numba.core.caching" for frame, _ in frames)
