"""Time the detectors, their parts and peers in one process: ``python -m tools.benchmark``."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro

from detect.sources.interface import Run
from detect.sources.opening import open_run
from redetect.storage import OutputExistsError
from redetect.storage.command_line import exit_code_of
from tools.arrays import ByteArray
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
from tools.benchmark.report import (
    Result,
    RunTime,
    Time,
    format_markdown,
    plot_png,
    run_time,
    this_machine,
    times_of,
)
from tools.benchmark.timing import measure_in_turn
from tools.evaluation.tables import write_json
from tools.simulator.files import write_bytes

#: Pictures of each point of the growth curves.
_GROWTH_PICTURES = 2
#: A command that has taken this long is left out of later rounds, seconds.
_RUN_BUDGET_S = 15.0


@dataclass(frozen=True)
class Benchmark:
    """Time the detectors, their parts and peers side by side, in one process.

    Prints Markdown tables.
    Example: python -m tools.benchmark --photographs ../shared/data/discs --plot /tmp/speed.png
    """

    run: Path = Path("images/e")  # The demo run: camera, pictures, and whole passes.
    photographs: Path | None = None  # Folder with photographs; without it they are left out.
    pictures: int = 8  # Pictures of each kind.
    rounds: int = 10  # How often each function gets each picture.
    run_frames: int = 1600  # Frames of a whole run: those of the demo run over and over.
    run_rounds: int = 5  # Passes over a whole run; slow commands get fewer.
    budget_s: float = 3.0  # A function that took this long is left out of later rounds, seconds.
    factors: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)  # Sides of growing images.
    landmarks: tuple[int, ...] = (0, 5, 10, 20, 30, 50)  # Discs, and edges, painted into an image.
    frames: tuple[int, ...] = (80, 320, 1600, 6400)  # Lengths of the growing runs.
    jobs: tuple[int, ...] = (1, 2)  # Numbers of jobs, for the growing runs.
    seed: int = 0  # Of noise and places.
    json: Path | None = None  # Write everything as JSON.
    plot: Path | None = None  # Draw the ratios and the growth curves into a PNG.
    markdown: Path | None = None  # Write the tables as Markdown.
    force: bool = False  # Replace existing files.

    def __call__(self) -> int:
        for path in (self.json, self.plot, self.markdown):
            if path is not None and path.exists() and not self.force:
                raise OutputExistsError(path)
        result = benchmark(self)
        text = format_markdown(result)
        print(text)
        if self.json is not None:
            write_json(self.json, asdict(result), overwrite=self.force)
        if self.plot is not None:
            write_bytes(self.plot, plot_png(result), overwrite=self.force)
        if self.markdown is not None:
            write_bytes(self.markdown, text.encode(), overwrite=self.force)
        return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    command = tyro.cli(Benchmark, prog="python -m tools.benchmark", args=arguments)
    return exit_code_of(command)


def benchmark(settings: Benchmark) -> Result:
    """Measure everything.

    Raises
    ------
    BenchmarkError, detect.errors.DetectError
        If the run or the photographs cannot be used.
    """
    import cv2
    import numba

    # All are measured on one core; only the jobs of whole passes may take more.
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    run = open_run(settings.run)
    times: list[Time] = []
    everything = {**f.all_detectors(run.camera), **f.peers()}
    for case, pictures in _kinds(run, settings):
        times += _timed("images", case, pictures, everything, settings)
    frames = run_pictures(run, _GROWTH_PICTURES)
    for factor in settings.factors:
        camera = scaled_camera(run.camera, factor)
        size = f"{camera.width * camera.height / 1e6:.6g}"
        scaled = [scaled_picture(picture, camera, settings.seed) for picture in frames]
        times += _timed("megapixels", size, scaled, f.whole_detectors(camera), settings)
    places = disc_places(run.camera, max(settings.landmarks, default=0), settings.seed)
    seeds = range(settings.seed, settings.seed + _GROWTH_PICTURES)
    detectors = f.whole_detectors(run.camera)
    for count in settings.landmarks:
        floors = [jpeg_picture(floor_with_discs(run.camera, places[:count], s)) for s in seeds]
        times += _timed("discs", str(count), floors, detectors, settings)
    for count in settings.landmarks:
        walls = [jpeg_picture(wall_with_edges(run.camera, count, seed)) for seed in seeds]
        times += _timed("verticals", str(count), walls, detectors, settings)
    described = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in vars(settings).items()
        if key not in ("json", "plot", "markdown", "force")
    }
    return Result(this_machine(), described, tuple(times), tuple(_runs(run, settings)))


def _kinds(run: Run, settings: Benchmark) -> Iterator[tuple[str, list[Picture]]]:
    """Name and pictures of each kind."""
    yield "demo", run_pictures(run, settings.pictures)
    yield "noise", noise_pictures(run.camera, settings.pictures, settings.seed)
    if settings.photographs is not None:
        pictures = photograph_pictures(settings.photographs, run.camera, settings.pictures)
        yield "photographs", pictures


def _timed(
    part: str,
    case: str,
    pictures: Sequence[Picture],
    functions: dict[str, f.Function],
    settings: Benchmark,
) -> list[Time]:
    """Times of functions, in turn with decoding."""
    print(f"{part} {case}: {len(pictures)} pictures", file=sys.stderr, flush=True)
    decoding: dict[str, f.Function] = {f.DECODING: lambda picture: decode(picture.encoded)}

    def of_pictures(function: f.Function) -> Callable[[int], object]:
        return lambda number: function(pictures[number])

    bound = {name: of_pictures(each) for name, each in {**decoding, **functions}.items()}
    seconds = measure_in_turn(bound, len(pictures), settings.rounds, settings.budget_s)
    return times_of(part, case, seconds, f.DECODING)


def _runs(run: Run, settings: Benchmark) -> Iterator[RunTime]:
    """Whole runs: all commands once, and `detect all` over growing lengths and numbers of jobs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command in f.commands(settings.run, folder).values():
            f.perform(command)  # compiles what is to be compiled
        whole = repeated_run(run, folder / "whole", settings.run_frames)
        every = [(command, 1) for command in f.commands(whole, folder)]
        yield from measure_runs(whole, every, folder, settings.run_rounds)
        for frames in settings.frames:
            growing = repeated_run(run, folder / f"frames{frames}", frames)
            by_jobs = [("detect all", jobs) for jobs in settings.jobs]
            yield from measure_runs(growing, by_jobs, folder, settings.run_rounds)


