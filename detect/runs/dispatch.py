"""Processes frames with any number of workers, and gives their rows in the order of the run.

Workers are a standard `concurrent.futures.Executor`: this process, others on this machine, or a
cluster (`detect.runs.workers`). Frames travel in chunks. Only a window of them is under way at any
time, so that neither what waits nor what is finished grows with the run, and a slow frame holds the
others up only when they are a window ahead of it.

A worker that dies, killed or out of memory, loses no other frame: all frames under way are
processed again, one at a time, until the frame that kills its worker is alone; that one is reported
like an image that cannot be read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from itertools import islice

from detect.errors import WorkerError
from detect.runs.plan import FramePlan, FrameRows, FrameTask, rows_of_failure

Chunk = tuple[FrameTask, ...]

#: After this many consecutive frames that killed their workers, the frames are not the cause.
_DEADLY_FRAMES = 10


@dataclass(frozen=True)
class Workers:
    """Workers that process the frames.

    Attributes
    ----------
    start : callable
        Starts them for a plan: a context manager that gives the executor, and ends what it started.
        Called again after workers have died.
    chunk : int
        How many frames a task has.
    window : callable
        How many tasks may be under way; called repeatedly, as clusters grow.
    died : tuple of exception types
        What a task raises, besides `BrokenExecutor`, when its worker has died.
    """

    start: Callable[[FramePlan], AbstractContextManager[Executor]]
    chunk: int
    window: Callable[[], int]
    died: tuple[type[BaseException], ...] = ()


def detect_chunks(
    tasks: Iterable[FrameTask], plan: FramePlan, workers: Workers
) -> Generator[list[tuple[FrameTask, FrameRows]], None, None]:
    """Work on frames, some at a time.

    Yields
    ------
    list of (FrameTask, FrameRows)
        In the order of the tasks, as many at a time as a worker gives back. Close the generator
        (`contextlib.closing`) if not all of them are consumed: that ends the workers.

    Raises
    ------
    WorkerError
        If workers die with any frame, disappear, or do not have this program.
    lut.TableError
        If there can be no table for the camera.
    """
    source = iter(tasks)
    chunks = iter(lambda: tuple(islice(source, workers.chunk)), ())
    # A chunk without a future is suspect: to be processed while nothing else is under way.
    under_way: deque[tuple[Chunk, Future[list[FrameRows]] | None]] = deque()
    with ExitStack() as started:
        crew = _Crew(workers, plan, started)
        while True:
            if all(future is not None for _, future in under_way):
                more = max(0, workers.window() - len(under_way))
                under_way.extend((chunk, crew.submit(chunk)) for chunk in islice(chunks, more))
            if not under_way:
                return
            chunk, future = under_way.popleft()
            if future is None:
                yield [(task, crew.rows_alone(task)) for task in chunk]
                continue
            try:
                rows = crew.rows(future)
            except crew.died as error:
                crew.dismiss(error)
                under_way.appendleft((chunk, None))
                under_way = deque((c, None if crew.lost(f) else f) for c, f in under_way)
                continue
            yield list(zip(chunk, rows))


def work_on_chunk(plan: FramePlan, chunk: Chunk) -> list[FrameRows]:
    """Process a task in a worker; its input and output are small."""
    from detect.runs.rows import rows_of_frames  # loads the compiler, which only workers need

    return rows_of_frames(chunk, plan)


class _Crew:
    """The workers of a run: replaced when one of them has died."""

    def __init__(self, workers: Workers, plan: FramePlan, started: ExitStack) -> None:
        self.died: tuple[type[BaseException], ...] = (BrokenExecutor, *workers.died)
        self._workers, self._plan, self._started = workers, plan, started
        self._executor: Executor | None = None
        self._deadly = 0

    def submit(self, chunk: Chunk) -> Future[list[FrameRows]]:
        try:
            if self._executor is None:
                self._executor = self._started.enter_context(self._workers.start(self._plan))
            return self._executor.submit(work_on_chunk, self._plan, chunk)
        except self.died as error:  # they died before they were given anything
            failed: Future[list[FrameRows]] = Future()
            failed.set_exception(error)
            return failed

    def rows(self, future: Future[list[FrameRows]]) -> list[FrameRows]:
        """The rows of a chunk; waits for them."""
        try:
            rows = future.result()
        except ImportError as error:
            raise WorkerError(
                f"a worker cannot do the work: {error}: expected redetect there, the same version"
            ) from None
        except CancelledError:
            raise WorkerError("the workers are gone: expected the cluster to stay") from None
        self._deadly = 0
        return rows

    def rows_alone(self, task: FrameTask) -> FrameRows:
        """The rows of a frame during which a worker may have died."""
        for _ in range(2):
            try:
                (rows,) = self.rows(self.submit((task,)))
                return rows
            except self.died as error:
                self.dismiss(error)
        reason = f"{task.name}: every worker died that was given this frame"
        self._deadly += 1
        if self._deadly == _DEADLY_FRAMES:
            raise WorkerError(
                f"{reason} or one of the {_DEADLY_FRAMES - 1} before it: killed, or out of memory?"
            )
        return rows_of_failure(task, f"{reason}: out of memory?")

    def dismiss(self, error: BaseException) -> None:
        """End the rest of broken workers; the next chunk gets new ones."""
        if isinstance(error, BrokenExecutor):
            self._executor = None
            self._started.close()

    def lost(self, future: Future[list[FrameRows]] | None) -> bool:
        """Whether a chunk was lost with its worker."""
        if future is None or future.cancelled():
            return True
        if not future.done():
            return self._executor is None
        return isinstance(future.exception(), self.died)
