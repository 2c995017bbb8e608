"""Commands and other programs, what they say, and the files of their results."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from detect.cli import main

Captured = pytest.CaptureFixture[str]


def files_in(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def output_of(program: str, *arguments: str) -> str:
    """What a Python program prints that ends well, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=Path(__file__).resolve().parents[2], capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def in_browser(address: str, profile: Path, *flags: str) -> tuple[str, str]:
    """What a browser makes of a page, and what it says."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium on this machine")
    usual = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0")
    shown = subprocess.run(
        [browser, *usual, *flags, f"--user-data-dir={profile}", "--dump-dom", address],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return shown.stdout, shown.stderr


def rows_in(path: Path) -> list[str]:
    """The lines of a file of landmarks but for its comments."""
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def assert_refused(arguments: list[str], run: Path, names: str, captured: Captured) -> str:
    """Exit code 1, one line that names the file, and nothing written or changed."""
    before = files_in(run)
    assert main(arguments) == 1
    shown = captured.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert line.startswith("error: ")
    assert names in line
    assert files_in(run) == before
    return line
