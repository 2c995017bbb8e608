"""Writes results to disk: completely or not at all, and never over a user's files.

All packages write their files with `write_whole`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from redetect.storage.parts import OutputExistsError, demand_place, new_part

__all__ = ["OutputExistsError", "write_whole"]


@contextmanager
def write_whole(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a binary stream whose content appears at `path` only once it is complete.

    The bytes go to a hidden file in the same folder (see `redetect.storage.parts`), which takes the
    place of `path` in one step when the block ends, and is removed when the block raises. If `path`
    is a symbolic link, its target is written.

    Parameters
    ----------
    path : path
        Where the file will be.
    overwrite : bool
        Whether an existing file may be replaced.

    Yields
    ------
    binary stream
        What is written to it becomes the file.

    Raises
    ------
    OutputExistsError
        If `path` exists and `overwrite` is false.
    OSError
        If `path` is no regular file, its folder cannot be written to, or the disk is full; names
        `path`.
    """
    path = Path(path)
    demand_place(path, overwrite=overwrite)
    with new_part(path) as part:
        yield part.stream
        part.sync()
        part.replace(path, overwrite=overwrite)
