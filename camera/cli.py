"""The command ``camera``.

Only what `--help` needs is imported at once; everything heavy waits for the command that uses it.

Exit codes: 0 all went well; 1 the command could not be carried out; 2 the command line was wrong;
130 it was interrupted, and wrote nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated

import tyro
from tyro.conf import arg, subcommand

from camera.options import Calibrate, Command, Convert, Floor

EXIT_ERROR = 1
EXIT_INTERRUPTED = 130

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
    command: Command = tyro.cli(
        Annotated[
            Annotated[Calibrate, subcommand("calibrate")]
            | Annotated[Floor, subcommand("floor")]
            | Annotated[Convert, subcommand("convert")],
            arg(name=""),
        ],
        prog="camera",
        description="Calibrate a camera, place it on the floor, convert its calibration.",
        args=sys.argv[1:] if arguments is None else arguments,
    )
    try:
        return int(import_module(PERFORMED_BY[type(command)]).perform(command))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_ERROR


if __name__ == "__main__":
    sys.exit(main())
