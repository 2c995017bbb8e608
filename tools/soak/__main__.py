"""Long runs, and many short ones: ``python -m tools.soak``."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from redetect.storage import OutputExistsError, write_whole
from redetect.storage.command_line import exit_code_of
from tools.soak.long_run import link_run, soak
from tools.soak.short_runs import repeat_short_runs


@dataclass(frozen=True)
class Soak:
    """A long run of `detect all`, or with --short many short ones; demands that nothing grows.

    The exit code is 1 where a demand is not met.
    """

    frames: int = 200_000  # How long the run is: the images of the source, linked over and over.
    jobs: int = 2  # Processes that share the work.
    short: int = 0
    """So many runs of eight frames instead, one after the other, with and without workers."""
    warm: bool = False
    """Fork the short runs from a process that has everything loaded, instead of starting an
    interpreter for each: a tenth of a second for each, and no workers."""
    source: Path = Path("images/e")  # A run folder whose images are repeated.
    scratch: Path | None = None
    """Where the run and its results are made, and removed again; on the source's file system."""
    json: Path | None = None  # Write the figures as JSON.
    force: bool = False  # Replace an existing JSON file.


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    command = tyro.cli(Soak, prog="python -m tools.soak", args=arguments)
    return exit_code_of(lambda: _carry_out(command))


def _carry_out(command: Soak) -> int:
    if command.json is not None and command.json.exists() and not command.force:
        raise OutputExistsError(command.json)
    with tempfile.TemporaryDirectory(dir=command.scratch, prefix="soak-") as name:
        folder = Path(name)
        if command.short:
            short = repeat_short_runs(
                command.source, folder, command.short, command.jobs, warm=command.warm
            )
            figures, unmet = asdict(short), short.unmet()
            print(short)
        else:
            run = link_run(command.source, folder / "soak", command.frames)
            result = soak(run, folder / "results", command.frames, command.jobs)
            figures, unmet = asdict(result), result.unmet()
            print(result)
    if command.json is not None:
        with write_whole(command.json, overwrite=command.force) as stream:
            stream.write(f"{json.dumps(figures, indent=1)}\n".encode())
    for sentence in unmet:
        print(sentence, file=sys.stderr)
    return 1 if unmet else 0


if __name__ == "__main__":
    sys.exit(main())
