"""The command line of a program: its commands, their errors and exit codes.

Commands are executed by other modules; only what `--help` needs is imported at once. A
command ends with its exit code and, in case of an error, one line on the terminal.
"""

from __future__ import annotations

import os
import re
import select
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from copy import copy
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import reduce
from inspect import cleandoc
from io import StringIO
from itertools import takewhile
from operator import or_
from pathlib import Path
from pkgutil import resolve_name
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NoReturn, cast, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, Positional, Suppress, arg, subcommand

from redetect import __version__
from redetect.bounds import expectation
from redetect.interrupts import interrupts_noted, say_interrupted
from redetect.messages import QUIET, OneLineError, excerpt, no_such, one_line

#: The command failed.
EXIT_ERROR = 1
#: The command line was wrong.
EXIT_WRONG_COMMAND_LINE = 2
#: The reader of the output has closed it (``| head``); the code of system tools in this case.
EXIT_UNREAD = 141

#: Flags of every command, which this module handles.
_QUIET = ("-q", "--quiet")
_HELP_ALL = "--help-all"
#: Part of the help of every program.
FOR_ALL = "Every command takes -q (only warnings and errors), --help, and --help-all (all flags)."
_NUMBAS_CACHING = os.path.join("numba", "core", "caching.py")  # noqa: PTH118 - part of a path
_ADVICE = (
    "free some disk space, delete those of another version of this program (*.nbi in __pycache__), "
    "or set the environment variable NUMBA_CACHE_DIR to another folder"
)

#: As the name of a JSON file: standard output, with no other output there.
_STANDARD_OUTPUT = Path("-")


def exit_code_of(work: Callable[[], int]) -> int:
    """Run a command, report its errors on one line, and return its exit code or one of those above.

    All packages raise `OneLineError`, the system raises OSError, libraries raise ValueError.
    Anything else is a bug and shows its traceback.
    """
    try:
        try:
            with interrupts_noted():
                return work()
        finally:
            if sys.stdout is not None:  # closed by the caller
                # Flushing can fail, too, if the output is a closed pipe.
                sys.stdout.flush()
    except KeyboardInterrupt:
        return say_interrupted()
    except Exception as error:
        unread = isinstance(error, BrokenPipeError) and _is_unread()
        _discard_what_cannot_be_written()
        if unread:
            return EXIT_UNREAD
        if not isinstance(error, OneLineError | ValueError | OSError) and not _is_of_cache(error):
            raise
        print(f"error: {one_line(_message(error))}", file=sys.stderr)
        return EXIT_ERROR


def _is_unread() -> bool:
    """Whether standard output is a pipe without a reader."""
    try:
        descriptor = sys.stdout.fileno()
    except (AttributeError, OSError):
        return False
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _discard_what_cannot_be_written() -> None:
    """Redirect standard output to the null device if it fails: Python flushes again at its end."""
    try:
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _message(error: Exception) -> str:
    """The error's message, with advice if a folder is missing or kernels cannot be cached."""
    if isinstance(error, OSError) and isinstance(error.filename, str | os.PathLike):
        path = Path(error.filename)
        if isinstance(error, FileExistsError | FileNotFoundError | NotADirectoryError):
            for place in (path, *path.parents):
                if place.exists() and not place.is_dir():
                    return f"{place}: is not a folder: expected one, or the name of a new one"
        if isinstance(error, IsADirectoryError):
            return f"{path}: is a folder: expected the name of a file"
        if isinstance(error, FileNotFoundError) and not path.parent.is_dir():
            return f"{path}: no such folder: {path.parent}: make it first, or name another"
    if _is_of_cache(error):
        lost = "kept" if isinstance(error, OSError) else "loaded"
        return f"compiled kernels cannot be {lost}: {error}: {_ADVICE}"
    return str(error)


def _is_of_cache(error: Exception) -> bool:
    """Whether Numba's cache of compiled kernels caused an error, here or in a worker.

    It has no folder, its disk is full, or its index names classes of another version of the
    program; Numba's own message does not help.
    """
    return _NUMBAS_CACHING in "".join(traceback.format_exception(error))


