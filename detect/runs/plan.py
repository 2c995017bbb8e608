"""The plan of a run and its prior data; the inputs and outputs of workers.

Imports nothing heavy.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import indent
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from camera import Camera
from detect.line_settings import LineSettings
from detect.projection import Tilt
from detect.settings import CircleSettings, Levelling, MarkerSettings
from detect.sources.image_files import image_name
from detect.sources.interface import ImageRun, RunFrame
from redetect.json_text import json_text
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    FrameTilt,
    LineLandmark,
    Step,
    circle_landmarks,
    format_no_tilt,
    format_record,
    frames_of_rows,
    parse_rows,
    read_rows,
    read_tilts,
)
from redetect.landmarks.frame_files import format_time
from redetect.landmarks.map_file import read_map, read_path
from redetect.plane import rotation

if TYPE_CHECKING:
    from detect.run_tilt import RunTilt


#: Largest distance from the robot at which discs of a map are matched, metres.
_REACH_M = 20.0


class FramePriors(NamedTuple):
    """Prior data on a frame: see `Priors`."""

    tilt: FrameTilt | None = None
    lines: tuple[LineLandmark, ...] = ()
    discs: tuple[CircleLandmark, ...] = ()
    discs_level: bool = False
    mapped: tuple[CircleLandmark, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.tilt or self.lines or self.discs or self.mapped)


@dataclass(frozen=True)
class Priors:
    """Prior data on the frames of a run, by the names of their images."""

    tilts: Mapping[str, FrameTilt] | None = None  # of frames whose verticals are not detected
    lines: FramesByImage | None = None  # with IDs, transferred to rows of the same lines
    discs: FramesByImage | None = None  # the same for discs
    discs_level: bool = False  # whether these are corrected for the tilt
    #: Discs of a map: rows without an ID from `discs` get the ID of the one at their position.
    mapped: MapByImage | None = None

    def of(self, prefix: str) -> FramePriors:
        """Prior data on a frame."""
        lines = self.lines.get(prefix) if self.lines else None
        discs = self.discs.get(prefix) if self.discs else None
        return FramePriors(
            self.tilts.get(image_name(prefix)) if self.tilts else None,
            lines.lines if lines else (),
            discs.circles if discs else (),
            self.discs_level,
            (self.mapped.get(prefix) or ()) if self.mapped else (),
        )


class FramesByImage:
    """The frames of a landmark file, by the names of their images; of equal names the last counts.

    The file is indexed once, and a frame's rows are read on request, so they are not kept in
    memory. Malformed files raise a `redetect.landmarks.LandmarkFileError`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offsets: dict[str, int] = {}
        offset = 0
        for row in read_rows(path):
            if isinstance(row.record, Step):
                self._offsets[image_name(row.record.prefix)] = offset
            offset += len(row.source or b"")

    def get(self, prefix: str) -> Frame | None:
        """A frame; None if the file does not have it."""
        offset = self._offsets.get(image_name(prefix))
        if offset is None:
            return None
        with self._path.open("rb") as stream:
            stream.seek(offset)
            return next(frames_of_rows(parse_rows(stream, str(self._path))))


class MapByImage:
    """The discs of a map that should be visible from the frames of a path, by image name.

    Map and path are files of `slam map`; malformed ones raise a `LandmarkFileError`.
    """

    def __init__(self, map_path: Path, path_path: Path) -> None:
        self._discs = read_map(map_path).discs
        path = read_path(path_path)
        self._poses = dict(zip(map(image_name, path.prefixes), path.poses))

    def get(self, prefix: str) -> tuple[CircleLandmark, ...] | None:
        """The discs within reach of a frame's pose; None if the path lacks the frame."""
        pose = self._poses.get(image_name(prefix))
        if pose is None:
            return None
        robot_from_map = rotation(-pose[2])
        xy = (self._discs.xy - pose[:2]) @ robot_from_map.T
        near = np.flatnonzero(np.hypot(*xy.T) <= _REACH_M)
        spread = robot_from_map @ self._discs.covariance[near] @ robot_from_map.T
        return circle_landmarks(xy[near], np.zeros(len(near)), spread, self._discs.ids[near])


KEPT_FAILURES = 100  #: Number of failures whose messages a summary keeps.


