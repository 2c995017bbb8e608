"""Real disks with faults: one that is full, and one without hard links.

A process of its own gets mounts of its own (namespaces of Linux): a disk of few bytes in memory, or
one that a server of this file's sort serves through FUSE. They vanish with the process. Where the
machine does not allow this, tests skip and say why.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from tests.storage.linkless_server import serve

PATIENCE_S = 240.0

# Of <sched.h> and <sys/mount.h>.
_NEW_MOUNTS, _NEW_USER = 0x00020000, 0x10000000
_PRIVATE_BELOW = 0x4000 | 0x40000

Work = Callable[..., None]


class DiskNotAllowedError(OSError):
    """Why this machine gives no disk of one's own."""


def on_small_disk(place: Path, size: int, work: Work, *arguments: Any) -> None:
    """Do work in a process of its own while a disk of so many bytes is at a place."""
    _in_own_process(_SmallDisk(str(place), size), work, arguments)


def on_linkless_disk(place: Path, work: Work, *arguments: Any) -> None:
    """Do work in a process of its own while a disk without hard links is at a place."""
    _in_own_process(_LinklessDisk(str(place)), work, arguments)


def fill(folder: Path) -> Path:
    """Fill the disk that a folder is on, to the last byte; gives the file that does."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as stream:
        size = 1 << 16
        while size:
            try:
                size = size if stream.write(bytes(size)) == size else size // 2
            except OSError:
                size //= 2
    return filler


class _SmallDisk:
    def __init__(self, place: str, size: int) -> None:
        self.place, self.size = place, size

    def __call__(self) -> None:
        _mount("none", self.place, "tmpfs", f"size={self.size}")


class _LinklessDisk:
    def __init__(self, place: str) -> None:
        self.place = place

    def __call__(self) -> None:
        try:
            handle = os.open("/dev/fuse", os.O_RDWR)
        except OSError as error:
            raise DiskNotAllowedError(*error.args, error.filename) from None
        options = f"fd={handle},rootmode=40000,user_id={os.getuid()},group_id={os.getgid()}"
        _mount("linkless", self.place, "fuse", options)
        parent = os.getpid()
        if os.fork() == 0:
            _die_with_parent(parent)
            try:
                serve(handle)
            finally:
                os._exit(0)
        os.close(handle)
        # Until Linux has asked for it, it takes user 0 for the owner, who is unknown in a namespace
        # that is an ordinary user's, and refuses whatever is to be written.
        Path(self.place).stat()


def _in_own_process(mount: Callable[[], None], work: Work, arguments: tuple[Any, ...]) -> None:
    if sys.platform != "linux":
        pytest.skip("disks of one's own as Linux gives them")
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_begin, args=(there, mount, work, arguments))
    process.start()
    there.close()
    try:
        assert here.poll(PATIENCE_S), "the work on a disk of its own does not end"
        kind, said = here.recv()
    finally:
        process.join(PATIENCE_S)
        process.kill()
        process.join()
        process.close()
    if kind == "not allowed":
        pytest.skip(f"this machine gives no disk of one's own: {said}")
    assert kind == "done", said


def _begin(
    connection: Connection, mount: Callable[[], None], work: Work, arguments: tuple[Any, ...]
) -> None:
    try:
        _own_mounts()
        mount()
    except DiskNotAllowedError as error:
        connection.send(("not allowed", str(error)))
        return
    try:
        work(*arguments)
    except BaseException:  # told to the test, whose failure it is
        connection.send(("failed", traceback.format_exc()))
    else:
        connection.send(("done", ""))


def _own_mounts() -> None:
    """See mounts that nobody else sees; as root of a namespace, so that anybody may."""
    user, group = os.getuid(), os.getgid()
    _demand("unshare", ctypes.c_int(_NEW_MOUNTS | _NEW_USER))
    try:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
        Path("/proc/self/gid_map").write_text(f"{group} {group} 1")
    except OSError as error:
        raise DiskNotAllowedError(*error.args, error.filename) from None
    _demand("mount", None, b"/", None, ctypes.c_ulong(_PRIVATE_BELOW), None)


def _mount(source: str, place: str, kind: str, options: str) -> None:
    _demand(
        "mount",
        source.encode(), place.encode(), kind.encode(), ctypes.c_ulong(0), options.encode(),
    )  # fmt: skip


def _demand(name: str, *arguments: Any) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise DiskNotAllowedError(number, f"{name}: {os.strerror(number)}")


def _die_with_parent(parent: int) -> None:
    _demand("prctl", ctypes.c_int(1), ctypes.c_ulong(signal.SIGKILL))  # PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(0)
