"""No image takes more memory than images of its run do, whatever its file is or claims to be."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from detect.errors import FrameError
from storage.image_header import MOST_PIXELS, claimed_size

# A file has at most what its pixels have uncompressed, 16 bits in four channels, twice over for
# formats that grow, and room for thumbnails and whatever else cameras write.
_BYTES_PER_PIXEL = 16
_BYTES_BESIDE = 1 << 23

# Opening a pipe would wait for somebody at its other end.
_WITHOUT_WAITING = os.O_RDONLY
for _flag in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):
    _WITHOUT_WAITING |= getattr(os, _flag, 0)


def bounded_content(path: Path | str, name: object, size: tuple[int, int] | None) -> bytes:
    """The content of an image file that may be anything: a pipe, a device, a film.

    Parameters
    ----------
    path : path or str
        The file.
    name : object
        What messages call it.
    size : (int, int) or None
        Width and height that are expected.

    Returns
    -------
    bytes

    Raises
    ------
    FrameError
        If it cannot be read, is no file, or has more bytes than such an image can have.
    """
    pixels = MOST_PIXELS if size is None else size[0] * size[1]
    limit = _BYTES_BESIDE + _BYTES_PER_PIXEL * pixels
    try:
        handle = os.open(path, _WITHOUT_WAITING)
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                if stat.S_ISDIR(status.st_mode):
                    raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
                raise FrameError(f"{name}: cannot be read: is no file, but a pipe or a device")
            if status.st_size > limit:
                raise FrameError(
                    f"{name}: has {status.st_size} bytes: expected an image, at most {limit}"
                )
            # Memory is taken for as much as is asked for, whatever there is. A file object would
            # ask the system five times as often.
            content = os.read(handle, status.st_size)
            while (left := status.st_size - len(content)) and (more := os.read(handle, left)):
                content += more  # some file systems give no more than so much at once
            return content
        finally:
            os.close(handle)
    except OSError as error:
        raise FrameError(f"{name}: cannot be read: {error.strerror}") from None


def demand_bounded(content: bytes, name: object, size: tuple[int, int] | None) -> None:
    """Refuse an image by its header, before it is decoded.

    Parameters
    ----------
    content : bytes
        The file.
    name : object
        What messages call it.
    size : (int, int) or None
        Width and height that are expected.

    Raises
    ------
    FrameError
        If the file is no JPEG, PNG, PNM, BMP or TIFF, claims another size, or more than
        `MOST_PIXELS`.
    """
    claimed = claimed_size(content)
    if claimed is None:
        raise FrameError(f"{name}: cannot be decoded: expected an image")
    width, height = claimed
    if width * height > MOST_PIXELS:
        raise FrameError(
            f"{name}: cannot be decoded: claims {width}x{height} px: "
            f"expected at most {MOST_PIXELS} pixels"
        )
    if size is not None and size != (width, height):
        raise FrameError(
            f"{name}: is {width}x{height} px: "
            f"expected {size[0]}x{size[1]}, the calibration's size: "
            "name the calibration of these images by --camera"
        )
