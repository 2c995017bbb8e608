"""Who works on the frames of a run: this process, processes of this machine, or a cluster.

Each is a standard executor with its number of frames per task, put together as
`detect.runs.dispatch.Workers`.

Processes are spawned, not forked: compiled kernels, OpenCV and the libraries of linear algebra
have threads of their own, which no fork survives. They take no notice of an interrupt from the
keyboard; the process that started them does, and ends them.
If that process is killed, they end by themselves.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event, Lock
from typing import TYPE_CHECKING, NamedTuple, ParamSpec, TypeVar, cast

from detect.announcing import (
    announce_compiling,
    announcements_are_shown,
    show_announcements,
)
from detect.errors import WorkerError
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan, import_detectors, rehearse, tables_of
from detect.runs.frame_rows import PIXELS_AT_ONCE
from detect.runs.garbage import settling, tidy_now_and_then
from detect.runs.interrupts import interrupts_deferred
from storage.kernel_loading import load_kernels_alone, waiting_before_compiling

if TYPE_CHECKING:
    from distributed import Client

    from camera import Camera

P = ParamSpec("P")
R = TypeVar("R")

#: Fewer frames than this are not worth another process's start.
FRAMES_PER_PROCESS = 500

#: One job works on so many frames together at most.
_LOCAL_CHUNK = 128
#: A task of a process has so many frames; the larger one where there are enough for many of them.
_PROCESS_CHUNK = 16
_LARGE_PROCESS_CHUNK = 64
_TASKS_PER_PROCESS = 32
_CLUSTER_CHUNK = 16
_WINDOW_PER_WORKER = 3
_GRACE_S = 1.0
_CLUSTER_ANSWER_S = 10.0
_CLUSTER_PATIENCE_S = 60.0
_CLUSTER_LOOK_S = 5.0


def default_jobs(frames: int) -> int:
    """A process for every `FRAMES_PER_PROCESS` frames, at most as many as there are cores."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return max(1, min(cores, frames // FRAMES_PER_PROCESS))


def pixels_of(camera: Camera | None) -> int:
    """How large a camera's images are; 0 if nobody knows."""
    return 0 if camera is None else camera.width * camera.height


