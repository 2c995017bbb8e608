"""How a run is carried out, apart from what is detected."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ConductOptions:
    """How failures are handled.

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
    version : str
        The program's version, for the heads of files.
    overwrite : bool
        Whether existing files may be replaced.
    crlf : bool
        Whether the lines of files of landmarks end with CR and LF.
    log : path or None
        Where the log goes. A run with a log keeps a journal beside it (see `detect.runs.journal`).
    command : str
        What the log calls the run.
    faults : ConductOptions
        Whether the first frame that cannot be worked on ends the run, and whether the frames that
        an unfinished run kept are taken over.
    """

    version: str = ""
    overwrite: bool = False
    crlf: bool = False
    log: Path | None = None
    command: str = ""
    faults: ConductOptions = ConductOptions()
