"""The command ``slam``.

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

from slam.options import Associate, Command, Ekf, Export, Import, Localize, Map, Noise
from storage.exit_codes import exit_code_of
from storage.kernel_loading import load_kernels_alone

#: The module whose `perform` carries a command out.
PERFORMED_BY: dict[type, str] = {
    Map: "slam.map_command",
    Localize: "slam.localize_command",
    Ekf: "slam.ekf_command",
    Associate: "slam.associate_command",
    Noise: "slam.noise_command",
    Export: "slam.export_command",
    Import: "slam.export_command",
}
#: Those that run compiled kernels.
COMPILED: tuple[type, ...] = (Map, Localize, Ekf, Associate)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    # Matrices are small or sparse here: threads of BLAS would cost more than they save.
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
            Annotated[Map, subcommand("map")]
            | Annotated[Localize, subcommand("localize")]
            | Annotated[Ekf, subcommand("ekf")]
            | Annotated[Associate, subcommand("associate")]
            | Annotated[Noise, subcommand("noise")]
            | Annotated[Export, subcommand("export")]
            | Annotated[Import, subcommand("import")],
            arg(name=""),
        ],
        prog="slam",
        description="What landmarks are for: map, localisation, SLAM, association, noise.\n\n"
        "Example: slam map images/e --circles --lines -o /tmp/e-map",
        args=arguments,
    )
    return command


if __name__ == "__main__":
    sys.exit(main())
