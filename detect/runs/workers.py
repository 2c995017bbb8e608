"""Workers for the frames of a run: this process, processes of this machine, or a cluster.

Each is a standard executor with its number of frames per task, put together as
`detect.runs.dispatch.Workers`.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from multiprocessing.connection import wait
from multiprocessing.synchronize import RLock
from typing import TYPE_CHECKING, ParamSpec, TypeVar, cast

import cv2

from detect.announcing import (
    announcements_are_shown,
    on_compilation,
    say_compiling,
    show_announcements,
)
from detect.errors import WorkerError
from detect.interrupts import interrupts_deferred
from detect.runs.dispatch import Workers
from detect.runs.plan import FramePlan

if TYPE_CHECKING:
    from distributed import Client

P = ParamSpec("P")
R = TypeVar("R")

#: Fewer frames than this are not worth another process's start.
FRAMES_PER_PROCESS = 500

#: Frames of a task.
_TOGETHER = 16
_WINDOW_PER_WORKER = 3
_CLUSTER_ANSWER_S = 10.0
_CLUSTER_PATIENCE_S = 60.0
_CLUSTER_LOOK_S = 5.0
#: Time that processes have to end by themselves.
_GRACE_S = 1.0


def default_jobs(frames: int) -> int:
    """A process for every `FRAMES_PER_PROCESS` frames, at most as many as there are cores."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    return max(1, min(cores, frames // FRAMES_PER_PROCESS))


def local_workers(jobs: int, *, large: bool = False) -> Workers:
    """Processes of this machine; 1 is this process itself.

    Of `large` tasks, which carry images or bring pictures back, each has one frame.
    """
    if jobs < 1:
        raise WorkerError(f"jobs is {jobs}: expected 1 or more")
    chunk = 1 if large else _TOGETHER
    if jobs == 1:
        return Workers(lambda _: _InProcess(), chunk, window=lambda: 1)
    window = 2 + _WINDOW_PER_WORKER * jobs
    return Workers(lambda plan: _ProcessPool(jobs, plan), chunk, lambda: window)


def cluster_workers(address: str, *, large: bool = False) -> Workers:
    """The workers of a dask cluster, whose scheduler has an `address` as ``tcp://host:8786``.

    They have this program installed, in the same version, and see the images under the same
    paths. Of `large` tasks, which carry images or bring pictures back, each has one frame.

    Raises
    ------
    WorkerError
        If the address is invalid, or the package for clusters is not installed.
    """
    if not re.fullmatch(r"[a-z]+://\S+:[0-9]+", address):
        raise WorkerError(f"cluster is {address!r}: expected the scheduler's tcp://host:port")
    try:
        from distributed import KilledWorker
    except ImportError:
        raise WorkerError(
            "a cluster needs the package distributed: install it by pip install 'redetect[cluster]'"
        ) from None
    clients: list[Client] = []

    @lru_cache(maxsize=1)
    def threads(_: object) -> int:
        return sum(sum(client.nthreads().values()) for client in clients)

    def window() -> int:  # a cluster grows
        time_and_client = (time.monotonic() // _CLUSTER_LOOK_S, len(clients))
        return 2 + _WINDOW_PER_WORKER * max(1, threads(time_and_client))

    chunk = 1 if large else _TOGETHER
    return Workers(lambda _: _cluster(address, clients), chunk, window, died=(KilledWorker,))


# -- this process ---------------------------------------------------------------------------


class _InProcess(Executor):
    """Runs each task immediately, before it returns the future."""

    def __init__(self) -> None:
        on_compilation(say_compiling)

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        future: Future[R] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


# -- processes of this machine ---------------------------------------------------------------

# They are spawned, not forked: compiled kernels, OpenCV and the libraries of linear algebra have
# threads of their own, which no fork survives. They take no notice of an interrupt from the
# keyboard; the process that started them does, and ends them. If that process is killed, they end
# by themselves.


class _ProcessPool(ProcessPoolExecutor):
    """Processes that get ready for a plan; as a context manager it ends them.

    They inherit a blocked interrupt: it would reach them even while they start.
    """

    def __init__(self, count: int, plan: FramePlan) -> None:
        context = multiprocessing.get_context("spawn")
        arguments = (plan, context.RLock(), announcements_are_shown())
        super().__init__(count, mp_context=context, initializer=_begin, initargs=arguments)

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        with interrupts_deferred():  # else one would be left half started
            return super().submit(_in_worker, fn, *args, **kwargs)

    def __exit__(self, *_: object) -> None:
        """End them, whatever they are doing; a further interrupt waits for that.

        The thread that manages them is joined: an interrupted program leaves threads behind, and
        this one could be stopped after it has removed a semaphore and before it has recorded that.
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


#: Held by the process that compiles kernels, until it has done what it needs them for.
_compiling: list[RLock] = []


def _begin(plan: FramePlan, lock: RLock, show: bool) -> None:
    """Make a new process a worker; the first one to need them fills the caches for all."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if show:
        show_announcements()
    cv2.setNumThreads(1)
    on_compilation(lambda: _compile_or_wait(lock))
    with suppress(Exception):  # any error recurs, and is reported, with the first task
        from detect.runs.frame import tables_of  # loads detectors, which only workers need

        with lock:
            _in_worker(tables_of, plan)


def _compile_or_wait(lock: RLock) -> None:
    if not _compiling and lock.acquire(block=False):
        _compiling.append(lock)
        say_compiling()
    elif not _compiling:
        # All kernels but this one will be loaded: the other process has kept them.
        with lock:
            pass


def _in_worker(fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> R:
    try:
        return fn(*args, **kwargs)
    finally:
        while _compiling:
            _compiling.pop().release()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


# -- a cluster ------------------------------------------------------------------------------


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
                f"{address}: no worker came within {_CLUSTER_PATIENCE_S:g} s"
            ) from None
        clients[:] = [client]
        # The same frame twice is not the same task: nothing is kept between runs.
        yield client.get_executor(pure=False)
