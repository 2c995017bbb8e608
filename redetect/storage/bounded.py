"""Reads untrusted files: regular files of bounded size only."""

from __future__ import annotations

import errno
import os
import stat


def read_bounded(path: str | os.PathLike[str], largest_bytes: int, *, own: bool = False) -> bytes:
    """The content of a regular file of at most `largest_bytes`, or of what a link leads to.

    Pipes and devices are refused, never waited for; if it must be the user's `own`, so are links,
    and files that another user may have written to. Raises an OSError whose `strerror` says why in
    words.
    """
    try:
        links = os.O_NOFOLLOW if own else 0
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | links)
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
        if own and (why := writable_by_others(state)) is not None:
            raise PermissionError(errno.EACCES, why)
        # Some file systems return only part of what is asked for in one call.
        content = os.read(handle, state.st_size + 1)
        while more := os.read(handle, state.st_size + 1 - len(content)):
            content += more
    finally:
        os.close(handle)
    if len(content) > state.st_size:
        raise OSError(errno.EBUSY, "grows while it is read")
    return content


def writable_by_others(state: os.stat_result) -> str | None:
    """Why another user may have written to a file or folder; None if none can have."""
    if state.st_uid != os.geteuid():
        return f"belongs to user {state.st_uid}, not {os.geteuid()}"
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"can be written to by others (mode {stat.S_IMODE(state.st_mode):o})"
    return None
