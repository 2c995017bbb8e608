"""Reads untrusted files: regular files of bounded size only."""

from __future__ import annotations

import errno
import os
import stat


def read_bounded(path: str | os.PathLike[str], largest_bytes: int) -> bytes:
    """The content of a file.

    Parameters
    ----------
    path : path
        A regular file, or a link to one; pipes and devices are refused, never waited for.
    largest_bytes : int
        A larger file is refused before it is read.

    Raises
    ------
    OSError
        If there is no such file, it cannot be read, is too large or something else; `strerror`
        says so in words.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError:
        raise OSError(errno.EINVAL, "there is a NUL in its name") from None
    try:
        state = os.fstat(handle)
        if stat.S_ISDIR(state.st_mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, "is a pipe, socket or device: expected a file")
        if state.st_size > largest_bytes:
            raise OSError(errno.EFBIG, f"larger than {largest_bytes} bytes")
        # Some file systems return only part of what is asked for in one call.
        content = os.read(handle, state.st_size + 1)
        while more := os.read(handle, state.st_size + 1 - len(content)):
            content += more
    finally:
        os.close(handle)
    if len(content) > state.st_size:
        raise OSError(errno.EBUSY, "grows while it is read")
    return content
