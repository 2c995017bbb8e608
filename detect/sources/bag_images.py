"""ROS image messages as grey values, by the encodings of `sensor_msgs/image_encodings`."""

from __future__ import annotations

from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.errors import FrameError
from storage.messages import excerpt

_GRAY = frozenset({"mono8", "8UC1", "mono16", "16UC1"})
_CHANNELS = {
    "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "8UC3": 3, "8UC4": 4,
    "bgr16": 3, "rgb16": 3, "bgra16": 4, "rgba16": 4,
}  # fmt: skip
_BAYER = ("bayer_rggb", "bayer_bggr", "bayer_gbrg", "bayer_grbg")
# Offset of the brightness in each pair of bytes.
_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}


class ImageMessage(Protocol):
    """The fields of a `sensor_msgs/Image` that are used."""

    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: NDArray[np.uint8]


def pixels_of_message(message: ImageMessage, name: object) -> NDArray[Any]:
    """The pixels of a raw image message.

    Parameters
    ----------
    message : sensor_msgs/Image
        Grey, colour, Bayer or YUV 4:2:2, of 8 or 16 bits.
    name : object
        What messages call the image.

    Returns
    -------
    (H, W), (H, W, 3) or (H, W, 4) uint8 or uint16 array
        Grey values, or blue, green, red and perhaps opacity; of Bayer patterns and YUV the
        brightness.

    Raises
    ------
    FrameError
        If the encoding is another, or there is less data than the message states.
    """
    encoding = message.encoding
    bayer = encoding.rstrip("0123456789").rstrip("_") if encoding.startswith("bayer_") else None
    if encoding in _LUMA:
        return _rows(message, name, np.dtype(np.uint8), 2)[:, _LUMA[encoding] :: 2]
    if encoding not in _GRAY and encoding not in _CHANNELS and bayer not in _BAYER:
        raise FrameError(
            f"{name}: encoding {excerpt(encoding)}: expected mono, bgr, rgb, bgra, rgba or bayer "
            "of 8 or 16 bits, or yuv422"
        )
    deep = encoding.endswith("16") or encoding.startswith("16")
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(f"{order}u2" if deep else "u1")
    channels = _CHANNELS.get(encoding, 1)
    rows = _rows(message, name, dtype, channels).astype(dtype.newbyteorder("="), copy=False)
    if bayer is not None:
        pattern = bayer.removeprefix("bayer_").upper()
        code: int = getattr(cv2, f"COLOR_Bayer{pattern}2GRAY")
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), code))
    if channels == 1:
        return rows
    pixels = rows.reshape(message.height, message.width, channels)
    if encoding.startswith("rgb"):
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return np.ascontiguousarray(pixels)


def _rows(message: ImageMessage, name: object, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """The (H, W * channels) numbers of a message, without what its rows are padded with."""
    height, width = message.height, message.width
    wide = width * channels * dtype.itemsize
    data = np.asarray(message.data).view(np.uint8).ravel()
    if height < 1 or width < 1 or message.step < wide or len(data) < height * message.step:
        raise FrameError(
            f"{name}: {len(data)} bytes for {width}x{height} px of {message.encoding} in rows of "
            f"{message.step}: expected {wide} or more in a row"
        )
    rows = data[: height * message.step].reshape(height, message.step)[:, :wide]
    return np.ascontiguousarray(rows).view(dtype)


def compressed_content(message: Any, name: object) -> bytes:
    """The image file in a `sensor_msgs/CompressedImage`.

    Raises
    ------
    FrameError
        If it is none that can be decoded: compressed depth.
    """
    if "compressedDepth" in message.format:
        raise FrameError(f"{name}: format {excerpt(message.format)}: expected jpeg, png or tiff")
    return bytes(message.data)
