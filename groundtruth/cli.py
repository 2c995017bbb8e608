"""The command ``groundtruth``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out, or gave no pose; 2 the command
line was wrong; 130 it was interrupted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import tyro
from tyro.conf import arg, subcommand

from groundtruth.commands.options import (
    Command,
    Fuse,
    Laser,
    Lasers,
    Network,
    Poses,
    Report,
    Rig,
    Score,
    Sync,
    Validate,
)
from storage.exit_codes import exit_code_of
from storage.kernel_loading import load_kernels_alone

#: The module whose `perform` carries a command out.
PERFORMED_BY: dict[type, str] = {
    Rig: "groundtruth.commands.rig",
    Network: "groundtruth.commands.network",
    Poses: "groundtruth.commands.poses",
    Score: "groundtruth.commands.score",
    Lasers: "groundtruth.commands.lasers",
    Laser: "groundtruth.commands.laser",
    Sync: "groundtruth.commands.sync",
    Fuse: "groundtruth.commands.fuse",
    Validate: "groundtruth.commands.validate",
    Report: "groundtruth.commands.report",
}
#: Those that run compiled kernels.
COMPILED: tuple[type, ...] = (Lasers, Laser, Sync, Fuse, Validate)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    # Matrices are small here: threads of BLAS would cost more than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return exit_code_of(lambda: _perform(sys.argv[1:] if arguments is None else arguments))


def _perform(arguments: Sequence[str]) -> int:
    command = parsed(arguments)
    if isinstance(command, COMPILED):
        load_kernels_alone()
    code: int = import_module(PERFORMED_BY[type(command)]).perform(command)
    return code


def parsed(arguments: Sequence[str]) -> Command:
    """What a command line says; exits, as `--help` does, where it says nothing that can be done."""
    command: Command = tyro.cli(
        Annotated[
            Annotated[Rig, subcommand("rig")]
            | Annotated[Network, subcommand("network")]
            | Annotated[Poses, subcommand("poses")]
            | Annotated[Score, subcommand("score")]
            | Annotated[Lasers, subcommand("lasers")]
            | Annotated[Laser, subcommand("laser")]
            | Annotated[Sync, subcommand("sync")]
            | Annotated[Fuse, subcommand("fuse")]
            | Annotated[Validate, subcommand("validate")]
            | Annotated[Report, subcommand("report")],
            arg(name=""),
        ],
        prog="groundtruth",
        description="Where the robot really was: markers, lasers, clocks, and their fusion.\n\n"
        "Example: groundtruth poses images/m -o poses.csv",
        args=arguments,
    )
    return command
