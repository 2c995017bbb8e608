"""Hidden files beside a result, locked while they are written.

A result is written to ``.NAME.part`` in its folder and renamed in one step when it is complete. The
operating system releases the lock however the writing process ends: an unlocked file was left by a
killed process, and the next process that writes the same result removes it. While one is being
written, the next one is ``.NAME.1.part``. For a symbolic link, the target is the result.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

#: Number of names that are searched for files left by killed processes.
_NUMBERS = 8

_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
# The file may be anything: follow no link and wait for no pipe.
_OLD = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class OutputExistsError(FileExistsError):
    """A result's file already exists and must not be overwritten."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: exists already: give --force to overwrite it")


def demand_place(path: Path, *, overwrite: bool) -> None:
    """Reject a path that cannot be a result's, or has one that must not be replaced."""
    if str(path) == "-":
        raise OSError("-: expected the name of a file: only --json writes to standard output")
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: is a device, pipe or socket: expected the name of a file")
    if not overwrite and os.path.lexists(path):
        raise OutputExistsError(path)
    demand_writable(path)


def demand_writable(path: Path) -> None:
    """Reject a path if its folder, or the nearest existing one above, has no write permission."""
    above = next(place for place in Path(os.path.realpath(path)).parents if place.exists())
    if not above.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(above))
    effective = os.access in os.supports_effective_ids
    if not os.access(above, os.W_OK | os.X_OK, effective_ids=effective):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def demand_free(paths: Iterable[Path], *, overwrite: bool) -> None:
    """Reject outputs that could not be written later; folders may be created later."""
    for path in paths:
        if path.parent.is_dir():
            demand_place(path, overwrite=overwrite)
        else:
            demand_writable(path)


def demand_distinct(paths: Iterable[Path]) -> None:
    """Reject outputs of which two are the same file."""
    taken = set[Path]()
    for path in paths:
        if path.resolve() in taken:
            raise OSError(
                f"{path}: two of the outputs would be written there: expected different names or "
                "endings"
            )
        taken.add(path.resolve())


class PartFile(AbstractContextManager["PartFile"]):
    """A hidden file that this process has locked, and a stream to read and write it.

    Its number is 0 unless others are being written. As a context manager it is removed at the end,
    unless it was closed or has replaced the result. Errors of the stream name the result.
    """

    def __init__(self, result: Path, place: Path, number: int, handle: int) -> None:
        self._result, self.place, self.number = result, place, number
        self.stream = io.BufferedRandom(_NamedFile(handle, result))

    def __exit__(self, *_: object) -> None:
        self.remove()

    def sync(self) -> None:
        """Flush everything written to disk."""
        self.stream.flush()
        with _naming(self._result):
            os.fsync(self.stream.fileno())

    def replace(self, path: Path, *, overwrite: bool) -> None:
        """Rename it to the result's path, unless a file there must not be overwritten."""
        with _naming(path):
            if overwrite:
                self.place.replace(os.path.realpath(path))
            else:
                _link_new(self.place, path)

    def is_in_place(self) -> bool:
        """Whether it is still there; it may have been moved or removed with its folder."""
        return _is_at(self.stream.fileno(), self.place)

    def remove(self) -> None:
        """Remove it, unless it was closed or renamed to the result."""
        if not self.stream.closed:
            if self.is_in_place():
                self.place.unlink(missing_ok=True)
            self.close()

    def close(self) -> None:
        """Leave it where it is, unlocked."""
        with suppress(OSError):  # what cannot be flushed is lost
            self.stream.close()


class _NamedFile(io.FileIO):
    """A descriptor whose errors name the result."""

    def __init__(self, handle: int, result: Path) -> None:
        super().__init__(handle, "r+b")
        self._result = result

    def write(self, content: Any, /) -> int:
        with _naming(self._result):
            return super().write(content)


def new_part(path: Path, suffix: str = "part", named: Path | None = None) -> PartFile:
    """A new hidden file beside `path`; files left by killed processes are removed.

    Errors name `named`, by default the path.
    """
    for number in range(_NUMBERS):
        left = left_part(path, suffix, number)
        if left is not None:
            left.remove()
    number = 0
    while True:
        place = _place(path, suffix, number)
        with _naming(named or path), suppress(FileExistsError):
            handle = os.open(place, _NEW, 0o666)
            if _lock(handle) is not False and _is_at(handle, place):
                return PartFile(named or path, place, number, handle)
            os.close(handle)  # another process took it for a leftover
        number += 1


def left_part(
    path: Path, suffix: str = "part", number: int = 0, named: Path | None = None
) -> PartFile | None:
    """A hidden file left by a process that ended; None if there is none or it is in use."""
    place = _place(path, suffix, number)
    try:
        handle = os.open(place, _OLD)
    except OSError:
        return None
    if stat.S_ISREG(os.fstat(handle).st_mode) and _lock(handle) and _is_at(handle, place):
        return PartFile(named or path, place, number, handle)
    os.close(handle)
    return None


@contextmanager
def write_whole(path: str | os.PathLike[str], *, overwrite: bool) -> Iterator[BinaryIO]:
    """Open a binary stream whose content appears at `path` only once it is complete.

    It is written to a hidden file in the same folder, which replaces `path` (or, if that is a
    symbolic link, its target) in one step when the block ends, and is removed if it raises.

    Raises
    ------
    OutputExistsError
        If `path` exists and `overwrite` is false.
    OSError
        If `path` is not a regular file, its folder cannot be written to, or the disk is full.
    """
    path = Path(path)
    demand_place(path, overwrite=overwrite)
    with new_part(path) as part:
        yield part.stream
        part.sync()
        part.replace(path, overwrite=overwrite)


def write_bytes(path: str | os.PathLike[str], content: bytes, *, overwrite: bool) -> None:
    """Write a file, whole or not at all: `write_whole` for content in memory."""
    with write_whole(path, overwrite=overwrite) as stream:
        stream.write(content)


def write_text(path: str | os.PathLike[str], rows: Iterable[str], *, overwrite: bool) -> None:
    """Write rows of text, whole or not at all."""
    content = "".join(f"{row}\n" for row in rows).encode("utf-8", "surrogateescape")
    write_bytes(path, content, overwrite=overwrite)


@contextmanager
def folder_locked(folder: Path) -> Iterator[None]:
    """Lock a folder for the duration of a block; waits for other processes that hold the lock."""
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        # Without locks, results of concurrent runs may be mixed; each file is complete.
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


@contextmanager
def _naming(result: Path) -> Iterator[None]:
    """Let errors name the result, since the name of a hidden file would confuse users."""
    try:
        yield
    except OutputExistsError:
        raise
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(result)) from None


def _place(path: Path, suffix: str, number: int) -> Path:
    real = Path(os.path.realpath(path))
    return real.with_name(f".{real.name}.{number}.{suffix}" if number else f".{real.name}.{suffix}")


def _lock(handle: int) -> bool | None:
    """Lock a file: False if another process holds the lock, None if locks are not supported."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_at(handle: int, place: Path) -> bool:
    """Whether an open file is the one at a path."""
    try:
        return os.path.samestat(os.fstat(handle), os.lstat(place))
    except OSError:
        return False


def _link_new(part: Path, path: Path) -> None:
    """Give a file its name unless the name is taken."""
    try:
        os.link(part, path)
    except FileExistsError:
        if not path.is_file() or not part.samefile(path):
            raise OutputExistsError(path) from None
        # Otherwise a process was killed after it had given the file its name.
    except OSError:  # a file system without hard links: claim the name first
        try:
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            raise OutputExistsError(path) from None
        part.replace(path)
    part.unlink(missing_ok=True)