@dataclass(frozen=True)
class Program:
    """A program with its commands."""

    name: str
    description: str  # for its `--help`
    #: Dataclasses of flags, one for each command, whose name is that of the class in lower case,
    #: and the function that executes it, as `module:function`.
    performed_by: Mapping[type, str]
    expert: Mapping[type, frozenset[str]] = field(default_factory=dict)

    @property
    def commands(self) -> dict[str, type]:
        """The dataclasses of the commands by name."""
        return {kind.__name__.lower(): kind for kind in self.performed_by}

    def main(self, arguments: list[str] | None = None) -> int:
        """Run the command line, quietly if requested; returns the exit code."""
        return exit_code_of(lambda: self._run(sys.argv[1:] if arguments is None else arguments))

    def _run(self, arguments: Sequence[str]) -> int:
        # Matrices are small or sparse here: BLAS threads would cost more time than they save.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        words = [word for word in arguments if word not in _QUIET]
        command = self.parsed(words)
        if getattr(command, "json", None) == _STANDARD_OUTPUT:
            # Only the content of the JSON file is written to standard output.
            with TemporaryDirectory() as folder:
                path = Path(folder) / "result.json"
                with _quietly():
                    code = self.carry_out(replace(command, json=path))
                if path.exists():
                    sys.stdout.write(path.read_text("utf-8"))
            return code
        with nullcontext() if len(words) == len(arguments) else _quietly():
            return self.carry_out(command)

    def parsed(self, arguments: Sequence[str], defaults: Sequence[object] = ()) -> Any:
        """Parse a command line; exits after `--help`, `--version` and on errors.

        `defaults` are commands whose values become the defaults of their flags.
        """
        words = list(arguments)
        if words == ["--version"]:
            print(f"{self.name} {__version__}")
            raise SystemExit(0)
        asked = {_HELP_ALL, "-h", "--help"} & {*words}
        words = ["--help" if word == _HELP_ALL else word for word in words]
        first = words[0] if words else ""
        if first in ("-h", "--help") or first.startswith("--tyro-"):
            kinds: Any = (Annotated[k, subcommand(name)] for name, k in self.commands.items())
            choice: Any = Annotated[reduce(or_, kinds), arg(name="")]
            text = f"{self.description}\n\n{FOR_ALL}"
            return tyro.cli(choice, prog=self.name, description=text, args=words)
        if first not in self.commands:
            end_with(no_such(f"{self.name}: no command", first, self.commands))
        kind = self.commands[first]
        shown = self._brief(kind) if asked and _HELP_ALL not in asked else kind
        known = {type(each): {"default": _with_values_of(each, shown)} for each in defaults}
        return _parsed_as(shown, known.get(kind, {}), f"{self.name} {first}", words[1:])

    def carry_out(self, command: Any) -> int:
        """Execute a command; returns the exit code."""
        code: int = resolve_name(self.performed_by[type(command)])(command)
        return code

    def _brief(self, kind: type) -> type:
        """The dataclass of a command without its expert flags, for its help."""
        short: type = _without(kind, self.expert)
        if short is not kind:
            text, section, parameters = cleandoc(kind.__doc__ or "").partition("\n\nParameters\n")
            short.__doc__ = f"{text}\n\nMore flags are shown by {_HELP_ALL}.{section}{parameters}"
        return short


def _with_values_of(values: Any, kind: Any) -> Any:
    """The values of a dataclass's instance in one of its subclasses without expert flags."""
    if not issubclass(kind, type(values)) or kind is type(values):
        return values
    hints = get_type_hints(kind)
    own = {each.name: getattr(values, each.name) for each in fields(kind)}
    nested = {name: hints[name] for name, value in own.items() if is_dataclass(value)}
    return kind(**own | {name: _with_values_of(own[name], inner) for name, inner in nested.items()})


def all_but(kind: type, *names: str) -> frozenset[str]:
    """The names of a dataclass's fields except these."""
    return frozenset(each.name for each in fields(kind)) - {*names}


def end_with(words: str) -> NoReturn:
    """Exit because of a wrong command line, with a message."""
    print(f"error: {words}", file=sys.stderr)
    raise SystemExit(EXIT_WRONG_COMMAND_LINE)


