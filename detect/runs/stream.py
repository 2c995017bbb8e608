"""Processes a run: frames in, files out, neither ever in memory as a whole.

    frames of the run  ->  tasks  ->  workers (`detect.runs.workers`)  ->  rows in order  ->  files

The files have the same bytes with any number of workers; at the end, all of them appear or none.

The rows of each finished frame are appended to the journal (`detect.runs.journal`). However
a run ends (a signal, a full disk, lost workers), it remains, and a resumed run continues after its
frames, provided that program, settings, camera and frames are the same. When all frames are done,
the results are written from the journal to part files and flushed to disk, the journal records
that, and they are renamed, by the next run if the process is killed before.
"""

from __future__ import annotations

import errno
import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import chain

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.projection import Tilt
from detect.runs.journal import Journal, made_by, task_digest
from detect.runs.outputs import log_text, outputs_of
from detect.runs.plan import FramePlan, FrameRows, FrameTask, Job, RunSummary
from detect.runs.workers import WorkerPool, Workers, local_workers
from detect.sources.interface import ImageRun, RunFrame, spread_frames
from redetect.storage import OutputExistsError
from redetect.storage.parts import PartFile, demand_place, folder_locked, left_part, new_part

#: Largest number of frames from which a run's tilt is estimated first, and their largest spacing.
_FIRST_FRAMES = 32
_FIRST_SPACING = 20

_log = logging.getLogger("redetect")


def detect_run(
    job: Job, workers: Workers | None = None, on_progress: Callable[[], None] | None = None
) -> RunSummary:
    """Process every frame of a run by a plan, and write the results.

    Each image is decoded once, except for some from which the camera's lean is estimated first. If
    discs are levelled by the run, the tilt file has the tilts used for that, and those of single
    frames are in another file (`outputs.frames_tilt_place`). By default, this process is the only
    worker; `on_progress` is called once after every frame.

    Raises
    ------
    DetectError
        If another run is writing the same files, no image has odometry, a frame fails in strict
        mode, or the dictionary of markers is unknown.
    lut.TableError, redetect.storage.OutputExistsError, WorkerError
        If no table can be made for the camera, an output exists and must not be replaced, or there
        are no workers.
    """
    workers = workers or local_workers(1, large=job.run.frames.images_in_memory)
    summary = RunSummary()

    def count(rows: FrameRows) -> None:
        summary.add(rows)
        if on_progress is not None:
            on_progress()

    def task(frame: RunFrame) -> FrameTask:
        known = job.known.of(frame.step.prefix)
        summary.known += bool(known)
        return FrameTask(frame, known)

    with ExitStack() as stack:
        pool = stack.enter_context(closing(WorkerPool(workers)))
        plan = replace(job.plan, json="json" in job.outputs)
        plan = with_initial_tilt(job.run, plan, pool)
        if plan.circles != job.plan.circles and plan.circles:
            summary.unlevelled_deg = plan.circles.tilt_sigma_deg
        job, summary.lean = replace(job, plan=plan), plan.lean
        files = stack.enter_context(RunFiles(job))
        source = stack.enter_context(closing(iter(job.run.frames)))
        for frames in pool.detect_chunks(files.take_over(map(task, source), count), plan):
            files.add(frames)
            for _, rows in frames:
                count(rows)
        pool.close()
        summary.images_left_out = left_out = job.run.frames.left_out
        if left_out and not summary.frames:
            raise DetectError(f"{left_out} {job.run.frames.why_left_out}, and none remain")
        written = files.rows()
        if plan.levelling == "run" and plan.camera and plan.lines and plan.circles:
            from detect.runs.level_run import level_run  # loads the compiler

            written = level_run(plan.camera, plan.circles, files.rows, summary)
        files.finish(written, summary)
    return summary


