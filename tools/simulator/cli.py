"""The command line: ``python -m tools.simulator --help``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from redetect.storage.command_line import exit_code_of
from tools.simulator.drive import DriveStyle
from tools.simulator.laser.commands import LaserSession
from tools.simulator.laser.commands import perform as perform_laser
from tools.simulator.markers.commands import MarkerDemo, MarkerFrames, MarkerSession
from tools.simulator.markers.commands import perform as perform_markers
from tools.simulator.plan import PUBLISHED_CAMERA, RunSettings
from tools.simulator.sensor import Sensor

T = TypeVar("T")


@dataclass(frozen=True)
class Demo:
    """Render the demo run of the project (images/e) anew."""

    output: Path = Path("images/e")
    """Folder of the run."""
    jobs: int = 1
    """Processes that render."""
    force: bool = False
    """Replace files that exist."""


@dataclass(frozen=True)
class Run:
    """Render a run through the office: images, odometry, and the truth."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the run; its name is the run's."""
    frames: int = 3297
    """Frames to render."""
    seed: int = 1
    """Everything about the run follows from it."""
    discs: int | None = None
    """Discs on the floor along the way; by default as dense as 576 in 3297 frames."""
    lookalikes: int | None = None
    """Other things on the floor; by default as dense as 140 in 3297 frames."""
    visits: float = 0.6
    """Probability that a room with an open door is visited in passing."""
    skip: int = 0
    """Steps of the drive that go by before the first frame."""
    unlabelled: float = 0.03
    """Share of rows whose ID is not known (-1)."""
    camera: Path | None = None
    """Calibration (.cam); the published one by default."""
    jobs: int = 1
    """Processes that render."""
    force: bool = False
    """Replace files that exist."""
    style: DriveStyle = field(default_factory=DriveStyle)
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True)
class Rows:
    """Write odometry and disc rows of a run, without images."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the run; its name is the run's."""
    frames: int = 3297
    """Steps to drive."""
    seed: int = 1
    """Everything about the run follows from it."""
    discs: int | None = None
    """Discs on the floor along the way; by default as dense as 576 in 3297 frames."""
    visits: float = 0.6
    """Probability that a room with an open door is visited in passing."""
    unlabelled: float = 0.03
    """Share of rows whose ID is not known (-1)."""
    camera: Path | None = None
    """Calibration (.cam); the published one by default."""
    exact: bool = False
    """Leave the rows without measurement noise."""
    miss: float = 0.0
    """Probability that a row is left out."""
    force: bool = False
    """Replace files that exist."""
    style: DriveStyle = field(default_factory=DriveStyle)


@dataclass(frozen=True)
class Reenact:
    """Render what the camera of a recorded run would have seen.

    Prints the discs' quality by distance, shipped and rendered.
    """

    landmarks: Annotated[Path, tyro.conf.Positional]
    """The recorded run's .circles file."""
    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the run; its name is the run's."""
    camera: Path
    """The calibration (.cam) that belongs to it."""
    world: Path
    """Path, discs and true mounting: what `python -m tools.reenactment prepare` wrote."""
    every: int = 5
    """Render every so many frames."""
    seed: int = 1
    """Of noise and light."""
    jobs: int = 1
    """Processes that render."""
    force: bool = False
    """Replace files that exist."""


@dataclass(frozen=True)
class Discs:
    """Render single discs all over the image, with exact truth, as one .npz."""

    output: Annotated[Path, tyro.conf.Positional]
    """The file: grey_0000, ... (crops), u0_v0, floor_xy, pixel."""
    camera: Path | None = None
    """Calibration (.cam); the published one by default."""
    count: int = 200
    """Discs to render."""
    seed: int = 1
    """Of places and noise."""
    radius_m: float = 0.10
    """Radius (m)."""
    blur_px: float = 0.8
    """Blur along u, standard deviation (pixels); half of it along v."""
    noise_grey: float = 2.0
    """Standard deviation of the noise (grey values)."""
    row_aperture: float = 1.0
    """Height of a pixel's sensitive area (rows)."""
    force: bool = False
    """Replace a file that exists."""


_FULL_FRAMES, _FULL_DISCS, _FULL_LOOKALIKES = 3297, 576, 140


