"""A run of `detect all` that ends early, and what is there of it: for the tests of such runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from detect.cli import main
from tests.detect.demo_frames import demo_frames

Captured = pytest.CaptureFixture[str]

KINDS = ("lines", "tilt", "circles", "log.json")
FRAMES = 24
PREVIOUS = b"what was there before\n"


def a_run(project_root: Path, run: Path) -> Path:
    demo_frames(project_root, run, [place % 8 for place in range(FRAMES)])
    (run / "images" / "e.0011.jpg").write_bytes(b"no image")  # a bad frame is resumed as well
    return run


def results(folder: Path) -> dict[str, bytes]:
    """The files of a folder that are not hidden."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
    }


def hidden(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.name.startswith(".")}


def command(run: Path, output: Path, *flags: str) -> list[str]:
    return ["all", str(run), "-o", str(output), "--force", *flags]


def journalled(folder: Path) -> int:
    """How many frames the journal has; 0 where there is none."""
    try:
        return (folder / ".detected.journal").read_bytes().count(b"\n") - 1
    except OSError:
        return 0


def resumed(run: Path, output: Path, capsys: Captured, *flags: str) -> int:
    """Resume a run; gives how many frames were taken over."""
    capsys.readouterr()
    assert main(command(run, output, "--resume", *flags)) == 3
    shown = capsys.readouterr()
    assert f"{FRAMES} frames" in shown.out
    taken = [line for line in shown.err.splitlines() if "are reused" in line]
    return int(taken[0].split()[0]) if taken else 0
