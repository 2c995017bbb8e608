"""Verticals over a whole run: frames in, a ``.lines`` and a ``.tilt`` file out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from detect.line_settings import LineSettings
from detect.run import Run
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.stream import IdSources, LineSource, Output, RunSummary, detect_run
from landmarks import format_head


def detect_lines_run(
    run: Run,
    settings: LineSettings,
    output: Path,
    tilt_output: Path,
    *,
    version: str,
    overwrite: bool = False,
    reference: LineSource | None = None,
    pictures: Path | None = None,
    drawing: Literal["lines", "tracks"] = "lines",
    draw_response: bool = False,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct = PLAIN,
    crlf: bool = False,
) -> RunSummary:
    """Detect the verticals of a run and write them, with the tilt that they show.

    Parameters
    ----------
    run : Run
        The run.
    settings : LineSettings
        What to look for.
    output, tilt_output : path
        The ``.lines`` and the ``.tilt`` file (see `landmarks.tilts`).
    version : str
        The program's version, for the files' heads.
    overwrite : bool
        Whether existing files may be replaced.
    reference : mapping, optional
        Rows with IDs by image prefix: carried over where the match is unambiguous.
    pictures : path, optional
        Folder for images with the lines drawn in,
    drawing : {"lines", "tracks"}
        or with all tracks,
    draw_response : bool
        and for images of the filter's response.
    workers, on_progress, conduct
        As in `detect.runs.stream.detect_run`.
    crlf : bool
        Whether the lines of the ``.lines`` file end with CR and LF.

    Returns
    -------
    RunSummary

    Raises
    ------
    storage.OutputExistsError
        If an output exists and must not be replaced.
    """
    plan = FramePlan(
        run.camera,
        lines=settings,
        drawing=None if pictures is None else drawing,
        draw_response=pictures is not None and draw_response,
        working_folder=Path.cwd(),
    )
    return detect_run(
        run,
        plan,
        [tilt_file(tilt_output, version), lines_file(output, settings, version, run, crlf=crlf)],
        overwrite=overwrite,
        ids=None if reference is None else IdSources(lines=reference),
        pictures=pictures,
        workers=workers,
        on_progress=on_progress,
        conduct=conduct,
    )


def lines_file(
    path: Path, settings: LineSettings, version: str, run: Run, *, crlf: bool = False
) -> Output:
    """A ``.lines`` file: what the rows mean and how they were made stands at its head."""
    odometry = run.odometry.name if run.odometry is not None else "none: the steps are zeros"
    values = " ".join(
        f"{k}={str(v).replace(' ', '')}" for k, v in dataclasses.asdict(settings).items()
    )
    sign = "compensated for the tilt"
    if settings.alpha == "published":
        sign += ", with the data set's own sign"
    lines = [
        f"Verticals of the building, detected by redetect {version}.",
        "Robot frame: origin on the floor, X left, Y backward (forward is -Y), metres, radians.",
        "STEP <image> <dX> <dY> <dPhi> <cXX> <cXY> <cYY> <cXPhi> <cYPhi> <cPhiPhi>",
        f"  odometry: {odometry}; the image was taken after the step",
        "LANDMARK_L <xTop> <yTop> <xBottom> <yBottom> <alpha> <beta> <quality> <sigma> <ID>",
        "  ends: undistorted normalised coordinates; beta: inclination of the plane's normal",
        f"  alpha: bearing (0 forward, positive to the left), {sign}; sigma: its deviation",
        f"camera {run.camera}",
        f"settings {values}",
    ]
    head = format_head("\n".join(lines), "\r\n" if crlf else "\n")
    return Output(path, "lines", head, crlf=crlf)


def tilt_file(path: Path, version: str) -> Output:
    """A ``.tilt`` file: what the rows mean stands at its head."""
    lines = [
        f"Pitch and roll of each frame from the building's verticals, by redetect {version}.",
        "TILT <image> <pitch> <roll> <cPP> <cPR> <cRR> <lines>",
        "  rotation vector (pitch, roll, 0) about the robot's X (left) and Y (backward), radians:",
        "  it turns directions measured with the calibrated mounting level; its covariance;",
        "  and the number of verticals that agree with it",
        "NOTILT <image> <lines>: too few lines agree",
    ]
    return Output(path, "tilt", format_head("\n".join(lines)))