def _parsed_as(kind: type, default: Any, name: str, words: list[str]) -> Any:
    """Parse the flags of a command; an error is one line that states what was expected."""
    flags, boxes = dict(_flags(kind)), StringIO()
    try:
        with redirect_stderr(boxes):
            command, unknown = tyro.cli(
                kind, prog=name, args=words, return_unknown_args=True, **default
            )
    except (SystemExit, OneLineError) as end:
        if isinstance(end, SystemExit) and not end.code:
            raise
        cause: BaseException | None = end
        while cause is not None and not isinstance(cause, OneLineError):
            cause = cause.__context__
        if cause is None:
            end_with(f"{name}: {_misunderstood(kind, words, boxes.getvalue())}")
        setting = str(cause).partition(" is ")[0]
        named = {name: flag for flag, (name, _) in flags.items()}.get(setting, setting)
        end_with(str(cause).replace(setting, named, 1))
    for word in unknown:
        if word.startswith("-"):
            known = [flag for flag in flags if flag.startswith("-")]
            end_with(no_such(f"{name}: no flag", word.partition("=")[0], known))
        end_with(f"{name}: {excerpt(word)}: one word too many: {name} --help lists the flags")
    return command


def _flags(kind: Any, prefix: str = "--") -> Iterator[tuple[str, tuple[str, Any]]]:
    """The flags of a dataclass, positional ones as NAME; field name and type of each."""
    hints = get_type_hints(kind, include_extras=True)
    for name in [each.name for each in fields(kind)]:
        marks = getattr(hints[name], "__metadata__", ())
        inner = hints[name].__origin__ if marks else hints[name]
        if is_dataclass(inner):
            yield from _flags(inner, prefix if OmitArgPrefixes in marks else f"{prefix}{name}.")
        else:
            own = next((mark.name for mark in marks if getattr(mark, "name", None)), name)
            flag = name.upper() if Positional in marks else f"{prefix}{own}".replace("_", "-")
            yield flag, (name, hints[name])


def _misunderstood(kind: type, words: Sequence[str], said: str) -> str:
    """What is wrong with words that tyro rejects; it says more than fits on a line."""
    flags = dict(_flags(kind))
    given = [word.partition("=")[0] for word in words]
    for flag in re.findall(r"--[a-z][\w.-]*", said):
        if flag in flags and "Required options" not in said:
            expected = expectation(flags[flag][1])
            own = max((k for k, word in enumerate(given) if word == flag), default=len(words))
            after = takewhile(lambda word: not word.startswith("--"), words[own + 1 :])
            values = [word.partition("=")[2] for word in words[own : own + 1]] + [*after]
            shown = [flag, *filter(None, values)][: None if "numbers" in expected else 2]
            return f"{' '.join(shown)}: expected {expected}"
    bare = {each.name for each in fields(kind) if each.default is each.default_factory}
    lacking = [flag for flag, (name, _) in flags.items() if name in bare and flag not in given]
    return f"expected {' '.join([each for each in lacking if each[0] == '-'] or lacking)}"


@contextmanager
def _quietly() -> Iterator[None]:
    """Suppress standard output, progress and notices."""
    before = os.environ.get(QUIET)
    os.environ[QUIET] = "1"  # workers inherit it
    try:
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):  # noqa: PTH123
            yield
    finally:
        os.environ.pop(QUIET) if before is None else os.environ.update({QUIET: before})


def _without(kind: Any, expert: Mapping[type, frozenset[str]]) -> Any:
    """A dataclass whose expert fields are not flags; itself if it has none."""
    hidden = frozenset[str]().union(*(expert.get(base, ()) for base in kind.__mro__))
    hints = get_type_hints(kind, include_extras=True)
    changed: list[tuple[str, Any, Any]] = []
    for each in fields(kind):
        hint, own = hints[each.name], cast(Any, copy(each))
        marks = getattr(hint, "__metadata__", ())
        inner = hint.__origin__ if marks else hint
        if each.name in hidden:
            hint = Annotated[hint, Suppress]
        elif is_dataclass(inner) and (brief := _without(inner, expert)) is not inner:
            own.default_factory = hint = brief
            for mark in marks:
                hint = Annotated[hint, mark]
        else:
            continue
        changed.append((each.name, hint, own))
    if not changed:
        return kind
    short = make_dataclass(kind.__name__, changed, bases=(kind,), frozen=True)
    # The help is in comments: tyro finds them by module and name, since Python 3.13 by line.
    for name in ("__doc__", "__module__", "__firstlineno__"):
        if name in vars(kind):
            setattr(short, name, vars(kind)[name])
    return short
