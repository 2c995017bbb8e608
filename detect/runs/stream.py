"""Processes a run: frames in, files out, neither ever in memory as a whole.

    frames of the run  ->  tasks  ->  workers (`detect.runs.dispatch`)  ->  rows in order  ->  files

The files have the same bytes with any number of workers; they appear together at the end, or not at
all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from detect.errors import DetectError
from detect.markers.dictionaries import templates_of
from detect.run import ImageRun
from detect.runs.dispatch import Workers, detect_chunks
from detect.runs.frame import FramePlan, FrameTask, tables_of
from detect.runs.known import Known
from detect.runs.outputs import Conduct, outputs_of
from detect.runs.rows import FrameRows, RunSummary
from detect.runs.run_files import RunFiles, SecondPass
from detect.runs.workers import local_workers
from storage import write_whole


def detect_run(
    run: ImageRun,
    plan: FramePlan,
    places: Mapping[str, Path],
    *,
    known: Known | None = None,
    pictures: Path | None = None,
    workers: Workers | None = None,
    on_progress: Callable[[], None] | None = None,
    conduct: Conduct | None = None,
) -> RunSummary:
    """Process every frame of a run by a plan, and write the results.

    Each image is decoded once. Levelled by frames, discs and lines together give the files that
    they give one after the other, with the tilts that were written. Levelled by the run, the tilt
    file has the tilts that the discs were levelled by, and the single frames' are in another one
    (`detect.runs.outputs.frames_tilt_place`).

    Parameters
    ----------
    run : ImageRun
        The run; without a calibration, only markers can be detected.
    plan : FramePlan
        The landmarks to detect.
    places : mapping
        The files to write, by kind: "circles", "lines", "tilt", "markers", "json" (the discs once
        more). Where the frames' times are known, they go beside them.
    known : Known, optional
        Prior data on the frames.
    pictures : path, optional
        Folder for the plan's pictures.
    workers : Workers, optional
        The workers; by default this process (see `detect.runs.workers`).
    on_progress : callable, optional
        Called once after every frame.
    conduct : Conduct, optional
        Whether files may be replaced, whether there are a log and a journal, how bad frames are
        met, and whether an unfinished run is resumed.

    Returns
    -------
    RunSummary

    Raises
    ------
    lut.TableError
        If there can be no table for the camera.
    storage.OutputExistsError
        If an output exists and must not be replaced.
    WorkerError
        If there are no workers.
    DetectError
        If another run is writing the same files, a frame fails where every frame is demanded, or
        there is no such dictionary of markers.
    """
    known = Known() if known is None else known
    conduct = Conduct() if conduct is None else conduct
    plan = replace(plan, json="json" in places, working_folder=Path.cwd())
    levelled = plan.levelling != "none" and (plan.lines is not None or known.tilts is not None)
    outputs = outputs_of(run, plan, places, conduct, levelled=levelled)
    files = RunFiles(outputs, plan, conduct)
    if pictures is not None:
        make_folder(pictures)
    if workers is None:
        large = pictures is not None or run.frames.ships_images
        workers = local_workers(1, large=large)
    _demand_possible(plan, workers)
    summary = RunSummary()

    def count(rows: FrameRows) -> None:
        summary.add(rows)
        if on_progress is not None:
            on_progress()

    with ExitStack() as stack:
        stack.enter_context(files)
        tasks = files.take_over(stack.enter_context(closing(_tasks(run, known))), count)
        for chunk in stack.enter_context(closing(detect_chunks(tasks, plan, workers))):
            # A frame whose picture is there is noted before the next picture is.
            for frames in [chunk] if pictures is None else [[frame] for frame in chunk]:
                if pictures is not None:
                    _write_pictures(frames[0][1], pictures, overwrite=files.may_replace_pictures)
                files.add(frames)
                for _, rows in frames:
                    count(rows)
        summary.images_without_step = run.images_without_step
        files.finish(summary, _second_pass(plan, summary))
    return summary


def make_folder(folder: Path) -> None:
    """A folder for results, if there is none yet."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DetectError(
            f"{folder}: is no folder: expected one, or the name of a new one"
        ) from None


def _demand_possible(plan: FramePlan, workers: Workers) -> None:
    """Refuse what would fail for every frame, as far as this process can check quickly."""
    if plan.markers is not None:
        templates_of(plan.markers.dictionary, plan.markers.ids)
    if not workers.tell_of_tables:
        tables_of(plan)


def _second_pass(plan: FramePlan, summary: RunSummary) -> SecondPass | None:
    """The second pass over the files of the frames, if there is one."""
    if plan.levelling != "run" or not (plan.camera and plan.lines and plan.circles):
        return None
    from detect.runs.level_run import level_run

    return partial(level_run, plan.camera, math.radians(plan.circles.tilt_sigma_deg), summary)


def _write_pictures(rows: FrameRows, folder: Path, *, overwrite: bool) -> None:
    for name, picture in rows.pictures:
        with write_whole(folder / name, overwrite=overwrite) as stream:
            stream.write(picture)


def _tasks(run: ImageRun, known: Known) -> Generator[FrameTask, None, None]:
    with closing(iter(run.frames)) as frames:
        for frame in frames:
            yield FrameTask(frame, known.of(frame.step.prefix))
