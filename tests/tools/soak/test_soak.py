"""The soak tool: what it makes, what it measures, and that it sees what it is to see."""

from __future__ import annotations

import multiprocessing
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from detect.cli import main as detect
from tools.soak import short_runs
from tools.soak.__main__ import main
from tools.soak.long_run import MOST_GROWTH_MIB, SoakResult, family
from tools.soak.short_runs import ShortRuns, marked

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="reads Linux's /proc")

shared_memory = pytest.mark.skipif(
    not Path("/dev/shm").is_dir(), reason="looks for shared memory in /dev/shm"
)

PATIENCE_S = 60.0

GOOD = SoakResult(
    frames=1000,
    jobs=2,
    duration_s=10.0,
    frames_per_s=(100.0, 100.0),
    decoding_ms=(0.7, 0.7),
    decodings_per_frame=(10.0, 10.0),
    resident_mib=(200.0, 200.0, 200.0, 200.0),
    worker_mib=(300.0, 300.0, 300.0, 300.0),
    descriptors=(40, 40, 40, 40),
    processes=4,
)


def test_processes_are_found_and_measured() -> None:
    """A child that has 40 MiB, 30 descriptors, and a child of its own."""
    program = (
        "import subprocess, sys; block = bytearray(b'1') * (40 << 20);"
        "files = [open('/dev/null') for _ in range(30)];"
        # The child says so, once it is all there.
        "say = 'print(\"ready\", flush=True); input()';"
        "subprocess.Popen([sys.executable, '-c', say]); input()"
    )
    mark = f"soak-test-{os.getpid()}"  # other tests of this sort may run at the same time
    with subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "REDETECT_MARK": mark},
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        found = family(process.pid)
        try:
            assert found[0].pid == process.pid
            assert len(found) == 2
            assert found[0].resident_bytes > 40 << 20
            assert found[0].descriptors >= 33
            assert sorted(marked("REDETECT_MARK", mark)) == sorted(s.pid for s in found)
        finally:
            for state in reversed(found):
                os.kill(state.pid, 9)
    end = time.monotonic() + PATIENCE_S  # one that is nobody's child any more ends when it is let
    while marked("REDETECT_MARK", mark) and time.monotonic() < end:
        time.sleep(0.01)
    assert marked("REDETECT_MARK", mark) == []


def test_demands() -> None:
    grown = (200.0, 201.0, 204.0, 200.1 + MOST_GROWTH_MIB)
    assert GOOD.unmet() == []
    assert len(replace(GOOD, resident_mib=grown).unmet()) == 1
    assert len(replace(GOOD, worker_mib=grown).unmet()) == 1
    assert replace(GOOD, descriptors=(40, 40, 41, 42)).unmet() == ["2 descriptors stayed open"]
    assert replace(GOOD, decodings_per_frame=(10.0, 10.4)).unmet() == []
    slower = replace(GOOD, decodings_per_frame=(10.0, 10.7)).unmet()
    assert slower == ["the last tenth was 6.5% slower than the first"]
    assert ShortRuns(9, 0, 0, 0, 0, 0, 0).unmet() == []
    assert len(ShortRuns(9, 1, 2, 3, 4, 5, 6).unmet()) == 6


@pytest.mark.long
def test_a_soak_of_some_seconds(
    tmp_path: Path, project_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = project_root / "images" / "e"
    # A first run would have processes of its own compile the kernels.
    assert detect(["all", str(source / "images" / "e.0000.jpg"), "-o", str(tmp_path)]) == 0
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    arguments = ["--frames", "1000", "--jobs", "1", "--source", str(source)]
    code = main([*arguments, "--scratch", str(scratch)])
    said = capsys.readouterr()
    assert code in (0, 1), said.err
    rows = dict(
        re.split(r"  +", line, maxsplit=1) for line in said.out.splitlines() if "  " in line
    )
    assert rows["frames"] == "1000", said.err
    descriptors = [int(number) for number in rows["descriptors"].split()]
    assert "memory grew" not in said.err
    assert 50.0 < float(rows["resident_mib"].split()[0]) < 600.0
    assert 3 <= descriptors[-1] <= descriptors[0]
    assert rows["processes"] == "1"
    assert list(scratch.iterdir()) == []  # the run is removed


@shared_memory
def test_shared_memory_in_use_was_not_left_behind() -> None:
    lock: Any = multiprocessing.get_context("spawn").Lock()  # of a program that goes on
    in_use = f"sem.{lock._semlock.name.strip('/')}"
    orphan = Path(f"/dev/shm/psm_redetect_{os.getpid()}")
    assert (orphan.parent / in_use).exists()
    orphan.touch()
    try:
        names = {in_use, orphan.name, "psm_gone"}
        assert short_runs.in_nobodys_use(names) == {orphan.name}
    finally:
        orphan.unlink()


@shared_memory
def test_shared_memory_that_is_still_removed_was_not_left_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late, left = (Path(f"/dev/shm/psm_redetect_{os.getpid()}_{name}") for name in ("late", "left"))
    late.touch()
    left.touch()
    try:
        monkeypatch.setattr(time, "sleep", lambda _: late.unlink(missing_ok=True))
        ticks = iter(range(1000))
        monkeypatch.setattr(time, "monotonic", lambda: next(ticks))
        assert short_runs._left_for_good({late.name, left.name}) == {left.name}
    finally:
        late.unlink(missing_ok=True)
        left.unlink()