def with_initial_tilt(run: ImageRun, plan: FramePlan, pool: WorkerPool) -> FramePlan:
    """The plan with what some frames of a run show of its tilt.

    That is the camera's lean and, if positions are not levelled by the run, the usual tilt.
    """
    camera, circles = plan.camera, plan.circles
    if not (camera and circles and circles.refine and plan.levelling != "none"):
        return plan
    if run.frames.expected is None or not run.frames.is_recorded:
        return plan
    from detect.runs.level_run import lean_of_search, tilt_of_some  # loads the compiler

    tasks = [FrameTask(frame) for frame in spread_frames(run.frames, _FIRST_FRAMES, _FIRST_SPACING)]
    level = replace(
        plan, lines=plan.lines or LineSettings(), levelling="run", search_by_frame=False
    )

    def rows_by(lean: Tilt | None) -> list[FrameRows]:
        chunks = pool.detect_chunks(tasks, replace(level, lean=lean))
        return [rows for chunk in chunks for _, rows in chunk]

    rows = rows_by(None)
    mean, usual_rad = tilt_of_some(camera, rows)
    if mean is not None and (lean := lean_of_search(mean, rows, rows_by)) is not None:
        # Discs that are found without the lean show less of it.
        plan, usual_rad = replace(plan, lean=lean), max(usual_rad, math.hypot(*lean) / math.sqrt(2))
    known = mean is not None or usual_rad > circles.tilt_sigma_rad
    if known and circles.tilt_sigma_deg is None and plan.levelling != "run":
        circles = replace(circles, tilt_sigma_deg=round(math.degrees(usual_rad), 2))
        plan = replace(plan, circles=circles)
    return plan


