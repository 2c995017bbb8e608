"""Processes frames with any number of workers, and returns their rows in the order of the run.

Workers are a standard `concurrent.futures.Executor`: this process, others on this machine, or a
cluster. Frames are sent in chunks. Only a window of chunks is pending at any time, so that memory
does not grow with the run, and a slow frame delays the others only when they are a window ahead.

If a worker dies, killed or out of memory, no other frame is lost: all pending frames are processed
again, one at a time, until the one that kills its worker is found; it is reported as unreadable.
"""

from __future__ import annotations

import concurrent.futures
import logging
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing.synchronize import RLock
from typing import TYPE_CHECKING, ParamSpec, TypeVar, cast

import cv2

from detect.errors import WorkerError
from detect.runs.plan import FramePlan, FrameRows, FrameTask, rows_of_failure
from detect.terminal import on_compilation, say_compiling, show_announcements
from redetect.interrupts import interrupts_deferred, raise_if_interrupt_waits
from redetect.messages import excerpt, imported_for

if TYPE_CHECKING:
    from distributed import Client

Chunk = tuple[FrameTask, ...]

#: After this many consecutive frames that killed their workers, the run is given up.
_DEADLY_FRAMES = 10

P = ParamSpec("P")
R = TypeVar("R")
FRAMES_PER_PROCESS = 500  #: Number of frames for which starting another process pays off.
_MOST_JOBS = 1000  #: Largest number of processes: more than cores and memory are good for.
#: Frames per chunk.
_TOGETHER = 16
_WINDOW_PER_WORKER = 3
_CLUSTER_ANSWER_S = 10.0
_CLUSTER_PATIENCE_S = 60.0
_GRACE_S = 1.0  #: Time after which processes are killed.
_PATIENCE_S = 0.2  #: Interval of checks for an interrupt.
#: The lock that a process of a pool holds while it compiles kernels.
_compiling: list[RLock] = []
#: Locks of the parts of missing kernels, until this process has compiled, or waited for, each.
_parts: list[RLock] = []


@dataclass(frozen=True)
class Workers:
    """Workers that process the frames."""

    #: Starts the executor for a plan, also again after workers have died, and ends it.
    start: Callable[[FramePlan], AbstractContextManager[Executor]]
    chunk: int  # frames per chunk
    window: Callable[[], int]  # largest number of pending chunks; not constant, as clusters grow
    died: tuple[type[BaseException], ...] = ()  # raised if a worker dies, as `BrokenExecutor` is


class WorkerPool:
    """The workers of a run: started when needed, replaced when one has died, ended by `close`."""

    _plan: FramePlan  # how they process frames

    def __init__(self, workers: Workers) -> None:
        self._died: tuple[type[BaseException], ...] = (BrokenExecutor, *workers.died)
        self._workers, self._started = workers, ExitStack()
        self._executor: Executor | None = None
        self._deadly = 0

    def close(self) -> None:
        """End the workers."""
        self._executor = None
        self._started.close()

    def detect_chunks(
        self, tasks: Iterable[FrameTask], plan: FramePlan
    ) -> Iterator[list[tuple[FrameTask, FrameRows]]]:
        """Frames with their rows, in the order of the tasks, chunk by chunk.

        Raises WorkerError if workers die with every frame, disappear, or do not have this program,
        and `lut.TableError` if no table can be made for the camera.
        """
        source = iter(tasks)
        chunks = iter(lambda: tuple(islice(source, self._workers.chunk)), ())
        # A chunk without a future is suspect: it is processed while nothing else is pending.
        under_way: deque[tuple[Chunk, Future[list[FrameRows]] | None]] = deque()
        self._plan = plan
        while True:
            if all(future is not None for _, future in under_way):
                more = max(0, self._workers.window() - len(under_way))
                under_way.extend((chunk, self._submit(chunk)) for chunk in islice(chunks, more))
            if not under_way:
                return
            chunk, future = under_way.popleft()
            if future is None:
                yield [(task, self._rows_alone(task)) for task in chunk]
                continue
            try:
                rows = self._rows(future)
            except self._died as error:
                self._dismiss(error)
                under_way.appendleft((chunk, None))
                under_way = deque((c, None if self._lost(f) else f) for c, f in under_way)
                continue
            yield list(zip(chunk, rows))

    def _submit(self, chunk: Chunk) -> Future[list[FrameRows]]:
        try:
            if self._executor is None:
                self._executor = self._started.enter_context(self._workers.start(self._plan))
            return self._executor.submit(work_on_chunk, self._plan, chunk)
        except self._died as error:  # they died before they received anything
            failed: Future[list[FrameRows]] = Future()
            failed.set_exception(error)
            return failed

    def _rows(self, future: Future[list[FrameRows]]) -> list[FrameRows]:
        """The rows of a chunk; waits for them."""
        try:
            rows = future.result()
        except ImportError as error:
            raise WorkerError(
                f"a worker cannot import the program: {error}: expected the same version there"
            ) from None
        except CancelledError:
            raise WorkerError("the workers are gone: expected the cluster to stay") from None
        self._deadly = 0
        return rows

    def _rows_alone(self, task: FrameTask) -> FrameRows:
        """The rows of a frame during which a worker may have died."""
        for _ in range(2):
            try:
                (rows,) = self._rows(self._submit((task,)))
                return rows
            except self._died as error:
                self._dismiss(error)
        reason = f"{task.name}: every worker died on this frame"
        self._deadly += 1
        if self._deadly == _DEADLY_FRAMES:
            raise WorkerError(
                f"{reason} or one of the {_DEADLY_FRAMES - 1} before it: killed, or out of memory?"
            )
        return rows_of_failure(task, f"{reason}: out of memory?")

    def _dismiss(self, error: BaseException) -> None:
        """End the remaining workers if their pool is broken; the next chunk gets new ones."""
        if isinstance(error, BrokenExecutor):
            self.close()

    def _lost(self, future: Future[list[FrameRows]] | None) -> bool:
        """Whether a chunk was lost with its worker."""
        if future is None or future.cancelled():
            return True
        if not future.done():
            return self._executor is None
        return isinstance(future.exception(), self._died)


