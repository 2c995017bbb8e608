"""Fuzz readers with atheris: `python -m tools.fuzz --help`.

Each reader is fuzzed for so many seconds in a process of its own, or, with --together, all of them
in one, which starts once only. The number of executions is printed, and what broke off; inputs that
did are kept as ``NAME-crash-*`` in the working folder. atheris is no dependency of the project:
`pip install atheris`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from redetect.storage.command_line import exit_code_of
from tools.fuzz.readers import READERS

_FAULTS = (
    re.compile(rb"=== Uncaught Python exception: ===\n(.*)"),
    re.compile(rb"(ERROR: libFuzzer: .*)"),
)
_MEMORY = re.compile(rb" rss: (\d+)Mb")
_SLOWEST = re.compile(rb"slowest_unit_time_sec:\s*(\d+)")
_MEMORY_FILES = Path("/dev/shm")


@dataclass
class Round:
    """What came of fuzzing for a while.

    Attributes
    ----------
    counts : dict of int
        Executions of each reader, up to some hundreds that were not noted any more.
    fault : str or None
        What broke off,
    faulty : str or None
        and which reader did.
    memory_mib, slowest_s : int
        Of the process, and of one file (whole seconds).
    """

    counts: dict[str, int]
    fault: str | None
    faulty: str | None
    memory_mib: int
    slowest_s: int


def main(arguments: list[str] | None = None) -> int:
    """Fuzz; 1 if anything was found."""
    names = [reader.name.replace(" ", "-") for reader in READERS]
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description="Fuzz the readers.")
    parser.add_argument("seconds", type=int, nargs="?", default=20, help="for each (default: 20)")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of: {', '.join(names)}")
    parser.add_argument("--rounds", type=int, default=1, help="so often, one after the other")
    parser.add_argument("--together", action="store_true", help="all of them in one process")
    parser.add_argument("--corpus", type=Path, help="keep what was found to lead further here")
    parser.add_argument("--json", type=Path, help="add the figures to those of a file")
    options = parser.parse_args(arguments)
    if unknown := set(options.names) - set(names):
        parser.error(f"no such reader: {', '.join(sorted(unknown))}")
    chosen = options.names or names
    groups = [chosen] if options.together else [[name] for name in chosen]
    total = faults = 0
    for group in [group for _ in range(options.rounds) for group in groups]:
        left, end = list(group), time.monotonic() + options.seconds * len(group)
        while left and (seconds := int(end - time.monotonic())) > 0:
            found = fuzz(left, seconds, options.corpus)
            for name, count in found.counts.items():
                print(f"{name:18} {count:10,}", flush=True)
                total += count
            if options.json is not None:
                add_figures(options.json, found)
            if found.fault is None:
                break
            print(f"{found.faulty or left}: {found.fault}", flush=True)
            faults += 1
            left = [name for name in left if name != found.faulty] if found.faulty else []
    print(f"{'together':18} {total:10,}")
    return 1 if faults else 0


def fuzz(names: list[str], seconds: int, corpora: Path | None) -> Round:
    """Fuzz readers in one process until something breaks off."""
    # Files in memory: nothing waits for a disk.
    place = _MEMORY_FILES if _MEMORY_FILES.is_dir() else None
    with tempfile.TemporaryDirectory(dir=place, prefix="fuzz-") as name:
        folder = Path(name)
        group = (
            names[0] if len(names) == 1 else hashlib.sha256(",".join(names).encode()).hexdigest()
        )
        corpus = (folder if corpora is None else corpora) / f"corpus-{group[:20]}"
        corpus.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "tools.fuzz.target", ",".join(names), name, str(corpus)]
        command.append(f"-max_total_time={seconds}")
        environment = {**os.environ, "OPENCV_LOG_LEVEL": "OFF", "TMPDIR": name}
        shown = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ).stdout
        told = folder / "counts.json"
        counted = json.loads(told.read_text()) if told.exists() else {"counts": {}, "faulty": None}
        faults = [fault[1] for pattern in _FAULTS if (fault := pattern.search(shown))]
        said = ascii(faults[0].decode(errors="replace")) if faults else None
        if said is None and not counted["counts"]:
            said = ascii(shown.decode(errors="replace")[-300:])
        for kept in [*folder.glob("crash-*"), *folder.glob("timeout-*"), *folder.glob("oom-*")]:
            content = folder / "input" if (folder / "input").exists() else kept
            Path(f"{counted['faulty'] or group[:20]}-{kept.name}").write_bytes(content.read_bytes())
    return Round(
        counted["counts"],
        said,
        counted["faulty"],
        max(map(int, _MEMORY.findall(shown)), default=0),
        max(map(int, _SLOWEST.findall(shown)), default=0),
    )


def add_figures(path: Path, found: Round) -> None:
    """Add the figures of a round to those of a file."""
    known = json.loads(path.read_text()) if path.exists() else {}
    for name, count in found.counts.items():
        entry = known.setdefault(name, {"executions": 0, "faults": []})
        entry["executions"] += count
        entry["memory_mib"] = max(entry.get("memory_mib", 0), found.memory_mib)
        entry["slowest_s"] = max(entry.get("slowest_s", 0), found.slowest_s)
    if found.fault is not None:
        known.setdefault(found.faulty or "?", {"executions": 0, "faults": []})
        known[found.faulty or "?"]["faults"].append(found.fault)
    path.write_text(f"{json.dumps(known, indent=1)}\n")


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
