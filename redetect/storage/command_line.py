"""The command line of a program: its commands, and how they end.

Each command is carried out by a module of its own; only what `--help` needs is imported at once. A
command ends with its exit code, and one line on the terminal where something was wrong.
"""

from __future__ import annotations

import os
import select
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Union

from redetect.storage.messages import OneLineError, one_line
from redetect.storage.version import __version__

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


@dataclass(frozen=True)
class Program:
    """A program with its commands."""

    name: str
    description: str  # what its `--help` says
    #: Dataclasses of flags, one for each command, which has the class's name in small letters; and
    #: the module whose `perform` carries it out.
    performed_by: Mapping[type, str]

    def main(self, arguments: list[str] | None = None) -> int:
        """Run the command line; returns the exit code."""
        # Matrices are small or sparse here: threads of BLAS would cost more than they save.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        given = sys.argv[1:] if arguments is None else arguments
        return exit_code_of(lambda: self.carry_out(self.parsed(given)))

    def parsed(self, arguments: Sequence[str], defaults: Sequence[object] = ()) -> Any:
        """Parse a command line; exits after `--help`, `--version` and on errors.

        `defaults` are commands whose values the flags of these commands start from.
        """
        import tyro
        from tyro.conf import arg, subcommand

        if list(arguments) == ["--version"]:
            print(f"{self.name} {__version__}")
            raise SystemExit(0)
        known: dict[type, Any] = {type(c): {"default": c} for c in defaults}
        commands: Any = tuple(
            Annotated[kind, subcommand(kind.__name__.lower(), **known.get(kind, {}))]
            for kind in self.performed_by
        )
        choice: Any = Union.__getitem__(commands)
        return tyro.cli(
            Annotated[choice, arg(name="")],
            prog=self.name,
            description=self.description,
            args=arguments,
        )

    def carry_out(self, command: Any) -> int:
        """Carry out a command; returns the exit code."""
        code: int = import_module(self.performed_by[type(command)]).perform(command)
        return code