def local_workers(
    jobs: int, *, pictures: bool = False, frame_pixels: int = 0, frames: int | None = None
) -> Workers:
    """Workers on this machine.

    Parameters
    ----------
    jobs : int
        How many processes; 1 is this process itself.
    pictures : bool
        Whether frames give pictures: tasks are kept small then.
    frame_pixels : int
        How large an image is, if that is known: no more are worked on together than are decoded at
        once.
    frames : int, optional
        How many there are, if that is known: the longer the run, the more are worked on together.

    Raises
    ------
    WorkerError
        If `jobs` is less than 1.
    """
    if jobs < 1:
        raise WorkerError(f"jobs is {jobs}: expected 1 or more")
    decoded_at_once = max(PIXELS_AT_ONCE // max(frame_pixels, 1), 1)
    if jobs == 1:
        together = min(decoded_at_once, _LOCAL_CHUNK)
        return Workers(_in_process, chunk=1 if pictures else together, window=lambda: 1)
    window = 2 + _WINDOW_PER_WORKER * jobs
    return Workers(
        lambda plan: _processes(jobs, plan),
        chunk=1 if pictures else min(decoded_at_once, _frames_per_task(jobs, frames)),
        window=lambda: window,
        tell_of_tables=True,
    )


def _frames_per_task(jobs: int, frames: int | None) -> int:
    """How many frames a process works on together: few where the last tasks would be waited for."""
    if frames is None:
        return _PROCESS_CHUNK
    return min(max(frames // (jobs * _TASKS_PER_PROCESS), _PROCESS_CHUNK), _LARGE_PROCESS_CHUNK)


def cluster_workers(address: str, *, pictures: bool = False) -> Workers:
    """The workers of a dask cluster.

    They have this program installed, in the same version, and see the images under the same
    paths.

    Parameters
    ----------
    address : str
        The scheduler's, as ``tcp://host:8786``.
    pictures : bool
        Whether frames give pictures: tasks are kept small then.

    Raises
    ------
    WorkerError
        If there can be no scheduler of that address, or the package that speaks to clusters is not
        installed.
    """
    if not re.fullmatch(r"[a-z]+://\S+:[0-9]+", address):
        raise WorkerError(f"cluster is {address!r}: expected the scheduler's tcp://host:port")
    try:
        from distributed import KilledWorker
    except ImportError:
        raise WorkerError(
            "a cluster needs the package distributed: install it by pip install 'redetect[cluster]'"
        ) from None
    size = _ClusterSize()
    return Workers(
        lambda plan: _cluster(address, size),
        chunk=1 if pictures else _CLUSTER_CHUNK,
        window=size.window,
        died=(KilledWorker,),
    )


# -- this process ---------------------------------------------------------------------------


class _InProcess(Executor):
    """Does what it is given at once, before it gives the future back."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        tidy_now_and_then()
        future: Future[R] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextmanager
def _in_process(plan: FramePlan) -> Iterator[Executor]:
    announce_compiling()
    yield _InProcess()


# -- processes ------------------------------------------------------------------------------


class _SpawnedProcesses(ProcessPoolExecutor):
    """Processes that inherit a blocked interrupt: it would reach them even while they start.

    None is left half started: an interrupt of this process waits meanwhile.

    The plan that they were started for, they have: it does not travel with every task.
    """

    plan: FramePlan

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        given = [_Known.PLAN if value is self.plan else value for value in args]
        with interrupts_deferred():
            return super().submit(_unless_stopped, fn, *given, **kwargs)


@contextmanager
def _processes(jobs: int, plan: FramePlan) -> Iterator[Executor]:
    context = multiprocessing.get_context("spawn")
    with ExitStack() as ending:
        with interrupts_deferred():
            stop, beginning = context.Event(), _Beginning.of(context)
            pool = _SpawnedProcesses(
                jobs,
                mp_context=context,
                initializer=_begin,
                initargs=(plan, stop, beginning, announcements_are_shown()),
            )
            pool.plan = plan
            ending.callback(_shut_down, pool, stop)
        yield pool


def _shut_down(pool: ProcessPoolExecutor, stop: Event) -> None:
    """End a pool's processes, whatever they are doing; a further interrupt waits for that.

    The thread that looks after them is waited for: an interrupted program leaves threads behind,
    and this one would be stopped between the removal of a semaphore and the note of that.
    """
    with interrupts_deferred():
        stop.set()
        processes = list((pool._processes or {}).values())
        caretaker = cast("threading.Thread | None", pool._executor_manager_thread)
        pool.shutdown(wait=False, cancel_futures=True)
        _end(processes)
        if caretaker is not None:
            caretaker.join(_GRACE_S)


def _end(processes: Sequence[BaseProcess]) -> None:
    """Let processes end, and make those that do not: they may still be starting."""
    running = {process.sentinel: process for process in processes}
    latest_s = time.monotonic() + _GRACE_S
    while running and (left_s := latest_s - time.monotonic()) > 0.0:
        for ended in wait(list(running), left_s):
            assert isinstance(ended, int)
            del running[ended]
    for process in running.values():
        process.terminate()
    for process in processes:
        process.join(_GRACE_S)
        if process.is_alive():
            process.kill()
            process.join()


def _unless_stopped(fn: Callable[..., R], /, *args: object, **kwargs: object) -> R:
    """Do a task, unless its result is no longer waited for."""
    if _stopped is not None and _stopped.is_set():
        raise CancelledError
    tidy_now_and_then()
    return fn(*[_own_plan if value is _Known.PLAN else value for value in args], **kwargs)


class _Known(Enum):
    """What stands in a task for what a worker has already."""

    PLAN = "plan"


#: In a worker process: the plan that it was started for.
_own_plan: FramePlan | None = None

#: Set in a worker process when the run ends early.
_stopped: Event | None = None


class _Beginning(NamedTuple):
    """What new worker processes share: one of them makes what is not in the caches yet, for all.

    Attributes
    ----------
    first : Lock
        Taken by that one.
    tables, kernels : Event
        Set when tables are in the cache, and when kernels are.
    """

    first: Lock
    tables: Event
    kernels: Event

    @classmethod
    def of(cls, context: SpawnContext) -> _Beginning:
        return cls(context.Lock(), context.Event(), context.Event())


def _begin(plan: FramePlan, stop: Event, beginning: _Beginning, show: bool) -> None:
    """Make a new process a worker."""
    global _stopped, _own_plan
    _stopped, _own_plan = stop, plan
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if show:
        show_announcements()
    with settling():
        import cv2

        cv2.setNumThreads(1)
        announce_compiling()
        with suppress(Exception):  # whatever it is: the first task will tell
            _rehearse_together(plan, beginning)


def _rehearse_together(plan: FramePlan, beginning: _Beginning) -> None:
    if beginning.first.acquire(block=False):
        try:
            load_kernels_alone()
            tables_of(plan)
            beginning.tables.set()
            rehearse(plan)
        finally:  # the others see for themselves what is wrong
            beginning.tables.set()
            beginning.kernels.set()
        return
    with waiting_before_compiling(beginning.kernels.wait) as waits:
        import_detectors(plan)
        (beginning.tables if waits else beginning.kernels).wait()
        rehearse(plan)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


# -- a cluster ------------------------------------------------------------------------------


class _ClusterSize:
    """How many tasks a cluster may have under way; looked at now and then."""

    def __init__(self) -> None:
        self._client: Client | None = None
        self._threads = 1
        self._looked_s = 0.0

    def watch(self, client: Client) -> None:
        self._client = client
        self._looked_s = 0.0

    def window(self) -> int:
        now_s = time.monotonic()
        if self._client is not None and now_s - self._looked_s > _CLUSTER_LOOK_S:
            self._looked_s = now_s
            self._threads = max(1, sum(self._client.nthreads().values()))
        return 2 + _WINDOW_PER_WORKER * self._threads


@contextmanager
def _cluster(address: str, size: _ClusterSize) -> Iterator[Executor]:
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
                f"{address}: no worker came within {_CLUSTER_PATIENCE_S:g} s"
            ) from None
        size.watch(client)
        # The same frame twice is not the same task: nothing is kept between runs.
        yield client.get_executor(pure=False)
