"""The files of a run while they grow, so that a run that ends early keeps what is done.

The rows of the frames that a worker gives back together are written at once to the parts of the
files (`storage.parts`), then noted in the journal (`detect.runs.resume_journal`). However a run
ends, by a signal, a full disk, workers that are gone, what is noted is there, and a run that
resumes goes on after it:

    journal fits program, settings, camera  ->  its frames are those of the run  ->  the rows are
    those that it noted  ->  the parts are cut off after the last of them, and grow on

When all frames are done, everything is brought to the disk, the journal says that the files are
complete, and they take their places. A process killed in between leaves this last step to the next
run. Runs of the library without a log have no journal; their files grow and appear the same way.
"""

from __future__ import annotations

import errno
import logging
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from detect.errors import DetectError
from detect.runs.conduct import Conduct
from detect.runs.frame import FramePlan
from detect.runs.frame_rows import FrameRows, FrameTask
from detect.runs.growing_files import GrowingFile, RunOutput, held_open, sync_together
from detect.runs.resume_journal import (
    Journal,
    JournalHead,
    JournalLine,
    checked,
    journal_place,
    left_journal,
    line_of_frame,
    made_by,
    new_journal,
    task_digest,
)
from detect.runs.run_log import (
    Counted,
    FailedFrameError,
    WrittenFile,
    demand_log_place,
    log_failure,
    log_head,
    log_tail,
)
from storage import OutputExistsError
from storage.parts import folder_locked, left_part, new_part, remove_left_part

_log = logging.getLogger("redetect")


# Rows for the files that are made of others, from those (by their names): name and bytes.
SecondPass = Callable[[Mapping[str, BinaryIO]], Iterable[tuple[str, bytes]]]


