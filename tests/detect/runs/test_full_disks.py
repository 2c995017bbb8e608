"""No room for kernels, and results on disks that are full or have no hard links: real ones."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from detect.cli import main
from tests.storage.own_disks import fill, on_linkless_disk, on_small_disk

ROOT = Path(__file__).resolve().parents[3]
PREVIOUS = b"what was there before\n"

pytestmark = pytest.mark.long

#: Says how often a kernel was loaded from the cache instead of compiled.
ONE_KERNEL = """
import numpy as np
from tests.detect.runs.one_kernel import doubled
assert (doubled(np.ones(3)) == 2.0).all()
print(sum(doubled.stats.cache_hits.values()))
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    folder = tmp_path / "disk"
    folder.mkdir()
    return folder


def kernels_find_no_room(place: Path, run: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(place / "kernels"), "PYTHONPATH": str(ROOT)}

    def python(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *arguments],
            cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip

    output = run / "detected.circles"
    output.write_bytes(PREVIOUS)
    filler = fill(place)
    done = python("-m", "detect", "circles", str(run), "--force")
    assert done.returncode == 1, done.stderr
    *_, line = done.stderr.splitlines()
    assert line.startswith("error: compiled kernels cannot be kept: [Errno 28] No space left")
    assert line.endswith("set the environment variable NUMBA_CACHE_DIR to another folder")
    assert output.read_bytes() == PREVIOUS
    # Room for the index of a kernel, but not for itself.
    with filler.open("r+b") as stream:
        stream.truncate(filler.stat().st_size - 4096)
    assert python("-c", ONE_KERNEL).returncode == 1
    filler.unlink()
    assert [python("-c", ONE_KERNEL).stdout for _ in range(2)] == ["0\n", "1\n"]


def test_no_room_for_kernels(place: Path, small_run: Path) -> None:
    on_small_disk(place, 1 << 20, kernels_find_no_room, place, small_run)


def results_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}


def ends_as_elsewhere(place: Path, run: Path, elsewhere: Path) -> None:
    """A run without room keeps what was there; with room again, it is resumed."""
    output = place / "output"
    output.mkdir()
    (output / "detected.circles").write_bytes(PREVIOUS)
    filler = fill(place)
    command = ["all", str(run), "-o", str(output), "--force"]
    assert main(command) == 1
    assert (output / "detected.circles").read_bytes() == PREVIOUS
    filler.unlink()
    assert main([*command, "--resume"]) == 0
    assert results_of(output) == results_of(elsewhere)


def has_no_links_and_ends_as_elsewhere(place: Path, run: Path, elsewhere: Path) -> None:
    (place / "file").write_bytes(b"content")
    with pytest.raises(OSError, match="not permitted"):
        os.link(place / "file", place / "link")
    output = place / "output"
    output.mkdir()
    assert main(["all", str(run), "-o", str(output)]) == 0
    assert results_of(output) == results_of(elsewhere)
    assert main(["all", str(run), "-o", str(output)]) == 1  # exists already
    assert main(["all", str(run), "-o", str(output), "--force"]) == 0
    assert results_of(output) == results_of(elsewhere)
    assert [path for path in output.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize("disk", ["full", "linkless"])
def test_results_on_disks_with_faults(
    place: Path, small_run: Path, tmp_path: Path, disk: str
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    assert main(["all", str(small_run), "-o", str(elsewhere)]) == 0
    if disk == "full":
        on_small_disk(place, 256 << 10, ends_as_elsewhere, place, small_run, elsewhere)
    else:
        work = has_no_links_and_ends_as_elsewhere
        on_linkless_disk(place, work, place, small_run, elsewhere)
