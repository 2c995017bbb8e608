"""The files of a run as they grow: one by one, and all of them onto the disk at once."""

from __future__ import annotations

import hashlib
import os
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from detect.runs.frame_rows import FrameRows
from storage.parts import PartFile


class RunOutput(Protocol):
    """A file that a run is written to: `detect.runs.stream.Output`."""

    @property
    def path(self) -> Path: ...
    @property
    def part(self) -> str: ...
    @property
    def head(self) -> bytes: ...
    @property
    def tail(self) -> bytes: ...
    @property
    def between(self) -> bytes: ...
    @property
    def placed(self) -> bool: ...
    @property
    def crlf(self) -> bool: ...


@dataclass
class GrowingFile:
    """A file of a run, its part, and what is in it so far.

    Attributes
    ----------
    path : path
        Where it will be.
    head, tail : bytes
        What stands before and after the rows of all frames.
    rows : callable
        What a frame gives it, from the frame's rows and prefix.
    overwrite : bool
        Whether an existing file may be replaced.
    placed : bool
        Whether it is a result; else others are made of it, and it goes when they are there.
    part : PartFile or None
        Where it grows.
    size : int
        How many bytes it has.
    digest : hash
        SHA-256 of them.
    """

    path: Path
    head: bytes
    tail: bytes
    rows: Callable[[FrameRows, str], bytes]
    overwrite: bool
    placed: bool = True
    part: PartFile | None = None
    size: int = 0

    def __post_init__(self) -> None:
        self.digest = hashlib.sha256()

    def write(self, content: bytes) -> None:
        """Write at once, all of it."""
        assert self.part is not None
        if content:
            self.part.write(content)
            self.count(content)

    def count(self, content: bytes) -> None:
        """Count what is there already."""
        self.size += len(content)
        self.digest.update(content)


def sync_together(parts: Sequence[PartFile]) -> None:
    """Have files on the disk: one after the other takes longer.

    Raises
    ------
    OSError
        Of the first that cannot be; names the result.
    """
    if len(parts) < 2:
        for part in parts:
            part.sync()
        return
    with ThreadPoolExecutor(len(parts)) as threads:
        for done in [threads.submit(part.sync) for part in parts]:
            done.result()


@contextmanager
def held_open(paths: Iterable[Path]) -> Iterator[None]:
    """Hold files open while others take their places.

    What a replaced file has on the disk is given back when nobody has it open any more. That takes
    much longer than to replace it, and happens behind the last one: a process that is killed leaves
    new files beside previous ones only if it is hit between two of the calls that replace them.
    """
    handles = []
    try:
        if sys.platform != "win32":  # where a file that is open cannot be replaced
            for path in paths:
                with suppress(OSError):
                    if stat.S_ISREG(os.lstat(path).st_mode):
                        handles.append(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK))
        yield
    finally:
        for handle in handles:
            os.close(handle)
