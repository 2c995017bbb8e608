"""Converts images of any kind to the 8-bit grey images of the detectors.

Colour becomes 0.299 R + 0.587 G + 0.114 B, as OpenCV has it (of a JPEG, the brightness that it
stores). Of images with more than 8 bits, the 8 highest of their *significant* bits are kept: a
12-bit camera's values are stored in 16-bit files, and would be nearly black if all 16 were used.

No image takes more memory than images of its run do, whatever its file is or claims to be.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from redetect.storage.bounded import MOST_PIXELS, claimed_size, read_bounded, without_orientation

#: Significant bits of a 16-bit image.
BIT_DEPTHS = (8, 10, 12, 14, 16)

# A file is at most as large as its uncompressed pixels, 16 bits in four channels, twice over for
# formats that grow, plus thumbnails and other metadata that cameras write.
_BYTES_PER_PIXEL = 16
_BYTES_BESIDE = 1 << 23


def decode_gray(
    content: bytes, name: object, bits: int = 16, size: tuple[int, int] | None = None
) -> NDArray[np.uint8]:
    """Decode a JPEG, PNG, PNM, BMP or TIFF file's content to (H, W) uint8 grey values.

    Parameters
    ----------
    content : bytes
    name : object
        The image's name in messages.
    bits : int
        Significant bits of images that have more than 8 bits.
    size : (int, int) or None
        Width and height that are expected: an image that claims others is not decoded.

    Raises
    ------
    FrameError
        If there is no image in it, it is cut off, or its values need more bits.
    """
    if not content:
        raise FrameError(f"{name}: is empty: expected an image")
    if content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9", len(content) // 2) < 0:
        raise FrameError(f"{name}: the JPEG is cut off: its end is missing")
    demand_bounded(content, name, size)
    image = _decoded(content)
    if image is None:
        raise FrameError(f"{name}: cannot be decoded: expected an image")
    return gray_of_pixels(image, name, bits)


def gray_of_pixels(pixels: NDArray[Any], name: object, bits: int = 16) -> NDArray[np.uint8]:
    """Bring pixels to (H, W) uint8 grey values, contiguous and writable.

    They are (H, W) or (H, W, 1) grey values, or (H, W, 3 or 4) blue, green, red and perhaps
    opacity, of 8 or 16 bits, any byte order and strides; else, or if they need more bits, a
    FrameError. `name` and `bits` as of `decode_gray`.
    """
    dtype = pixels.dtype.newbyteorder("=")
    if dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"{name}: holds {pixels.dtype}: expected images of 8 or 16 bits (uint8, uint16)"
        )
    channels = 1 if pixels.ndim == 2 else pixels.shape[-1]
    if pixels.ndim not in (2, 3) or channels not in (1, 3, 4) or not pixels.size:
        raise FrameError(
            f"{name}: is an array of shape {pixels.shape}: expected (height, width) grey values, "
            "or (height, width, 3 or 4) of colours in the order blue, green, red"
        )
    # Numba would compile every kernel once more for arrays that are read-only, as in messages.
    gray: NDArray[Any] = np.require(pixels, dtype, ["C", "W"])
    if channels != 1:
        code = cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY
        gray = np.asarray(cv2.cvtColor(gray, code), dtype)
    elif gray.ndim == 3:
        gray = gray[:, :, 0]
    if dtype == np.uint8:
        return gray
    largest = int(gray.max())
    if largest >> bits:
        raise FrameError(
            f"{name}: a value of {largest} needs more than {bits} bits: "
            "name the significant bits of these images by --bits"
        )
    return (gray >> (bits - 8)).astype(np.uint8)


def significant_bits(pixels: NDArray[Any]) -> int:
    """The smallest of `BIT_DEPTHS` that holds all values of an image; 8 for an 8-bit image."""
    largest = int(pixels.max(initial=0))
    return next((bits for bits in BIT_DEPTHS if not largest >> bits), BIT_DEPTHS[-1])


def significant_bits_of_file(path: Path) -> int | None:
    """The significant bits of an image file; None if it is no image of 16 bits."""
    try:
        content = bounded_content(path, path, None)
        demand_bounded(content, path, None)
    except FrameError:
        return None  # reported when the file is processed
    image = _decoded(content)
    return None if image is None or image.dtype != np.uint16 else significant_bits(image)


def _decoded(content: bytes) -> NDArray[Any] | None:
    # A calibration is of the sensor's pixels, whichever way up a telephone would show them (Exif).
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return cv2.imdecode(np.frombuffer(without_orientation(content), np.uint8), flags)
    except cv2.error:  # sizes beyond OpenCV's bounds
        return None


def bounded_content(path: Path | str, name: object, size: tuple[int, int] | None) -> bytes:
    """The content of an image file; a FrameError if it is larger than such an image can be."""
    pixels = MOST_PIXELS if size is None else size[0] * size[1]
    try:
        return read_bounded(path, _BYTES_BESIDE + _BYTES_PER_PIXEL * pixels)
    except OSError as error:
        raise FrameError(f"{name}: cannot be read: {error.strerror}") from None


def demand_bounded(content: bytes, name: object, size: tuple[int, int] | None) -> None:
    """Refuse an image by its header, with a FrameError: no image, too large, or of another size."""
    claimed = claimed_size(content)
    if claimed is None:
        raise FrameError(f"{name}: cannot be decoded: expected an image")
    width, height = claimed
    if width * height > MOST_PIXELS:
        raise FrameError(
            f"{name}: cannot be decoded: claims {width}x{height} px: "
            f"expected at most {MOST_PIXELS} pixels"
        )
    if size is not None and size != claimed:
        raise wrong_size(name, claimed, size)


def wrong_size(name: object, found: tuple[int, int], expected: tuple[int, int]) -> FrameError:
    """The error of an image that has not the calibration's width and height."""
    return FrameError(
        f"{name}: is {found[0]}x{found[1]} px: "
        f"expected {expected[0]}x{expected[1]}, the calibration's size: "
        "name the calibration of these images by --camera"
    )
