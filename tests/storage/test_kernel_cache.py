"""Compiled kernels: what is said where they cannot be loaded, or are compiled."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
from numba.core import event

from detect.terminal import on_compilation

PAIRED = """
from typing import NamedTuple
from numba import njit

class {name}(NamedTuple):
    first: float
    second: float

@njit(cache=True)
def total(pair):
    return pair.first + pair.second

def of(first, second):
    return total({name}(first, second))
"""

PROGRAM = """
import sys
from functools import cache
from detect.terminal import on_compilation
from redetect.command_line import exit_code_of
from kernels import of

on_compilation(cache(lambda: print("compiles")))
sys.exit(exit_code_of(lambda: print(of(1.0, 2.0), of(1, 2)) or 0))
"""


def test_garbage_is_collected_again_although_a_call_before_compilation_fails() -> None:
    collected: list[bool] = []

    def refuse_once() -> None:
        if not collected:
            raise RuntimeError

    stop = on_compilation(refuse_once)
    for expected in (pytest.raises(RuntimeError), nullcontext()):
        with expected, event.trigger_event("numba:compile"):
            pass
        collected.append(gc.isenabled())
    stop()
    assert collected == [True, True]


def run(folder: Path) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).resolve().parents[2]
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(root), str(folder)]),
            "NUMBA_CACHE_DIR": str(folder / "cache"),
        },
        capture_output=True,
        text=True,
        check=False,
    )


def test_kernels_are_kept_and_those_of_other_classes_are_named(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(PAIRED.format(name="Pair"))
    assert run(tmp_path).stdout == "compiles\n3.0 3\n"
    assert run(tmp_path).stdout == "3.0 3\n"
    # Another version of the program: the index names a class that it does not have.
    (tmp_path / "kernels.py").write_text(PAIRED.format(name="Couple"))
    refused = run(tmp_path)
    assert (refused.returncode, refused.stdout) == (1, "")
    (line,) = refused.stderr.splitlines()
    assert line.startswith("error: compiled kernels cannot be loaded: ")
    assert "NUMBA_CACHE_DIR" in line
