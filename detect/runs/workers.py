"""Who works on the frames of a run: this process, processes of this machine, or a cluster.

Each is a standard executor with its number of frames per task, put together as
`detect.runs.dispatch.Workers`.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from detect.announcing import announce_compiling, announcements_are_shown
from detect.errors import WorkerError
from detect.runs.dispatch import Workers
from detect.runs.frame import FramePlan
from detect.runs.frame_rows import PIXELS_AT_ONCE
from detect.runs.garbage import tidy_now_and_then
from detect.runs.interrupts import interrupts_deferred
from detect.runs.processes import WorkerProcesses

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
_LARGE_PROCESS_CHUNK = 128
_TASKS_PER_PROCESS = 32
_CLUSTER_CHUNK = 16
_WINDOW_PER_WORKER = 3
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


@contextmanager
def _processes(jobs: int, plan: FramePlan) -> Iterator[Executor]:
    with ExitStack() as ending:
        with interrupts_deferred():
            pool = WorkerProcesses(jobs, plan, show=announcements_are_shown())
            ending.callback(pool.end)
        yield pool


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
