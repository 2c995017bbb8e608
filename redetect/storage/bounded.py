"""Reads untrusted files: only regular files of bounded size, plain arrays, within a folder."""

from __future__ import annotations

import errno
import math
import os
import posixpath
import re
import stat
import tokenize
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from redetect.bounds import number_in
from redetect.messages import excerpt, one_line

FilePath = str | os.PathLike[str]

_LARGEST_TEXT_BYTES = 1 << 28
_DRIVE = re.compile(r"[A-Za-z]:")


def read_bounded(path: FilePath, largest_bytes: int, *, own: bool = False) -> bytes:
    """The content of a regular file, or a link to one, of at most `largest_bytes`.

    Pipes and devices are rejected, never waited for; if it must be the user's `own`, so are links,
    and files that another user may have written to. Raises an OSError; `strerror` is the reason.
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
        # Some file systems return only a part of the requested bytes per call.
        content = os.read(handle, state.st_size + 1)
        while more := os.read(handle, state.st_size + 1 - len(content)):
            content += more
    finally:
        os.close(handle)
    if len(content) > state.st_size:
        raise OSError(errno.EBUSY, "grows while it is read")
    return content


def read_content(path: FilePath, largest_bytes: int, kind: str, error: type[Exception]) -> bytes:
    """The content of a file of some kind; raises an `error` if `read_bounded` rejects it."""
    try:
        return read_bounded(path, largest_bytes)
    except FileNotFoundError:
        raise error(f"{path}: no such {kind}") from None
    except OSError as why:
        raise error(f"{path}: cannot be read as a {kind}: {why.strerror}") from None


def read_text(path: FilePath, largest_bytes: int, kind: str, error: type[Exception]) -> str:
    """The text of a file (UTF-8, perhaps with a byte order mark); errors as in `read_content`."""
    try:
        return read_content(path, largest_bytes, kind, error).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: cannot be read as a {kind}: it is not text") from None


def rows_of_numbers(
    path: FilePath, kind: str, columns: str, error: type[Exception], *, head: bool = False
) -> Iterator[tuple[str, list[float]]]:
    """The place and the finite numbers of each row of a text file with the given columns.

    They are separated by blanks or commas; ``#`` begins a comment. With a `head`, the names of the
    columns come first. Other files raise an `error`.
    """
    count = len(columns.split())
    lines = read_text(path, _LARGEST_TEXT_BYTES, kind, error).split("\n")
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        if head:
            if " ".join(words).lower() != columns:
                found, expected = excerpt(line.strip()), columns.replace(" ", ",")
                raise error(f"{path}:{number}: the header is {found}: expected {expected}")
            head = False
            continue
        try:
            values = [number_in(word) for word in words]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise error(
                f"{path}:{number}: {' '.join(words)[:60]!r}: expected {count} numbers: {columns}"
            )
        yield f"{path}:{number}", values


def writable_by_others(state: os.stat_result) -> str | None:
    """Why another user may have written to a file or folder; None if that is impossible."""
    if state.st_uid != os.geteuid():
        return f"belongs to user {state.st_uid}, not {os.geteuid()}"
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"can be written to by others (mode {stat.S_IMODE(state.st_mode):o})"
    return None


def leads_out(name: str, *folders: str) -> str | None:
    r"""Why a name cannot be that of a file within a folder, judged by its letters alone.

    The name has / or \ between folders. `folders` are absolute paths; the file may be in any of
    them. Without them, any folder is assumed. The result is the end of a message that starts
    with the name; None if the name is valid.
    """
    parts = name.replace("\\", "/")
    if "\0" in name:
        return "has a NUL in it"
    if parts.startswith("/") or _DRIVE.match(parts):
        return "is an absolute path"
    if ".." in parts and not any(
        _within(posixpath.normpath(f"{home}/{parts}"), home) for home in folders or ("/any/folder",)
    ):
        return "leads out of the folder"
    return None


def link_out(path: Path, *folders: Path) -> bool:
    """Whether a path, with all links resolved, is outside all of the folders."""
    real = os.path.realpath(path)
    return not any(real == home or _within(real, home) for home in map(os.path.realpath, folders))


def path_inside(folder: Path, name: str) -> Path:
    """Path of a file named in another file, in that file's folder.

    Raises ValueError if it is elsewhere; its message is the end of one that starts with the name.
    """
    why = leads_out(name)
    if why is None and link_out(folder / name, folder):
        why = "is a link that leads out of the folder"
    if why is not None:
        raise ValueError(why)
    return folder / name


def _within(path: str, folder: str) -> bool:
    return path.startswith(folder.rstrip("/") + "/")


def read_plain_array(
    stream: BinaryIO, dtype: np.dtype[Any], dimensions: int, largest_bytes: int
) -> NDArray[Any]:
    """Read an array of a known type from a stream, to the array's end.

    Arrays of more bytes than `largest_bytes` are rejected before memory is allocated. Raises a
    ValueError that states on one line what was found instead.
    """
    expected = f"expected {dimensions}-dimensional {dtype}, row by row"
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of its header is not known")
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # headers written by Python 2 are rejected
            shape, fortran, stored = read(stream)
        if stored.hasobject or stored != dtype or len(shape) != dimensions or fortran:
            raise ValueError(f"it is {stored} of shape {shape}")
        size = dtype.itemsize * math.prod(shape)
        if min(shape, default=0) < 0 or size > largest_bytes:
            raise ValueError(f"its shape {shape} does not fit in {largest_bytes} bytes")
        data = stream.read(size)
    # A damaged header can raise almost any exception.
    except (
        ValueError, SyntaxError, TypeError, OverflowError, EOFError, MemoryError, RecursionError,
        tokenize.TokenError, Warning,
    ) as error:  # fmt: skip
        said = one_line(str(error).partition("\n")[0] or type(error).__name__, 200)
        raise ValueError(f"{said}: {expected}") from None
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes of data: expected {size}: {expected}")
    return np.frombuffer(bytearray(data), dtype=dtype).reshape(shape)
