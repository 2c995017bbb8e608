"""The files of a run: its journal while it lasts, then its results.

The rows of each frame that is done go to the journal (`detect.runs.journal`). However a run ends,
by a signal, a full disk, workers that are gone, they are there, and a run that resumes goes on
after them:

    journal fits program, settings, camera  ->  its frames are those of the run  ->  the journal is
    cut off after the last of them, and grows on

When all frames are done, the results are written from the journal to parts (`storage.parts`) and
brought to the disk; the journal says so; they take their places. A process killed in between leaves
this last step to the next run. A run without a log has a journal without a name.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from itertools import chain
from pathlib import Path
from types import TracebackType

from detect.errors import DetectError
from detect.runs.frame import FramePlan, FrameTask
from detect.runs.journal import (
    Journal,
    JournalFrame,
    JournalHead,
    journal_place,
    left_journal,
    made_by,
    new_journal,
    record_of,
    task_digest,
    unnamed_journal,
)
from detect.runs.outputs import (
    LOG,
    Conduct,
    Output,
    demand_log_place,
    log_failure,
    log_head,
    log_tail,
)
from detect.runs.rows import FrameRows, RunSummary
from storage import OutputExistsError
from storage.parts import PartFile, folder_locked, left_part, new_part

_log = logging.getLogger("redetect")

#: Rows of each frame, by kind, in the order of the run.
RowsOfFrames = Iterable[Mapping[str, bytes]]
#: Makes the rows that are written from those of the frames, which can be read more than once.
SecondPass = Callable[[Callable[[], RowsOfFrames]], RowsOfFrames]


class FailedFrameError(DetectError):
    """A frame that could not be worked on, where every frame is demanded."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"{reason} (--strict: nothing is written)")


