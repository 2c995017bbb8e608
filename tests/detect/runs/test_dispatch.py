"""Frames handed out and collected: order, bounds, and workers that die."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from camera import Camera
from detect.errors import WorkerError
from detect.runs.plan import FramePlan, FrameRows, FrameTask
from detect.runs.workers import Chunk, WorkerPool, Workers
from detect.sources.interface import RunFrame
from redetect.landmarks import Step


def tasks(count: int) -> Iterator[FrameTask]:
    for number in range(count):
        step = Step(f"k.{number:04d}", *[0.0] * 9)
        yield FrameTask(RunFrame(step, Path(f"k.{number:04d}.png")))


def number_of(task: FrameTask) -> int:
    return int(task.frame.step.prefix[2:])


def rows_of(task: FrameTask) -> FrameRows:
    prefix = task.frame.step.prefix
    return FrameRows(prefix, {"circles": prefix})


def expected(count: int) -> list[str]:
    return [task.frame.step.prefix for task in tasks(count)]


def detect_frames(
    tasks: Iterable[FrameTask], plan: FramePlan, workers: Workers
) -> Generator[FrameRows, None, None]:
    """The frames of all chunks, one by one; each comes with its own task."""
    with closing(WorkerPool(workers)) as pool:
        for task, rows in chain.from_iterable(pool.detect_chunks(tasks, plan)):
            assert task.frame.step.prefix in rows.rows["circles"]
            yield rows


class Threads(Executor):
    """An executor that does not look at images: what it does with a chunk is the test's."""

    def __init__(self, work: Callable[[Chunk], list[FrameRows]], threads: int) -> None:
        self.pool = ThreadPoolExecutor(threads)
        self.work = work
        self.broken = threading.Event()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        if self.broken.is_set():
            raise BrokenExecutor("broken")
        _, chunk = args
        return self.pool.submit(self._do, chunk)

    def _do(self, chunk: Chunk) -> list[FrameRows]:
        if self.broken.is_set():
            raise BrokenExecutor("broken")
        try:
            return self.work(chunk)
        except BrokenExecutor:
            self.broken.set()
            raise


class Hired:
    """Workers whose every start is counted."""

    def __init__(
        self,
        work: Callable[[Chunk], list[FrameRows]],
        *,
        chunk: int = 4,
        window: int = 6,
        threads: int = 3,
        died: tuple[type[BaseException], ...] = (),
    ) -> None:
        self.started = self.ended = 0

        @contextmanager
        def start(_: FramePlan) -> Iterator[Executor]:
            self.started += 1
            executor = Threads(work, threads)
            try:
                yield executor
            finally:
                executor.pool.shutdown(wait=True, cancel_futures=True)
                self.ended += 1

        self.workers = Workers(start, chunk=chunk, window=lambda: window, died=died)


@pytest.fixture
def plan(published_camera: Camera) -> FramePlan:
    return FramePlan(published_camera)


@pytest.mark.parametrize("count", [0, 1, 4, 5, 50])
def test_rows_are_in_the_order_of_the_run(plan: FramePlan, count: int) -> None:
    def slow_at_first(chunk: Chunk) -> list[FrameRows]:
        time.sleep(0.02 if number_of(chunk[0]) % 8 == 0 else 0.0)
        return [rows_of(task) for task in chunk]

    hired = Hired(slow_at_first)
    found = [rows.rows["circles"] for rows in detect_frames(tasks(count), plan, hired.workers)]
    assert found == expected(count)
    assert hired.started == hired.ended == (1 if count else 0)


def test_only_a_window_is_under_way(plan: FramePlan) -> None:
    """Frames are taken from the run when there is room for them, not before."""
    taken = [0]

    def counted() -> Iterator[FrameTask]:
        for task in tasks(200):
            taken[0] += 1
            yield task

    hired = Hired(lambda chunk: [rows_of(task) for task in chunk], chunk=4, window=5)
    for given, _ in enumerate(detect_frames(counted(), plan, hired.workers), start=1):
        # A chunk is handed out in full before its place is filled again.
        assert taken[0] - given <= 5 * 4
    assert taken[0] == 200


