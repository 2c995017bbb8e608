"""The grey images of frames, with 8 bits.

Colour is 0.299 R + 0.587 G + 0.114 B, as in OpenCV (for a JPEG, its luminance). Of values with 16
bits, the 8 highest of a bit depth are kept: those of a 12-bit camera would be nearly black
otherwise. One depth is used for the whole run: else discs would have another contrast in each
image, by the brightest things beside them. No image takes more memory than the images of its run
do, whatever its file contains or claims.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.errors import FrameError
from detect.sources.interface import Frames, RunFrame, spread_frames
from redetect.array_types import GreyImage
from redetect.storage.bounded import read_bounded
from redetect.storage.images import MOST_PIXELS, claimed_size, decoded_image

_BIT_DEPTHS = (8, 10, 12, 14, 16)  # of cameras
#: Number of images by which a run's bit depth is found, and their largest spacing in a bag.
_DEPTH_IMAGES = 32
_DEPTH_SPACING = 20
_HOT_PIXELS = 1e-4  #: Largest share of values that a bit depth need not hold: hot pixels.
# Limit of a file's size: uncompressed pixels, 16 bits in four channels, times two for formats that
# expand, plus thumbnails and other metadata of cameras.
_BYTES_PER_PIXEL = 16
_BYTES_BESIDE = 1 << 23


def read_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> GreyImage:
    """The grey image (H, W) of a frame, of 8 bits.

    Paths are relative to `working_folder`, by default the process's own. FrameError if there is no
    image, it cannot be read, or has another size than the camera or values beyond the bit depth.
    """
    stored = stored_image(frame, camera, working_folder)
    return eight_bits(stored, frame.image or frame.step.prefix, frame.bit_depth)


def stored_image(
    frame: RunFrame, camera: Camera | None, working_folder: Path | None = None
) -> NDArray[Any]:
    """The grey values (H, W) of a frame, of 8 or 16 bits; parameters and errors as `read_image`."""
    name: object = frame.image or frame.step.prefix
    size = None if camera is None else (camera.width, camera.height)
    if frame.failure is not None:
        raise FrameError(frame.failure)
    image: NDArray[Any]
    if isinstance(frame.content, np.ndarray):
        image = frame.content
    elif frame.content is not None:
        image = decode_grey(frame.content, name, size)
    elif frame.image is None:
        raise FrameError(f"{frame.step.prefix}: no image of that name in the run")
    else:
        path = os.path.join(working_folder or "", frame.image)  # noqa: PTH118 - faster than a Path
        image = decode_grey(bounded_content(path, frame.image, size), name, size)
    if camera is not None and image.shape != (camera.height, camera.width):
        raise wrong_size(name, (image.shape[1], image.shape[0]), (camera.width, camera.height))
    return image


def decode_grey(content: bytes, name: object, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """Decode a JPEG, PNG, PNM, BMP or TIFF file's content to (H, W) grey values, uint8 or uint16.

    An image with another width and height than `size` is not decoded. Raises FrameError, with
    `name` for the image, if the content is not an image, or is truncated.
    """
    if not content:
        raise FrameError(f"{name}: is empty: expected an image")
    if content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9", len(content) // 2) < 0:
        raise FrameError(f"{name}: the JPEG is truncated: its end is missing")
    claimed = claimed_size(content)
    if claimed and size and size != claimed and claimed[0] * claimed[1] <= MOST_PIXELS:
        raise wrong_size(name, claimed, size)
    return grey_of_pixels(decoded_image(content, name, FrameError), name)


def grey_of_pixels(pixels: NDArray[Any], name: object) -> NDArray[Any]:
    """Convert pixels to (H, W) grey values of as many bits, contiguous and writable.

    From (H, W) or (H, W, 1) grey values, or (H, W, 3 or 4) blue, green, red and perhaps opacity, of
    8 or 16 bits, any byte order and strides; else FrameError, `name` as in `decode_grey`.
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
    # For read-only arrays, as in messages, Numba would compile every kernel once more.
    grey: NDArray[Any] = np.require(pixels, dtype, ["C", "W"])
    if channels != 1:
        code = cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY
        grey = np.asarray(cv2.cvtColor(grey, code), dtype)
    elif grey.ndim == 3:
        grey = grey[:, :, 0]
    return grey


def eight_bits(stored: NDArray[Any], name: object, bit_depth: int | None = None) -> GreyImage:
    """The 8 highest bits of grey values (H, W), by default of the lowest bit depth that holds them.

    Raises FrameError, with `name` for the image, if a given one does not.
    """
    if stored.dtype == np.uint8:
        return stored
    bits = bit_depth or bits_needed(stored)
    if not _holds(bits, stored):
        raise FrameError(
            f"{name}: values of {bits_needed(stored)} bits: expected {bits}, as in the images by "
            f"which the run's bit depth was found, or as stated: --bit-depth {bits_needed(stored)}"
        )
    return np.asarray(np.minimum(stored >> (bits - 8), 255), np.uint8)


def bit_depth_of(frames: Frames, camera: Camera | None) -> int | None:
    """The bit depth of images whose values are stored in 16 bits, by some of them.

    None if the first that can be read has 8 bits; if later ones have more, each has its own depth.
    """
    depth = None
    # All messages of a bag before the last of these are read.
    farthest = _DEPTH_SPACING if frames.images_in_memory else None
    for frame in spread_frames(frames, _DEPTH_IMAGES, farthest):
        with suppress(FrameError):  # reported when the frame is processed
            stored = stored_image(frame, camera)
            if stored.dtype == np.uint16:
                depth = max(depth or 0, bits_needed(stored))
            elif depth is None:
                return None
    return depth


def bits_needed(stored: NDArray[Any]) -> int:
    """The lowest bit depth of cameras that holds grey values, apart from hot pixels."""
    return next(bits for bits in _BIT_DEPTHS if _holds(bits, stored))


def _holds(bits: int, stored: NDArray[Any]) -> bool:
    return bool(np.count_nonzero(stored >> bits) <= _HOT_PIXELS * stored.size)


def bounded_content(path: Path | str, name: object, size: tuple[int, int] | None) -> bytes:
    """The content of an image file; a FrameError if it is larger than such an image can be."""
    pixels = MOST_PIXELS if size is None else size[0] * size[1]
    try:
        return read_bounded(path, _BYTES_BESIDE + _BYTES_PER_PIXEL * pixels)
    except OSError as error:
        raise FrameError(f"{name}: cannot be read: {error.strerror}") from None


def wrong_size(name: object, found: tuple[int, int], expected: tuple[int, int]) -> FrameError:
    """The error for an image without the calibration's width and height."""
    return FrameError(
        f"{name}: is {found[0]}x{found[1]} px: "
        f"expected {expected[0]}x{expected[1]}, the calibration's size: "
        "name the calibration of these images by --camera"
    )
