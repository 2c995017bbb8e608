"""How a run is carried out, besides what is looked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ConductOptions:
    """How faults are met.

    Parameters
    ----------
    strict : bool
        Stop at the first frame that cannot be worked on, with exit code 1 and nothing written.
    resume : bool
        Take over the frames that an unfinished run of the same command kept, and go on after them.
    """

    strict: bool = False
    resume: bool = False


@dataclass(frozen=True)
class Conduct:
    """How a run is carried out.

    Attributes
    ----------
    log : path or None
        Where the log goes. A run with a log keeps a journal beside it (see `detect.runs.resume`).
    command, version : str
        What the log calls the run, and the program's version.
    strict : bool
        Whether the first frame that cannot be worked on ends the run.
    resume : bool
        Whether the frames that an unfinished run kept are taken over.
    """

    log: Path | None = None
    command: str = ""
    version: str = ""
    strict: bool = False
    resume: bool = False


#: Without a log or a journal, as the library does it unless it is told otherwise.
PLAIN = Conduct()


def conduct_of(options: ConductOptions, log: Path, command: str, version: str) -> Conduct:
    """How a command is carried out."""
    return Conduct(log, command, version, options.strict, options.resume)
