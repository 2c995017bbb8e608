"""Fuzz every reader with atheris, one after the other: `python -m tools.fuzz [SECONDS [NAME...]]`.

Each reader is fuzzed for so many seconds in a process of its own. The number of executions is
printed, and what broke off; inputs that did are kept as ``crash-*`` in the working folder. atheris
is no dependency of the project: `pip install atheris`.
"""

from __future__ import annotations

import re
import subprocess
import sys

from tools.fuzz.readers import READERS

_RUNS = re.compile(rb"^(?:Done (\d+) runs|#(\d+)\t)", re.MULTILINE)
_FAULT = re.compile(rb"=== Uncaught Python exception: ===\n(.*)|(ERROR: libFuzzer: .*)")


def main(arguments: list[str]) -> int:
    """Fuzz; 1 if anything was found."""
    seconds = int(arguments[0]) if arguments else 20
    names = arguments[1:] or [reader.name.replace(" ", "-") for reader in READERS]
    total = faults = 0
    for name in names:
        command = [sys.executable, "-m", "tools.fuzz.target", name, f"-max_total_time={seconds}"]
        shown = subprocess.run(command, check=False, stderr=subprocess.PIPE).stderr
        counts = [int(done or so_far) for done, so_far in _RUNS.findall(shown)]
        executions = max(counts, default=0)
        fault = _FAULT.search(shown)
        print(f"{name:16} {executions:10,}", end="")
        print(f"  {(fault[1] or fault[2]).decode(errors='replace')!a}" if fault else "", flush=True)
        total += executions
        faults += fault is not None
    print(f"{'together':16} {total:10,}")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