def _by_length(given: int | None, full: int, frames: int) -> int:
    """How many things a run gets: what was asked for, or as many as its length allows."""
    return given if given is not None else max(1, round(full * frames / _FULL_FRAMES))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; 0 if all went well."""
    command = tyro.cli(
        Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Rows, tyro.conf.subcommand("rows")]
        | Annotated[Reenact, tyro.conf.subcommand("reenact")]
        | Annotated[Discs, tyro.conf.subcommand("discs")]
        | Annotated[MarkerFrames, tyro.conf.subcommand("marker-frames")]
        | Annotated[MarkerSession, tyro.conf.subcommand("marker-session")]
        | Annotated[MarkerDemo, tyro.conf.subcommand("marker-demo")]
        | Annotated[LaserSession, tyro.conf.subcommand("laser-session")],
        prog="python -m tools.simulator",
        description="Rendered runs with known truth.",
        args=arguments,
    )
    return exit_code_of(lambda: _perform(command))


def _perform(
    command: Demo
    | Run
    | Rows
    | Reenact
    | Discs
    | MarkerFrames
    | MarkerSession
    | MarkerDemo
    | LaserSession,
) -> int:
    begin = time.perf_counter()
    if isinstance(command, MarkerFrames | MarkerSession | MarkerDemo):
        what = perform_markers(command)
    elif isinstance(command, LaserSession):
        what = perform_laser(command)
    elif isinstance(command, Discs):
        what = _discs(command)
    elif isinstance(command, Reenact):
        what = _reenact(command)
    elif isinstance(command, Rows):
        what = _rows(command)
    else:
        what = _run(command)
    print(f"{command.output}: {what}, {time.perf_counter() - begin:.0f} s")
    return 0


def _run(command: Demo | Run) -> str:
    from tools.simulator.demo import DEMO
    from tools.simulator.run_folder import write_run

    settings = DEMO
    if isinstance(command, Run):
        settings = RunSettings(
            name=command.output.resolve().name, frames=command.frames, seed=command.seed,
            discs=_by_length(command.discs, _FULL_DISCS, command.frames),
            lookalikes=_by_length(command.lookalikes, _FULL_LOOKALIKES, command.frames),
            visits=command.visits, skip=command.skip, unlabelled=command.unlabelled,
            style=command.style, camera_text=_camera_text(command.camera), sensor=command.sensor,
        )  # fmt: skip
    rows = _with_progress(
        settings.frames,
        1,
        lambda tick: write_run(
            settings, command.output, jobs=command.jobs, overwrite=command.force, on_frame=tick
        ),
    )
    return f"{settings.frames} frames, {rows} disc rows"


def _rows(command: Rows) -> str:
    from tools.simulator.run_folder import write_rows

    settings = RunSettings(
        name=command.output.resolve().name, frames=command.frames, seed=command.seed,
        discs=_by_length(command.discs, _FULL_DISCS, command.frames), lookalikes=0,
        visits=command.visits, unlabelled=command.unlabelled,
        camera_text=_camera_text(command.camera), style=command.style,
    )  # fmt: skip
    rows = write_rows(
        settings, command.output, noisy=not command.exact, miss=command.miss,
        overwrite=command.force,
    )  # fmt: skip
    return f"{settings.frames} steps, {rows} disc rows"


def _camera_text(path: Path | None) -> str:
    from camera import format_camera, read_camera

    return PUBLISHED_CAMERA if path is None else format_camera(read_camera(path))


def _reenact(command: Reenact) -> str:
    from tools.simulator.reenact import prepare, quality_table, write_reenactment

    run = prepare(command.landmarks, command.camera, command.world, command.seed)
    rendered = len(range(0, len(run.frames), command.every))
    qualities = _with_progress(
        rendered,
        command.every,
        lambda tick: write_reenactment(
            run, command.output, command.every, jobs=command.jobs, overwrite=command.force,
            on_frame=tick,
        ),
    )  # fmt: skip
    for line in quality_table(qualities):
        print(line)
    return f"{rendered} frames"


def _discs(command: Discs) -> str:
    from tools.simulator.disc_set import write_discs

    write_discs(
        command.output, command.camera, count=command.count, seed=command.seed,
        radius_m=command.radius_m, blur_px=(command.blur_px, 0.5 * command.blur_px),
        noise_sigma=command.noise_grey, row_aperture=command.row_aperture,
        overwrite=command.force,
    )  # fmt: skip
    return f"{command.count} discs"


def _with_progress(frames: int, every: int, work: Callable[[Callable[[int], None]], T]) -> T:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    with Progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=frames)
        return work(lambda frame: progress.update(task, completed=frame // every + 1))
