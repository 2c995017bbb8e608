"""Processes a run: frames in, files out, neither ever in memory as a whole.

    frames of the run  ->  tasks  ->  workers (`detect.runs.dispatch`)  ->  rows in order  ->  files

The files have the same bytes with any number of workers; they appear together at the end, or not at
all.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from detect.errors import DetectError
from detect.runs.dispatch import Workers, detect_chunks
from detect.runs.plan import FrameRows, FrameTask, Job, RunSummary
from detect.runs.run_files import RunFiles
from detect.runs.workers import local_workers
from redetect.storage import write_whole


def detect_run(
    job: Job, workers: Workers | None = None, on_progress: Callable[[], None] | None = None
) -> RunSummary:
    """Process every frame of a run by a plan, and write the results.

    Each image is decoded once. Levelled by frames, discs and lines together give the files that
    they give one after the other, with the tilts that were written. Levelled by the run, the tilt
    file has the tilts that the discs were levelled by, and the single frames' are in another one
    (`detect.runs.outputs.frames_tilt_place`).

    Parameters
    ----------
    job : Job
    workers : Workers, optional
        The workers; by default this process (see `detect.runs.workers`).
    on_progress : callable, optional
        Called once after every frame.

    Returns
    -------
    RunSummary

    Raises
    ------
    lut.TableError
        If there can be no table for the camera.
    redetect.storage.OutputExistsError
        If an output exists and must not be replaced.
    WorkerError
        If there are no workers.
    DetectError
        If another run is writing the same files, a frame fails where every frame is demanded, or
        there is no such dictionary of markers.
    """
    plan = replace(job.plan, json="json" in job.places)
    job = replace(job, plan=plan)
    if job.pictures is not None:
        make_folder(job.pictures)
    workers = workers or local_workers(1, large=job.ships_images)
    summary = RunSummary()

    def count(rows: FrameRows) -> None:
        summary.add(rows)
        if on_progress is not None:
            on_progress()

    with ExitStack() as stack:
        files = stack.enter_context(RunFiles(job))
        tasks = files.take_over(stack.enter_context(closing(_tasks(job))), count)
        for frames in stack.enter_context(closing(detect_chunks(tasks, plan, workers))):
            if job.pictures is not None:
                _write_pictures(frames, job.pictures, overwrite=files.may_replace_pictures)
            files.add(frames)
            for _, rows in frames:
                count(rows)
        summary.images_without_step = job.run.images_without_step
        written = files.rows()
        if plan.levelling == "run" and plan.camera and plan.lines and plan.circles:
            from detect.runs.level_run import level_run  # loads the compiler

            written = level_run(plan.camera, plan.circles.tilt_sigma_deg, files.rows, summary)
        files.finish(written, summary)
    return summary


def make_folder(folder: Path) -> None:
    """A folder for results, if there is none yet."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise DetectError(
            f"{folder}: is no folder: expected one, or the name of a new one"
        ) from None


def _tasks(job: Job) -> Generator[FrameTask, None, None]:
    with closing(iter(job.run.frames)) as frames:
        for frame in frames:
            yield FrameTask(frame, job.known.of(frame.step.prefix))


def _write_pictures(
    frames: Sequence[tuple[FrameTask, FrameRows]], folder: Path, *, overwrite: bool
) -> None:
    for _, rows in frames:
        for name, picture in rows.pictures:
            with write_whole(folder / name, overwrite=overwrite) as stream:
                stream.write(picture)
