"""Discs over a whole run: frames in, a ``.circles`` file out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from detect.errors import DetectError
from detect.run import Run
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.stream import (
    DiscSource,
    IdSources,
    MapSource,
    Output,
    RunSummary,
    TiltSource,
    detect_run,
    json_file,
)
from detect.settings import CircleSettings
from landmarks import format_head
from storage.bounds import NOT_NEGATIVE, demand


@dataclass(frozen=True)
class DiscIds:
    """Where the IDs of discs come from.

    Attributes
    ----------
    rows : mapping, optional
        Rows with IDs by image prefix: those of the same discs are carried over.
    level : bool
        Whether these rows are corrected for the tilt.
    mapped : mapping, optional
        Discs of a map by image prefix: rows that `rows` knows nothing of get the ID of the one they
        fall on.
    slack_m : float
        Standard deviation of where these are, besides their covariances, metres.
    """

    rows: DiscSource | None = None
    level: bool = False
    mapped: MapSource | None = None
    slack_m: float = 0.1

    def __post_init__(self) -> None:
        demand(self, DetectError, slack_m=NOT_NEGATIVE)


#: No row has an ID.
UNKNOWN = DiscIds()


def detect_circles_run(
    run: Run,
    settings: CircleSettings,
    output: Path,
    *,
    version: str,
    overwrite: bool = False,
    json_output: Path | None = None,
    tilts: TiltSource | None = None,
    pictures: Path | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct = PLAIN,
    ids: DiscIds = UNKNOWN,
    crlf: bool = False,
) -> RunSummary:
    """Detect the discs of a run and write them.

    Parameters
    ----------
    run : Run
        The run.
    settings : CircleSettings
        What to look for.
    output : path
        The ``.circles`` file.
    version : str
        The program's version, for the file's head.
    overwrite : bool
        Whether existing files may be replaced.
    json_output : path, optional
        Where the rows go as JSON as well.
    tilts : mapping, optional
        Tilts by image prefix: the positions of frames that have one are corrected for it.
    pictures : path, optional
        Folder for images with the discs drawn in.
    workers, on_progress, conduct
        As in `detect.runs.stream.detect_run`.
    ids : DiscIds
        Where the rows' IDs come from.
    crlf : bool
        Whether the lines of the ``.circles`` file end with CR and LF.

    Returns
    -------
    RunSummary

    Raises
    ------
    lut.TableError
        If there can be no table for the camera.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    plan = FramePlan(
        run.camera,
        circles=settings,
        json=json_output is not None,
        drawing=None if pictures is None else "discs",
        known_level=ids.level,
        id_slack_m=ids.slack_m,
        working_folder=Path.cwd(),
    )
    as_json = [] if json_output is None else [json_file(json_output, plan, version)]
    file = circles_file(output, settings, version, run, levelled=tilts is not None, crlf=crlf)
    return detect_run(
        run,
        plan,
        [*as_json, file],
        overwrite=overwrite,
        tilts=tilts,
        ids=IdSources(discs=ids.rows, mapped=ids.mapped),
        pictures=pictures,
        workers=workers,
        on_progress=on_progress,
        conduct=conduct,
    )


#: Stand in the head of files whose positions are true level ones, or corrected for the tilt.
LEVEL = "level robot frame"
LEVELLED = "corrected for the tilt of the frames that have one"


def circles_file(
    path: Path,
    settings: CircleSettings,
    version: str,
    run: Run,
    *,
    levelled: bool = False,
    crlf: bool = False,
) -> Output:
    """A ``.circles`` file: what the rows mean and how they were made stands at its head."""
    odometry = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    position = "fitted to the grey values" if settings.refine else "that of the pixel in the middle"
    values = " ".join(f"{k}={v}" for k, v in dataclasses.asdict(settings).items())
    lines = [
        f"Discs on the floor, detected by redetect {version}.",
        "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians.",
        "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>",
        f"  odometry: {odometry}; the image was taken after the step",
        "LANDMARK_C <pX> <pY> <quality> <cXX> <cXY> <cYY> <ID>",
        f"  position {position}; quality is Otsu's, 0 to 1; ID -1: unknown",
        *([f"  positions are {LEVELLED}: # levelled <pitch> <roll>"] if levelled else []),
        f"camera {run.camera}",
        f"settings {values}",
    ]
    head = format_head("\n".join(lines), "\r\n" if crlf else "\n")
    return Output(path, "circles", head, crlf=crlf)
