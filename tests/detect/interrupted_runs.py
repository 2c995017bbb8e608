"""A run of `detect all` that ends early, and what is there of it: for the tests of such runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from detect.cli import main
from tests.detect.commands import Captured
from tests.detect.demo_frames import demo_frames

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


def command(run: Path, output: Path, *flags: str) -> list[str]:
    return ["all", str(run), "-o", str(output), "--force", *flags]


def journalled(folder: Path) -> int:
    """How many frames the journal has; 0 where there is none."""
    try:
        return (folder / ".detected.journal").read_bytes().count(b"\n") - 1
    except OSError:
        return 0


@dataclass(frozen=True)
class Trial:
    """A run, a folder for its results, and what it writes when nothing happens to it."""

    run: Path
    output: Path
    undisturbed: dict[str, bytes]
    capsys: Captured

    def command(self, *flags: str) -> list[str]:
        return command(self.run, self.output, *flags)

    def results(self) -> dict[str, bytes]:
        return results(self.output)

    def hidden(self) -> set[str]:
        return {path.name for path in self.output.iterdir() if path.name.startswith(".")}

    def journalled(self) -> int:
        return journalled(self.output)

    def lay_previous(self) -> dict[str, bytes]:
        for kind in KINDS:
            (self.output / f"detected.{kind}").write_bytes(PREVIOUS)
        return self.results()

    def said(self) -> str:
        """What was said on standard error since the last time."""
        return self.capsys.readouterr().err

    def resumed(self, *flags: str) -> int:
        """Resume the run; gives how many frames were taken over."""
        self.capsys.readouterr()
        assert main(self.command("--resume", *flags)) == 3
        shown = self.capsys.readouterr()
        assert f"{FRAMES} frames" in shown.out
        taken = [line for line in shown.err.splitlines() if "are reused" in line]
        return int(taken[0].split()[0]) if taken else 0

    def assert_complete(self) -> None:
        """The results are those of the undisturbed run, and nothing else is there."""
        assert self.results() == self.undisturbed
        assert self.hidden() == set()
