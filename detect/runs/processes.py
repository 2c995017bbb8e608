"""Worker processes of this machine, and what goes on in them.

They are spawned, not forked: compiled kernels, OpenCV and the libraries of linear algebra have
threads of their own, which no fork survives. They take no notice of an interrupt from the keyboard;
the process that started them does, and ends them. If that process is killed, they end by
themselves.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from contextlib import suppress
from enum import Enum
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event, Lock
from typing import NamedTuple, ParamSpec, TypeVar, cast

from detect.announcing import announce_compiling, show_announcements
from detect.runs.frame import FramePlan, import_detectors, rehearse, tables_of
from detect.runs.garbage import settling, tidy_now_and_then
from detect.runs.interrupts import interrupts_deferred
from storage.kernel_loading import load_kernels_alone, waiting_before_compiling

P = ParamSpec("P")
R = TypeVar("R")

_GRACE_S = 1.0


class WorkerProcesses(ProcessPoolExecutor):
    """Processes that inherit a blocked interrupt: it would reach them even while they start.

    None is left half started: an interrupt of this process waits meanwhile.

    Parameters
    ----------
    count : int
        How many there are at most.
    plan : FramePlan
        What they begin with. They have it then: it does not travel with every task.
    show : bool
        Whether they announce on stderr what takes long.
    """

    def __init__(self, count: int, plan: FramePlan, *, show: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self._plan = plan
        with interrupts_deferred():
            self._stop = context.Event()
            super().__init__(
                count,
                mp_context=context,
                initializer=_begin,
                initargs=(plan, self._stop, _Beginning.of(context), show),
            )

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Have one of them do something."""
        given = [_Known.PLAN if value is self._plan else value for value in args]
        with interrupts_deferred():
            return super().submit(_unless_stopped, fn, *given, **kwargs)

    def end(self) -> None:
        """End them, whatever they are doing; a further interrupt waits for that.

        The thread that looks after them is waited for: an interrupted program leaves threads
        behind, and this one would be stopped between the removal of a semaphore and the note of
        that.
        """
        with interrupts_deferred():
            self._stop.set()
            processes = list((self._processes or {}).values())
            caretaker = cast("threading.Thread | None", self._executor_manager_thread)
            self.shutdown(wait=False, cancel_futures=True)
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


# -- in a worker process --------------------------------------------------------------------


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


class _Known(Enum):
    """What stands in a task for what a worker has already."""

    PLAN = "plan"


#: The plan that this process was started for.
_own_plan: FramePlan | None = None

#: Set when the run ends early.
_stopped: Event | None = None


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


def _unless_stopped(fn: Callable[..., R], /, *args: object, **kwargs: object) -> R:
    """Do a task, unless its result is no longer waited for."""
    if _stopped is not None and _stopped.is_set():
        raise CancelledError
    tidy_now_and_then()
    return fn(*[_own_plan if value is _Known.PLAN else value for value in args], **kwargs)
