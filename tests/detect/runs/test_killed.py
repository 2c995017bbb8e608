"""Runs that end early: killed, without room on the disk, without their folder.

Whatever happens, the previous files are there or the new ones are, never a mixture, and
`--resume` ends with the bytes of a run that nothing happened to.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
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
    wait_until_stopped,
)

Captured = pytest.CaptureFixture[str]

KINDS = ("lines", "tilt", "circles", "log.json")
FRAMES = 24
PREVIOUS = b"what was there before\n"

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="kills as Linux does")


def a_run(project_root: Path, run: Path) -> Path:
    source = project_root / "images" / "e"
    (run / "images").mkdir(parents=True)
    shutil.copy(source / "e.cam", run)
    for number in range(FRAMES):
        image = source / "images" / f"e.{number % 8:04d}.jpg"
        shutil.copy(image, run / "images" / f"e.{number:04d}.jpg")
    (run / "images" / "e.0011.jpg").write_bytes(b"no image")  # a bad frame is resumed as well
    return run


@pytest.fixture(scope="module")
def run_folder(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is not to be changed."""
    return a_run(project_root, tmp_path_factory.mktemp("run") / "e")


@pytest.fixture
def own_run(project_root: Path, tmp_path: Path) -> Path:
    """A run that may be changed."""
    return a_run(project_root, tmp_path / "e")


@pytest.fixture(scope="module")
def undisturbed(run_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What the run writes when nothing happens to it."""
    output = tmp_path_factory.mktemp("undisturbed")
    assert main(["all", str(run_folder), "-o", str(output)]) == 3
    return results(output)


@pytest.fixture(scope="module")
def runs(
    run_folder: Path, undisturbed: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ForkedRuns]:
    with forked_runs(run_folder, tmp_path_factory.mktemp("forked")) as started_runs:
        yield started_runs


@pytest.fixture
def output(tmp_path: Path) -> Path:
    folder = tmp_path / "output"
    folder.mkdir()
    return folder


def results(folder: Path) -> dict[str, bytes]:
    """The files of a folder that are not hidden."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
    }


def hidden(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.name.startswith(".")}


def lay_previous(folder: Path) -> dict[str, bytes]:
    for kind in KINDS:
        (folder / f"detected.{kind}").write_bytes(PREVIOUS)
    return results(folder)


def command(run: Path, output: Path, *flags: str) -> list[str]:
    return ["all", str(run), "-o", str(output), "--force", *flags]


def started(arguments: list[str]) -> subprocess.Popen[str]:
    root = Path(__file__).resolve().parents[3]
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def journalled(folder: Path) -> int:
    """How many frames the journal has; 0 where there is none."""
    try:
        return (folder / ".detected.journal").read_bytes().count(b"\n") - 1
    except OSError:
        return 0


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


def resumed(run: Path, output: Path, capsys: Captured, *flags: str) -> int:
    """Resume a run; gives how many frames were taken over."""
    capsys.readouterr()
    assert main(command(run, output, "--resume", *flags)) == 3
    shown = capsys.readouterr()
    assert f"{FRAMES} frames" in shown.out
    taken = [line for line in shown.err.splitlines() if "are taken over" in line]
    return int(taken[0].split()[0]) if taken else 0


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
    assert resumed(run_folder, output, capsys, "--jobs", jobs) == 14
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
    """At fifty moments, from the program's start to its end, with and without workers."""
    moments = random.Random(5)
    outcomes = {"previous": 0, "new": 0, "between": 0}
    whole_s = processor_s_of(command(run_folder, output))
    for trial in range(50):
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
        resumed(run_folder, output, capsys, "--jobs", "2" if trial in (4, 9) else "1")
        assert results(output) == undisturbed
        assert hidden(output) == set()
    assert outcomes["previous"] > 20
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
        assert resumed(run_folder, output, capsys) == 0
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
    assert hidden(output) == {".detected.journal", *[f".detected.{kind}.part" for kind in KINDS]}
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


# -- journals that do not fit -----------------------------------------------------------------


