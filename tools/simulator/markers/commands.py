"""The commands ``marker-frames``, ``marker-session`` and ``marker-demo`` of the simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, TypeVar

import tyro

from tools.simulator.markers.errors import CalibrationErrors
from tools.simulator.markers.sampling import SampleSettings
from tools.simulator.markers.session import SessionSettings
from tools.simulator.markers.session_files import ImageFormat

T = TypeVar("T")


@dataclass(frozen=True)
class MarkerFrames:
    """Render random frames of markers among things that look like markers, with exact truth."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the frames."""
    count: int = 100
    """Frames to render."""
    seed: int = 1
    """Everything about them follows from it."""
    jobs: int = 1
    """Processes that render."""
    force: bool = False
    """Replace files that exist."""
    sample: SampleSettings = field(default_factory=SampleSettings)


@dataclass(frozen=True)
class MarkerSession:
    """Render a session: cameras in a room, a robot with six markers, standing and driving.

    With images for estimating the calibrations of robot and cameras, in `calibration`.
    """

    output: Annotated[Path, tyro.conf.Positional]
    """Folder of the session; its name is the session's."""
    calibration: bool = True
    """Also render the images for calibrations."""
    image_format: ImageFormat = "jpg"
    """Of the images."""
    quality: int = 92
    """Of the jpg images."""
    jobs: int = 1
    """Processes that render."""
    force: bool = False
    """Replace files that exist."""
    session: SessionSettings = field(default_factory=SessionSettings)
    errors: CalibrationErrors = field(default_factory=CalibrationErrors)


@dataclass(frozen=True)
class MarkerDemo:
    """Render the session of the project (images/m) anew."""

    output: Path = Path("images/m")
    """Folder of the session."""
    force: bool = False
    """Replace files that exist."""


MarkerCommand = MarkerFrames | MarkerSession | MarkerDemo


def perform(command: MarkerCommand) -> str:
    """Carry a command out.

    Parameters
    ----------
    command : MarkerFrames, MarkerSession or MarkerDemo

    Returns
    -------
    str
        What was made.
    """
    if isinstance(command, MarkerFrames):
        return _frames(command)
    if isinstance(command, MarkerSession):
        return _session(command)
    return _demo(command)


def _frames(command: MarkerFrames) -> str:
    from tools.simulator.markers.sample_files import write_samples

    markers = _with_progress(
        command.count,
        lambda tick: write_samples(
            command.sample, command.output, count=command.count, seed=command.seed,
            jobs=command.jobs, overwrite=command.force, on_frame=tick,
        ),
    )  # fmt: skip
    return f"{command.count} frames, {markers} markers"


def _session(command: MarkerSession) -> str:
    from tools.simulator.markers.calibration_set import write_calibration_set
    from tools.simulator.markers.session import plan_session
    from tools.simulator.markers.session_files import write_session

    settings = replace(command.session, name=command.output.resolve().name)
    images = _with_progress(
        settings.cameras * (settings.references + settings.steps),
        lambda tick: write_session(
            settings, command.output, errors=command.errors, image_format=command.image_format,
            quality=command.quality, jobs=command.jobs, overwrite=command.force, on_frame=tick,
        ),
    )  # fmt: skip
    if not command.calibration:
        return f"{images} images"
    more = _with_progress(
        None,
        lambda tick: write_calibration_set(
            plan_session(settings), command.output / "calibration", errors=command.errors,
            image_format=command.image_format, quality=command.quality, overwrite=command.force,
            on_frame=tick,
        ),
    )  # fmt: skip
    return f"{images} images, {more} for calibrations"


def _demo(command: MarkerDemo) -> str:
    from tools.simulator.markers.demo import DEMO, DEMO_QUALITY
    from tools.simulator.markers.session_files import write_session

    images = write_session(DEMO, command.output, quality=DEMO_QUALITY, overwrite=command.force)
    return f"{images} images"


def _with_progress(total: int | None, work: Callable[[Callable[[], None]], T]) -> T:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    with Progress(BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) as progress:
        task = progress.add_task("", total=total)
        return work(lambda: progress.advance(task))
