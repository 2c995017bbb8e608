"""Many short runs, one after the other, checked for leftovers."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import psutil  # type: ignore[import-untyped,unused-ignore]

from detect.sources.opening import open_run
from tools.benchmark.material import repeated_run
from tools.evaluation.figures import StudyError

_FRAMES = 8
_SHARED_MEMORY = Path("/dev/shm")
_TRACKER_S = 10.0


@dataclass(frozen=True)
class ShortRuns:
    """Leftovers of many short runs."""

    runs: int
    processes: int
    """Running processes; segments of shared memory; files in the folder for temporary files; hidden
    files beside the results; and files in the cache of tables in excess of those after the first
    run."""
    shared: int
    temporary: int
    hidden: int
    caches: int
    different: int  # Number of runs whose results differ from the first.

    def unmet(self) -> list[str]:
        """The failed checks, a sentence each."""
        left = {
            "processes": self.processes,
            "segments of shared memory": self.shared,
            "temporary files": self.temporary,
            "hidden files": self.hidden,
            "files in the cache": self.caches,
        }
        found = [f"{count} {name} left over" for name, count in left.items() if count]
        if self.different:
            found.append(f"{self.different} runs had other results than the first")
        return found


def repeat_short_runs(source: Path, folder: Path, runs: int, jobs: int) -> ShortRuns:
    """Run `detect all` on a few frames repeatedly, every second time with workers."""
    run = repeated_run(open_run(source), folder / "short", _FRAMES)
    output, temporary, caches = (folder / name for name in ("results", "temporary", "tables"))
    for path in (output, temporary, caches):
        path.mkdir()
    added = {"REDETECT_SOAK": str(folder), "TMPDIR": str(temporary), "REDETECT_CACHE": str(caches)}
    command = [sys.executable, "-m", "detect", "all", str(run), "-o", str(output), "--force"]
    first: dict[str, bytes] = {}
    cached = different = 0
    shared = _shared()
    for number in range(runs):
        words = [*command, "--jobs", str(jobs if number % 2 else 1)]
        done = subprocess.run(
            words, env=os.environ | added, capture_output=True, text=True, check=False
        )
        if done.returncode != 0:
            raise StudyError(f"detect ended with {done.returncode}: {done.stderr.strip()[-500:]}")
        found = {path.name: path.read_bytes() for path in output.iterdir()}
        if number == 0:
            first, cached = found, len(_names(caches))
        different += found != first
    return ShortRuns(
        runs=runs,
        processes=len(marked("REDETECT_SOAK", str(folder))),
        shared=len(_left_for_good(_shared() - shared)),
        temporary=len(_names(temporary)),
        hidden=sum(name.startswith(".") for name in _names(output)),
        caches=len(_names(caches)) - cached,
        different=different,
    )


def marked(name: str, value: str) -> list[int]:
    """Processes with a variable of this value in their environment, except this one."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if process.pid != os.getpid() and process.environ().get(name) == value:
                found.append(process.pid)
    return found


def _shared() -> set[str]:
    """Shared memory and semaphores of all programs, by Python's names."""
    return {name for name in _names(_SHARED_MEMORY) if name.startswith(("sem.", "psm_"))}


def in_nobodys_use(names: set[str]) -> set[str]:
    """Segments of shared memory that no process has mapped.

    Those of running programs are mapped, but under the different names with which they were
    created, so that only their numbers identify them.
    """
    mapped = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with suppress(OSError):  # it ended, or is another user's
            for line in maps.read_text().splitlines():
                if str(_SHARED_MEMORY) in line:
                    mapped.add(int(line.split()[4]))
    left = set()
    for name in names:
        with suppress(FileNotFoundError):
            if (_SHARED_MEMORY / name).stat().st_ino not in mapped:
                left.add(name)
    return left


def _left_for_good(names: set[str]) -> set[str]:
    """Segments of shared memory that remain unused.

    Those of a killed program remain only for a moment, until Python's resource tracker has removed
    them: other programs may run, and be killed, at the same time.
    """
    left = in_nobodys_use(names)
    latest_s = time.monotonic() + _TRACKER_S
    while left and time.monotonic() < latest_s:
        time.sleep(0.05)
        left &= in_nobodys_use(left)
    return left


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()