class RunFiles:
    """The files of a run: a context manager that begins or resumes its journal, and closes it."""

    def __init__(self, job: Job) -> None:
        self._job, self._outputs = job, outputs_of(job)
        self._base, self._log_path = job.beside(""), job.beside(".log.json")
        self._paths = [*(output.path for output in self._outputs), self._log_path]
        self._made_by = made_by(self._outputs, job.plan)
        self._overwrite = job.overwrite
        self._frames, self._resumes = 0, False
        self._journal: Journal

    # -- beginning ------------------------------------------------------------------------

    def __enter__(self) -> RunFiles:
        places = [os.path.realpath(path) for path in self._paths]
        for path, place in zip(self._paths, places):
            if places.count(place) > 1:  # each would overwrite the one before
                raise DetectError(f"{path}: named for two results: expected a file for each")
        left = left_part(self._base, "journal", named=self._paths[0])
        try:
            if left is not None:
                self._take_up(left)
            self._demand_places()
        except BaseException:
            if left is not None:
                left.close()
            raise
        if not self._resumes:
            if left is not None:
                left.remove()
            self._begin()
        return self

    def _take_up(self, left: PartFile) -> None:
        """Resume a journal that was left, if possible, or complete its run if that had ended."""
        journal = Journal(left)
        self._resumes = self._job.resume and journal.is_by(self._made_by)
        complete = journal.complete()
        if complete is not None:
            _log.info("renaming the files of a run that was killed at its very end")
            numbers, overwrite = complete
            for path, number in zip(self._paths, numbers):
                part = left_part(path, number=number)
                if part is not None:
                    with part:
                        part.replace(path, overwrite=overwrite)
        if self._resumes:
            self._journal = journal
            self._overwrite |= complete is not None  # the files are its own
        elif complete is not None:
            left.remove()
        elif self._job.resume:
            _log.info(
                "the unfinished run had other settings, another camera or another version: "
                "starting again"
            )
        else:
            _log.info("removing the journal of an unfinished run (--resume would continue it)")

    def _begin(self) -> None:
        file = new_part(self._base, "journal", named=self._paths[0])
        self._journal = Journal(file)
        try:
            if file.number > 0:
                place = self._base.with_name(f".{self._base.name}.journal")
                raise DetectError(
                    f"{place}: another run is writing these files: wait for it, or, if it was "
                    "killed on another machine, remove this file"
                )
            self._journal.write([self._made_by])
        except BaseException:
            file.remove()
            raise

    def _demand_places(self) -> None:
        """Raise an error if an existing file must not be replaced, or cannot be."""
        for path in self._paths:
            demand_place(path, overwrite=self._overwrite)

    # -- frames -----------------------------------------------------------------------------

    def take_over(
        self, tasks: Iterator[FrameTask], count: Callable[[FrameRows], None]
    ) -> Iterator[FrameTask]:
        """Reuse the finished frames of the journal, counting each; returns the remaining ones."""
        if not self._resumes:
            return tasks
        beyond: list[FrameTask] = []
        for digest, rows in self._journal.frames():
            task = next(tasks, None)
            if task is None or digest != task_digest(task):
                beyond = [] if task is None else [task]
                break
            self._demand_strictly(rows)
            self._frames += 1
            count(rows)
        self._journal.cut()
        _log.info("%d frames of an unfinished run are reused", self._frames)
        return chain(beyond, tasks)

    def add(self, frames: Sequence[tuple[FrameTask, FrameRows]]) -> None:
        """Write the next frames to the journal; if one has failed, a strict run keeps nothing."""
        if self._job.strict and any(rows.error is not None for _, rows in frames):
            self._journal.file.remove()
        for _, rows in frames:
            self._demand_strictly(rows)
        self._journal.write_frames(frames)
        self._frames += len(frames)

    def _demand_strictly(self, rows: FrameRows) -> None:
        if rows.error is not None and self._job.strict:
            raise DetectError(f"{rows.error} (--strict: nothing is written)")

    # -- ending -----------------------------------------------------------------------------

    def rows(self) -> Iterator[Mapping[str, str]]:
        """The rows of each frame, by kind; can be read more than once."""
        return (rows.rows for _, rows in self._journal.frames())

    def finish(self, rows_of_frames: Iterable[Mapping[str, str]], summary: RunSummary) -> None:
        """Write the results, and move them to their final paths."""
        if not self._journal.file.is_in_place():
            # The folder may have been replaced by another one: nothing in it is touched.
            raise FileNotFoundError(errno.ENOENT, "the run's journal is gone", str(self._paths[0]))
        with ExitStack() as stack:
            parts = [stack.enter_context(new_part(path)) for path in self._paths]
            results = list(zip(self._outputs, parts))
            for output, part in results:
                part.stream.write(output.encoded(output.head))
            separators = dict.fromkeys((output.kind for output in self._outputs), "")
            for rows in rows_of_frames:
                for output, part in results:
                    if text := rows.get(output.kind):
                        part.stream.write(output.encoded(separators[output.kind] + text))
                        separators[output.kind] = output.between
            for output, part in results:
                part.stream.write(output.encoded(output.tail))
            failures = [
                {"frame": number, "prefix": rows.prefix, "reason": rows.error}
                for number, (_, rows) in enumerate(self._journal.frames())
                if rows.error is not None
            ]
            parts[-1].stream.write(log_text(self._job, summary, failures).encode())
            for part in parts:
                part.sync()
            self._place(parts)
        self._journal.file.remove()

    def _place(self, parts: Sequence[PartFile]) -> None:
        with folder_locked(self._log_path.parent):
            self._demand_places()
            self._journal.write_complete([part.number for part in parts], overwrite=self._overwrite)
            try:
                for path, part in zip(self._paths, parts):
                    part.replace(path, overwrite=self._overwrite)
            except OutputExistsError:
                raise
            except BaseException:
                for part in parts:
                    part.close()  # the next run continues with it
                raise

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        journal = self._journal.file
        if (
            isinstance(error, OutputExistsError)  # another process was first
            or not (self._frames or self._resumes)
            or journal.stream.closed
            or not journal.is_in_place()
        ):
            journal.remove()
            return
        journal.close()
        if self._frames:
            _log.info("%d frames are kept: --resume continues after them", self._frames)
