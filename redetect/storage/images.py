"""Decodes image files and opens videos: the sensor's pixels, in no more memory than they need.

A file of a few hundred bytes can claim an image of gigabytes, for which decoders allocate memory
first. So an image's size is read from its header, for the supported input formats: JPEG (ISO/IEC
10918-1), PNG, PNM (P1 to P6), BMP, and TIFF (6.0 and BigTIFF).
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from redetect.array_types import GreyImage
from redetect.storage.bounded import read_bounded

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
_LARGEST_FILE_BYTES = 1 << 30


def read_grey(path: Path, error: type[Exception]) -> GreyImage:
    """Read an image as grey values of 8 bits, as the sensor saw it; raises an `error`."""
    try:
        content = read_bounded(path, _LARGEST_FILE_BYTES)
    except OSError as why:
        raise error(f"{path}: cannot be read: {why.strerror}") from None
    image = decoded_image(content, path, error)
    if image.dtype not in (np.uint8, np.uint16):
        raise error(f"{path}: holds {image.dtype}: expected images of 8 or 16 bits")
    if image.dtype == np.uint8:
        return np.asarray(image)
    # Cameras of 10 to 16 bits leave the upper part of the range unused: by the brightest pixel.
    brightest = max(float(image.max()), 1.0)
    return np.asarray(np.rint(image.astype(np.float64) * (255.0 / brightest)), dtype=np.uint8)


def decoded_image(content: bytes, name: object, error: type[Exception]) -> NDArray[Any]:
    """(H, W) grey values of an image file's content, of any depth.

    Orientation in metadata (Exif) turns nothing: a calibration is of the sensor's pixels. Raises an
    `error`, before memory is allocated if the image is too large.
    """
    size, image = claimed_size(content), None
    if size is not None:
        if size[0] * size[1] > MOST_PIXELS:
            claim = f"claims {size[0]}x{size[1]} px: expected at most {MOST_PIXELS} pixels"
            raise error(f"{name}: cannot be decoded: {claim}")
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # sizes beyond OpenCV's bounds
            image = cv2.imdecode(np.frombuffer(without_orientation(content), np.uint8), flags)
    if image is None:
        raise error(f"{name}: cannot be decoded: expected an image: JPEG, PNG, PNM, BMP or TIFF")
    return image


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
    """The first directory's tags: `struct` format (None if not a number) and offset of each."""
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


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Suppress messages of OpenCV and its FFmpeg on errors that are reported here."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    levels: Any = getattr(cv2.utils, "logging", cv2)  # where OpenCV 4 has them
    before = levels.getLogLevel()
    levels.setLogLevel(0)  # silent
    try:
        yield
    finally:
        levels.setLogLevel(before)


@contextmanager
def opened_video(path: Path, error: Exception) -> Iterator[cv2.VideoCapture]:
    """Open a video, of the sensor's pixels, however a player would rotate them; else an error."""
    with quiet_opencv():
        capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise error
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()
