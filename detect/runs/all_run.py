"""Verticals, tilt and discs over a whole run in one pass: three files out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from detect.line_settings import LineSettings
from detect.run import Run
from detect.runs.circles_run import UNKNOWN, DiscIds, circles_file
from detect.runs.conduct import PLAIN, Conduct
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.lines_run import lines_file, tilt_file
from detect.runs.stream import IdSources, LineSource, RunSummary, detect_run
from detect.settings import CircleSettings


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
) -> RunSummary:
    """Detect the verticals, the tilt and the discs of a run, each image decoded once.

    The files are those of `detect.runs.lines_run.detect_lines_run`, followed by
    `detect.runs.circles_run.detect_circles_run` with the tilts that it wrote.

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
        known_level=disc_ids.level,
        id_slack_m=disc_ids.slack_m,
        working_folder=Path.cwd(),
    )
    files = [
        tilt_file(tilt_output, version),
        lines_file(lines_output, lines, version, run, crlf=crlf),
        circles_file(circles_output, circles, version, run, levelled=True, crlf=crlf),
    ]
    return detect_run(
        run,
        plan,
        files,
        overwrite=overwrite,
        ids=IdSources(line_ids, disc_ids.rows, disc_ids.mapped),
        workers=workers,
        on_progress=on_progress,
        conduct=conduct,
    )
