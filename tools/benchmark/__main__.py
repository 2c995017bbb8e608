"""Measure times of the detectors, their parts and peers: ``python -m tools.benchmark``."""

from __future__ import annotations

import os
import platform
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import cv2
import numba
import numpy as np

from detect.cli import PROGRAM
from detect.sources.interface import Run
from detect.sources.opening import open_run
from redetect import __version__
from redetect.array_types import ByteArray
from tools.benchmark import functions as f
from tools.benchmark.material import (
    Picture,
    contents_of,
    decode,
    disc_places,
    floor_with_discs,
    jpeg_picture,
    noise_pictures,
    photograph_pictures,
    repeated_run,
    run_pictures,
    scaled_camera,
    scaled_picture,
    wall_with_edges,
)
from tools.benchmark.timing import decodings, measure_in_turn, number, quartiles, spread
from tools.evaluation.figures import Figures, Study, run_quietly, study_main
from tools.evaluation.tables import Table

#: Number of pictures at each point of the growth curves.
_GROWTH_PICTURES = 2
#: A command that has taken this long is omitted in later rounds, seconds.
_RUN_BUDGET_S = 15.0
_PACKAGES = ("numpy", "numba", "opencv-python-headless", "scikit-image")

#: Rows of a table: the kind of pictures, the pictures, and the functions measured on them.
Cases = Iterable[tuple[str, Sequence[Picture], dict[str, f.Function]]]


@dataclass(frozen=True)
class Benchmark(Study):
    """Measure the times of the detectors, their parts and peers, alternating in one process.

    Prints Markdown tables: ratios to decoding first, since they hardly depend on the machine.
    Example: python -m tools.benchmark --photographs ../shared/data/discs
    """

    run: Path = Path("images/e")  # The demo run: camera, pictures, and whole passes.
    photographs: Path | None = None  # Folder with photographs; omitted without it.
    pictures: int = 8  # Pictures of each kind.
    rounds: int = 10  # Number of times that each function processes each picture.
    run_frames: int = 1600  # Frames of a whole run: those of the demo run, repeated.
    run_rounds: int = 5  # Passes over a whole run; slow commands get fewer.
    budget_s: float = 3.0  # A function that took this long is omitted in later rounds, seconds.
    factors: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # Sides of growing images.
    landmarks: tuple[int, ...] = (0, 5, 10, 20, 30, 50)  # Discs, and edges, drawn into an image.
    frames: tuple[int, ...] = (80, 320, 1600, 6400)  # Lengths of the growing runs.
    jobs: tuple[int, ...] = (1, 2)  # Numbers of jobs, for the growing runs.
    seed: int = 0  # Of noise and positions.

    def measure(self) -> Figures:
        # All are measured on one core; only the jobs of whole runs may use more.
        cv2.setNumThreads(1)
        numba.set_num_threads(1)
        run = open_run(self.run)
        detectors = f.whole_detectors(run.camera)
        given = {name: value for name, value in vars(self).items() if value is not None}
        settings = (
            f"{name} {' '.join(map(str, value)) if isinstance(value, tuple) else value}"
            for name, value in given.items()
        )
        print(f"- {this_machine()}\n- settings: {', '.join(settings)}\n")
        seeds = range(self.seed, self.seed + _GROWTH_PICTURES)
        places = disc_places(run.camera, max(self.landmarks, default=0), self.seed)
        print("Median processor time per image, relative to decoding the same image "
              "(quartiles; milliseconds):\n")  # fmt: skip
        kinds = self._times(self._kinds(run))
        print("\nBy size of the image, Mpixel:\n")
        sizes = self._times(self._sizes(run))
        print("\nBy number of discs in the image:\n")
        discs = self._times(
            (str(n), [jpeg_picture(floor_with_discs(run.camera, places[:n], s)) for s in seeds],
             detectors)
            for n in self.landmarks
        )  # fmt: skip
        print("\nBy number of vertical edges in the image:\n")
        edges = self._times(
            (str(n), [jpeg_picture(wall_with_edges(run.camera, n, s)) for s in seeds], detectors)
            for n in self.landmarks
        )
        print("\nWhole runs, from files to files, by wall clock; for comparison, one core that "
              "only decodes the same files, or reads and decodes them:\n")  # fmt: skip
        table = Table(dict.fromkeys(RunSpeed._fields, "<"))
        runs = []
        for row in self._runs(run):
            table.row(*row.cells())
            runs.append(row._asdict())
        return {"machine": this_machine(), "kinds": kinds, "sizes": sizes,
                "discs": discs, "edges": edges, "runs": runs}  # fmt: skip

    def _kinds(self, run: Run) -> Cases:
        everything = {**f.all_detectors(run.camera), **f.peers()}
        yield "demo", run_pictures(run, self.pictures), everything
        yield "noise", noise_pictures(run.camera, self.pictures, self.seed), everything
        if self.photographs is not None:
            pictures = photograph_pictures(self.photographs, run.camera, self.pictures)
            yield "photographs", pictures, everything

    def _sizes(self, run: Run) -> Cases:
        frames = run_pictures(run, _GROWTH_PICTURES)
        for factor in self.factors:
            camera = scaled_camera(run.camera, factor)
            scaled = [scaled_picture(picture, camera, self.seed) for picture in frames]
            yield f"{camera.width * camera.height / 1e6:.6g}", scaled, f.whole_detectors(camera)

    def _times(self, cases: Cases) -> Figures:
        """Print the times of functions, alternating with decoding, and return them by case."""
        columns = {}
        for case, pictures, functions in cases:
            print(f"{case}: {len(pictures)} pictures", file=sys.stderr, flush=True)
            timed = {f.DECODING: lambda picture: decode(picture.encoded), **functions}
            bound = {name: _on_each(of, pictures) for name, of in timed.items()}
            seconds = measure_in_turn(bound, len(pictures), self.rounds, self.budget_s)
            columns[case] = decodings(seconds, f.DECODING)
        table = Table(dict.fromkeys(["", *columns], "<"))
        for name in next(iter(columns.values()), {}):
            each = [column[name] for column in columns.values()]
            table.row(name, *(f"{spread(times)}; {number(times['ms'])} ms" for times in each))
        return columns

    def _runs(self, run: Run) -> Iterator[RunSpeed]:
        """Whole runs: all commands once, and `detect all` over growing lengths and jobs."""
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for command in f.commands(self.run, folder).values():
                perform(command)  # compiles the kernels
            whole = repeated_run(run, folder / "whole", self.run_frames)
            every = [(command, 1) for command in f.commands(whole, folder)]
            yield from measure_runs(whole, every, folder, self.run_rounds)
            for frames in self.frames:
                growing = repeated_run(run, folder / f"frames{frames}", frames)
                by_jobs = [("detect all", jobs) for jobs in self.jobs]
                yield from measure_runs(growing, by_jobs, folder, self.run_rounds)