def work_on_chunk(plan: FramePlan, chunk: Chunk) -> list[FrameRows]:
    """Process a chunk in a worker; its input and output are small."""
    from detect.runs.frame import rows_of_frames  # loads the compiler, which only workers need

    return rows_of_frames(chunk, plan)


def default_jobs(frames: int) -> int:
    """One process for every `FRAMES_PER_PROCESS` frames, up to the number of cores."""
    return max(1, min(_cores(), frames // FRAMES_PER_PROCESS))


def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def local_workers(jobs: int, *, large: bool = False, shared: bool = False) -> Workers:
    """Processes on this machine; 1 is this process itself.

    Chunks of `large` tasks, which contain images, have one frame. With `shared`, a single process
    lets two others compile missing kernels at the same time.
    """
    if not 1 <= jobs <= _MOST_JOBS:
        raise WorkerError(f"jobs is {excerpt(jobs)}: expected 1 to {_MOST_JOBS}")
    chunk = 1 if large else _TOGETHER
    if jobs == 1:
        return Workers(lambda plan: _InProcess(plan, shared=shared), chunk, window=lambda: 1)
    window = 2 + _WINDOW_PER_WORKER * jobs
    show = bool(logging.getLogger("redetect").handlers)
    return Workers(lambda plan: _ProcessPool(jobs, plan, show=show), chunk, lambda: window)


def cluster_workers(address: str, *, large: bool = False) -> Workers:
    """The workers of a dask cluster with the scheduler's `address`, such as ``tcp://host:8786``.

    They need the same version of this program and access to the images under the same paths.
    `large` as for `local_workers`.
    """
    if not re.fullmatch(r"[a-z]+://\S+:[0-9]+", address):
        raise WorkerError(f"cluster is {address!r}: expected the scheduler's tcp://host:port")
    with imported_for("a cluster needs the package distributed", "cluster", WorkerError):
        from distributed import KilledWorker
    clients: list[Client] = []

    def window() -> int:  # a cluster grows
        threads = sum(sum(client.nthreads().values()) for client in clients)
        return 2 + _WINDOW_PER_WORKER * max(1, threads)

    chunk = 1 if large else _TOGETHER
    return Workers(lambda _: _cluster(address, clients), chunk, window, died=(KilledWorker,))


class _MissingKernelsError(Exception):
    """Kernels are not in the disk cache: the task begins again when other processes have them."""


class _InProcess(Executor):
    """Runs each task immediately, before returning the future."""

    def __init__(self, plan: FramePlan, *, shared: bool) -> None:
        self._plan = plan
        self._shared = shared and plan.circles is not None and _cores() > 1
        self._chunk: Chunk = ()
        self._forget = on_compilation(self._before_compilation)

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        self._chunk = cast("Chunk", args[-1])
        future: Future[R] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except _MissingKernelsError:
            future.set_result(fn(*args, **kwargs))
        finally:
            self._chunk = ()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._forget()

    def _before_compilation(self) -> None:
        raise_if_interrupt_waits()
        say_compiling()
        if not self._shared or not self._chunk:  # or between tasks
            return
        self._shared = False  # only before the first kernel
        # If no process can be started, this one compiles all kernels.
        with suppress(OSError, ImportError, BrokenExecutor), ExitStack() as started:
            pool = started.enter_context(_ProcessPool(2, self._plan, show=False))
            done = [pool.submit(work_on_chunk, self._plan, self._chunk) for _ in range(2)]
            # Any error there recurs here, and is reported.
            while concurrent.futures.wait(done, _PATIENCE_S).not_done:
                raise_if_interrupt_waits()
            raise _MissingKernelsError


# Processes are spawned, not forked: compiled kernels, OpenCV and linear algebra libraries have
# threads, which do not survive a fork. They ignore keyboard interrupts; the parent process handles
# these and ends them. If the parent is killed, they end by themselves.


class _ProcessPool(ProcessPoolExecutor):
    """Processes prepared for a plan; leaving the context ends them.

    They start with interrupts blocked, which could reach them even while they start.
    """

    def __init__(self, count: int, plan: FramePlan, *, show: bool) -> None:
        context = multiprocessing.get_context("spawn")
        arguments = (plan, [context.RLock() for _ in range(3)], show)
        super().__init__(count, mp_context=context, initializer=_begin, initargs=arguments)

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        with interrupts_deferred():  # else a process could be left half started
            return super().submit(_in_worker, fn, *args, **kwargs)

    def __exit__(self, *_: object) -> None:
        """End the processes, whatever they are doing; further interrupts wait for that.

        The thread that manages them is joined: otherwise, it could be stopped at exit between
        removing a semaphore and recording that.
        """
        with interrupts_deferred():
            processes = list((self._processes or {}).values())
            manager = cast("threading.Thread | None", self._executor_manager_thread)
            self.shutdown(wait=False, cancel_futures=True)
            latest_s = time.monotonic() + _GRACE_S
            for process in processes:
                process.join(max(0.0, latest_s - time.monotonic()))
            for process in processes:
                process.kill()
                process.join()
            if manager is not None:
                manager.join(_GRACE_S)


def _begin(plan: FramePlan, locks: list[RLock], show: bool) -> None:
    """Initialise a worker process; the first one that needs the tables makes them for all."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if show:
        show_announcements()
    cv2.setNumThreads(1)
    tables, *parts = locks
    on_compilation(lambda: _before_compilation(tables))
    with suppress(Exception):  # any error recurs, and is reported, with the first task
        from detect.runs.frame import prepare  # loads detectors, which only workers need

        with tables:
            _in_worker(prepare, plan)
    _parts[:] = parts


def _before_compilation(lock: RLock) -> None:
    if _compiling:
        return
    if _parts:
        raise _MissingKernelsError
    if lock.acquire(block=False):
        _compiling.append(lock)
        say_compiling()
    else:  # further kernels will be loaded: the other process caches them
        with lock:
            pass


def _in_worker(fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
    try:
        return fn(*args, **kwargs)
    except _MissingKernelsError:
        _compile_part(*cast("tuple[FramePlan, Chunk]", args))
        return fn(*args, **kwargs)
    finally:
        while _compiling:
            _compiling.pop().release()


def _compile_part(plan: FramePlan, chunk: Chunk) -> None:
    """Compile the kernels of a plan, but those that other processes compile at the same time."""
    from detect.runs.frame import compile_discs

    locks = _parts.copy()
    _parts.clear()
    for lock, search in zip(locks, (True, False)):
        if lock.acquire(block=False):
            _compiling.append(lock)
            if search:
                say_compiling()
                work_on_chunk(replace(plan, circles=None), chunk)
            compile_discs(plan, search=search)
            _compiling.pop().release()
    for lock in locks:  # wait for the others
        with lock:
            pass


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _cluster(address: str, clients: list[Client]) -> Iterator[Executor]:
    from distributed import Client

    try:
        client = Client(address, timeout=_CLUSTER_ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise WorkerError(f"{address}: no dask scheduler answers there: {error}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_CLUSTER_PATIENCE_S)
        except TimeoutError:
            raise WorkerError(
                f"{address}: no worker connected within {_CLUSTER_PATIENCE_S:g} s"
            ) from None
        clients[:] = [client]
        # Not pure, so that dask does not reuse results of earlier runs.
        yield client.get_executor(pure=False)
