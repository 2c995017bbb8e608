"""The command line: ``python -m tools.simulator --help``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from storage import OutputExistsError
from tools.simulator.drive import DriveStyle
from tools.simulator.plan import RunSettings
from tools.simulator.sensor import Sensor


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
    discs: int = 576
    """Discs on the floor along the way."""
    lookalikes: int = 140
    """Other things on the floor."""
    visits: float = 0.6
    """Probability that a room with an open door is visited in passing."""
    skip: int = 0
    """Steps of the drive that go by before the first frame."""
    unlabelled: float = 0.03
    """Share of rows whose ID is not known (-1)."""
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
    discs: int = 576
    """Discs on the floor along the way."""
    visits: float = 0.6
    """Probability that a room with an open door is visited in passing."""
    unlabelled: float = 0.03
    """Share of rows whose ID is not known (-1)."""
    exact: bool = False
    """Leave the rows without measurement noise."""
    miss: float = 0.0
    """Probability that a row is left out."""
    force: bool = False
    """Replace files that exist."""
    style: DriveStyle = field(default_factory=DriveStyle)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; 0 if all went well."""
    command = tyro.cli(
        Annotated[Demo, tyro.conf.subcommand("demo")]
        | Annotated[Run, tyro.conf.subcommand("run")]
        | Annotated[Rows, tyro.conf.subcommand("rows")],
        prog="python -m tools.simulator",
        description="Rendered runs with known truth.",
        args=arguments,
    )
    try:
        return _perform(command)
    except (OutputExistsError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _perform(command: Demo | Run | Rows) -> int:
    from tools.simulator.demo import DEMO
    from tools.simulator.run_folder import write_rows, write_run

    begin = time.perf_counter()
    if isinstance(command, Rows):
        settings = RunSettings(
            name=command.output.resolve().name, frames=command.frames, seed=command.seed,
            discs=command.discs, lookalikes=0, visits=command.visits,
            unlabelled=command.unlabelled, style=command.style,
        )  # fmt: skip
        rows = write_rows(
            settings, command.output, noisy=not command.exact, miss=command.miss,
            overwrite=command.force,
        )  # fmt: skip
    else:
        settings = DEMO
        if isinstance(command, Run):
            settings = RunSettings(
                name=command.output.resolve().name, frames=command.frames, seed=command.seed,
                discs=command.discs, lookalikes=command.lookalikes, visits=command.visits,
                skip=command.skip, unlabelled=command.unlabelled, style=command.style,
                sensor=command.sensor,
            )  # fmt: skip
        rows = _with_progress(
            settings.frames,
            lambda tick: write_run(
                settings, command.output, jobs=command.jobs, overwrite=command.force, on_frame=tick
            ),
        )
    seconds = time.perf_counter() - begin
    print(
        f"{command.output}: {settings.frames} steps, {rows} disc rows, {seconds:.0f} s "
        f"({1000.0 * seconds / settings.frames:.0f} ms per step)"
    )
    return 0


def _with_progress(frames: int, work: Callable[[Callable[[int], None]], int]) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    with Progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=frames)
        return work(lambda frame: progress.update(task, completed=frame + 1))
