"""Soak test: ``python -m tools.soak``."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from detect.sources.opening import open_run
from tools.benchmark.material import repeated_run
from tools.evaluation.figures import WRONG, Figures, Study, print_figures, study_main
from tools.soak.long_run import SoakResult, soak
from tools.soak.short_runs import ShortRuns, repeat_short_runs


@dataclass(frozen=True)
class Soak(Study):
    """A long run of `detect all`, or with --short many short ones, checked for growth.

    The exit code is 1 if a check fails.
    """

    frames: int = 200_000  # Length of the run: the images of the source, linked repeatedly.
    jobs: int = 2  # Number of worker processes.
    short: int = 0
    """Number of runs of eight frames instead, one after the other, with and without workers."""
    source: Path = Path("images/e")  # A run folder whose images are repeated.
    scratch: Path | None = None
    """Folder for the run and its results, which are removed; on the source's file system."""

    def measure(self) -> Figures:
        result: ShortRuns | SoakResult
        with tempfile.TemporaryDirectory(dir=self.scratch, prefix="soak-") as name:
            folder = Path(name)
            if self.short:
                result = repeat_short_runs(self.source, folder, self.short, self.jobs)
            else:
                run = repeated_run(open_run(self.source), folder / "soak", self.frames, 0)
                result = soak(run, folder / "results", self.frames, self.jobs)
        figures = asdict(result)
        print_figures(figures)
        for sentence in result.unmet():
            print(sentence, file=sys.stderr)
        return {**figures, WRONG: len(result.unmet())}


#: Runs the command line, that of the process or what it is given; returns the exit code.
main = partial(study_main, Soak, "python -m tools.soak")


if __name__ == "__main__":
    sys.exit(main())