class RunFiles:
    """The files of a run: a context manager that begins or resumes its journal, and ends it.

    Parameters
    ----------
    outputs : sequence of Output
        The files.
    plan : FramePlan
        The plan for every frame.
    conduct : Conduct
        Whether there are a log and a run to be resumed.

    Raises
    ------
    OSError, OutputExistsError, DetectError
        On entering, if a file cannot be written, or must not be.
    """

    def __init__(self, outputs: Sequence[Output], plan: FramePlan, conduct: Conduct) -> None:
        self._conduct = conduct
        self._made_by = made_by(outputs, plan, conduct)
        self._outputs = list(outputs)
        if conduct.log is not None:
            self._outputs.append(Output(conduct.log, LOG, log_head(plan, conduct), between=b","))
        self._kinds = [output.kind for output in self._outputs]
        self._journal: Journal | None = None
        self._frames = self._taken_over = 0
        self._resumes = self._done = False

    # -- beginning ------------------------------------------------------------------------

    def __enter__(self) -> RunFiles:
        places = [Path(os.path.realpath(o.path.parent), o.path.name) for o in self._outputs]
        for output, place in zip(self._outputs, places):
            if places.count(place) > 1:  # the last one would be all there is
                raise DetectError(f"{output.path}: named for two results: expected a file for each")
        log, result, left = self._conduct.log, self._outputs[0].path, None
        if log is not None:
            left = left_journal(journal_place(log), result)
        if left is not None:
            try:
                self._look_at(left)
            finally:
                if left is not self._journal:
                    left.close()
        if self._journal is None:
            self._demand_new()
            self._journal = self._begun(None if log is None else journal_place(log), result)
            try:
                self._journal.write(JournalHead(self._made_by, self._conduct.overwrite))
            except BaseException:
                self._journal.remove()
                raise
        return self

    def _begun(self, place: Path | None, result: Path) -> Journal:
        journal = None if place is None else new_journal(place, result)
        if journal is not None:
            return journal
        if place is not None and not self._conduct.overwrite:
            raise DetectError(
                f"{place}: another run is writing these files: wait for it, or, if it was killed "
                "on another machine, remove this file"
            )
        if place is not None:
            _log.info("another run is writing these files: this one cannot be resumed")
        return unnamed_journal(result)

    def _demand_new(self) -> None:
        """Refuse to replace what must not be, or cannot be."""
        for path in (output.path for output in self._outputs):
            if not path.parent.is_dir():
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
            if path.is_dir() and not path.is_symlink():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            if not self._may_replace(path) and os.path.lexists(path):
                raise OutputExistsError(path)
        if self._conduct.log is not None:
            demand_log_place(self._conduct.log, overwrite=self._conduct.overwrite)

    def _may_replace(self, path: Path) -> bool:
        """Whether an existing file may be replaced: the log always, if it is one."""
        return self._conduct.overwrite or path == self._conduct.log

    def _look_at(self, left: Journal) -> None:
        """Complete, take over, or remove what an interrupted run left."""
        head, parts = left.head(), left.parts()
        fits = head is not None and head.made_by == self._made_by
        resume = self._conduct.resume and head is not None
        if head is not None and parts is not None and len(parts) == len(self._outputs):
            _log.info("the files of a run that was killed at its very end take their places")
            for output, number in zip(self._outputs, parts):
                part = left_part(output.path, number)
                if part is not None:
                    with closing(part):
                        part.place(overwrite=head.overwrite or self._may_replace(output.path))
            if fits and resume:
                self._journal, self._done = left, True
            else:
                left.remove()
            return
        self._demand_new()
        if fits and resume:
            self._journal, self._resumes = left, True
            return
        if resume:
            _log.info(
                "what an unfinished run left was made with other settings, another camera or "
                "version: beginning anew"
            )
        else:
            _log.info("removing what an unfinished run left (--resume would have gone on with it)")
        left.remove()

    # -- frames -----------------------------------------------------------------------------

    def take_over(
        self, tasks: Iterator[FrameTask], count: Callable[[FrameRows], None]
    ) -> Iterator[FrameTask]:
        """Take over the frames that are done already.

        Parameters
        ----------
        tasks : iterator of FrameTask
            The frames of the run.
        count : callable
            Called with the rows of each frame that is taken over.

        Returns
        -------
        iterator of FrameTask
            The frames that remain to be done.
        """
        assert self._journal is not None
        if self._done:
            for frame in self._journal.frames():
                count(frame.frame_rows())
            return iter(())
        if not self._resumes:
            return tasks
        beyond: list[FrameTask] = []
        for frame in self._journal.frames():
            task = next(tasks, None)
            if task is None or frame.task != task_digest(task):
                beyond = [] if task is None else [task]
                break
            if frame.error is not None and self._conduct.strict:
                raise FailedFrameError(frame.error)
            self._frames += 1
            count(frame.frame_rows())
        self._journal.cut()
        self._taken_over = self._frames
        _log.info("%d frames of an unfinished run are taken over", self._frames)
        return chain(beyond, tasks)

    @property
    def may_replace_pictures(self) -> bool:
        """Whether pictures of the next frame may be replaced.

        The run that is resumed may have drawn it before it ended.
        """
        return self._conduct.overwrite or (self._resumes and self._frames == self._taken_over)

    def add(self, frames: Iterable[tuple[FrameTask, FrameRows]]) -> None:
        """Note frames, the next ones.

        Raises
        ------
        OSError
            If they cannot be written.
        FailedFrameError
            If one of them could not be worked on, and every frame is demanded.
        """
        assert self._journal is not None
        records: list[JournalFrame] = []
        for task, rows in frames:
            if rows.error is not None:
                if self._conduct.strict:
                    self._journal.remove()
                    raise FailedFrameError(rows.error)
                place = self._frames + len(records)
                failure = log_failure(place, task.frame.step.prefix, rows.error)
                rows = rows._replace(rows={**rows.rows, LOG: failure})
            records.append(record_of(task, rows, self._kinds))
        self._journal.write(*records)
        self._frames += len(records)

    # -- ending -----------------------------------------------------------------------------

    def finish(self, found: RunSummary, second_pass: SecondPass | None = None) -> None:
        """Write the results, and move them to their final paths.

        Raises
        ------
        OSError, OutputExistsError
            If they cannot.
        """
        assert self._journal is not None
        if self._done:  # by a run that was killed at its very end
            return
        if self._journal.place is not None and not self._journal.is_in_place():
            # Another folder may have come in its place: nothing in it is touched.
            raise FileNotFoundError(
                errno.ENOENT, "the run's journal is gone", str(self._outputs[0].path)
            )
        with ExitStack() as stack:
            files = [_Result(o, stack.enter_context(new_part(o.path))) for o in self._outputs]
            for rows in self._rows() if second_pass is None else second_pass(self._rows):
                for file in files:
                    file.add(rows.get(file.output.kind, b""))
            written: list[dict[str, object]] = []
            for file in files:
                is_log = file.output.kind == LOG
                file.end(log_tail(found, written) if is_log else file.output.tail)
                written.append(file.described())
            self._place(files)
        self._done = True

    def _rows(self) -> Iterator[Mapping[str, bytes]]:
        assert self._journal is not None
        return (frame.frame_rows().rows for frame in self._journal.frames())

    def _place(self, files: Sequence[_Result]) -> None:
        assert self._journal is not None
        with folder_locked(self._outputs[-1].path.parent), ExitStack() as replaced:
            for path in (output.path for output in self._outputs):
                if not self._may_replace(path) and os.path.lexists(path):
                    raise OutputExistsError(path)
                # The disk space of a replaced file is freed when no process has it open any
                # more. That takes much longer than to replace it, and so happens behind the last
                # one: hardly any kill falls between the calls that replace them.
                if path.is_file():
                    with suppress(OSError):
                        replaced.enter_context(path.open("rb"))
            self._journal.complete([file.part.number for file in files])
            try:
                for file in files:
                    file.part.place(overwrite=self._may_replace(file.output.path))
            except OutputExistsError:
                raise
            except BaseException:
                for file in files:
                    file.part.close()  # the next run goes on with it
                raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        assert self._journal is not None
        worth_keeping = (
            not self._done
            and not isinstance(error, OutputExistsError)  # another process was faster
            and self._journal.is_in_place()
            and (self._frames > 0 or self._resumes)
        )
        if not worth_keeping:
            self._journal.remove()
            return
        self._journal.close()
        if self._frames:
            _log.info("%d frames are kept: --resume goes on after them", self._frames)


class _Result:
    """A result while it is written."""

    def __init__(self, output: Output, part: PartFile) -> None:
        self.output, self.part = output, part
        self._size, self._digest, self._has_rows = 0, hashlib.sha256(), False
        self._write(output.head)

    def add(self, rows: bytes) -> None:
        """Write the rows of a frame."""
        if rows:
            self._write(self.output.between + rows if self._has_rows else rows)
            self._has_rows = True

    def end(self, tail: bytes) -> None:
        """Write what comes behind them, and bring all of it to the disk."""
        self._write(tail)
        self.part.sync()

    def described(self) -> dict[str, object]:
        """Name, size and hash, for the log."""
        sha256 = self._digest.hexdigest()
        return {"name": self.output.path.name, "bytes": self._size, "sha256": sha256}

    def _write(self, text: bytes) -> None:
        content = text.replace(b"\n", b"\r\n") if self.output.crlf else text
        self.part.stream.write(content)
        self._size += len(content)
        self._digest.update(content)
