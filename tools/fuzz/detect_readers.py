"""Readers of the parts of a run: images, poses, heads of files, journals, cached tables."""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterable
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from camera import CameraError, parse_camera
from detect.errors import DetectError, FrameError
from detect.row_files import circle_settings_of
from detect.runs.journal import Journal
from detect.sources.bag import pixels_of_message
from detect.sources.grey_images import bounded_content, decode_grey, eight_bits, grey_of_pixels
from detect.sources.poses import TimedPose, step_between, tick_poses, tum_poses, velocity_poses
from lut import build_vertical_table
from lut.cache import cached_vertical_table
from redetect.landmarks import LandmarkError
from redetect.landmarks.files import read_head
from redetect.storage.images import claimed_size, read_grey
from redetect.storage.parts import left_part
from tools.fuzz.reader import CAMERA_TEXT, NPZ_WORDS, NUMBERS, Reader, npz

#: Images are read for a calibration of this size.
_SIZE = (8, 8)
#: Without a calibration, images that claim more pixels are skipped: they only take time.
_MOST_PIXELS = 1 << 16

_JPEG = b"\xff\xd8\xff\xe0\0\x04AB\xff\xc0\0\x0b\x08\0\x08\0\x08\x01\x01\x11\0\xff\xd9"
_TIFF = b"II*\0\x08\0\0\0\x02\0" + b"".join(
    struct.pack("<HHII", tag, 3, 1, 8) for tag in (256, 257)
) + bytes(4)  # fmt: skip
_IMAGE_WORDS = (
    b"\xff\xd8", b"\xff\xc0", b"\xff\xc2", b"\xff\xc4", b"\xff\xda", b"\xff\xd9", b"\xff\xff",
    b"II*\0", b"MM\0*", b"II+\0", b"MM\0+", b"P5", b"P2", b"P6", b"#", b"IHDR", b"IDAT", b"PLTE",
    b"tRNS", b"acTL", b"eXIf", b"iCCP", b"\0\x08",
)  # fmt: skip


def _header(path: Path) -> object:
    size = claimed_size(path.read_bytes())
    assert size is None or (len(size) == 2 and all(type(side) is int for side in size))
    return size


def _image(path: Path) -> object:
    """As frames are decoded."""
    content = bounded_content(path, path, _SIZE)
    image = eight_bits(decode_grey(content, path, _SIZE), path)
    assert image.dtype == np.uint8
    assert image.ndim == 2
    return image


def _calibration_image(path: Path) -> object:
    size = claimed_size(path.read_bytes()) if path.is_file() else None
    small = size is None or size[0] * size[1] <= _MOST_PIXELS
    return read_grey(path, CameraError) if small else None


def steps_of(poses: Iterable[TimedPose]) -> object:
    """Steps between poses, as runs have them."""
    return [step_between("e", *pair) for pair in pairwise(poses)]


@cache
def _encoded() -> tuple[bytes, ...]:
    """Images as OpenCV writes them, of 8 and 16 bits, grey and coloured."""
    grey = (np.arange(64, dtype=np.uint8) * 3).reshape(8, 8)
    deep = grey.astype(np.uint16) * 16
    colour = np.dstack([grey, grey.T, 255 - grey])
    found = [cv2.imencode(f".{form}", grey)[1] for form in ("jpg", "png", "pgm", "bmp", "tiff")]
    found += [cv2.imencode(f".{form}", colour)[1] for form in ("jpg", "png", "ppm", "bmp")]
    found += [cv2.imencode(f".{form}", deep)[1] for form in ("png", "pgm", "tiff")]
    progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    found.append(cv2.imencode(".jpg", grey, progressive)[1])
    return tuple(image.tobytes() for image in found)


def _image_message(path: Path) -> object:
    """An image message whose fields are at the beginning of a file."""
    content = path.read_bytes()
    height, width, step, big = struct.unpack("<IIIB", content[:13].ljust(13, b"\0"))
    encoding, _, data = content[13:].partition(b"\n")
    message = SimpleNamespace(
        height=height, width=width, step=step, is_bigendian=big,
        encoding=encoding.decode("utf-8", "replace"), data=np.frombuffer(data, np.uint8),
    )  # fmt: skip
    image = eight_bits(grey_of_pixels(pixels_of_message(message, path), path), path)
    assert image.dtype == np.uint8
    assert image.ndim == 2
    return image


def _message(encoding: str, step: int, bytes_there: int, big: int = 0) -> bytes:
    return struct.pack("<IIIB", 8, 8, step, big) + f"{encoding}\n".encode() + bytes(bytes_there)


def _head(path: Path) -> object:
    return circle_settings_of(read_head(path))


def _journal(path: Path) -> object:
    file = left_part(path.with_name("detected"), "journal")
    assert file is not None
    try:
        journal = Journal(file)
        return journal.is_by("ab"), journal.complete(), list(journal.frames())
    finally:
        file.close()


