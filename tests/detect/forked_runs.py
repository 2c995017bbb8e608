"""Runs of `detect` in a process each, without the cost of its start.

Starting Python, importing and loading compiled kernels takes ten times as long as the small runs
of the tests. A process of their own does that once, and runs are forked off it; where the start
itself is at stake, `python -m detect` is started as a user does.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from detect.runs.plan import FrameRows, FrameTask

#: Nothing takes that long, but to compile kernels on a slow machine.
PATIENCE_S = 600.0

#: `python -m detect`, but stopped as `StopAfter` does: the first argument says when.
STOPPING_PROGRAM = """
import runpy, sys
from tests.detect.forked_runs import StopAfter

if __name__ == "__main__":
    StopAfter(int(sys.argv.pop(1)))()
    runpy.run_module("detect", run_name="__main__", alter_sys=True)
"""

Preparation = Callable[[], None]


class DieAtPlacing:
    """Killed at the so manyth file that takes its place."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __call__(self) -> None:
        replace, placed = Path.replace, list[Path]()

        def killed(path: Path, target: Path) -> Path:
            if len(placed) == self.number:
                os.kill(os.getpid(), signal.SIGKILL)
            placed.append(target)
            return replace(path, target)

        Path.replace = killed  # type: ignore[method-assign, assignment]


class DieAfter:
    """Killed after so much processor time, at whatever it is, without a last word."""

    def __init__(self, processor_s: float) -> None:
        self.processor_s = processor_s

    def __call__(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, max(self.processor_s, 1e-6))


class StopAfter:
    """Stopped, as SIGSTOP does, once so many frames are written and noted."""

    def __init__(self, frames: int) -> None:
        self.frames = frames

    def __call__(self) -> None:
        from detect.runs.stream import RunFiles

        add, count = RunFiles.add, [0]
        if self.frames == 0:
            os.kill(os.getpid(), signal.SIGSTOP)

        def stopped(files: RunFiles, frames: Sequence[tuple[FrameTask, FrameRows]]) -> None:
            for frame in frames:
                add(files, [frame])
                count[0] += 1
                if count[0] == self.frames:
                    os.kill(os.getpid(), signal.SIGSTOP)

        RunFiles.add = stopped  # type: ignore[method-assign, assignment]


class Room:
    """Files may have so many bytes only, and frames are written eight by eight."""

    def __init__(self, size: int) -> None:
        self.size = size

    def __call__(self) -> None:
        from detect.runs import workers

        workers._TOGETHER = 8
        resource.setrlimit(resource.RLIMIT_FSIZE, (self.size, resource.RLIM_INFINITY))


class ForkedRun:
    """One run; of the interface of `subprocess.Popen` what the tests need."""

    def __init__(self, connection: Connection, pid: int) -> None:
        self._connection, self.pid = connection, pid
        self._said = ""
        self.returncode: int | None = None

    def poll(self) -> int | None:
        if self.returncode is None and self._connection.poll():
            self.returncode, self._said = self._connection.recv()
        return self.returncode

    def wait_until_stopped(self) -> None:
        wait_until_stopped(self.pid, lambda: self.poll() is None)

    def go_on(self) -> None:
        os.kill(self.pid, signal.SIGCONT)

    def kill(self) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):  # it has just ended, and is not told of yet
                os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> int:
        if self.returncode is None:
            assert self._connection.poll(PATIENCE_S), "the run does not end"
            self.returncode, self._said = self._connection.recv()
        assert self.returncode is not None
        return self.returncode

    def said(self) -> str:
        """What stands on its standard error once it has ended."""
        self.wait()
        return self._said


def started(arguments: Sequence[str], **environment: str) -> subprocess.Popen[str]:
    """Python with some arguments, in a group of processes of its own, as a shell starts it."""
    root = Path(__file__).resolve().parents[2]
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_until_stopped(pid: int, runs: Callable[[], bool]) -> None:
    """Wait for a process that stops itself, as long as it runs."""
    end = time.monotonic() + PATIENCE_S
    while _state(pid) != "T":
        assert runs(), "the run has ended"
        assert time.monotonic() < end, "the run does not stop"
        time.sleep(0.002)


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


class ForkedRuns:
    """Starts runs of `detect`, one after the other."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    @contextmanager
    def started(
        self, arguments: Sequence[str], prepare: Preparation | None = None
    ) -> Iterator[ForkedRun]:
        self._connection.send((list(arguments), prepare))
        assert self._connection.poll(PATIENCE_S), "no run begins"
        run = ForkedRun(self._connection, self._connection.recv())
        try:
            yield run
        finally:
            try:
                run.kill()
            finally:
                run.wait()  # else the next run would be told how this one ended

    def ended(
        self, arguments: Sequence[str], prepare: Preparation | None = None
    ) -> tuple[int, str]:
        with self.started(arguments, prepare) as run:
            return run.wait(), run.said()


@contextmanager
def forked_runs(sample: Path, folder: Path) -> Iterator[ForkedRuns]:
    """Runs can be forked off while this lasts; `sample` is a run that loads what they need."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, str(sample), str(folder)))
    with pytest.MonkeyPatch.context() as patch:
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
            patch.setenv(name, "1")
        process.start()
    there.close()
    try:
        assert here.poll(PATIENCE_S), "no runs can be forked off"
        assert here.recv() == "ready"
        yield ForkedRuns(here)
    finally:
        here.close()
        process.join(PATIENCE_S)
        process.kill()
        process.join()
        process.close()


def _serve(connection: Connection, sample: str, folder: str) -> None:
    import cv2

    from detect.cli import main

    cv2.setNumThreads(1)
    warmed = Path(folder) / "warm"
    warmed.mkdir()
    main(["all", sample, "-o", str(warmed)])
    shutil.rmtree(warmed)
    _wait_until_alone()
    connection.send("ready")
    while True:
        try:
            arguments, prepare = connection.recv()
        except EOFError:
            return
        # A pipe, whose size is not bounded as a file's may be, and which holds all that is said.
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            _run(main, arguments, writing, prepare)
        os.close(writing)
        connection.send(pid)
        _, status = os.waitpid(pid, 0)
        os.set_blocking(reading, False)
        try:
            said = os.read(reading, 1 << 16)
        except BlockingIOError:  # workers still have the other end
            said = b""
        os.close(reading)
        connection.send((os.waitstatus_to_exitcode(status), said.decode()))


def _wait_until_alone() -> None:
    """A fork takes over one thread only; of others it would take over the locks.

    A thread that was waited for may be on its way out still.
    """
    end = time.monotonic() + PATIENCE_S
    while len(threads := [*Path("/proc/self/task").iterdir()]) > 1:
        assert time.monotonic() < end, threads
        time.sleep(0.002)


def _run(main: Callable[..., Any], arguments: list[str], said: int, prepare: Any) -> None:
    ignored = os.open(os.devnull, os.O_WRONLY)
    os.dup2(ignored, sys.stdout.fileno())
    os.dup2(said, sys.stderr.fileno())
    code = 70  # never given by the program itself
    # As a program of its own has it: what a killed one leaves is removed when its workers end, not
    # when the tests do, one of which may be counting semaphores.
    tracker: Any = resource_tracker._resource_tracker
    tracker._fd = tracker._pid = None
    try:
        if prepare is not None:
            prepare()
        code = main(arguments)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
