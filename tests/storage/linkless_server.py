"""A file system in memory that has no hard links, as exFAT has none, served through Linux's FUSE.

As much of the protocol (<linux/fuse.h>, version 7.31) as files, folders, symbolic links, names and
permissions need. What is not answered by `_Tree` is refused as not implemented; a hard link is
refused as such file systems do, with EPERM.
"""

from __future__ import annotations

import errno
import os
import stat
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field

_LARGEST_WRITE = 1 << 17
_ROOT = 1
_INTERRUPT, _INIT, _DESTROY, _FORGET, _BATCH_FORGET = 36, 26, 38, 2, 42
_BIG_WRITES = 1 << 5
# Of a change of attributes: what is changed.
_MODE, _USER, _GROUP, _SIZE, _MTIME, _MTIME_NOW = 1, 2, 4, 8, 32, 256
_NO_REPLACE = 1


@dataclass
class _Node:
    mode: int
    user: int
    group: int
    content: bytearray = field(default_factory=bytearray)
    names: dict[bytes, int] = field(default_factory=dict)
    links: int = 1
    changed_s: float = field(default_factory=time.time)

    def attributes(self, number: int) -> bytes:
        size, (seconds, nanoseconds) = len(self.content), divmod(int(self.changed_s * 1e9), 10**9)
        times = (*[seconds] * 3, *[nanoseconds] * 3)
        owner = (self.mode, self.links, self.user, self.group)
        return struct.pack("<6Q10I", number, size, -(-size // 512), *times, *owner, 0, 4096, 0)


class _Tree:
    """What is in the file system; every method answers one kind of request."""

    def __init__(self) -> None:
        self.nodes = {_ROOT: _Node(stat.S_IFDIR | 0o755, os.getuid(), os.getgid())}
        self.last = _ROOT
        self.answers: dict[int, Callable[[int, bytes, int, int], bytes]] = {
            1: self.look_up, 3: self.attributes, 4: self.change, 5: self.read_link, 6: self.symlink,
            8: self.make_file, 9: self.make_folder, 10: self.remove, 11: self.remove_folder,
            12: self.rename, 13: self.link, 14: self.open, 15: self.read, 16: self.write,
            17: self.room, 18: self.nothing, 20: self.nothing, 25: self.nothing, 27: self.open,
            28: self.listing, 29: self.nothing, 30: self.nothing, 35: self.create, 45: self.rename2,
        }  # fmt: skip

    def entry(self, number: int) -> bytes:
        # Nothing may be remembered for longer than a moment: 0 seconds.
        return struct.pack("<4Q2I", number, 0, 0, 0, 0, 0) + self.nodes[number].attributes(number)

    def new(self, parent: int, name: bytes, mode: int, user: int, group: int) -> int:
        if name in self.nodes[parent].names:
            raise OSError(errno.EEXIST, "exists")
        self.last += 1
        self.nodes[self.last] = _Node(mode, user, group)
        self.nodes[parent].names[name] = self.last
        return self.last

    def look_up(self, at: int, said: bytes, user: int, group: int) -> bytes:
        try:
            return self.entry(self.nodes[at].names[said[:-1]])
        except KeyError:
            raise OSError(errno.ENOENT, "no such name") from None

    def attributes(self, at: int, said: bytes, user: int, group: int) -> bytes:
        return struct.pack("<Q2I", 0, 0, 0) + self.nodes[at].attributes(at)

    def change(self, at: int, said: bytes, user: int, group: int) -> bytes:
        node = self.nodes[at]
        (what, _, _, size, _, _, mtime, _, _, mtime_ns, _, mode, _, uid, gid, _) = struct.unpack(
            "<2I6Q8I", said[:88]
        )
        if what & _MODE:
            node.mode = stat.S_IFMT(node.mode) | stat.S_IMODE(mode)
        node.user = uid if what & _USER else node.user
        node.group = gid if what & _GROUP else node.group
        if what & _SIZE:
            del node.content[size:]
            node.content.extend(bytes(size - len(node.content)))
            node.changed_s = time.time()
        if what & _MTIME:
            node.changed_s = time.time() if what & _MTIME_NOW else mtime + mtime_ns * 1e-9
        return self.attributes(at, b"", user, group)

    def read_link(self, at: int, said: bytes, user: int, group: int) -> bytes:
        return bytes(self.nodes[at].content)

    def symlink(self, at: int, said: bytes, user: int, group: int) -> bytes:
        name, target, _ = said.split(b"\0")
        number = self.new(at, name, stat.S_IFLNK | 0o777, user, group)
        self.nodes[number].content.extend(target)
        return self.entry(number)

    def make_file(self, at: int, said: bytes, user: int, group: int) -> bytes:
        (mode,) = struct.unpack("<I", said[:4])
        return self.entry(self.new(at, said[16:-1], mode, user, group))

    def make_folder(self, at: int, said: bytes, user: int, group: int) -> bytes:
        (mode,) = struct.unpack("<I", said[:4])
        return self.entry(self.new(at, said[8:-1], stat.S_IFDIR | mode, user, group))

    def remove(self, at: int, said: bytes, user: int, group: int) -> bytes:
        # Who has it open keeps it: numbers are not used again.
        self.nodes[self.nodes[at].names.pop(said[:-1])].links = 0
        return b""

    def remove_folder(self, at: int, said: bytes, user: int, group: int) -> bytes:
        if self.nodes[self.nodes[at].names[said[:-1]]].names:
            raise OSError(errno.ENOTEMPTY, "not empty")
        return self.remove(at, said, user, group)

    def rename(self, at: int, said: bytes, user: int, group: int) -> bytes:
        (to,) = struct.unpack("<Q", said[:8])
        old, new, _ = said[8:].split(b"\0")
        there = self.nodes[to].names.get(new)
        if there is not None and self.nodes[there].names:
            raise OSError(errno.ENOTEMPTY, "not empty")
        number = self.nodes[at].names.pop(old)
        if there is not None and there != number:
            self.nodes[there].links = 0
        self.nodes[to].names[new] = number
        return b""

    def rename2(self, at: int, said: bytes, user: int, group: int) -> bytes:
        to, how = struct.unpack("<QI", said[:12])
        new = said[16:].split(b"\0")[1]
        if how & ~_NO_REPLACE:
            raise OSError(errno.EINVAL, "only without replacing")
        if how and new in self.nodes[to].names:
            raise OSError(errno.EEXIST, "exists")
        return self.rename(at, said[:8] + said[16:], user, group)

    def link(self, at: int, said: bytes, user: int, group: int) -> bytes:
        raise OSError(errno.EPERM, "no hard links")

    def open(self, at: int, said: bytes, user: int, group: int) -> bytes:
        return struct.pack("<Q2I", at, 0, 0)

    def create(self, at: int, said: bytes, user: int, group: int) -> bytes:
        (mode,) = struct.unpack("<I", said[4:8])
        number = self.new(at, said[16:-1], stat.S_IFREG | stat.S_IMODE(mode), user, group)
        return self.entry(number) + self.open(number, b"", user, group)

    def read(self, at: int, said: bytes, user: int, group: int) -> bytes:
        place, size = struct.unpack("<QI", said[8:20])
        return bytes(self.nodes[at].content[place : place + size])

    def write(self, at: int, said: bytes, user: int, group: int) -> bytes:
        place, size = struct.unpack("<QI", said[8:20])
        node = self.nodes[at]
        node.content.extend(bytes(max(0, place - len(node.content))))
        node.content[place : place + size] = said[40 : 40 + size]
        node.changed_s = time.time()
        return struct.pack("<2I", size, 0)

    def listing(self, at: int, said: bytes, user: int, group: int) -> bytes:
        place, size = struct.unpack("<QI", said[8:20])
        shown = b""
        named = [(b".", at), (b"..", at), *self.nodes[at].names.items()]
        for number, (name, node) in enumerate(named[place:], start=place + 1):
            kind = stat.S_IFMT(self.nodes[node].mode) >> 12
            entry = struct.pack("<2Q2I", node, number, len(name), kind) + name
            entry += bytes(-len(entry) % 8)
            if len(shown) + len(entry) > size:
                break
            shown += entry
        return shown

    def room(self, at: int, said: bytes, user: int, group: int) -> bytes:
        blocks = 1 << 20
        return struct.pack("<5Q4I24x", blocks, blocks, blocks, blocks, blocks, 4096, 255, 4096, 0)

    def nothing(self, at: int, said: bytes, user: int, group: int) -> bytes:
        return b""


def serve(handle: int) -> None:
    """Answer what the kernel asks on ``/dev/fuse`` until the file system is gone."""
    tree = _Tree()
    while True:
        try:
            asked = os.read(handle, _LARGEST_WRITE + 4096)
        except InterruptedError:
            continue
        except OSError as error:
            if error.errno == errno.ENOENT:  # withdrawn before it was read
                continue
            return  # unmounted
        _, kind, number, at, user, group, _, _ = struct.unpack("<2I2Q4I", asked[:40])
        if kind in (_FORGET, _BATCH_FORGET, _INTERRUPT):
            continue
        code, said = 0, b""
        if kind == _INIT:
            _, _, ahead, _ = struct.unpack("<4I", asked[40:56])
            # Version, reading ahead, abilities; requests at once; sizes; times to the nanosecond.
            said = struct.pack(
                "<4I2H2I2H32x", 7, 31, ahead, _BIG_WRITES, 12, 9, _LARGEST_WRITE, 1, 0, 0
            )
        elif kind != _DESTROY:
            try:
                if kind not in tree.answers:
                    raise OSError(errno.ENOSYS, "not implemented")
                said = tree.answers[kind](at, asked[40:], user, group)
            except OSError as error:
                code, said = -(error.errno or errno.EIO), b""
        os.write(handle, struct.pack("<IiQ", 16 + len(said), code, number) + said)
