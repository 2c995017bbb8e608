"""How a result gets onto the disk: whole or not at all, and never over what the user has.

Every room writes its files through `write_whole`.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

__all__ = ["OutputExistsError", "write_whole"]


class OutputExistsError(FileExistsError):
    """A file that would be overwritten stands where a result should go."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: exists already: give --force to overwrite it")


@contextmanager
def write_whole(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a binary stream whose content appears at `path` only once it is complete.

    The bytes go to a temporary file in the same folder, which takes the place of `path` in one step
    when the block ends, and is removed when the block raises.

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
        If the folder cannot be written to.
    """
    path = Path(path)
    if not overwrite and os.path.lexists(path):
        raise OutputExistsError(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        # The temporary file's name would mean nothing to whoever reads the message.
        raise type(error)(error.errno, error.strerror, str(path)) from None
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files that only their owner can read; results follow the user's umask.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        if overwrite:
            temporary.replace(path)
        else:
            _place_new(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _place_new(temporary: Path, path: Path) -> None:
    """Give the file its name unless somebody took it meanwhile."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise OutputExistsError(path) from None
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise OutputExistsError(path) from None
        temporary.replace(path)
