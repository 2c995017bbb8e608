"""The command line of the simulator: ``python -m tools.simulator --help``."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from camera import format_camera, read_camera
from redetect.command_line import exit_code_of
from tools.simulator import runs
from tools.simulator.driving import DriveStyle
from tools.simulator.laser import session_files as laser
from tools.simulator.laser.settings import LaserSettings
from tools.simulator.markers import session as markers
from tools.simulator.markers.calibration_set import write_calibration_set
from tools.simulator.markers.samples import SampleSettings, write_samples
from tools.simulator.renderer import Sensor

# Numbers of frames, discs and look-alikes in a run of the data set.
_FULL_FRAMES, _FULL_DISCS, _FULL_LOOKALIKES = 3297, 576, 140


@dataclass(frozen=True)
class Demo:
    """Render the demo run of the project (images/e) again."""

    output: Path = Path("images/e")  # Folder of the run.
    jobs: int = 1  # Number of processes.
    force: bool = False  # Replace existing files.

    def __call__(self) -> str:
        rows = runs.write_run(runs.DEMO, self.output, jobs=self.jobs, overwrite=self.force)
        return f"{runs.DEMO.frames} frames, {rows} disc rows"


@dataclass(frozen=True)
class _Drive:
    """A drive through the office."""

    output: Positional[Path]  # Folder of the run; its name is the run's.
    frames: int = _FULL_FRAMES  # Number of steps, each followed by a frame.
    seed: int = 1  # Seed of everything random in the run.
    discs: int | None = None  # Discs on the floor along the way; by default 576 in 3297 frames.
    visits: float = 0.6  # Probability that a room with an open door is visited.
    unlabelled: float = 0.03  # Share of rows with unknown ID (-1).
    camera: Path | None = None  # Calibration (.cam); the published one by default.
    force: bool = False  # Replace existing files.
    style: DriveStyle = field(default_factory=DriveStyle)

    def settings(self) -> runs.RunSettings:
        """Settings of the run, without look-alikes."""
        settings = runs.RunSettings(
            name=self.output.resolve().name, frames=self.frames, seed=self.seed, lookalikes=0,
            discs=self.by_length(self.discs, _FULL_DISCS), visits=self.visits,
            unlabelled=self.unlabelled, style=self.style,
        )  # fmt: skip
        if self.camera is None:
            return settings
        return replace(settings, camera_text=format_camera(read_camera(self.camera)))

    def by_length(self, given: int | None, full: int) -> int:
        """The given number, or one in proportion to the length of the run."""
        return given if given is not None else max(1, round(full * self.frames / _FULL_FRAMES))


@dataclass(frozen=True)
class Run(_Drive):
    """Render a run through the office: images, odometry, and the truth."""

    lookalikes: int | None = None  # Look-alikes on the floor; by default 140 in 3297 frames.
    skip: int = 0  # Number of steps before the first frame.
    jobs: int = 1  # Number of processes.
    sensor: Sensor = field(default_factory=Sensor)

    def __call__(self) -> str:
        lookalikes = self.by_length(self.lookalikes, _FULL_LOOKALIKES)
        settings = replace(
            self.settings(), lookalikes=lookalikes, skip=self.skip, sensor=self.sensor
        )
        rows = runs.write_run(settings, self.output, jobs=self.jobs, overwrite=self.force)
        return f"{self.frames} frames, {rows} disc rows"


@dataclass(frozen=True)
class Rows(_Drive):
    """Write odometry and disc rows of a run, without images."""

    exact: bool = False  # Omit the measurement noise of rows.
    miss: float = 0.0  # Probability that a row is missing.

    def __call__(self) -> str:
        rows = runs.write_rows(
            self.settings(), self.output, noisy=not self.exact, miss=self.miss, overwrite=self.force
        )
        return f"{self.frames} steps, {rows} disc rows"


@dataclass(frozen=True)
class MarkerFrames:
    """Render random frames of markers and look-alikes, with exact truth."""

    output: Positional[Path]  # Folder of the frames.
    count: int = 100  # Number of frames.
    seed: int = 1  # Seed of everything random.
    jobs: int = 1  # Number of processes.
    force: bool = False  # Replace existing files.
    sample: SampleSettings = field(default_factory=SampleSettings)

    def __call__(self) -> str:
        shown = write_samples(
            self.sample, self.output, count=self.count, seed=self.seed, jobs=self.jobs,
            overwrite=self.force,
        )  # fmt: skip
        return f"{self.count} frames, {shown} markers"


@dataclass(frozen=True)
class MarkerSession:
    """Render a session: cameras in a room, a robot with six markers, at rest and driving.

    Also renders images for estimating the calibrations of robot and cameras, in `calibration`.
    """

    output: Positional[Path]  # Folder of the session; its name is the session's.
    calibration: bool = True  # Also render the images for calibrations.
    image_format: markers.ImageFormat = "jpg"  # Of the images.
    quality: int = 92  # Of the jpg images.
    jobs: int = 1  # Number of processes.
    force: bool = False  # Replace existing files.
    session: markers.SessionSettings = field(default_factory=markers.SessionSettings)
    errors: markers.CalibrationErrors = field(default_factory=markers.CalibrationErrors)

    def __call__(self) -> str:
        settings = replace(self.session, name=self.output.resolve().name)
        writer = markers.SessionWriter(self.errors, self.image_format, self.quality, self.force)
        images = markers.write_session(settings, self.output, writer, self.jobs)
        if not self.calibration:
            return f"{images} images"
        plan = markers.plan_session(settings)
        more = write_calibration_set(plan, self.output / "calibration", writer)
        return f"{images} images, {more} for calibrations"


@dataclass(frozen=True)
class MarkerDemo:
    """Render the session of the project (images/m) again."""

    output: Path = Path("images/m")  # Folder of the session.
    force: bool = False  # Replace existing files.

    def __call__(self) -> str:
        writer = markers.SessionWriter(quality=markers.DEMO_QUALITY, overwrite=self.force)
        return f"{markers.write_session(markers.DEMO, self.output, writer)} images"


@dataclass(frozen=True)
class LaserSession:
    """Simulate a session of a robot watched by fixed laser scanners and marker cameras.

    No images: scans, odometry, poses from markers, distances, clocks, and the truth.
    """

    output: Positional[Path]  # Folder of the session.
    seed: int = 1  # Seed of everything random.
    force: bool = False  # Replace existing files.
    session: Annotated[LaserSettings, arg(name="")] = field(default_factory=LaserSettings)

    def __call__(self) -> str:
        plan = laser.write_session(self.session, self.output, seed=self.seed, overwrite=self.force)
        inside = sum(end - begin for begin, end in plan.visits)
        away = plan.route.end_s - plan.route.start_s - inside
        return f"{len(plan.visits)} visits, {inside:.0f} s in the room and {away:.0f} s outside"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""

    def perform() -> int:
        command = tyro.cli(
            Demo | Run | Rows | MarkerFrames | MarkerSession | MarkerDemo | LaserSession,
            prog="python -m tools.simulator",
            description="Rendered runs and sessions with known truth.",
            args=arguments,
        )
        begin = time.perf_counter()
        made = command()
        print(f"{command.output}: {made}, {time.perf_counter() - begin:.0f} s")
        return 0

    return exit_code_of(perform)


if __name__ == "__main__":
    sys.exit(main())