@dataclass(frozen=True)
class FramePlan:
    """How every frame of a run is processed. Small, since it is sent with every task.

    Without a camera only markers can be detected; kinds whose settings are None are not detected.
    """

    camera: Camera | None
    lines: LineSettings | None = None
    circles: CircleSettings | None = None
    markers: MarkerSettings | None = None
    json: bool = False  # whether discs are written as JSON as well; set by `detect_run`
    #: Whether discs are not levelled, levelled by the tilt of their own frame, or, after all frames
    #: are processed, by that of the run.
    levelling: Levelling = "frame"
    #: Lean of the camera in the search for discs; set by `detect_run`.
    lean: Tilt | None = None
    #: Whether frames are also searched with their own tilts, if these differ from the lean.
    search_by_frame: bool = True
    working_folder: Path = field(default_factory=Path.cwd)  # where relative paths start from


@dataclass(frozen=True)
class Job:
    """A run to be processed, and the files of its results."""

    run: ImageRun
    plan: FramePlan
    #: The files to write: "circles", "lines", "tilt", "markers", "json" (the discs once more).
    outputs: Mapping[str, Path]
    known: Priors = field(default_factory=Priors)
    #: Path of log, journal and times without their extensions; None: the first of the outputs.
    base: Path | None = None
    command: str = ""  # name of the run in the log
    crlf: bool = False  # whether lines of landmark files end with CRLF
    overwrite: bool = False
    strict: bool = False  # whether the first frame that cannot be processed ends the run
    resume: bool = False  # whether to reuse the finished frames of an interrupted run

    def beside(self, ending: str) -> Path:
        """A file beside the results, with their name and this extension."""
        base = self.base or next(iter(self.outputs.values()))
        return base.with_name(f"{base.name}{ending}")


class FrameTask(NamedTuple):
    """A frame to be processed, prior data on it, and its plan if it is not the run's. Small."""

    frame: RunFrame
    known: FramePriors = FramePriors()
    plan: FramePlan | None = None

    @property
    def name(self) -> object:
        """The frame's name in messages."""
        return self.frame.image or self.frame.step.prefix


class FrameRows(NamedTuple):
    """Result of a frame, some kilobytes: all that a worker sends back."""

    prefix: str
    rows: Mapping[str, str]  # by kind of file: those of `Job.outputs`, and "times"
    found: Mapping[str, int] = {}  # numbers of "discs", "lines", "tilts" and "markers"
    rejected: Mapping[str, int] = {}  # numbers of rejected candidates for markers, by cause
    error: str | None = None  # why there are no landmarks
    evidence: float = 0.0  # sum over the discs


@dataclass
class RunSummary:
    """What was found in a run, and the first `KEPT_FAILURES` reasons why frames failed."""

    frames: int = 0
    found: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    failures: list[str] = field(default_factory=list)
    images_left_out: int = 0  # not part of the run
    known: int = 0  # frames with prior data
    lean: Tilt | None = None  # of the camera in the search for discs
    unlevelled_deg: float | None = None  # sigma of pitch and roll, as some frames show
    tilt: RunTilt | None = None  # used for levelling, if that was by the run

    def add(self, rows: FrameRows) -> None:
        """Count a frame."""
        self.frames += 1
        self.found.update(rows.found)
        self.rejected.update(rows.rejected)
        if rows.error is not None:
            self.failed += 1
            if len(self.failures) < KEPT_FAILURES:
                self.failures.append(rows.error)


def tilts_by_image(path: Path) -> dict[str, FrameTilt]:
    """The tilts of a file by the names of their images; see `redetect.landmarks.read_tilts`."""
    return {image_name(prefix): tilt for prefix, tilt in read_tilts(path).items()}


def rows_of_failure(task: FrameTask, reason: str) -> FrameRows:
    """Output of a frame that could not be processed."""
    step = task.frame.step
    rows = dict.fromkeys(("circles", "lines", "markers"), f"{format_record(step)}\n")
    rows["tilt"] = f"{format_no_tilt(step.prefix, 0)}\n"
    rows["json"] = json_record({"frame": step.prefix, "error": reason})
    rows["times"] = time_row(task)
    return FrameRows(step.prefix, rows, error=reason)


def time_row(task: FrameTask) -> str:
    """The frame's row in a file of times."""
    frame = task.frame
    return "" if frame.time_s is None else f"{format_time(frame.step.prefix, frame.time_s)}\n"


def json_record(record: dict[str, object]) -> str:
    """A record in the list of frames of an indented document."""
    return "\n" + indent(json_text(record), "  ")
