"""The command ``camera``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out; 2 the command line was wrong;
130 it was interrupted, and wrote nothing.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import tyro
from tyro.conf import arg, subcommand

from camera.options import Calibrate, Command, Convert, Floor
from storage.exit_codes import exit_code_of

#: The module whose `perform` carries a command out.
PERFORMED_BY: dict[type, str] = {
    Calibrate: "camera.calibrate_command",
    Floor: "camera.calibrate_floor_command",
    Convert: "camera.convert_command",
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    # Matrices are small here: threads of BLAS would cost more than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return exit_code_of(lambda: _perform(sys.argv[1:] if arguments is None else arguments))


def _perform(arguments: Sequence[str]) -> int:
    command = parsed(arguments)
    code: int = import_module(PERFORMED_BY[type(command)]).perform(command)
    return code


def parsed(arguments: Sequence[str]) -> Command:
    """What a command line says; exits, as `--help` does, where it says nothing that can be done."""
    command: Command = tyro.cli(
        Annotated[
            Annotated[Calibrate, subcommand("calibrate")]
            | Annotated[Floor, subcommand("floor")]
            | Annotated[Convert, subcommand("convert")],
            arg(name=""),
        ],
        prog="camera",
        description="Calibrate a camera, place it on the floor, convert its calibration.\n\n"
        "Example: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025 -o my.cam",
        args=arguments,
    )
    return command


if __name__ == "__main__":
    sys.exit(main())
