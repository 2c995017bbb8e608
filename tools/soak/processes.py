"""What the system says of a process and those that it started."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import NamedTuple

import psutil  # type: ignore[import-untyped,unused-ignore]


class ProcessState(NamedTuple):
    """A process at a moment."""

    pid: int
    resident_bytes: int  # Memory of its own and shared that is in use.
    descriptors: int  # Open files, pipes and the like.
    processor_s: float  # What it has computed so far.


def family(pid: int) -> list[ProcessState]:
    """A process and all that descend from it, itself first, but for those that have just ended."""
    found = []
    with suppress(psutil.Error):
        first = psutil.Process(pid)
        for process in [first, *first.children(recursive=True)]:
            with suppress(psutil.Error), process.oneshot():
                times = process.cpu_times()
                state = process.memory_info().rss, process.num_fds(), times.user + times.system
                found.append(ProcessState(process.pid, *state))
    return found


def marked(variable: str) -> list[int]:
    """Processes with a ``NAME=value`` in their environment, but for this one."""
    name, _, value = variable.partition("=")
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if process.pid != os.getpid() and process.environ().get(name) == value:
                found.append(process.pid)
    return found