class RunSpeed(NamedTuple):
    """The speed of a command on a run: images per second, and times relative to decoding alone.

    Quartiles are those of `tools.benchmark.timing.quartiles`, per job, within the same round.
    """

    command: str
    frames: int
    jobs: int
    per_s: float
    of_decoding: dict[str, float]
    of_reading: dict[str, float]  #: of reading and decoding
    times_one_job: float | None
    decoding_per_s: float
    reading_per_s: float

    def cells(self) -> list[object]:
        """Numbers as texts."""
        return [
            spread(value) if isinstance(value, dict)
            else number(value) if isinstance(value, float) else value
            for value in self
        ]  # fmt: skip


def perform(command: f.Command) -> None:
    """Execute a command like ``detect``, but silently."""
    run_quietly("detect", lambda: PROGRAM.carry_out(command))


def _on_each(function: f.Function, pictures: Sequence[Picture]) -> Callable[[int], object]:
    return lambda number: function(pictures[number])


def measure_runs(
    run: Path, chosen: Sequence[tuple[str, int]], folder: Path, rounds: int
) -> Iterator[RunSpeed]:
    """Speeds of whole runs: commands by name and jobs, alternating with decoding."""
    print(f"whole runs: {run}", file=sys.stderr, flush=True)
    paths = [frame.image for frame in open_run(run).frames if frame.image is not None]
    files = contents_of(paths)

    def decode_all(contents: Iterable[ByteArray]) -> None:
        for content in contents:
            decode(content)

    def timed(name: str, jobs: int, _: int) -> None:
        perform(f.commands(run, folder, jobs)[name])

    functions: dict[str, Callable[[int], object]] = {
        "decoding": lambda _: decode_all(files),
        "reading": lambda _: decode_all(np.fromfile(path, np.uint8) for path in paths),
        **{f"{name} {jobs}": partial(timed, name, jobs) for name, jobs in chosen},
    }
    # By wall clock, since jobs are separate processes.
    seconds = measure_in_turn(
        functions, 1, rounds, _RUN_BUDGET_S, time.perf_counter, warm_up=False, least_calls=1
    )
    alone = [seconds["decoding"], seconds["reading"]]
    for name, jobs in chosen:
        taken, one_job = seconds[f"{name} {jobs}"], seconds.get(f"{name} 1")
        per_s, decoded, read = (len(paths) / float(np.nanmedian(of)) for of in (taken, *alone))
        of_decoding, of_reading = (quartiles(of / taken / jobs) for of in alone)
        gain = None if one_job is None else float(np.nanmedian(one_job / taken))
        yield RunSpeed(name, len(paths), jobs, per_s, of_decoding, of_reading, gain, decoded, read)


def this_machine() -> str:
    """Processor, cores, system and versions, on one line."""
    file = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", file.read_text() if file.is_file() else "")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = [f"{name} {version(name)}" for name in _PACKAGES]
    return ", ".join(
        [(names or [platform.processor() or "unknown"])[0], f"{cores} cores",
         f"{platform.system()} {platform.machine()}", f"redetect {__version__}",
         f"python {platform.python_version()}", *versions]
    )  # fmt: skip


#: Runs the command line, that of the process or what it is given; returns the exit code.
main = partial(study_main, Benchmark, "python -m tools.benchmark")


if __name__ == "__main__":
    sys.exit(main())