class Kept:
    """A run that was interrupted after half of its frames."""

    def __init__(self, run: Path, output: Path) -> None:
        self.run, self.output = run, output
        self.frames = self.interrupt_after(FRAMES // 2)

    def interrupt_after(self, frames: int) -> int:
        def interrupt() -> None:
            if journalled(self.output) >= frames:
                raise KeyboardInterrupt

        from detect import commands

        with pytest.MonkeyPatch.context() as patch:
            from contextlib import contextmanager

            @contextmanager
            def progress(*_: object) -> Iterator[Callable[[], None]]:
                yield interrupt

            patch.setattr(commands, "progress_bar", progress)
            assert main(command(self.run, self.output)) == 130
        return journalled(self.output)


@pytest.fixture
def kept(run_folder: Path, output: Path) -> Kept:
    return Kept(run_folder, output)


@pytest.fixture
def own(own_run: Path, output: Path) -> Kept:
    return Kept(own_run, output)


def test_an_interrupted_run_is_resumed(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured
) -> None:
    assert resumed(kept.run, kept.output, capsys) == kept.frames == FRAMES // 2
    assert results(kept.output) == undisturbed
    assert hidden(kept.output) == set()


@pytest.mark.parametrize("flags", [["--circles.threshold", "0.45"], ["--lines.alpha", "published"]])
def test_other_settings_begin_anew(kept: Kept, capsys: Captured, flags: list[str]) -> None:
    assert main(command(kept.run, kept.output, *flags)) == 3
    expected = results(kept.output)
    Kept(kept.run, kept.output)
    capsys.readouterr()
    assert resumed(kept.run, kept.output, capsys, *flags) == 0
    assert results(kept.output) == expected


def test_another_camera_begins_anew(own: Kept, tmp_path: Path, capsys: Captured) -> None:
    camera = (own.run / "e.cam").read_text().replace("1.50354", "1.51354")
    (own.run / "e.cam").write_text(camera)
    assert main(command(own.run, own.output, "--resume")) == 3
    assert "another camera" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 3
    assert results(own.output) == results(other)


def test_frames_after_one_that_changed_are_done_again(
    own: Kept, tmp_path: Path, capsys: Captured
) -> None:
    """The bad image was mended: its row, and those after it, are those of the run as it is now."""
    bad = own.run / "images" / "e.0011.jpg"
    shutil.copy(own.run / "images" / "e.0003.jpg", bad)
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 0
    capsys.readouterr()
    assert main(command(own.run, own.output, "--resume")) == 0
    assert "11 frames of an unfinished run are taken over" in capsys.readouterr().err
    assert results(own.output) == results(other)


def test_a_new_image_in_between_is_seen(own: Kept, tmp_path: Path, capsys: Captured) -> None:
    shutil.copy(own.run / "images" / "e.0003.jpg", own.run / "images" / "e.0005a.jpg")
    other = tmp_path / "other"
    other.mkdir()
    assert main(command(own.run, other)) == 3
    capsys.readouterr()
    assert main(command(own.run, own.output, "--resume")) == 3
    assert "6 frames of an unfinished run are taken over" in capsys.readouterr().err
    assert results(own.output) == results(other)


@pytest.mark.parametrize(
    ("kind", "damage"),
    [("lines", "changed"), ("circles", "shorter"), ("tilt", "missing"), ("log.json", "changed")],
)
def test_damaged_rows_are_not_taken_over(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured, kind: str, damage: str
) -> None:
    part = kept.output / f".detected.{kind}.part"
    content = bytearray(part.read_bytes())
    if damage == "changed":
        content[-5] ^= 1
    elif damage == "shorter":
        del content[-20:]
    if damage == "missing":
        part.unlink()
    else:
        part.write_bytes(content)
    assert resumed(kept.run, kept.output, capsys) < kept.frames
    assert results(kept.output) == undisturbed
    assert hidden(kept.output) == set()


@pytest.mark.parametrize("seed", range(9))
def test_damaged_journals(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured, seed: int
) -> None:
    """Torn, changed, or something else altogether: only what is proven to be right is used."""
    chance = random.Random(seed)
    journal = kept.output / ".detected.journal"
    content = bytearray(journal.read_bytes())
    if seed % 3 == 0:
        del content[chance.randrange(len(content)) :]
    elif seed % 3 == 1:
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    else:
        content = bytearray([b"", b"[" * 100_000, b"null\n" * 9][seed // 3])
    journal.write_bytes(content)
    assert resumed(kept.run, kept.output, capsys) <= kept.frames
    assert results(kept.output) == undisturbed
    assert hidden(kept.output) == set()


def test_rows_of_a_journal_that_were_swapped(kept: Kept, undisturbed: dict[str, bytes]) -> None:
    """Each line is in order by itself, but they belong to other frames."""
    journal = kept.output / ".detected.journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    lines[3], lines[4] = lines[4], lines[3]
    journal.write_bytes(b"".join(lines))
    assert main(command(kept.run, kept.output, "--resume")) == 3
    assert results(kept.output) == undisturbed


@pytest.mark.parametrize("name", [".detected.journal", ".detected.lines.part"])
def test_links_in_the_place_of_a_part_are_not_followed(
    run_folder: Path, output: Path, tmp_path: Path, undisturbed: dict[str, bytes], name: str
) -> None:
    precious = tmp_path / "precious"
    precious.write_bytes(PREVIOUS)
    (output / name).symlink_to(precious)
    main(command(run_folder, output))
    assert precious.read_bytes() == PREVIOUS
    assert results(output) == undisturbed


def test_resuming_what_was_never_begun(
    run_folder: Path, output: Path, undisturbed: dict[str, bytes], capsys: Captured
) -> None:
    assert resumed(run_folder, output, capsys) == 0
    assert results(output) == undisturbed


def test_pictures_of_the_frame_under_way(run_folder: Path, tmp_path: Path) -> None:
    """A killed run may have drawn a frame that it had not noted yet."""
    drawings = tmp_path / "drawn"
    arguments = ["circles", str(run_folder), "-o", str(tmp_path / "rows"), "--draw", str(drawings)]
    assert main(arguments) == 3
    whole = results(drawings)
    rows = (tmp_path / "rows").read_bytes()
    shutil.rmtree(drawings)
    (tmp_path / "rows").unlink()

    from detect.runs.resume import RunFiles

    add, count = RunFiles.add, [0]

    def fail(self: RunFiles, found: object) -> None:
        count[0] += 1
        if count[0] == 7:
            raise KeyboardInterrupt
        add(self, found)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFiles, "add", fail)
        assert main(arguments) == 130
    assert len(results(drawings)) == 7
    assert main([*arguments, "--resume"]) == 3
    assert results(drawings) == whole
    assert (tmp_path / "rows").read_bytes() == rows


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
    """The largest file may have so many bytes: too few for it at first, then half-way."""
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
    assert taken > 0 or room <= 2_000
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
    assert "No such file or directory" in line
    assert str(output) in line
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


def test_the_log_says_nothing_of_the_interruption(
    kept: Kept, undisturbed: dict[str, bytes], capsys: Captured
) -> None:
    resumed(kept.run, kept.output, capsys)
    log = json.loads(results(kept.output)["detected.log.json"])
    assert [failure["prefix"] for failure in log["failures"]] == ["e.0011"]
    assert log["failures"][0]["frame"] == 11
    assert log["frames"] == FRAMES
