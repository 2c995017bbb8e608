"""Runs that end early: killed, without room on the disk, without their folder.

Whatever happens, the previous files are there or the new ones are, never a mixture, and
`--resume` ends with the bytes of a run that nothing happened to.
"""

from __future__ import annotations

import multiprocessing
import random
import resource
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from detect.cli import main
from tests.detect.forked_runs import (
    PATIENCE_S,
    STOPPING_PROGRAM,
    DieAfter,
    DieAtPlacing,
    ForkedRun,
    ForkedRuns,
    Room,
    StopAfter,
    forked_runs,
    started,
    wait_until_stopped,
)
from tests.detect.interrupted_runs import (
    FRAMES,
    KINDS,
    PREVIOUS,
    Captured,
    command,
    hidden,
    journalled,
    results,
    resumed,
)

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="kills as Linux does")


@pytest.fixture(scope="module")
def runs(
    run_folder: Path, undisturbed: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ForkedRuns]:
    with forked_runs(run_folder, tmp_path_factory.mktemp("forked")) as started_runs:
        yield started_runs


def lay_previous(folder: Path) -> dict[str, bytes]:
    for kind in KINDS:
        (folder / f"detected.{kind}").write_bytes(PREVIOUS)
    return results(folder)


def killed(runs: ForkedRuns, run: Path, output: Path, frames: int, *flags: str) -> int:
    """Kill a run once it has done so many frames; gives how many are done."""
    with runs.started(command(run, output, *flags), StopAfter(frames)) as process:
        process.wait_until_stopped()
        process.kill()
        assert process.wait() == -signal.SIGKILL
    return journalled(output)


def processor_s_of(arguments: list[str]) -> float:
    begun = time.process_time()
    assert main(arguments) == 3
    return time.process_time() - begun


def test_a_run_that_has_ended_and_is_not_told_of_yet() -> None:
    here, there = multiprocessing.Pipe()
    no_such_process = 1 << 30
    ForkedRun(here, no_such_process).kill()
    there.send((3, "ended"))
    run = ForkedRun(here, no_such_process)
    run.kill()
    assert (run.wait(), run.said()) == (3, "ended")


# -- killed -----------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_killed_run_is_resumed(
    run_folder: Path, output: Path, undisturbed: dict[str, bytes], capsys: Captured, jobs: str
) -> None:
    """As a user starts it, with and without workers."""
    before = lay_previous(output)
    arguments = command(run_folder, output, "--jobs", jobs)
    with started(["-c", STOPPING_PROGRAM, "14", *arguments]) as process:
        wait_until_stopped(process.pid, lambda: process.poll() is None)
        process.kill()
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGKILL
    assert journalled(output) == 14
    assert results(output) == before
    assert resumed(run_folder, output, capsys) == 14
    assert results(output) == undisturbed
    assert hidden(output) == set()


@pytest.mark.long
def test_a_resumed_run_may_be_killed_again(
    runs: ForkedRuns,
    run_folder: Path,
    output: Path,
    undisturbed: dict[str, bytes],
    capsys: Captured,
) -> None:
    first = killed(runs, run_folder, output, 8)
    second = killed(runs, run_folder, output, 8, "--resume")
    assert (first, second) == (8, 16)
    assert resumed(run_folder, output, capsys) == second
    assert results(output) == undisturbed


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="looks for shared memory in /dev/shm")
def test_workers_of_a_killed_run_leave_no_shared_memory(
    runs: ForkedRuns, run_folder: Path, output: Path
) -> None:
    def there() -> set[str]:
        return {path.name for path in Path("/dev/shm").iterdir()}

    before = there()
    with runs.started(command(run_folder, output, "--jobs", "2"), StopAfter(8)) as process:
        process.wait_until_stopped()
        own = there() - before
        process.kill()
    assert len(own) > 4
    end = time.monotonic() + PATIENCE_S
    while own & there():
        assert time.monotonic() < end, "what the run shared with its workers stays"
        time.sleep(0.01)


@pytest.mark.long
def test_killed_at_any_moment(
    runs: ForkedRuns,
    run_folder: Path,
    output: Path,
    undisturbed: dict[str, bytes],
    capsys: Captured,
) -> None:
    """At moments from the program's start to its end, with and without workers."""
    moments = random.Random(5)
    outcomes = {"previous": 0, "new": 0, "between": 0}
    whole_s = processor_s_of(command(run_folder, output))
    for trial in range(8):
        jobs = "2" if trial % 5 == 4 else "1"
        before = lay_previous(output)
        arguments = command(run_folder, output, "--jobs", jobs)
        if trial % 2:  # half of them surely while frames are worked on
            with runs.started(arguments, StopAfter(moments.randrange(FRAMES))) as process:
                process.wait_until_stopped()
                process.go_on()
                time.sleep(moments.uniform(0.0, 0.02))
                process.kill()
        elif trial % 10 == 0 or jobs == "2":  # as users start it
            with started(["-m", "detect", *arguments]) as program:
                time.sleep(moments.uniform(0.0, 4.0))
                program.kill()
                program.communicate(timeout=PATIENCE_S)
        else:
            code, err = runs.ended(arguments, DieAfter(moments.uniform(0.0, 1.1 * whole_s)))
            assert code in (-signal.SIGPROF, 3), err
        outcomes[state_of(results(output), before, undisturbed)] += 1
        resumed(run_folder, output, capsys, "--jobs", "2" if trial == 4 else "1")
        assert results(output) == undisturbed
        assert hidden(output) == set()
    assert outcomes["previous"] > 3
    # They take them by four calls in a row: hardly any kill falls between those.
    assert outcomes["between"] <= 1


