"""The command line of a program: its commands, each carried out by a module of its own.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, Union

from redetect.storage.exit_codes import exit_code_of
from redetect.storage.version import __version__


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
