"""No image takes more memory than images of its run do, whatever its file is or claims to be."""

from __future__ import annotations

from pathlib import Path

from detect.errors import FrameError
from storage.bounded import read_bounded
from storage.image_header import MOST_PIXELS, claimed_size

# A file is at most as large as its uncompressed pixels, 16 bits in four channels, twice over for
# formats that grow, plus thumbnails and other metadata that cameras write.
_BYTES_PER_PIXEL = 16
_BYTES_BESIDE = 1 << 23


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
    try:
        return read_bounded(path, _BYTES_BESIDE + _BYTES_PER_PIXEL * pixels)
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