class RunFiles:
    """The files of a run: a context manager that opens them, and keeps or removes what there is.

    Parameters
    ----------
    outputs : sequence of RunOutput
        The files.
    plan : FramePlan
        What is done with every frame.
    conduct : Conduct
        Whether there are a log and a journal, and a run to be resumed.
    overwrite : bool
        Whether existing files may be replaced.
    """

    def __init__(
        self, outputs: Sequence[RunOutput], plan: FramePlan, conduct: Conduct, *, overwrite: bool
    ) -> None:
        self._conduct = conduct
        self._overwrite = overwrite
        self._frames = self._failed = self._taken_over = self._noted = 0
        self._check = self._made_by = made_by(outputs, plan, conduct)
        self._journal: Journal | None = None
        self._kept: Iterator[JournalLine] = iter(())
        self._pushed_back: FrameTask | None = None
        self._under_way: deque[tuple[str, str]] = deque()
        self._resumes = self._goes_on = self._done = False
        self._files = [
            GrowingFile(
                output.path,
                output.head,
                output.tail,
                self._rows_of(output),
                overwrite,
                placed=output.placed,
            )
            for output in outputs
        ]
        if conduct.log is not None:
            head = log_head(plan, conduct)
            # That it may be replaced is made sure of when it is opened: it is a log.
            self._files.append(GrowingFile(conduct.log, head, b"", self._failure, True))

    # -- beginning ------------------------------------------------------------------------

    def __enter__(self) -> RunFiles:
        try:
            self._open()
        except BaseException:
            self._discard()
            raise
        return self

    def _open(self) -> None:
        self._demand_a_place_each()
        log = self._conduct.log
        left = None if log is None else left_journal(journal_place(log))
        if left is not None:
            try:
                left = self._completed(left)
                if self._done:
                    return
                self._demand_new()
                if left is not None and self._takes_over(left):
                    return
            finally:
                if left is not None and left is not self._journal:
                    left.close()
        self._demand_new()
        if log is not None:
            self._journal = self._new_journal(log)
        for file in self._files:
            file.part = new_part(file.path)
            file.write(file.head)
        self._begin_journal()

    def _demand_a_place_each(self) -> None:
        """Refuse to write two results to the same file: the last one would be all there is."""
        taken = set()
        for file in self._files:
            place = Path(os.path.realpath(file.path.parent), file.path.name)
            if place in taken:
                raise DetectError(f"{file.path}: named for two results: expected a file for each")
            taken.add(place)

    def _demand_new(self) -> None:
        """Refuse to replace what must not be, or cannot be."""
        for file in self._files:
            if not file.placed:
                continue
            if file.path.is_dir() and not file.path.is_symlink():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(file.path))
            if not file.overwrite and os.path.lexists(file.path):
                raise OutputExistsError(file.path)
        if self._conduct.log is not None:
            demand_log_place(self._conduct.log, overwrite=self._overwrite)

    def _begin_journal(self) -> None:
        if self._journal is not None:
            numbers = tuple(file.part.number for file in self._files if file.part is not None)
            self._journal.begin(JournalHead(self._made_by, numbers, self._overwrite))

    def _new_journal(self, log: Path) -> Journal | None:
        place = journal_place(log)
        journal = new_journal(place)
        if journal is None:
            if not self._overwrite:
                raise DetectError(
                    f"{place}: another run is writing these files: wait for it, or, if it was "
                    "killed on another machine, remove this file"
                )
            _log.info("another run is writing these files: this one keeps no journal")
        return journal

    def _completed(self, left: Journal) -> Journal | None:
        """Do the last step of a run that was killed at it; gives back any other run's journal."""
        complete = left.is_complete()
        head, lines = left.read()
        if not complete or head is None or len(head.parts) != len(self._files):
            return left
        _log.info("the files of a run that was killed at its very end take their places")
        for file, number in zip(self._files, head.parts):
            part = left_part(file.path, number)
            if part is not None:
                try:
                    if file.placed:
                        part.place(overwrite=head.overwrite or file.overwrite)
                    else:
                        part.discard()
                finally:
                    part.close()
        if self._conduct.resume and head.made_by == self._made_by:
            self._done = True
            self._kept = iter(list(lines))
        left.remove()
        return None

    def _takes_over(self, left: Journal) -> bool:
        """Whether the journal of an ended run can be gone on with; else it is done away with."""
        head, lines = left.read()
        if head is not None and self._conduct.resume:
            if head.made_by != self._made_by or len(head.parts) != len(self._files):
                _log.info(
                    "what an unfinished run left was made with other settings, another camera or "
                    "version: beginning anew"
                )
            elif self._parts_left(head):
                self._journal, self._kept, self._resumes = left, lines, True
                return True
        else:
            _log.info("removing what an unfinished run left (--resume would have gone on with it)")
        for file, number in zip(self._files, () if head is None else head.parts):
            remove_left_part(file.path, number)
        left.remove()
        return False

    def _parts_left(self, head: JournalHead) -> bool:
        """Take over the parts of an ended run, if they are all there and begin as they must."""
        for file, number in zip(self._files, head.parts):
            file.part = left_part(file.path, number)
            if file.part is None or file.part.read(0, len(file.head)) != file.head:
                _log.info("what an unfinished run left is not complete: beginning anew")
                for opened in self._files:
                    if opened.part is not None:
                        opened.part.discard()
                        opened.part = None
                return False
        for file in self._files:
            file.count(file.head)
        return True

    # -- frames -----------------------------------------------------------------------------

    def kept(self, tasks: Iterator[FrameTask]) -> Iterator[FrameRows]:
        """The counts of the frames that are done already, without their rows.

        Parameters
        ----------
        tasks : iterator of FrameTask
            The frames of the run; `left` gives those that remain.
        """
        if self._done:
            yield from (line.rows for line in self._kept)
            return
        if not self._resumes:
            return
        end = None
        for line in self._kept:
            task = next(tasks, None)
            content = None if task is None else self._content_of(line)
            if (
                task is None
                or content is None
                or line.task != task_digest(task)
                or line.check != checked(self._check, line.lengths, line.task, line.rows, content)
            ):
                self._pushed_back = task
                break
            if line.rows.error is not None and self._conduct.strict:
                raise FailedFrameError(line.rows.error)
            for file, rows in zip(self._files, content):
                file.count(rows)
            self._check = line.check
            end = line.end
            self._frames += 1
            self._failed += line.rows.error is not None
            yield line.rows
        self._taken_over = self._noted = self._frames
        self._go_on_after(end)

    def _content_of(self, line: JournalLine) -> list[bytes] | None:
        """The rows that a line stands for; None if they are not all there."""
        if len(line.lengths) != len(self._files):
            return None
        content = []
        for file, length in zip(self._files, line.lengths):
            assert file.part is not None
            content.append(file.part.read(file.size, length))
        whole = all(len(rows) == length for rows, length in zip(content, line.lengths))
        return content if whole else None

    def _go_on_after(self, end: int | None) -> None:
        """Cut off whatever follows the frames that are taken over."""
        assert self._journal is not None
        for file in self._files:
            assert file.part is not None
            file.part.cut(file.size)
        self._journal.cut(0 if end is None else end)
        if end is None:
            self._begin_journal()
        self._goes_on = True
        _log.info("%d frames of an unfinished run are taken over", self._frames)

    def left(self, tasks: Iterator[FrameTask]) -> Iterator[FrameTask]:
        """The frames that remain to be done; remembered until their rows come."""
        if self._done:
            return
        pushed_back, self._pushed_back = self._pushed_back, None
        if pushed_back is not None:
            self._under_way.append(self._remembered(pushed_back))
            yield pushed_back
        for task in tasks:
            self._under_way.append(self._remembered(task))
            yield task

    def _remembered(self, task: FrameTask) -> tuple[str, str]:
        return task.frame.step.prefix, "" if self._journal is None else task_digest(task)

    @property
    def may_be_drawn_already(self) -> bool:
        """Whether the run that is resumed may have drawn the next frame before it ended."""
        return self._resumes and self._frames == self._taken_over

    def add(self, frames: Sequence[FrameRows]) -> None:
        """Write frames, the next ones.

        Raises
        ------
        OSError
            If they cannot be written; names the file.
        FailedFrameError
            If one of them could not be worked on, and every frame is demanded.
        """
        content: list[list[bytes]] = [[] for _ in self._files]
        noted = []
        for rows in frames:
            if rows.error is not None and self._conduct.strict:
                self._discard()
                raise FailedFrameError(rows.error)
            prefix, task = self._under_way.popleft()
            own = [file.rows(rows, prefix) for file in self._files]
            for whole, part in zip(content, own):
                whole.append(part)
            if self._journal is not None:
                lengths = tuple([len(part) for part in own])
                self._check, line = line_of_frame(self._check, lengths, task, rows, own)
                noted.append(line)
            self._frames += 1
            self._failed += rows.error is not None
        for file, parts in zip(self._files, content):
            file.write(b"".join(parts))
        if self._journal is not None:
            self._journal.write(noted)
            self._noted = self._frames

    def _rows_of(self, output: RunOutput) -> Callable[[FrameRows, str], bytes]:
        def rows_of(rows: FrameRows, _: str) -> bytes:
            if output.part == "late":
                return b""
            content = getattr(rows, output.part)
            assert isinstance(content, bytes)
            if output.crlf:
                content = content.replace(b"\n", b"\r\n")
            return output.between + content if output.between and self._frames else content

        return rows_of

    def _failure(self, rows: FrameRows, prefix: str) -> bytes:
        if rows.error is None:
            return b""
        return log_failure(self._frames, prefix, rows.error, first=not self._failed)

    # -- ending -----------------------------------------------------------------------------

    def finish(self, found: Counted, second_pass: SecondPass | None = None) -> None:
        """Write what stands after the frames, and have the files take their places.

        Raises
        ------
        OSError, OutputExistsError
            If they cannot.
        """
        if self._done:  # by a run that was killed at its very end
            return
        if second_pass is not None:
            self._write_late(second_pass)
        written: list[WrittenFile] = []
        for file in self._files:
            is_log = file.path == self._conduct.log
            file.write(log_tail(found, written) if is_log else file.tail)
            if file.placed:
                written.append(WrittenFile(file.path.name, file.size, file.digest.hexdigest()))
        parts = [(file, file.part) for file in self._files if file.part is not None and file.placed]
        sync_together([part for _, part in parts])
        with folder_locked(self._files[-1].path.parent):
            for file, _ in parts:
                if not file.overwrite and os.path.lexists(file.path):
                    raise OutputExistsError(file.path)
            with held_open([file.path for file, _ in parts]):
                if self._journal is not None:
                    self._journal.complete()
                for file, part in parts:
                    part.place(overwrite=file.overwrite)
        for file in self._files:
            if file.part is not None and not file.placed:
                file.part.discard()
        self._done = True

    def _write_late(self, second_pass: SecondPass) -> None:
        """Fill the files that are made of the others. What a killed run left of them is cut off."""
        files = {file.path.name: file for file in self._files}
        with ExitStack() as stack:
            first = {}
            for name, file in files.items():
                assert file.part is not None
                file.part.rewind()
                stream = open(file.part.fileno(), "rb", closefd=False)  # noqa: SIM115 - on the stack
                first[name] = stack.enter_context(stream)
            begun = set()
            for name, rows in second_pass(first):
                file = files[name]
                if name not in begun:
                    assert file.part is not None
                    file.part.cut(len(file.head))
                    begun.add(name)
                file.write(rows)
        for file in files.values():
            assert file.part is not None
            file.part.to_end()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._done or self._journal is None or not self._is_worth_keeping(error):
            self._discard()
            return
        self._journal.close()
        for file in self._files:
            if file.part is not None:
                file.part.close()
        if self._noted:
            _log.info("%d frames are kept: --resume goes on after them", self._noted)

    def _is_worth_keeping(self, error: BaseException | None) -> bool:
        """Whether there is something, of this run or the one resumed, that can be gone on with."""
        if isinstance(error, OutputExistsError) or self._journal is None:
            return False  # somebody else was faster
        if not os.path.lexists(self._journal.place):
            return False  # it went with its folder
        return self._noted > 0 or (self._resumes and not self._goes_on)

    def _discard(self) -> None:
        for file in self._files:
            if file.part is not None:
                file.part.discard()
        if self._journal is not None:
            self._journal.remove()
            self._journal = None
