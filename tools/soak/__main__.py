"""Long runs, and many short ones: ``python -m tools.soak``."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from detect.sources.opening import open_run
from redetect.storage.command_line import exit_code_of
from tools.benchmark.material import repeated_run
from tools.soak.long_run import SoakResult, soak
from tools.soak.short_runs import ShortRuns, repeat_short_runs


@dataclass(frozen=True)
class Soak:
    """A long run of `detect all`, or with --short many short ones; demands that nothing grows.

    The exit code is 1 where a demand is not met.
    """

    frames: int = 200_000  # How long the run is: the images of the source, linked over and over.
    jobs: int = 2  # Processes that share the work.
    short: int = 0
    """So many runs of eight frames instead, one after the other, with and without workers."""
    source: Path = Path("images/e")  # A run folder whose images are repeated.
    scratch: Path | None = None
    """Where the run and its results are made, and removed again; on the source's file system."""

    def __call__(self) -> int:
        result: ShortRuns | SoakResult
        with tempfile.TemporaryDirectory(dir=self.scratch, prefix="soak-") as name:
            folder = Path(name)
            if self.short:
                result = repeat_short_runs(self.source, folder, self.short, self.jobs)
            else:
                run = repeated_run(open_run(self.source), folder / "soak", self.frames, 0)
                result = soak(run, folder / "results", self.frames, self.jobs)
        print(result)
        for sentence in result.unmet():
            print(sentence, file=sys.stderr)
        return 1 if result.unmet() else 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    command = tyro.cli(Soak, prog="python -m tools.soak", args=arguments)
    return exit_code_of(command)


if __name__ == "__main__":
    sys.exit(main())
