"""Kernels that are compiled ahead, by two processes at the same time, are all that a run needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

DEMO = Path(__file__).parents[3] / "images" / "e"

#: Prints the signatures that the frames of a run need beyond those compiled ahead.
SCRIPT = """
import gc, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from detect.line_settings import LineSettings
from detect.runs.frame import compile_discs, detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import CircleSettings
from detect.sources.opening import open_run

def compiled():
    return {
        (kernel.py_func.__module__, kernel.py_func.__qualname__, str(signature))
        for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)
        for signature in kernel.signatures
    }

run = open_run(Path(sys.argv[1]))
plan = FramePlan(run.camera, LineSettings(), CircleSettings(), levelling="run")
tasks = [FrameTask(frame) for frame in run.frames][:: int(sys.argv[2])]
detect_batch(tasks, FramePlan(run.camera, LineSettings()))
for search in (True, False):
    compile_discs(plan, search=search)
before = compiled()
found = detect_batch(tasks, plan)
assert sum(len(each.discs.pixels) for each in found) > 10
for missing in sorted(compiled() - before):
    if missing[1] != "rim_points":  # is compiled, and stored, with follow_rims
        print(*missing)
"""


@pytest.mark.skipif(not DEMO.is_dir(), reason="the demo run is not part of the package")
def test_nothing_is_left_to_compile() -> None:
    command = [sys.executable, "-c", SCRIPT, str(DEMO), "8"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout == ""
