"""Reads untrusted files: only regular files of bounded size, plain arrays, within a folder.

A file of a few hundred bytes can claim an image of gigabytes, for which decoders allocate memory
first. So an image's size is read from its header, for the supported input formats: JPEG (ISO/IEC
10918-1), PNG, PNM (P1 to P6), BMP, and TIFF (6.0 and BigTIFF).
"""

from __future__ import annotations

import errno
import math
import os
import posixpath
import re
import stat
import struct
import tokenize
import warnings
from collections.abc import Iterator
from contextlib import suppress
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
#: Names that denote a device on Windows, in any folder and with any ending.
_DEVICE = re.compile(
    r"(?:\A|/)(?:con|prn|aux|nul|com[0-9]|lpt[0-9])(?: *\.[^/]*)?(?:/|\Z)", re.IGNORECASE
)
#: Bound of an image's size: one byte per grey value.
MOST_PIXELS = 1 << 27
#: The start-of-frame markers of a JPEG: C0 to CF except tables (C4), extensions (C8, CC).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
_PNG = b"\x89PNG\r\n\x1a\n"
_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,10})(?:\s|#[^\n]*\n)+(\d{1,10})(?=[\s#])")
_PNM_HEADER_BYTES = 4096
_TIFF_ENTRIES = 512
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TIFF_SIZES = (256, 257, 322, 323)  # width, height, and those of a tile
_TIFF_ORIENTATION = 274
_TIFF_NUMBERS = {3: "H", 4: "I", 16: "Q"}
# Tiles are padded and may be larger than a small image; up to this many pixels this is valid.
_ORDINARY_TILE = 1 << 22


def read_bounded(path: FilePath, largest_bytes: int, *, own: bool = False) -> bytes:
    """The content of a regular file, or a link to one, of at most `largest_bytes`.

    Pipes and devices are rejected, never waited for; if it must be the user's `own`, so are links,
    and files that another user may have written to. Raises an OSError whose `strerror` states the
    reason.
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
    if _DEVICE.search(parts):
        return "is the name of a device"
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


def claimed_size(content: bytes) -> tuple[int, int] | None:
    """Width and height (pixels) claimed by the header of an image file.

    For a TIFF with enormous tiles that are larger than the image, those of a tile. None if this is
    not a JPEG, PNG, PNM, BMP or TIFF, or its header is damaged.
    """
    try:
        if content.startswith(b"\xff\xd8"):
            return _jpeg_size(content)
        if content.startswith(_PNG):
            return _png_size(content)
        if content.startswith(b"BM"):
            return _bmp_size(content)
        if content.startswith(_TIFF):
            return _tiff_size(content)
        found = _PNM.match(content[:_PNM_HEADER_BYTES])
        return None if found is None else (int(found[1]), int(found[2]))
    except (struct.error, IndexError, OverflowError):  # ends early, or points far away
        return None


def _png_size(content: bytes) -> tuple[int, int] | None:
    """The size in the first chunk, if every chunk ends within the file.

    OpenCV allocates the claimed length of a chunk, up to 4 GiB, before it reads the chunk.
    """
    if content[12:16] != b"IHDR":
        return None
    place, kind = len(_PNG), b""
    while kind != b"IEND" and place < len(content):
        (length,) = struct.unpack_from(">I", content, place)
        kind = content[place + 4 : place + 8]
        place += 12 + length
        if place > len(content):
            return None
    width, height = struct.unpack_from(">II", content, 16)
    return width, height


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    place = 2
    while content[place] == 0xFF:
        marker = content[place + 1]
        if marker == 0xFF:  # fill
            place += 1
        elif marker in _JPEG_WITHOUT_LENGTH:
            place += 2
        elif marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", content, place + 5)
            return width, height
        elif marker in (0xD9, 0xDA):  # the image's end, or its data, before its size
            return None
        else:
            (length,) = struct.unpack_from(">H", content, place + 2)
            place += 2 + length
    return None


def _bmp_size(content: bytes) -> tuple[int, int]:
    (header_bytes,) = struct.unpack_from("<I", content, 14)
    numbers = "<HH" if header_bytes == 12 else "<ii"  # the former of OS/2
    width, height = struct.unpack_from(numbers, content, 18)
    return abs(width), abs(height)  # a negative height: rows from the top


def _tiff_size(content: bytes) -> tuple[int, int] | None:
    sizes = dict.fromkeys(_TIFF_SIZES, 0)
    for tag, number, place in _tiff_numbers(content):
        if tag in sizes:
            if number is None:
                return None
            (sizes[tag],) = struct.unpack_from(number, content, place)
    image, tile = (sizes[256], sizes[257]), (sizes[322], sizes[323])
    if not all(image):
        return None
    taken = tile[0] * tile[1]
    return image if taken <= max(_ORDINARY_TILE, image[0] * image[1]) else tile


def _tiff_numbers(content: bytes) -> Iterator[tuple[int, str | None, int]]:
    """The tags of the first directory, each with the `struct` format of its number (None if it is
    not a number) and its offset.
    """
    order = "<" if content.startswith(b"II") else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    offset_type, count_type, entry_bytes = ("Q", "Q", 20) if big else ("I", "H", 12)
    (directory,) = struct.unpack_from(order + offset_type, content, 8 if big else 4)
    (count,) = struct.unpack_from(order + count_type, content, directory)
    first = directory + struct.calcsize(order + count_type)
    for entry in range(min(count, _TIFF_ENTRIES)):
        place = first + entry * entry_bytes
        tag, kind = struct.unpack_from(order + "HH", content, place)
        number_type = _TIFF_NUMBERS.get(kind)
        number = None if number_type is None else order + number_type
        yield tag, number, place + (12 if big else 8)


def without_orientation(content: bytes) -> bytes:
    """The content of an image file, with a TIFF's orientation tag set to "not rotated".

    On request, OpenCV ignores the orientation of JPEG and PNG, but not that of TIFF.
    """
    if not content.startswith(_TIFF):
        return content
    changed = bytearray(content)
    with suppress(struct.error, OverflowError):  # damaged: the decoder reports it
        for tag, number, place in _tiff_numbers(content):
            if tag == _TIFF_ORIENTATION and number is not None:
                struct.pack_into(number, changed, place, 1)
    return bytes(changed)
