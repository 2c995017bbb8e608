"""Verticals, tilt and discs over a whole run in one pass: three files out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from detect.line_settings import LineSettings
from detect.run import Run
from detect.run_tilt import RunTilt
from detect.runs.circles_run import UNKNOWN, DiscIds, circles_file
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.level_run import LevelRun, applied_tilt_file
from detect.runs.lines_run import lines_file, tilt_file
from detect.runs.stream import IdSources, LineSource, Output, RunSummary, detect_run
from detect.settings import CircleSettings, Levelling


def detect_all_run(
    run: Run,
    lines: LineSettings,
    circles: CircleSettings,
    lines_output: Path,
    tilt_output: Path,
    circles_output: Path,
    *,
    version: str,
    overwrite: bool = False,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct = PLAIN,
    disc_ids: DiscIds = UNKNOWN,
    line_ids: LineSource | None = None,
    crlf: bool = False,
    levelling: Levelling = "none",
    on_lean: Callable[[RunTilt], None] | None = None,
) -> RunSummary:
    """Detect the verticals, the tilt and the discs of a run, each image decoded once.

    Levelled by frames, the files are those of `detect.runs.lines_run.detect_lines_run`, followed by
    `detect.runs.circles_run.detect_circles_run` with the tilts that it wrote. Levelled by the run,
    the tilt file has the tilts that the discs were levelled by, and the single frames' are in
    another one (see `frames_tilt_place`).

    Parameters
    ----------
    run : Run
        The run.
    lines : LineSettings
        Which verticals to look for.
    circles : CircleSettings
        Which discs to look for.
    lines_output, tilt_output, circles_output : path
        The files.
    version : str
        The program's version, for the files' heads.
    overwrite : bool
        Whether existing files may be replaced.
    workers, on_progress, conduct
        As in `detect.runs.stream.detect_run`.
    disc_ids : DiscIds
        Where the IDs of discs come from.
    line_ids : mapping, optional
        Lines with IDs by image prefix: carried over where the match is unambiguous.
    crlf : bool
        Whether the lines of the files of landmarks end with CR and LF.
    levelling : {"none", "frame", "run"}
        By what the discs are corrected for the tilt.
    on_lean : callable, optional
        Called with the run's tilt, if the discs are levelled by it.

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
        lines=lines,
        circles=circles,
        levelling=levelling,
        known_level=disc_ids.level,
        id_slack_m=disc_ids.slack_m,
        working_folder=Path.cwd(),
    )
    found = circles_file(
        circles_output, circles, version, run, levelled=levelling != "none", crlf=crlf
    )
    files = [
        tilt_file(tilt_output, version),
        lines_file(lines_output, lines, version, run, crlf=crlf),
        found,
    ]
    second_pass = None
    if levelling == "run":
        frames_tilt = tilt_file(frames_tilt_place(tilt_output), version)
        raw = Output(raw_place(circles_output), "circles", found.head, placed=False)
        applied = replace(applied_tilt_file(tilt_output, version), part="late")
        files = [frames_tilt, files[1], raw, applied, replace(found, part="late")]
        second_pass = LevelRun(
            camera=run.camera,
            tilt_sigma_rad=math.radians(circles.tilt_sigma_deg),
            frames_tilt=frames_tilt.path.name,
            raw=raw.path.name,
            tilt=applied.path.name,
            circles=found.path.name,
            crlf=crlf,
            on_lean=on_lean,
        )
    return detect_run(
        run,
        plan,
        files,
        overwrite=overwrite,
        ids=IdSources(line_ids, disc_ids.rows, disc_ids.mapped),
        workers=workers,
        on_progress=on_progress,
        conduct=conduct,
        second_pass=second_pass,
    )


def frames_tilt_place(tilt_output: Path) -> Path:
    """The file of the single frames' tilts beside that of the tilts that discs are levelled by."""
    return tilt_output.with_name(f"{tilt_output.stem}.frames.tilt")


def raw_place(circles_output: Path) -> Path:
    """Where the discs grow that are not levelled yet."""
    return circles_output.with_name(f"{circles_output.stem}.raw.circles")