def test_closing_ends_the_workers(plan: FramePlan) -> None:
    hired = Hired(lambda chunk: [rows_of(task) for task in chunk])
    with closing(detect_frames(tasks(1000), plan, hired.workers)) as found:
        next(found)
    assert hired.started == hired.ended == 1


def test_errors_of_the_program_are_not_hidden(plan: FramePlan) -> None:
    def wrong(chunk: Chunk) -> list[FrameRows]:
        raise TypeError("a slip")

    hired = Hired(wrong)
    with pytest.raises(TypeError, match="a slip"):
        list(detect_frames(tasks(10), plan, hired.workers))
    assert hired.started == hired.ended == 1


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ModuleNotFoundError("No module named 'detect'"), "No module named 'detect': expected"),
        (CancelledError(), "the workers are gone"),
    ],
)
def test_workers_that_cannot_work_are_told(plan: FramePlan, error: Exception, told: str) -> None:
    def work(chunk: Chunk) -> list[FrameRows]:
        raise error

    hired = Hired(work)
    with pytest.raises(WorkerError, match=told):
        list(detect_frames(tasks(10), plan, hired.workers))
    assert hired.started == hired.ended == 1


@pytest.mark.parametrize("deadly", [{0}, {17}, {49}, {3, 20, 21}, {0, 1}])
@pytest.mark.parametrize("chunk", [1, 4])
def test_a_frame_that_kills_its_worker_costs_itself(
    plan: FramePlan, deadly: set[int], chunk: int
) -> None:
    def work(chunk: Chunk) -> list[FrameRows]:
        if deadly & {number_of(task) for task in chunk}:
            raise BrokenExecutor("killed")
        return [rows_of(task) for task in chunk]

    hired = Hired(work, chunk=chunk)
    found = list(detect_frames(tasks(50), plan, hired.workers))
    assert len(found) == 50
    for number, (rows, sound) in enumerate(zip(found, expected(50))):
        if number in deadly:
            assert rows.error is not None
            assert rows.error.startswith(f"k.{number:04d}.png: every worker died")
            assert rows.rows["circles"].startswith("STEP ")
        else:
            assert rows.rows["circles"] == sound
    assert hired.started == hired.ended > len(deadly)


def test_deadly_frames_far_apart_are_frames_still(plan: FramePlan) -> None:
    """However many they are, and with no neighbours under way that speak for the workers."""

    def work(chunk: Chunk) -> list[FrameRows]:
        if any(number_of(task) % 4 == 1 for task in chunk):
            raise BrokenExecutor("killed")
        return [rows_of(task) for task in chunk]

    hired = Hired(work, chunk=1, window=1)
    found = list(detect_frames(tasks(100), plan, hired.workers))
    failed = [number for number, rows in enumerate(found) if rows.error is not None]
    assert failed == list(range(1, 100, 4))


def test_a_worker_killed_once_costs_nothing(plan: FramePlan) -> None:
    shots = iter([False, False, True])

    def work(chunk: Chunk) -> list[FrameRows]:
        if next(shots, False):
            raise BrokenExecutor("killed")
        return [rows_of(task) for task in chunk]

    hired = Hired(work)
    found = [rows.rows["circles"] for rows in detect_frames(tasks(50), plan, hired.workers)]
    assert found == expected(50)
    assert hired.started == hired.ended == 2


def test_of_a_cluster_only_the_task_is_lost(plan: FramePlan) -> None:
    """What a cluster gives up on leaves the cluster and the other tasks as they are."""

    class GivenUpError(Exception):
        pass

    def work(chunk: Chunk) -> list[FrameRows]:
        if any(number_of(task) == 9 for task in chunk):
            raise GivenUpError
        return [rows_of(task) for task in chunk]

    hired = Hired(work, died=(GivenUpError,))
    found = list(detect_frames(tasks(40), plan, hired.workers))
    assert [k for k, rows in enumerate(found) if rows.error is not None] == [9]
    assert hired.started == 1


def test_workers_that_always_die_end_the_run(plan: FramePlan) -> None:
    def work(chunk: Chunk) -> list[FrameRows]:
        raise BrokenExecutor("killed")

    hired = Hired(work)
    with pytest.raises(WorkerError, match="every worker died"):
        list(detect_frames(tasks(1000), plan, hired.workers))
    assert hired.started == hired.ended < 40
