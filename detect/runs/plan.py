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
from detect.run import ImageRun, RunFrame
from detect.runs.known import NOTHING, Known, KnownOfFrame
from detect.settings import CircleSettings, Levelling
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

    Attributes
    ----------
    camera : Camera or None
        The calibrated camera; without one, only markers can be detected.
    lines, circles, markers : settings or None
        Which verticals, discs and square markers are detected, if any.
    json : bool
        Whether the discs are written as JSON as well; set by `detect_run`.
    drawing : {"discs", "lines", "tracks", "markers"} or None
        What is drawn into the image; "tracks" are all tracks of lines, with the reason of those
        that are no lines.
    draw_response : bool
        Whether the filter's response of the lines is drawn as well.
    levelling : {"none", "frame", "run"}
        By what the discs are corrected for the tilt: by nothing, by the frame's own, or, when all
        frames are done, by the run's (`detect.runs.level_run`).
    working_folder : path
        Folder that relative image paths start from, on whatever machine.
    """

    camera: Camera | None
    lines: LineSettings | None = None
    circles: CircleSettings | None = None
    markers: MarkerSettings | None = None
    json: bool = False
    drawing: Drawing | None = None
    draw_response: bool = False
    levelling: Levelling = "frame"
    working_folder: Path = field(default_factory=Path.cwd)


@dataclass(frozen=True)
class Job:
    """A run to be processed, and where its results go.

    Attributes
    ----------
    run : ImageRun
    plan : FramePlan
        The landmarks to detect.
    places : mapping
        The files to write, by kind: "circles", "lines", "tilt", "markers", "json" (the discs once
        more). Where the frames' times are known, they go beside them.
    known : Known
        Prior data on the frames.
    pictures : path or None
        Folder for the plan's pictures.
    base : path or None
        What log, journal and times are called but for their endings; by default the first of the
        places.
    command : str
        What the log calls the run.
    crlf : bool
        Whether the lines of files of landmarks end with CR and LF.
    overwrite : bool
        Whether existing files may be replaced.
    strict : bool
        Whether the first frame that cannot be worked on ends the run.
    resume : bool
        Whether the frames that an unfinished run kept are taken over.
    """

    run: ImageRun
    plan: FramePlan
    places: Mapping[str, Path]
    known: Known = field(default_factory=Known)
    pictures: Path | None = None
    base: Path | None = None
    command: str = ""
    crlf: bool = False
    overwrite: bool = False
    strict: bool = False
    resume: bool = False

    @property
    def ships_images(self) -> bool:
        """Whether tasks or their results are as large as images."""
        return self.pictures is not None or self.run.frames.ships_images

    def beside(self, ending: str) -> Path:
        """A file beside the results that is called like them."""
        base = self.base or next(iter(self.places.values()))
        return base.with_name(f"{base.name}{ending}")


class FrameTask(NamedTuple):
    """A frame to be processed, with prior data on it. Small."""

    frame: RunFrame
    known: KnownOfFrame = NOTHING

    @property
    def name(self) -> object:
        """What messages call it."""
        return self.frame.image or self.frame.step.prefix


class FrameRows(NamedTuple):
    """Result of a frame, some kilobytes: all that a worker sends back.

    Attributes
    ----------
    prefix : str
        Of its image.
    rows : mapping
        Its rows in files of each kind: "circles", "lines", "tilt", "markers", "json", "times".
    found : mapping
        How many "discs", "lines", "tilts" and "markers" there are.
    rejected : mapping
        How many candidates for markers were rejected, by cause.
    error : str or None
        Why the frame could not be worked on: its STEP stays, without landmarks.
    pictures : tuple of (name, PNG)
    """

    prefix: str
    rows: Mapping[str, str]
    found: Mapping[str, int] = {}
    rejected: Mapping[str, int] = {}
    error: str | None = None
    pictures: tuple[tuple[str, bytes], ...] = ()


@dataclass
class RunSummary:
    """Summary of a run.

    Attributes
    ----------
    frames, failed : int
        Frames of the run, and those of them that could not be worked on.
    found, rejected : Counter
        Sums of these of `FrameRows`.
    failures : list of str
        A line for each of the first `KEPT_FAILURES` frames that failed.
    images_without_step : int
        Images that are no part of the run: the odometry does not have them.
    tilt : RunTilt or None
        The tilt of the run, if discs were levelled by it.
    """

    frames: int = 0
    found: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    images_without_step: int = 0
    tilt: RunTilt | None = None

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
