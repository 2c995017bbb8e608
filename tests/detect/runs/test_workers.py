"""Processes and machines that share the work: killed, interrupted, missing."""

from __future__ import annotations

import builtins
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from numba import njit
from numba.core import event

import detect.runs.workers as workers_module
from detect.cli import main
from detect.errors import WorkerError
from detect.line_settings import LineSettings
from detect.runs.plan import FramePlan, Job
from detect.runs.stream import detect_run
from detect.runs.workers import (
    FRAMES_PER_PROCESS,
    Workers,
    cluster_workers,
    default_jobs,
    local_workers,
)
from detect.settings import CircleSettings
from detect.sources.opening import open_run
from detect.terminal import on_compilation
from tests.detect.commands import Captured
from tests.detect.demo_frames import demo_frames
from tests.detect.forked_runs import started

KINDS = ("lines", "tilt", "circles")
FRAMES = 48
#: Of a run that is killed or interrupted: it does not end before, however fast the machine is.
MANY_FRAMES = 3000
#: Nothing takes that long, but to compile kernels on a slow machine.
PATIENCE_S = 600.0


@pytest.fixture(scope="module")
def run_folder(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough to be disturbed: frames of the demo run, over and over."""
    run = tmp_path_factory.mktemp("run") / "e"
    return demo_frames(project_root, run, [place % 8 for place in range(FRAMES)])


@pytest.fixture(scope="module")
def expected(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """What one process writes."""
    return detected(run_folder, tmp_path_factory.mktemp("expected") / "one", local_workers(1))


@pytest.fixture
def long_run(project_root: Path, tmp_path: Path) -> Path:
    """One image over and over; links that lead out of a run are refused."""
    run = demo_frames(project_root, tmp_path / "e", [0])
    image = (run / "images" / "e.0000.jpg").rename(run / "image.jpg")
    for number in range(MANY_FRAMES):
        (run / "images" / f"e.{number:04d}.jpg").symlink_to(image)
    return run


def test_a_kernel_may_be_compiled_between_two_tasks(project_root: Path) -> None:
    camera = open_run(project_root / "images" / "e").camera
    plan = FramePlan(camera, LineSettings(), CircleSettings())
    with local_workers(1, shared=True).start(plan):
        assert njit(lambda number: number + 1)(1) == 2


def detected(
    run: Path, output: Path, workers: Workers, on_progress: Callable[[], None] | None = None
) -> list[bytes]:
    output.mkdir()
    places = {kind: output / f"detected.{kind}" for kind in KINDS}
    opened = open_run(run)
    plan = FramePlan(opened.camera, LineSettings(), CircleSettings(polarity="light"))
    summary = detect_run(Job(opened, plan, places), workers, on_progress)
    assert (summary.frames, summary.failures) == (FRAMES, [])
    return [path.read_bytes() for path in places.values()]


def at_frame(number: int, act: Callable[[], None]) -> Callable[[], None]:
    """A progress callback that acts once, so many frames into the run."""
    seen = [0]

    def tick() -> None:
        seen[0] += 1
        if seen[0] == number:
            act()

    return tick


def test_as_many_processes_as_are_worth_it() -> None:
    assert default_jobs(1) == default_jobs(2 * FRAMES_PER_PROCESS - 1) == 1
    assert 1 <= default_jobs(10**6) <= (os.cpu_count() or 1)


@pytest.mark.parametrize("jobs", [0, 10**12])
def test_impossible_numbers_of_workers_are_refused(jobs: int) -> None:
    with pytest.raises(WorkerError, match=f"jobs is {jobs}: expected 1 to 1000"):
        local_workers(jobs)


def test_kernels_are_compiled_once_and_first(run_folder: Path, monkeypatch: Any) -> None:
    """By two processes; the task that was interrupted begins again."""
    began: list[str] = []

    class Processes(ThreadPoolExecutor):
        def __init__(self, count: int, plan: FramePlan, *, show: bool) -> None:
            assert not show
            super().__init__(count)

        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Any:
            began.append(f"{self._max_workers} {fn.__name__} {args[1]}")
            return super().submit(lambda: 1 / 0)  # what fails there is nothing to this process

    def work(plan: FramePlan, chunk: str) -> int:
        for _ in range(2):
            with event.trigger_event("numba:compile"):
                began.append(f"compiled {chunk}")
        return 7

    monkeypatch.setattr(workers_module, "_ProcessPool", Processes)
    monkeypatch.setattr(workers_module, "_cores", lambda: 2)
    plan = FramePlan(open_run(run_folder).camera, LineSettings(), CircleSettings())
    with local_workers(1, shared=True).start(plan) as executor:
        assert executor.submit(work, plan, "images").result() == 7
    assert began == ["2 work_on_chunk images"] * 2 + ["compiled images"] * 2
    only_lines = replace(plan, circles=None)
    with local_workers(1, shared=True).start(only_lines) as executor:
        executor.submit(work, only_lines, "more")
    assert began[4:] == ["compiled more", "compiled more"]


def test_each_process_of_a_pool_compiles_a_part(run_folder: Path, monkeypatch: Any) -> None:
    """And waits for the other one's, before its task begins again."""
    began: list[str] = []
    plan = FramePlan(open_run(run_folder).camera, LineSettings(), CircleSettings())
    taken_elsewhere, waited_for = threading.Event(), threading.Event()
    mine, other, tables = (multiprocessing.get_context("spawn").RLock() for _ in range(3))

    def occupy() -> None:
        with other:
            taken_elsewhere.set()
            waited_for.wait(10.0)
            began.append("the other process is ready")

    def compile_discs(plan: FramePlan, *, search: bool) -> None:
        began.append(f"discs, search {search}")
        with event.trigger_event("numba:compile"):  # is this process's own
            began.append("compiled")
        waited_for.set()

    def work(plan: FramePlan, chunk: str) -> str:
        began.append(f"{chunk}, discs {plan.circles is not None}")
        with event.trigger_event("numba:compile"):
            began.append("compiled")
        return chunk

    monkeypatch.setattr(workers_module, "work_on_chunk", work)
    monkeypatch.setattr("detect.runs.frame.compile_discs", compile_discs)
    monkeypatch.setattr(workers_module, "_parts", [mine, other])
    forget = on_compilation(lambda: workers_module._before_compilation(tables))
    thread = threading.Thread(target=occupy)
    thread.start()
    taken_elsewhere.wait(10.0)
    assert workers_module._in_worker(work, plan, "images") == "images"
    forget()
    thread.join()
    assert began == [
        "images, discs True", "images, discs False", "compiled", "discs, search True", "compiled",
        "the other process is ready", "images, discs True", "compiled",
    ]  # fmt: skip
    assert not workers_module._parts
    assert not workers_module._compiling


@pytest.mark.long
def test_a_killed_process_costs_nothing(
    run_folder: Path, expected: list[bytes], tmp_path: Path
) -> None:
    plain = local_workers(2)
    killed: list[int | None] = []
    starts: list[FramePlan] = []

    def start(plan: FramePlan) -> AbstractContextManager[Executor]:
        starts.append(plan)
        return plain.start(plan)

    def kill() -> None:
        victim = multiprocessing.active_children()[0]
        victim.kill()
        killed.append(victim.pid)

    # Most of the frames are not yet given to anybody then, in whatever order the two work.
    two = Workers(start, chunk=4, window=lambda: 2)
    found = detected(run_folder, tmp_path / "two", two, at_frame(8, kill))
    assert len(killed) == 1
    assert len(starts) == 2  # others took the place of those that the killed one belonged to
    assert found == expected
    assert multiprocessing.active_children() == []


# -- interrupts -----------------------------------------------------------------------------


@contextmanager
def at_work(run: Path, jobs: int) -> Iterator[subprocess.Popen[str]]:
    """`detect all` at work."""
    arguments = ["-m", "detect", "all", str(run), "--jobs", str(jobs)]
    with started(arguments, REDETECT_TEST=str(run)) as process:
        try:
            yield process
        finally:
            process.kill()


def processes_of(run: Path) -> list[int]:
    """Processes that are at work on a run, by a variable in their environment."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with suppress(OSError):
                content = (folder / "environ").read_bytes()
                if f"REDETECT_TEST={run}".encode() in content.split(b"\0"):
                    found.append(int(folder.name))
    return found


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.05)


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize(("jobs", "delay_s"), [(1, 0.5), (2, 0.3), (2, 1.5)])
def test_an_interrupt_ends_everything(long_run: Path, jobs: int, delay_s: float) -> None:
    """Control-C reaches the whole group of processes, at whatever they are."""
    before = sorted(path.name for path in long_run.iterdir())
    with at_work(long_run, jobs) as process:
        wait_until(lambda: bool(list(long_run.glob(".*.journal"))), "the run to begin")
        time.sleep(delay_s)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, err
    assert out == ""
    assert err.splitlines()[-1] == "interrupted"
    assert "Traceback" not in err
    left = {path.name for path in long_run.iterdir()} - set(before)
    assert left in (
        set(),
        {".detected.journal"},
    )  # whether a frame was done: `--resume` goes on after it
    assert ("--resume" in err) == bool(left)
    wait_until(lambda: not processes_of(long_run), "its processes to end")


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_processes_end_with_the_one_that_started_them(long_run: Path) -> None:
    with at_work(long_run, 2) as process:
        # Itself, both workers, and the one that Python has look after semaphores.
        wait_until(lambda: len(processes_of(long_run)) >= 4, "the workers")
        process.kill()
    wait_until(lambda: not processes_of(long_run), "its processes to end")


# -- a cluster ------------------------------------------------------------------------------


def address_in(contact: Path) -> str:
    """A scheduler's address in the file that it writes; nothing as long as that is not whole."""
    try:
        return str(json.loads(contact.read_text())["address"])
    except (FileNotFoundError, ValueError):
        return ""


def test_the_address_in_a_file_that_is_still_written(tmp_path: Path) -> None:
    whole = json.dumps({"type": "Scheduler", "address": "tcp://127.0.0.1:8786"}, indent=2)
    contact = tmp_path / "scheduler.json"
    assert address_in(contact) == ""
    for length in range(len(whole)):
        contact.write_text(whole[:length])
        assert address_in(contact) == ""
    contact.write_text(whole)
    assert address_in(contact) == "tcp://127.0.0.1:8786"


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers, each a process of its own; yields address and workers."""
    root = Path(__file__).resolve().parents[3]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    contact = folder / "scheduler.json"
    quiet: dict[str, Any] = {"cwd": folder, "env": environment, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    local = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(contact)]
    processes = [subprocess.Popen([*dask, "scheduler", "--port", "0", *local], **quiet)]
    try:
        for _ in range(workers):
            alone = ["--nthreads", "1", "--no-nanny", "--local-directory", str(folder)]
            processes.append(subprocess.Popen([*dask, "worker", *local, *alone], **quiet))
        # It is there before what it says is in it.
        wait_until(lambda: bool(address_in(contact)), "the scheduler")
        yield address_in(contact), processes[1:]
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


@pytest.mark.lowest
@pytest.mark.long
def test_a_cluster_writes_what_one_process_does(
    run_folder: Path, expected: list[bytes], tmp_path: Path
) -> None:
    """Also when one of its workers is killed half-way."""
    distributed = pytest.importorskip("distributed")
    with cluster(tmp_path, workers=2) as (address, workers):
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=PATIENCE_S)
        kill = at_frame(FRAMES // 2, workers[0].kill)
        # Small tasks, so that both have some when one is killed.
        small = replace(cluster_workers(address), chunk=2)
        found = detected(run_folder, tmp_path / "cluster", small, kill)
        assert workers[0].wait(PATIENCE_S) == -signal.SIGKILL
        assert workers[1].poll() is None
    assert found == expected


def test_a_missing_package_is_named(
    small_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    real = builtins.__import__

    def without(name: str, *arguments: Any, **named: Any) -> Any:
        if name == "distributed":
            raise ImportError(name)
        return real(name, *arguments, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    assert main(["circles", str(small_run), "--cluster", "tcp://127.0.0.1:1"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'redetect[cluster]'" in line
    assert not (small_run / "detected.circles").exists()


@pytest.mark.parametrize("address", ["nonsense", "localhost:8786", "tcp://localhost", ":::"])
def test_malformed_addresses(small_run: Path, capsys: Captured, address: str) -> None:
    assert main(["lines", str(small_run), "--cluster", address]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"cluster is {address!r}: expected the scheduler's tcp://host:port" in line


def test_jobs_or_a_cluster(small_run: Path, capsys: Captured) -> None:
    assert main(["all", str(small_run), "--jobs", "2", "--cluster", "tcp://127.0.0.1:1"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "--jobs and --cluster: expected one of them" in line
