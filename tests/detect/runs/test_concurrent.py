"""Runs at the same time, on the same folder and with the same caches; runs one after the other."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from detect.cli import main
from tests.detect.commands import Captured, files_in
from tests.detect.forked_runs import ForkedRuns, StopAfter, started
from tests.detect.interrupted_runs import FRAMES
from tools.soak.short_runs import repeat_short_runs

PATIENCE_S = 400.0
DETECT = ("-m", "detect")

pytestmark = pytest.mark.long


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said


def folder_of(path: Path) -> Path:
    path.mkdir()
    return path


def test_different_commands_on_one_folder(run_folder: Path, tmp_path: Path) -> None:
    """Cold tables, filled by all of them at once."""
    kinds = ("circles", "lines")
    alone, together = folder_of(tmp_path / "alone"), folder_of(tmp_path / "together")
    for kind in kinds:
        assert main([kind, str(run_folder), "-o", str(alone / f"rows.{kind}")]) == 3
    cold = {"REDETECT_CACHE": str(tmp_path / "tables")}
    processes = [
        started([*DETECT, kind, str(run_folder), "-o", str(together / f"rows.{kind}")], **cold)
        for kind in kinds
    ]
    for process in processes:
        code, said = ended(process)
        assert code == 3, said
    assert files_in(together) == files_in(alone)
    tables = [path.name for path in (tmp_path / "tables").iterdir()]
    assert len(tables) == 2
    assert all(name.endswith(".table") for name in tables)


def test_the_same_command_twice_is_refused(
    runs: ForkedRuns, run_folder: Path, tmp_path: Path, capsys: Captured
) -> None:
    output = folder_of(tmp_path / "output")
    arguments = ["all", str(run_folder), "-o", str(output)]
    with runs.started(arguments, StopAfter(FRAMES // 2)) as first:
        first.wait_until_stopped()
        for flags in ([], ["--resume"], ["--force"]):
            assert main([*arguments, *flags]) == 1
            *_, line = capsys.readouterr().err.splitlines()
            journal = output / ".detected.journal"
            assert line.startswith(f"error: {journal}: another run is writing")
        first.go_on()
        assert first.wait() == 3, first.said()
    assert len(files_in(output)) == 5


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="looks for shared memory in /dev/shm")
def test_short_runs_leave_nothing_behind(project_root: Path, tmp_path: Path) -> None:
    left = repeat_short_runs(project_root / "images" / "e", tmp_path, 2, 2)
    assert left.unmet() == []
    assert left.runs == 2
