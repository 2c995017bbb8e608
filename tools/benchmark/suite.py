"""The measurements, one after the other."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from camera import Camera
from detect.run import Run, open_run
from tools.benchmark import functions as f
from tools.benchmark.machine import this_machine
from tools.benchmark.material import (
    Picture,
    jpeg_picture,
    noise_pictures,
    photograph_pictures,
    repeated_run,
    run_pictures,
    scaled_camera,
    scaled_picture,
)
from tools.benchmark.painted import disc_places, floor_with_discs, wall_with_edges
from tools.benchmark.result import (
    GrowthPoint,
    KindTimes,
    Result,
    RunTimes,
    comparisons,
    function_times,
    run_times,
)
from tools.benchmark.runs import commands, measure_runs, perform
from tools.benchmark.timing import measure_in_turn

#: Peers, and what does their work here.
_COMPARED = (
    ("cv2.HoughCircles", f.CIRCLES),
    ("cv2.SimpleBlobDetector", f.CIRCLES),
    ("skimage hough_circle", f.CIRCLES),
    ("cv2 LSD", f.LINES),
    ("cv2.ximgproc FLD", f.LINES),
)

#: Pictures of each point of the growth curves.
_GROWTH_PICTURES = 2

_ALL_COMMAND = "detect all"


@dataclass(frozen=True)
class Settings:
    """What decides how it is measured.

    Parameters
    ----------
    run : Path
        The demo run: camera, pictures, and whole passes.
    photographs : Path
        Folder with photographs, in it or below; without it they are left out.
    pictures : int
        Pictures of each kind.
    rounds : int
        How often each function gets each picture.
    run_frames : int
        Frames of a whole run: those of the demo run over and over.
    run_rounds : int
        Passes over a whole run; slow commands get fewer.
    budget_s : float
        A function that has taken this long on a kind of pictures is left out of its later rounds,
        seconds.
    factors : tuple of float
        Lengths of the sides of the growing images, relative to the run's.
    landmarks : tuple of int
        Discs, and edges, painted into an image.
    frames : tuple of int
        Lengths of the growing runs.
    jobs : tuple of int
        Numbers of jobs, for the growing runs; the whole runs get one.
    seed : int
        Of noise and places.
    """

    run: Path = Path("images/e")
    photographs: Path | None = None
    pictures: int = 8
    rounds: int = 10
    run_frames: int = 1600
    run_rounds: int = 5
    budget_s: float = 3.0
    factors: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
    landmarks: tuple[int, ...] = (0, 5, 10, 20, 30, 50)
    frames: tuple[int, ...] = (80, 320, 1600, 6400)
    jobs: tuple[int, ...] = (1, 2)
    seed: int = 0


def benchmark(settings: Settings, on_stage: Callable[[str], None] | None = None) -> Result:
    """Measure everything.

    Parameters
    ----------
    settings : Settings
    on_stage : callable, optional
        Called with a few words before each measurement.

    Returns
    -------
    Result

    Raises
    ------
    BenchmarkError, detect.errors.DetectError
        If the run or the photographs cannot be used.
    """
    import cv2
    import numba

    say = on_stage if on_stage is not None else _nothing
    # All are measured on one core; only the jobs of whole passes may take more.
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    run = open_run(settings.run)
    skipped = []
    if settings.photographs is None:
        skipped.append("photographs: no folder was given")

    peers, absent = f.peers_of_other_libraries()
    say("compiling")
    measured = [
        f.decoding(),
        *f.circle_detectors(run.camera),
        *f.line_detectors(run.camera),
        f.both_detectors(run.camera),
        *peers,
    ]
    kinds = []
    for kind, description, pictures in _kinds(run, settings):
        say(f"{kind}: {len(pictures)} pictures")
        kinds.append(_kind_times(kind, description, pictures, measured, settings))

    say("growth with the image")
    by_megapixels = tuple(
        _point(
            camera.width * camera.height / 1e6,
            [scaled_picture(p, camera, settings.seed) for p in run_pictures(run, _GROWTH_PICTURES)],
            [*f.circle_detectors(camera, parts=False), *f.line_detectors(camera, parts=False)],
            settings,
        )
        for camera in (scaled_camera(run.camera, factor) for factor in settings.factors)
    )
    say("growth with the landmarks")
    by_discs, by_verticals = _by_landmarks(run.camera, settings)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        say(f"whole runs: {settings.run_frames} frames")
        for command in commands(settings.run, folder).values():
            perform(command)  # compiles what is to be compiled
        whole = repeated_run(run, folder / "whole", settings.run_frames)
        runs = _runs(whole, list(commands(whole, folder)), (1,), folder, settings, warm_up=False)
        by_frames: list[RunTimes] = []
        for frames in settings.frames:
            say(f"whole runs: {frames} frames")
            long_run = repeated_run(run, folder, frames)
            by_frames += _runs(
                long_run, [_ALL_COMMAND], settings.jobs, folder, settings, warm_up=False
            )
    return Result(
        machine=this_machine(),
        settings={
            key: str(value) if isinstance(value, Path) else value
            for key, value in dataclasses.asdict(settings).items()
        },
        absent=tuple(absent),
        skipped=tuple(skipped),
        kinds=tuple(kinds),
        runs=tuple(runs),
        by_megapixels=by_megapixels,
        by_discs=by_discs,
        by_verticals=by_verticals,
        by_frames=tuple(by_frames),
    )


def _nothing(_: str) -> None:
    pass


def _kinds(run: Run, settings: Settings) -> Iterator[tuple[str, str, list[Picture]]]:
    """Name, description and pictures of each kind."""
    size = f"{run.camera.width}x{run.camera.height}"
    yield (
        "demo",
        f"frames of {settings.run} of {size}, files as they are",
        run_pictures(run, settings.pictures),
    )
    yield (
        "noise",
        f"uniform noise of {size}, JPEG quality 90",
        noise_pictures(run.camera, settings.pictures, settings.seed),
    )
    if settings.photographs is not None:
        yield (
            "photographs",
            f"photographs scaled to {size}, JPEG quality 90",
            photograph_pictures(settings.photographs, run.camera, settings.pictures),
        )


def _kind_times(
    kind: str,
    description: str,
    pictures: Sequence[Picture],
    measured: Sequence[f.Measured],
    settings: Settings,
) -> KindTimes:
    seconds = measure_in_turn(
        f.by_picture_number(measured, pictures), len(pictures), settings.rounds, settings.budget_s
    )
    return KindTimes(
        kind,
        description,
        len(pictures),
        function_times(measured, seconds),
        comparisons(_COMPARED, seconds),
    )


def _point(
    amount: float,
    pictures: Sequence[Picture],
    detectors: Sequence[f.Measured],
    settings: Settings,
) -> GrowthPoint:
    """One point of a growth curve, in turn with decoding."""
    measured = [f.decoding(), *detectors]
    seconds = measure_in_turn(
        f.by_picture_number(measured, pictures), len(pictures), settings.rounds, settings.budget_s
    )
    return GrowthPoint(amount, function_times(measured, seconds))


def _by_landmarks(
    camera: Camera, settings: Settings
) -> tuple[tuple[GrowthPoint, ...], tuple[GrowthPoint, ...]]:
    """Growth curves over painted discs and painted edges."""
    circles = f.circle_detectors(camera, parts=False)
    lines = f.line_detectors(camera, parts=False)
    places = disc_places(camera, max(settings.landmarks, default=0), settings.seed)
    discs, verticals = [], []
    for count in settings.landmarks:
        seeds = range(settings.seed, settings.seed + _GROWTH_PICTURES)
        floors = [jpeg_picture(floor_with_discs(camera, places[:count], s)) for s in seeds]
        walls = [jpeg_picture(wall_with_edges(camera, count, s)) for s in seeds]
        discs.append(_point(count, floors, circles, settings))
        verticals.append(_point(count, walls, lines, settings))
    return tuple(discs), tuple(verticals)


def _runs(
    run: Path,
    names: Sequence[str],
    jobs: Sequence[int],
    folder: Path,
    settings: Settings,
    *,
    warm_up: bool = True,
) -> list[RunTimes]:
    """Whole passes of some commands with each number of jobs, all in turn."""
    performed = {
        (name, count): commands(run, folder, count)[name] for count in jobs for name in names
    }
    frames, decoding, reading, seconds = measure_runs(
        performed, run, settings.run_rounds, warm_up=warm_up
    )
    return [
        run_times(
            name, frames, count, seconds[name, count], decoding, reading, seconds.get((name, 1))
        )
        for name, count in performed
    ]
