"""Runs that end early: killed, without room on the disk, without their folder.

Whatever happens, the previous files are there or the new ones are, never a mixture, and
`--resume` ends with the bytes of a run that nothing happened to.
"""

from __future__ import annotations

import multiprocessing
import random
import shutil
import signal
import time
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
    started,
    wait_until_stopped,
)
from tests.detect.interrupted_runs import FRAMES, KINDS, Trial

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="kills as Linux does")


def killed(runs: ForkedRuns, trial: Trial, frames: int, *flags: str) -> int:
    """Kill a run once it has done so many frames; gives how many are done."""
    with runs.started(trial.command(*flags), StopAfter(frames)) as process:
        process.wait_until_stopped()
        process.kill()
        assert process.wait() == -signal.SIGKILL
    return trial.journalled()


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
def test_a_killed_run_is_resumed(trial: Trial, jobs: str) -> None:
    """As a user starts it, with and without workers."""
    before = trial.lay_previous()
    arguments = trial.command("--jobs", jobs)
    with started(["-c", STOPPING_PROGRAM, "14", *arguments]) as process:
        wait_until_stopped(process.pid, lambda: process.poll() is None)
        process.kill()
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGKILL
    assert trial.journalled() == 14
    assert trial.results() == before
    assert trial.resumed() == 14
    trial.assert_complete()


@pytest.mark.long
def test_a_resumed_run_may_be_killed_again(runs: ForkedRuns, trial: Trial) -> None:
    first = killed(runs, trial, 8)
    second = killed(runs, trial, 8, "--resume")
    assert (first, second) == (8, 16)
    assert trial.resumed() == second
    assert trial.results() == trial.undisturbed


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="looks for shared memory in /dev/shm")
def test_workers_of_a_killed_run_leave_no_shared_memory(runs: ForkedRuns, trial: Trial) -> None:
    def there() -> set[str]:
        return {path.name for path in Path("/dev/shm").iterdir()}

    before = there()
    with runs.started(trial.command("--jobs", "2"), StopAfter(8)) as process:
        process.wait_until_stopped()
        own = there() - before
        process.kill()
    assert len(own) > 4
    end = time.monotonic() + PATIENCE_S
    while own & there():
        assert time.monotonic() < end, "what the run shared with its workers stays"
        time.sleep(0.01)


@pytest.mark.long
def test_killed_at_any_moment(runs: ForkedRuns, trial: Trial) -> None:
    """At moments from the program's start to its end, with and without workers."""
    moments = random.Random(5)
    outcomes = {"previous": 0, "new": 0, "between": 0}
    whole_s = processor_s_of(trial.command())
    for number in range(8):
        jobs = "2" if number % 5 == 4 else "1"
        before = trial.lay_previous()
        arguments = trial.command("--jobs", jobs)
        if number % 2:  # half of them surely while frames are worked on
            with runs.started(arguments, StopAfter(moments.randrange(FRAMES))) as process:
                process.wait_until_stopped()
                process.go_on()
                time.sleep(moments.uniform(0.0, 0.02))
                process.kill()
        elif number % 10 == 0 or jobs == "2":  # as users start it
            with started(["-m", "detect", *arguments]) as program:
                time.sleep(moments.uniform(0.0, 4.0))
                program.kill()
                program.communicate(timeout=PATIENCE_S)
        else:
            code, err = runs.ended(arguments, DieAfter(moments.uniform(0.0, 1.1 * whole_s)))
            assert code in (-signal.SIGPROF, 3), err
        outcomes[state_of(trial.results(), before, trial.undisturbed)] += 1
        trial.resumed("--jobs", "2" if number == 4 else "1")
        trial.assert_complete()
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
    runs: ForkedRuns, trial: Trial, placed: int, resume: bool
) -> None:
    """The next run does what was left, whether or not it resumes, and whatever else it does."""
    trial.lay_previous()
    code, _ = runs.ended(trial.command(), DieAtPlacing(placed))
    assert code == -signal.SIGKILL
    if resume:
        assert trial.resumed() == FRAMES
    else:
        assert main(["all", str(trial.run), "-o", str(trial.output)]) == 1
        assert "exists already" in trial.said()
    trial.assert_complete()


@pytest.mark.long
def test_what_a_killed_run_left_is_removed(runs: ForkedRuns, trial: Trial) -> None:
    killed(runs, trial, 10)
    assert trial.hidden() == {".detected.journal"}
    assert main(trial.command()) == 3
    trial.assert_complete()


@pytest.mark.long
def test_files_that_must_stay_do_not_cost_what_was_kept(runs: ForkedRuns, trial: Trial) -> None:
    """Who forgets `--force` is told, and loses nothing."""
    done = killed(runs, trial, 10)
    trial.lay_previous()
    for flags in ([], ["--resume"]):
        assert main(["all", str(trial.run), "-o", str(trial.output), *flags]) == 1
        assert "exists already" in trial.said()
    assert trial.resumed() == done
    assert trial.results() == trial.undisturbed


# -- disks and folders --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("room", [100, 2_000, 9_000, 30_000])
def test_no_room_left(runs: ForkedRuns, trial: Trial, room: int) -> None:
    """The largest file may have so many bytes: too few for the first frames, then half-way."""
    assert room < max(len(content) for content in trial.undisturbed.values())
    before = trial.lay_previous()
    code, err = runs.ended(trial.command(), Room(room))
    assert code == 1, err
    *_, line = err.splitlines()
    assert line.startswith("error: ")
    assert "File too large" in line
    assert str(trial.output / "detected.") in line
    assert ".part" not in line
    assert trial.results() == before
    taken = trial.resumed()
    assert taken > 0 or room <= 9_000
    trial.assert_complete()


@pytest.mark.long
def test_the_folder_vanishes(runs: ForkedRuns, trial: Trial) -> None:
    with runs.started(trial.command(), StopAfter(5)) as process:
        process.wait_until_stopped()
        shutil.rmtree(trial.output)
        process.go_on()
        code, err = process.wait(), process.said()
    assert code == 1, err
    *_, line = err.splitlines()
    assert line.startswith("error: ")
    assert f"no such folder: {trial.output}" in line
    assert "--resume" not in err
    assert not trial.output.exists()


@pytest.mark.long
def test_a_folder_of_the_same_name_comes_back(runs: ForkedRuns, trial: Trial) -> None:
    """Somebody moved the results away and laid others there: nothing of them is touched."""
    with runs.started(trial.command(), StopAfter(5)) as process:
        process.wait_until_stopped()
        trial.output.rename(trial.output.with_name("moved"))
        trial.output.mkdir()
        before = trial.lay_previous()
        process.go_on()
        code = process.wait()
    assert code == 1
    assert trial.results() == before
    assert trial.hidden() == set()


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_in_the_place_of_a_result(trial: Trial, kind: str) -> None:
    """Told before anything is done, not when some of the files have taken their places."""
    (trial.output / f"detected.{kind}").mkdir()
    assert main(trial.command()) == 1
    assert f"{trial.output / f'detected.{kind}'}: is a folder" in trial.said()
    assert [path.name for path in trial.output.iterdir()] == [f"detected.{kind}"]
