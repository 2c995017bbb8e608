"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from detect import __version__

_PACKAGES = ("numpy", "numba", "opencv-python-headless", "scikit-image")
_CPU_FILE = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Machine:
    """The machine and the programs that were measured.

    Attributes
    ----------
    cpu : str
        Model of the processor.
    cores : int
        Cores that this process may use.
    system : str
        Operating system and architecture.
    versions : dict of str
        Of this project, Python and the packages that the measured functions come from.
    """

    cpu: str
    cores: int
    system: str
    versions: dict[str, str]


def this_machine() -> Machine:
    """Describe the machine that this process runs on."""
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    text = _CPU_FILE.read_text() if _CPU_FILE.is_file() else ""
    return Machine(
        cpu=cpu_model(text) or platform.processor() or "unknown",
        cores=cores,
        system=f"{platform.system()} {platform.machine()}",
        versions={
            "redetect": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
    )


def cpu_model(cpuinfo: str) -> str:
    """The processor's name in the text of ``/proc/cpuinfo``; empty if it is not there."""
    for line in cpuinfo.splitlines():
        key, colon, value = line.partition(":")
        if colon and key.strip() == "model name":
            return value.strip()
    return ""
