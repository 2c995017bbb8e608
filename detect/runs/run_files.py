"""The files of a run while they grow, so that an interrupted run keeps its completed frames.

The rows of the frames that a worker gives back together are written at once to the parts of the
files (`storage.parts`), then noted in the journal (`detect.runs.journal`). However a run ends, by a
signal, a full disk, workers that are gone, what is noted is there, and a run that resumes goes on
after it:

    journal fits program, settings, camera  ->  its frames are those of the run  ->  the rows are
    those that it noted  ->  the parts are cut off after the last of them, and grow on

When all frames are done, everything is brought to the disk, the journal says that the files are
complete, and they take their places. A process killed in between leaves this last step to the next
run. Runs of the library without a log have no journal; their files grow and appear the same way.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from detect.errors import DetectError
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan, FrameTask
from detect.runs.journal import (
    Journal,
    JournalFrame,
    JournalHead,
    digest_of,
    journal_place,
    left_journal,
    made_by,
    new_journal,
    task_digest,
)
from detect.runs.outputs import LATE_KINDS, LOG, Output
from detect.runs.rows import FrameRows, RunSummary
from detect.runs.run_log import (
    FailedFrameError,
    demand_log_place,
    log_failure,
    log_head,
    log_tail,
)
from storage import OutputExistsError
from storage.parts import PartFile, folder_locked, left_part, new_part, remove_left_part

_log = logging.getLogger("redetect")

# Makes the rows of files that follow from others, given those by kind: yields kind and rows.
SecondPass = Callable[[Mapping[str, BinaryIO]], Iterable[tuple[str, bytes]]]


class _GrowingFile:
    """A file of a run, its part, and its size."""

    def __init__(self, output: Output, part: PartFile) -> None:
        self.output, self.part = output, part
        self.size = 0
        self.digest = hashlib.sha256()
        self.has_rows = False

    def next_rows(self, rows: bytes) -> bytes:
        """The bytes that a frame adds, from its rows."""
        between = self.output.between if self.has_rows and rows else b""
        self.has_rows = self.has_rows or bool(rows)
        return between + self.output.ended(rows)

    def write(self, content: bytes) -> None:
        """Write at once, all of it."""
        if content:
            self.part.write(content)
            self.count(content)

    def count(self, content: bytes) -> None:
        """Count the existing content."""
        self.size += len(content)
        self.digest.update(content)


class RunFiles:
    """The files of a run: a context manager that opens them, and keeps or removes partial files.

    Parameters
    ----------
    outputs : sequence of Output
        The files.
    plan : FramePlan
        The plan for every frame.
    conduct : Conduct
        Whether there are a log and a journal, and a run to be resumed.

    Raises
    ------
    OSError, OutputExistsError, DetectError
        If a file cannot be written, or must not be.
    """

    def __init__(self, outputs: Sequence[Output], plan: FramePlan, conduct: Conduct) -> None:
        self._conduct = conduct
        self._made_by = made_by(outputs, plan, conduct)
        self._outputs = list(outputs)
        if conduct.log is not None:
            self._outputs.append(Output(conduct.log, LOG, log_head(plan, conduct), between=b","))
        self._files: list[_GrowingFile] = []
        self._journal: Journal | None = None
        self._kept: Iterator[JournalFrame] = iter(())
        self._frames = self._taken_over = self._noted = 0
        self._resumes = self._done = False
        places = [Path(os.path.realpath(o.path.parent), o.path.name) for o in self._outputs]
        for output, place in zip(self._outputs, places):
            if places.count(place) > 1:  # the last one would be all there is
                raise DetectError(f"{output.path}: named for two results: expected a file for each")
        # If there is a journal, existing files may be those of a killed run: checked later.
        if conduct.log is None or not journal_place(conduct.log).exists():
            self._demand_new()

    # -- beginning ------------------------------------------------------------------------

    def __enter__(self) -> RunFiles:
        try:
            left = None
            if self._conduct.log is not None:
                left = left_journal(journal_place(self._conduct.log))
            if left is not None:
                self._look_at(left)
            if not self._done and not self._resumes:
                self._begin()
        except BaseException:
            self._discard()
            raise
        return self

    def _begin(self) -> None:
        self._demand_new()
        overwrite = self._conduct.overwrite
        if self._conduct.log is not None:
            place = journal_place(self._conduct.log)
            self._journal = new_journal(place)
            if self._journal is None and not overwrite:
                raise DetectError(
                    f"{place}: another run is writing these files: wait for it, or, if it was "
                    "killed on another machine, remove this file"
                )
            if self._journal is None:
                _log.info("another run is writing these files: this one keeps no journal")
        for output in self._outputs:
            self._files.append(_GrowingFile(output, new_part(output.path)))
            self._files[-1].write(output.head)
        if self._journal is not None:
            numbers = [file.part.number for file in self._files]
            self._journal.write([JournalHead(self._made_by, numbers, overwrite)])

    def _demand_new(self) -> None:
        """Refuse to replace what must not be, or cannot be."""
        for path in (output.path for output in self._outputs if output.placed):
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
        """Complete, take over, or remove the files of an interrupted run."""
        try:
            head = left.head()
            numbers = () if head is None else head.parts
            fits = head is not None and head.made_by == self._made_by
            resume = self._conduct.faults.resume and head is not None
            if len(numbers) == len(self._outputs) and head is not None and left.is_complete():
                _log.info("the files of a run that was killed at its very end take their places")
                self._place_left(head)
                self._done = fits and resume
                self._kept = iter(list(left.frames()) if self._done else [])
                left.remove()
                return
            self._demand_new()
            if resume and fits and self._takes_over(numbers):
                self._journal, self._kept, self._resumes = left, left.frames(), True
                return
            if resume and fits:
                _log.info("what an unfinished run left is not complete: beginning anew")
            elif resume:
                _log.info(
                    "what an unfinished run left was made with other settings, another camera or "
                    "version: beginning anew"
                )
            else:
                _log.info(
                    "removing what an unfinished run left (--resume would have gone on with it)"
                )
            for output, number in zip(self._outputs, numbers):
                remove_left_part(output.path, number)
            left.remove()
        finally:
            if left is not self._journal:
                left.close()

    def _place_left(self, head: JournalHead) -> None:
        for output, number in zip(self._outputs, head.parts):
            part = left_part(output.path, number)
            if part is not None:
                try:
                    if output.placed:
                        part.place(overwrite=head.overwrite or self._may_replace(output.path))
                    else:
                        part.discard()
                finally:
                    part.close()

    def _takes_over(self, numbers: Sequence[int]) -> bool:
        """Whether the parts of an ended run are all there and begin as they must."""
        for output, number in zip(self._outputs, numbers):
            part = left_part(output.path, number)
            if part is not None:
                self._files.append(_GrowingFile(output, part))
                self._files[-1].count(part.read(0, len(output.head)))
        heads = [hashlib.sha256(output.head).digest() for output in self._outputs]
        if [file.digest.digest() for file in self._files] == heads:
            return True
        while self._files:
            self._files.pop().part.discard()
        return False

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
            Called with each frame that is taken over, its rows left out.

        Returns
        -------
        iterator of FrameTask
            The frames that remain to be done.
        """
        if self._done:
            for frame in self._kept:
                count(_counts_of(frame))
            return iter(())
        if not self._resumes:
            return tasks
        beyond: list[FrameTask] = []
        for frame in self._kept:
            task = next(tasks, None)
            content = self._content_of(frame)
            if task is None or content is None or frame.task != task_digest(task):
                beyond = [] if task is None else [task]
                break
            if frame.error is not None and self._conduct.faults.strict:
                raise FailedFrameError(frame.error)
            for file, rows in zip(self._files, content):
                file.count(rows)
                file.has_rows = file.has_rows or bool(rows)
            self._frames += 1
            count(_counts_of(frame))
        for file in self._files:
            file.part.cut(file.size)
        assert self._journal is not None
        self._journal.cut()
        self._taken_over = self._noted = self._frames
        _log.info("%d frames of an unfinished run are taken over", self._frames)
        return chain(beyond, tasks)

    def _content_of(self, frame: JournalFrame) -> list[bytes] | None:
        """The rows that a line of the journal records; None if they are not there."""
        content = [
            file.part.read(file.size, length) for file, length in zip(self._files, frame.lengths)
        ]
        return content if digest_of(content) == frame.content else None

    @property
    def may_replace_pictures(self) -> bool:
        """Whether pictures of the next frame may be replaced.

        The run that is resumed may have drawn it before it ended.
        """
        return self._conduct.overwrite or (self._resumes and self._frames == self._taken_over)

    def add(self, frames: Sequence[tuple[FrameTask, FrameRows]]) -> None:
        """Write frames, the next ones.

        Raises
        ------
        OSError
            If they cannot be written; names the file.
        FailedFrameError
            If one of them could not be worked on, and every frame is demanded.
        """
        content: list[list[bytes]] = []
        noted = []
        for task, rows in frames:
            if rows.error is not None and self._conduct.faults.strict:
                self._discard()
                raise FailedFrameError(rows.error)
            by_kind = {**rows.rows, LOG: self._log_row(task, rows)}
            own = [file.next_rows(by_kind.get(file.output.kind, b"")) for file in self._files]
            content.append(own)
            if self._journal is not None:
                noted.append(
                    JournalFrame(
                        [len(part) for part in own], digest_of(own), task_digest(task),
                        rows.found, rows.rejected, rows.error,
                    )
                )  # fmt: skip
            self._frames += 1
        for file, parts in zip(self._files, zip(*content)):
            file.write(b"".join(parts))
        if self._journal is not None:
            self._journal.write(noted)
            self._noted = self._frames

    def _log_row(self, task: FrameTask, rows: FrameRows) -> bytes:
        if rows.error is None:
            return b""
        return log_failure(self._frames, task.frame.step.prefix, rows.error)

    # -- ending -----------------------------------------------------------------------------

    def finish(self, found: RunSummary, second_pass: SecondPass | None = None) -> None:
        """Write the files' ends, and move the files to their final paths.

        Raises
        ------
        OSError, OutputExistsError
            If they cannot.
        """
        if self._done:  # by a run that was killed at its very end
            return
        if second_pass is not None:
            self._write_late(second_pass)
        written: list[dict[str, object]] = []
        for file in self._files:
            path = file.output.path
            is_log = path == self._conduct.log
            file.write(log_tail(found, written) if is_log else file.output.tail)
            if file.output.placed:
                sha256 = file.digest.hexdigest()
                written.append({"name": path.name, "bytes": file.size, "sha256": sha256})
                file.part.sync()
        results = [(file.output.path, file.part) for file in self._files if file.output.placed]
        with folder_locked(results[-1][0].parent), ExitStack() as replaced:
            for path, _ in results:
                if not self._may_replace(path) and os.path.lexists(path):
                    raise OutputExistsError(path)
                # The disk space of a replaced file is freed when no process has it open any
                # more. That takes much longer than to replace it, and so happens behind the last
                # one: hardly any kill falls between the calls that replace them.
                if path.is_file():
                    with suppress(OSError):
                        replaced.enter_context(path.open("rb"))
            if self._journal is not None:
                self._journal.complete()
            for path, part in results:
                part.place(overwrite=self._may_replace(path))
        self._done = True

    def _write_late(self, second_pass: SecondPass) -> None:
        """Fill the files that are made from the others."""
        files = {file.output.kind: file for file in self._files}
        first = {kind: file for kind, file in files.items() if kind not in LATE_KINDS}
        with ExitStack() as stack:
            streams = {}
            for kind, file in first.items():
                file.part.rewind()
                stream = open(file.part.fileno(), "rb", closefd=False)  # noqa: SIM115 - on the stack
                streams[kind] = stack.enter_context(stream)
            for kind, rows in second_pass(streams):
                files[kind].write(files[kind].output.ended(rows))
        for file in first.values():
            file.part.to_end()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._done or self._journal is None or not self._is_worth_keeping(self._journal, error):
            self._discard()
            return
        self._journal.close()
        for file in self._files:
            file.part.close()
        if self._noted:
            _log.info("%d frames are kept: --resume goes on after them", self._noted)

    def _is_worth_keeping(self, journal: Journal, error: BaseException | None) -> bool:
        """Whether there is something, of this run or the one resumed, that can be gone on with."""
        if isinstance(error, OutputExistsError):
            return False  # another process was faster
        if not os.path.lexists(journal.place):
            return False  # it went with its folder
        return self._noted > 0 or self._resumes

    def _discard(self) -> None:
        for file in self._files:
            file.part.discard()
        if self._journal is not None:
            self._journal.remove()
            self._journal = None


def _counts_of(frame: JournalFrame) -> FrameRows:
    return FrameRows({}, frame.found, frame.rejected, error=frame.error)
