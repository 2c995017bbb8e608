"""What a run is to do, what a worker gets of it, and what it sends back: nothing heavy."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, Literal, NamedTuple

from camera import Camera
from detect.line_settings import LineSettings
from detect.markers.settings import MarkerSettings
from detect.run import ImageRun
from detect.runs.known import NOTHING, Known, KnownOfFrame
from detect.settings import CircleSettings, Levelling
from detect.sources.interface import RunFrame
from detect.sources.times import format_time
from redetect.landmarks import format_no_tilt, format_record

if TYPE_CHECKING:
    from detect.run_tilt import RunTilt

Drawing = Literal["discs", "lines", "tracks", "markers"]

#: Number of failures whose messages a summary keeps.
KEPT_FAILURES = 100


@dataclass(frozen=True)
class FramePlan:
    """What is done with every frame of a run. Small: it is sent with every task.

    Without a camera only markers can be detected; of settings that are None, nothing is detected.
    """

    camera: Camera | None
    lines: LineSettings | None = None
    circles: CircleSettings | None = None
    markers: MarkerSettings | None = None
    json: bool = False  # whether discs are written as JSON as well; set by `detect_run`
    #: What is drawn into the image: "tracks" are all of the lines', with why some are no lines.
    drawing: Drawing | None = None
    draw_response: bool = False  # of the lines' filter
    #: What discs are levelled by: nothing, the tilt of their own frame, or, when all frames are
    #: done, of the run.
    levelling: Levelling = "frame"
    working_folder: Path = field(default_factory=Path.cwd)  # where relative paths start from


@dataclass(frozen=True)
class Job:
    """A run to be processed, and where its results go."""

    run: ImageRun
    plan: FramePlan
    #: The files to write: "circles", "lines", "tilt", "markers", "json" (the discs once more).
    places: Mapping[str, Path]
    known: Known = field(default_factory=Known)
    pictures: Path | None = None  # folder for those of the plan
    #: What log, journal and times are called but for their endings; None: the first of the places.
    base: Path | None = None
    command: str = ""  # what the log calls the run
    crlf: bool = False  # how lines of files of landmarks end
    overwrite: bool = False
    strict: bool = False  # whether the first frame that cannot be worked on ends the run
    resume: bool = False  # whether the frames that an unfinished run kept are taken over

    @property
    def ships_images(self) -> bool:
        """Whether tasks or their results are as large as images."""
        return self.pictures is not None or self.run.frames.ships_images

    def beside(self, ending: str) -> Path:
        """A file beside the results that is called like them."""
        base = self.base or next(iter(self.places.values()))
        return base.with_name(f"{base.name}{ending}")


class FrameTask(NamedTuple):
    """A frame to be processed, prior data on it, and its plan if it is not the run's. Small."""

    frame: RunFrame
    known: KnownOfFrame = NOTHING
    plan: FramePlan | None = None

    @property
    def name(self) -> object:
        """What messages call it."""
        return self.frame.image or self.frame.step.prefix


class FrameRows(NamedTuple):
    """Result of a frame, some kilobytes: all that a worker sends back."""

    prefix: str
    rows: Mapping[str, str]  # by kind of file: those of `Job.places`, and "times"
    found: Mapping[str, int] = {}  # how many "discs", "lines", "tilts" and "markers"
    rejected: Mapping[str, int] = {}  # how many candidates for markers, by cause
    error: str | None = None  # why there are no landmarks
    pictures: tuple[tuple[str, bytes], ...] = ()  # names and PNG files


@dataclass
class RunSummary:
    """What was found in a run, and the first `KEPT_FAILURES` reasons why frames failed."""

    frames: int = 0
    found: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0  # the odometry does not have them
    tilt: RunTilt | None = None  # that discs were levelled by, if by the run's

    def add(self, rows: FrameRows) -> None:
        """Count a frame."""
        self.frames += 1
        self.found.update(rows.found)
        self.rejected.update(rows.rejected)
        if rows.error is not None:
            self.failed += 1
            if len(self.failures) < KEPT_FAILURES:
                self.failures.append(rows.error)


def rows_of_failure(task: FrameTask, reason: str) -> FrameRows:
    """Output of a frame that could not be processed."""
    step = task.frame.step
    rows = dict.fromkeys(("circles", "lines", "markers"), f"{format_record(step)}\n")
    rows["tilt"] = f"{format_no_tilt(step.prefix, 0)}\n"
    rows["json"] = json_record({"frame": step.prefix, "error": reason})
    rows["times"] = time_row(task)
    return FrameRows(step.prefix, rows, error=reason)


def time_row(task: FrameTask) -> str:
    """The row of a file of times."""
    frame = task.frame
    return "" if frame.time_s is None else f"{format_time(frame.step.prefix, frame.time_s)}\n"


def json_record(record: dict[str, object]) -> str:
    """A record in the list of frames of an indented document."""
    return "\n" + indent(json.dumps(record, indent=1), "  ")
