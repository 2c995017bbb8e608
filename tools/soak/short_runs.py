"""Many short runs, one after the other: what do they leave behind?"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tools.soak.long_run import SoakError, link_run
from tools.soak.processes import marked

_FRAMES = 8
_SHARED_MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class ShortRuns:
    """What many short runs left behind.

    Attributes
    ----------
    runs : int
    processes, shared, temporary, hidden, caches : int
        Processes that still run; pieces of shared memory; files in the folder for temporary
        files; hidden files beside the results; and files that the cache of tables has more of
        than after the first run.
    different : int
        Runs whose results were not those of the first.
    """

    runs: int
    processes: int
    shared: int
    temporary: int
    hidden: int
    caches: int
    different: int

    def unmet(self) -> list[str]:
        """What there should be none of, a sentence each."""
        left = {
            "processes": self.processes,
            "pieces of shared memory": self.shared,
            "temporary files": self.temporary,
            "hidden files": self.hidden,
            "files in the cache": self.caches,
        }
        found = [f"{count} {name} stayed behind" for name, count in left.items() if count]
        if self.different:
            found.append(f"{self.different} runs had other results than the first")
        return found

    def __str__(self) -> str:
        return (
            f"{self.runs} runs left behind: {self.processes} processes, {self.shared} pieces of "
            f"shared memory, {self.temporary} temporary files, {self.hidden} hidden files, "
            f"{self.caches} files in the cache; {self.different} with other results"
        )


def repeat_short_runs(source: Path, folder: Path, runs: int, jobs: int) -> ShortRuns:
    """Carry out `detect all` on a few frames again and again, every second time by processes.

    Shared memory of other programs that comes meanwhile is counted as well.

    Raises
    ------
    SoakError
        If a run does not end well.
    """
    run = link_run(source, folder / "short", _FRAMES)
    output, temporary, caches = (folder / name for name in ("results", "temporary", "tables"))
    for path in (output, temporary, caches):
        path.mkdir()
    mark = f"REDETECT_SOAK={folder}"
    environment = {
        **os.environ,
        "REDETECT_SOAK": str(folder),
        "TMPDIR": str(temporary),
        "REDETECT_CACHE": str(caches),
    }
    first: dict[str, bytes] = {}
    cached = different = 0
    shared = _shared()
    for number in range(runs):
        arguments = ["all", str(run), "-o", str(output), "--force"]
        arguments += ["--jobs", str(jobs if number % 2 else 1)]
        done = subprocess.run(
            [sys.executable, "-m", "detect", *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        if done.returncode != 0:
            raise SoakError(f"detect ended with {done.returncode}: {done.stderr.strip()[-500:]}")
        found = {path.name: path.read_bytes() for path in output.iterdir()}
        if number == 0:
            first, cached = found, len(_names(caches))
        different += found != first
    return ShortRuns(
        runs=runs,
        processes=len(marked(mark)),
        shared=len(_shared() - shared),
        temporary=len(_names(temporary)),
        hidden=sum(name.startswith(".") for name in _names(output)),
        caches=len(_names(caches)) - cached,
        different=different,
    )


def _shared() -> set[str]:
    """Shared memory and semaphores as Python names them."""
    return {name for name in _names(_SHARED_MEMORY) if name.startswith(("sem.", "psm_"))}


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()
