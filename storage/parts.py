"""Partial files, renamed when they are complete.

A result is written to ``.NAME.part`` in the folder of ``NAME``, and renamed in one step when it is
complete. The writing process holds a lock on the partial file, which the operating system releases
however the process ends: an unlocked one was left by a killed process. The next process that writes
the same result removes it. While one is being written, the next partial file is ``.NAME.1.part``.
"""

from __future__ import annotations

import contextlib
import io
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

#: Number of names of partial files that are checked for leftovers of killed processes.
_PLACES_LOOKED_AT = 8

_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
# The path of a part may be anything: follow no link and wait for no pipe.
_OLD = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class OutputExistsError(FileExistsError):
    """A result's file exists already and must not be overwritten."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: exists already: give --force to overwrite it")


class NotAFileError(OSError):
    """The path of a result is a device, a pipe or a socket."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: is a device, pipe or socket: expected the name of a file")


class PartFile:
    """A result while it is written: locked, and removed by `discard` unless it took its place.

    Attributes
    ----------
    path : path
        Where the result will be.
    temporary : path
        Where it is written.
    number : int
        Which of the parts of this result it is; 0 unless others were being written.
    stream : binary stream
        What is written to it becomes the result. Its errors name the result, not the part.
    """

    def __init__(self, path: Path, number: int, handle: int) -> None:
        self.path = path
        self.number = number
        self.temporary = part_place(path, number)
        self.stream = io.BufferedWriter(_NamedFile(handle, path))

    def __enter__(self) -> PartFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.discard()

    def sync(self) -> None:
        """Have it on the disk."""
        self.stream.flush()
        try:
            os.fsync(self.stream.fileno())
        except OSError as error:
            raise named(error, self.path) from None

    def place(self, *, overwrite: bool) -> None:
        """Move the part to the result's path; if that is a link, to the link's target.

        Raises
        ------
        OutputExistsError
            If there is a file that must not be overwritten.
        """
        if sys.platform == "win32":
            self.close()  # a file that is open keeps its name there
        try:
            if overwrite:
                self.temporary.replace(os.path.realpath(self.path))
            else:
                _place_new(self.temporary, self.path)
        except OutputExistsError:
            raise
        except OSError as error:
            raise named(error, self.path) from None

    def discard(self) -> None:
        """Remove it, unless it took its place."""
        if not self.stream.closed:
            if is_at(self.stream.fileno(), self.temporary):
                self.temporary.unlink(missing_ok=True)
            self.close()

    def close(self) -> None:
        """Leave it where it is, and take the lock off."""
        with contextlib.suppress(OSError):  # what is written but not flushed goes with it
            self.stream.close()


class _NamedFile(io.FileIO):
    """A descriptor for writing whose errors name the result."""

    def __init__(self, handle: int, path: Path) -> None:
        super().__init__(handle, "wb")
        self._path = path

    def write(self, content: ReadableBuffer, /) -> int:
        try:
            return super().write(content)
        except OSError as error:
            raise named(error, self._path) from None


def new_part(path: Path) -> PartFile:
    """An empty part for a result; parts that killed processes left are removed.

    Raises
    ------
    NotAFileError
        If the path exists and is no regular file.
    OSError
        If the folder cannot be written to; names the result.
    """
    demand_file(path)
    try:
        number = 0
        while (handle := new_locked(part_place(path, number))) is None:
            number += 1
        for other in range(number + 1, _PLACES_LOOKED_AT):
            if os.path.lexists(part_place(path, other)) and (left := left_part(path, other)):
                left.discard()
    except OSError as error:
        raise named(error, path) from None
    return PartFile(path, number, handle)


def demand_file(path: Path) -> None:
    """Refuse to replace a device, a pipe or a socket (`NotAFileError`)."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise NotAFileError(path)


def left_part(path: Path, number: int = 0) -> PartFile | None:
    """The part of a result that an ended process left; None if there is none or it is in use."""
    handle = old_locked(part_place(path, number))
    return None if handle is None else PartFile(path, number, handle)


def part_place(path: Path, number: int) -> Path:
    """Where the parts of a result are."""
    return path.with_name(f".{path.name}.{number}.part" if number else f".{path.name}.part")


def named(error: OSError, path: Path) -> OSError:
    """The error with the name of the result: that of its part would mean nothing to a reader."""
    return type(error)(error.errno, error.strerror, str(path))


@contextmanager
def folder_locked(folder: Path) -> Iterator[None]:
    """Lock a folder for the duration of a block; waits for other processes that hold the lock."""
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        # Without locks on this file system, results of runs at once may be mixed; each is whole.
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def new_locked(place: Path) -> int | None:
    """A new file, locked; None if another process writes it, or the existing file is no part."""
    while True:
        try:
            handle = os.open(place, _NEW, 0o666)
        except FileExistsError:
            left = old_locked(place)
            if left is None:
                if not os.path.lexists(place):
                    continue  # it has just taken its place
                return None
            place.unlink(missing_ok=True)
            os.close(left)
            continue
        if _lock(handle) is not False and is_at(handle, place):
            return handle
        os.close(handle)  # mistaken for a leftover file before it was locked


def old_locked(place: Path) -> int | None:
    """A file that was left behind, locked; None if there is none or it is no such file."""
    try:
        handle = os.open(place, _OLD)
    except OSError:
        return None
    if stat.S_ISREG(os.fstat(handle).st_mode) and _lock(handle) and is_at(handle, place):
        return handle  # no process writes it any more
    os.close(handle)
    return None


def _lock(handle: int) -> bool | None:
    """Lock a file: False if another process holds the lock, None if locks are not supported."""
    if sys.platform == "win32":
        return None
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(handle: int, place: Path) -> bool:
    """Whether an open file is the one at a path."""
    try:
        return os.path.samestat(os.fstat(handle), os.lstat(place))
    except OSError:
        return False


def _place_new(temporary: Path, path: Path) -> None:
    """Give the file its name unless the name was taken meanwhile."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        if not path.is_file() or not temporary.samefile(path):
            raise OutputExistsError(path) from None
        # Else a process was killed after it had placed the file.
    except OSError:  # a file system without hard links: the name is taken first
        try:
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            raise OutputExistsError(path) from None
        temporary.replace(path)
    temporary.unlink(missing_ok=True)