def _journal_of(*records: bytes) -> bytes:
    """Records, each after the digest of itself and all earlier ones."""
    lines, digest = [], hashlib.sha256()
    for record in records:
        digest.update(record)
        lines.append(digest.hexdigest()[:16].encode() + b" " + record + b"\n")
    return b"".join(lines)


_TABLE_CAMERA = parse_camera(
    CAMERA_TEXT.decode()
    .replace("768 height: 288", "16 height: 12")
    .replace("384 offsetY: 144", "8 offsetY: 6")
)


def _table(path: Path) -> object:
    """A cached table with a valid hash: whatever it holds, the true table is returned."""
    folder = path.parent / "cache"
    if not folder.is_dir():
        folder.mkdir(mode=0o700)
        cached_vertical_table(_TABLE_CAMERA, folder)
    (place,) = folder.iterdir()
    payload = path.read_bytes()
    digest = hashlib.sha256(place.name.encode() + b"\0" + payload).digest()
    handle = os.open(place, os.O_WRONLY | os.O_TRUNC)
    os.write(handle, digest + payload)
    os.close(handle)
    return cached_vertical_table(_TABLE_CAMERA, folder)


@cache
def _table_content() -> tuple[bytes, ...]:
    return (npz(**vars(build_vertical_table(_TABLE_CAMERA))),)


_HEADERS = (
    _JPEG,
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x08\0\0\0\x08\x08\0\0\0\0\0\0\0\0",
    b"P5 8 8 255\n",
    b"BM" + bytes(12) + struct.pack("<Iii", 40, 8, 8),
    _TIFF,
)
_MESSAGES = (
    _message("mono8", 10, 80), _message("16UC1", 16, 128, 1), _message("rgb8", 24, 192),
    _message("bayer_rggb8", 8, 64), _message("yuv422", 16, 128), _message("bgra16", 64, 512),
)  # fmt: skip
_ENCODINGS = (
    b"mono16", b"8UC1", b"8UC4", b"bayer_bggr16", b"bayer_gbrg8", b"uyvy", b"rgba8", b"bgr16",
)  # fmt: skip
_HEADS = (b"# redetect 0.1.0\n# settings radius_m=0.1 samples=16 polarity=any refine=True\n",)
_SETTING_WORDS = (
    b"settings ", b"radius_m=", b"samples=", b"verify=", b"polarity=", b"threshold=",
    b"sigma_x_px=", b"evidence=", b"border_px=",
    b"True", b"1-2", b"1e5e5", *NUMBERS,
)  # fmt: skip
_JOURNALS = (
    _journal_of(b'["ab"]', b'["d","e",{"a":"b"},{"c":1},{},null]', b'["complete",[0],true]'),
    _journal_of(b'["ab"]', b'["d","e",{},{},{"size":2},"no image"]'),
)
_JOURNAL_WORDS = (
    b"[", b"]", b",", b'"', b"null", b"true", b"-1", b"1" * 30, b"1e999", b"NaN", b"{}",
)  # fmt: skip
_DETECT, _FRAME = (DetectError,), (FrameError,)

DETECT_READERS: tuple[Reader, ...] = (
    Reader("image header", "image", _header, (), _HEADERS, _IMAGE_WORDS),
    Reader("image", "e.0000.jpg", _image, _FRAME, (), _IMAGE_WORDS, made_seeds=_encoded),
    Reader("calibration image", "e.png", _calibration_image, (CameraError,), (), _IMAGE_WORDS,
           made_seeds=_encoded),
    Reader("image message", "message", _image_message, _FRAME, _MESSAGES, _ENCODINGS, needed=False),
    Reader("trajectory", "e.tum", lambda p: steps_of(tum_poses(p)), _DETECT,
           (b"# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n1 0.5 0 0 0 0 0.1 0.995\n",), NUMBERS),
    Reader("wheel ticks", "e.ticks", lambda p: steps_of(tick_poses(p, 0.5, 0.001)), _DETECT,
           (b"# t left right\n0 0 0\n1 500 510\n",), NUMBERS),
    Reader("velocities", "e.velocities", lambda p: steps_of(velocity_poses(p)), _DETECT,
           (b"# t v omega sigma_v sigma_omega\n0 1 0.1 0.01 0.02\n1 0 0 0 0\n",), NUMBERS),
    Reader("settings", "detected.circles", _head, (DetectError, LandmarkError), _HEADS,
           _SETTING_WORDS),
    Reader("journal", ".detected.journal", _journal, (), _JOURNALS, _JOURNAL_WORDS),
    Reader("cached table", "table", _table, (), (), NPZ_WORDS, files=10,
           made_seeds=_table_content),
)  # fmt: skip