def state_of(found: dict[str, bytes], before: dict[str, bytes], after: dict[str, bytes]) -> str:
    """Whether files have not taken their places, all have, or a kill fell right between them."""
    if found in (before, after):
        return "new" if found == after else "previous"
    assert set(found) == set(before) == set(after)
    assert all(found[name] in (before[name], after[name]) for name in found)
    return "between"


@pytest.mark.parametrize("resume", [True, False])
@pytest.mark.parametrize("placed", [0, 1, 2, 3])
@pytest.mark.long
def test_killed_while_files_take_their_places(
    runs: ForkedRuns,
    run_folder: Path,
    output: Path,
    undisturbed: dict[str, bytes],
    capsys: Captured,
    placed: int,
    resume: bool,
) -> None:
    """The next run does what was left, whether or not it resumes, and whatever else it does."""
    lay_previous(output)
    code, _ = runs.ended(command(run_folder, output), DieAtPlacing(placed))
    assert code == -signal.SIGKILL
    if resume:
        assert resumed(run_folder, output, capsys) == FRAMES
    else:
        assert main(["all", str(run_folder), "-o", str(output)]) == 1
        assert "exists already" in capsys.readouterr().err
    assert results(output) == undisturbed
    assert hidden(output) == set()


@pytest.mark.long
def test_what_a_killed_run_left_is_removed(
    runs: ForkedRuns, run_folder: Path, output: Path, undisturbed: dict[str, bytes]
) -> None:
    killed(runs, run_folder, output, 10)
    assert hidden(output) == {".detected.journal"}
    assert main(command(run_folder, output)) == 3
    assert results(output) == undisturbed
    assert hidden(output) == set()


@pytest.mark.long
def test_files_that_must_stay_do_not_cost_what_was_kept(
    runs: ForkedRuns,
    run_folder: Path,
    output: Path,
    undisturbed: dict[str, bytes],
    capsys: Captured,
) -> None:
    """Who forgets `--force` is told, and loses nothing."""
    done = killed(runs, run_folder, output, 10)
    lay_previous(output)
    for flags in ([], ["--resume"]):
        assert main(["all", str(run_folder), "-o", str(output), *flags]) == 1
        assert "exists already" in capsys.readouterr().err
    assert resumed(run_folder, output, capsys) == done
    assert results(output) == undisturbed


# -- disks and folders --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("room", [100, 2_000, 9_000, 30_000])
def test_no_room_left(
    runs: ForkedRuns,
    run_folder: Path,
    output: Path,
    undisturbed: dict[str, bytes],
    capsys: Captured,
    room: int,
) -> None:
    """The largest file may have so many bytes: too few for the first frames, then half-way."""
    assert room < max(len(content) for content in undisturbed.values())
    before = lay_previous(output)
    code, err = runs.ended(command(run_folder, output), Room(room))
    assert code == 1, err
    *_, line = err.splitlines()
    assert line.startswith("error: ")
    assert "File too large" in line
    assert str(output / "detected.") in line
    assert ".part" not in line
    assert results(output) == before
    taken = resumed(run_folder, output, capsys)
    assert taken > 0 or room <= 9_000
    assert results(output) == undisturbed
    assert hidden(output) == set()


def test_the_limit_is_the_tests_own() -> None:
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY


@pytest.mark.long
def test_the_folder_vanishes(runs: ForkedRuns, run_folder: Path, output: Path) -> None:
    with runs.started(command(run_folder, output), StopAfter(5)) as process:
        process.wait_until_stopped()
        shutil.rmtree(output)
        process.go_on()
        code, err = process.wait(), process.said()
    assert code == 1, err
    *_, line = err.splitlines()
    assert line.startswith("error: ")
    assert f"no such folder: {output}" in line
    assert "--resume" not in err
    assert not output.exists()


@pytest.mark.long
def test_a_folder_of_the_same_name_comes_back(
    runs: ForkedRuns, run_folder: Path, output: Path
) -> None:
    """Somebody moved the results away and laid others there: nothing of them is touched."""
    with runs.started(command(run_folder, output), StopAfter(5)) as process:
        process.wait_until_stopped()
        output.rename(output.with_name("moved"))
        output.mkdir()
        before = lay_previous(output)
        process.go_on()
        code = process.wait()
    assert code == 1
    assert results(output) == before
    assert hidden(output) == set()


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_in_the_place_of_a_result(
    run_folder: Path, output: Path, capsys: Captured, kind: str
) -> None:
    """Told before anything is done, not when some of the files have taken their places."""
    (output / f"detected.{kind}").mkdir()
    assert main(command(run_folder, output)) == 1
    assert f"Is a directory: '{output / f'detected.{kind}'}'" in capsys.readouterr().err
    assert [path.name for path in output.iterdir()] == [f"detected.{kind}"]
