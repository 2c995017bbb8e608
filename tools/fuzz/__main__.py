"""Fuzz every reader with atheris, one after the other: `python -m tools.fuzz --help`.

Each reader is fuzzed for so many seconds in a process of its own. The number of executions is
printed, and what broke off; inputs that did are kept as ``NAME-crash-*`` in the working folder.
atheris is no dependency of the project: `pip install atheris`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tools.fuzz.readers import READERS

_RUNS = re.compile(rb"^(?:Done (\d+) runs|#(\d+)\t)", re.MULTILINE)
_FAULTS = (
    re.compile(rb"=== Uncaught Python exception: ===\n(.*)"),
    re.compile(rb"(ERROR: libFuzzer: .*)"),
)
_MEMORY = re.compile(rb" rss: (\d+)Mb")
_SLOWEST = re.compile(rb"slowest_unit_time_sec:\s*(\d+)")
_MEMORY_FILES = Path("/dev/shm")


def main(arguments: list[str] | None = None) -> int:
    """Fuzz; 1 if anything was found."""
    names = [reader.name.replace(" ", "-") for reader in READERS]
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description="Fuzz every reader.")
    parser.add_argument("seconds", type=int, nargs="?", default=20, help="for each (default: 20)")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join(names)}")
    parser.add_argument("--rounds", type=int, default=1, help="so often, one after the other")
    parser.add_argument("--corpus", type=Path, help="keep what was found to lead further here")
    parser.add_argument("--json", type=Path, help="add the figures to those of a file")
    options = parser.parse_args(arguments)
    if unknown := set(options.names) - set(names):
        parser.error(f"no such reader: {', '.join(sorted(unknown))}")
    total = faults = 0
    for _ in range(options.rounds):
        for name in options.names or names:
            figures = fuzz(name, options.seconds, options.corpus)
            print(f"{name:18} {figures['executions']:10,}", figures["fault"] or "", flush=True)
            total += figures["executions"]
            faults += figures["fault"] is not None
            if options.json is not None:
                add_figures(options.json, name, figures)
    print(f"{'together':18} {total:10,}")
    return 1 if faults else 0


def fuzz(name: str, seconds: int, corpora: Path | None) -> dict[str, Any]:
    """Fuzz one reader: executions, fault, memory (MiB), the slowest file (s, whole ones)."""
    # Files in memory: nothing waits for a disk.
    place = _MEMORY_FILES if _MEMORY_FILES.is_dir() else None
    with tempfile.TemporaryDirectory(dir=place, prefix="fuzz-") as folder:
        corpus = (Path(folder) if corpora is None else corpora) / f"corpus-{name}"
        corpus.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "tools.fuzz.target", name, folder, str(corpus)]
        command.append(f"-max_total_time={seconds}")
        environment = {**os.environ, "OPENCV_LOG_LEVEL": "OFF", "TMPDIR": folder}
        shown = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ).stdout
    counts = [int(done or so_far) for done, so_far in _RUNS.findall(shown)]
    faults = [fault[1] for pattern in _FAULTS if (fault := pattern.search(shown))]
    said = ascii(faults[0].decode(errors="replace")) if faults else None
    if not counts and said is None:
        said = ascii(shown.decode(errors="replace")[-300:])
    return {
        "executions": max(counts, default=0),
        "fault": said,
        "memory_mib": max(map(int, _MEMORY.findall(shown)), default=0),
        "slowest_s": max(map(int, _SLOWEST.findall(shown)), default=0),
    }


def add_figures(path: Path, name: str, figures: dict[str, Any]) -> None:
    """Add the figures of a round to those of a file."""
    known = json.loads(path.read_text()) if path.exists() else {}
    entry = known.setdefault(name, {"executions": 0, "faults": [], "memory_mib": 0, "slowest_s": 0})
    entry["executions"] += figures["executions"]
    for key in ("memory_mib", "slowest_s"):
        entry[key] = max(entry[key], figures[key])
    if figures["fault"] is not None:
        entry["faults"].append(figures["fault"])
    path.write_text(f"{json.dumps(known, indent=1)}\n")


if __name__ == "__main__":
    sys.exit(main())
