"""What Linux says of a process and those that it started."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
_TICKS_PER_S = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
_PROC = Path("/proc")


@dataclass(frozen=True)
class ProcessState:
    """A process at a moment.

    Attributes
    ----------
    pid : int
    resident_bytes : int
        Memory of its own and shared that is in use.
    descriptors : int
        Open files, pipes and the like.
    processor_s : float
        What it has computed so far.
    """

    pid: int
    resident_bytes: int
    descriptors: int
    processor_s: float


def family(pid: int) -> list[ProcessState]:
    """A process and all that descend from it, itself first; those that have just ended are left."""
    children: dict[int, list[int]] = {}
    for folder in _PROC.iterdir():
        if folder.name.isdigit():
            fields = _fields(int(folder.name))
            if fields is not None:
                children.setdefault(int(fields[1]), []).append(int(folder.name))
    found, pending = [], [pid]
    while pending:
        one = pending.pop(0)
        state = _state(one)
        if state is not None:
            found.append(state)
        pending += children.get(one, [])
    return found


def marked(variable: str) -> list[int]:
    """Processes with a ``NAME=value`` in their environment, but for this one."""
    found = []
    for folder in _PROC.iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            try:
                content = (folder / "environ").read_bytes()
            except OSError:
                continue
            if variable.encode() in content.split(b"\0"):
                found.append(int(folder.name))
    return found


def _fields(pid: int) -> list[str] | None:
    """The fields of ``stat`` from the state on."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None


def _state(pid: int) -> ProcessState | None:
    fields = _fields(pid)
    if fields is None:
        return None
    try:
        descriptors = sum(1 for _ in (_PROC / str(pid) / "fd").iterdir())
    except OSError:
        return None
    processor_s = (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
    return ProcessState(pid, int(fields[21]) * _PAGE_BYTES, descriptors, processor_s)