def measure_runs(
    run: Path, chosen: Sequence[tuple[str, int]], folder: Path, rounds: int
) -> list[RunTime]:
    """Passes over a run of commands by name and jobs, in turn with decoding its files."""
    print(f"whole runs: {run}", file=sys.stderr, flush=True)
    paths = [frame.image for frame in open_run(run).frames if frame.image is not None]
    files = contents_of(paths)

    def decode_all(contents: Iterable[ByteArray]) -> None:
        for content in contents:
            decode(content)

    def perform(name: str, jobs: int, _: int) -> None:
        f.perform(f.commands(run, folder, jobs)[name])

    functions: dict[str, Callable[[int], object]] = {
        "decoding": lambda _: decode_all(files),
        "reading": lambda _: decode_all(np.fromfile(path, np.uint8) for path in paths),
        **{f"{name} {jobs}": partial(perform, name, jobs) for name, jobs in chosen},
    }
    # By the clock on the wall, since jobs are processes of their own.
    seconds = measure_in_turn(
        functions, 1, rounds, _RUN_BUDGET_S, time.perf_counter, warm_up=False, least_calls=1
    )
    taken = {key: values[:, 0] for key, values in seconds.items()}
    alone = [taken["decoding"], taken["reading"]]
    return [
        run_time(name, len(paths), jobs, taken[f"{name} {jobs}"], alone, taken.get(f"{name} 1"))
        for name, jobs in chosen
    ]


if __name__ == "__main__":
    sys.exit(main())
