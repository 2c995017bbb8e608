"""The messages of a bag, read by the package ``rosbags``; errors are reported on one line.

Image messages become pixels by the encodings of `sensor_msgs/image_encodings`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.errors import DetectError, FrameError
from redetect.storage.messages import OneLineError, excerpt, one_line

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

#: Characters that are shown of what another package says, and of topics and types in a bag.
_LONGEST_CAUSE, LONGEST_NAME = 200, 60

#: Numbers of a pixel, by its encoding; numbers have 16 bits if the encoding says so, else 8.
_CHANNELS = {
    "mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1,
    "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "8UC3": 3, "8UC4": 4,
    "bgr16": 3, "rgb16": 3, "bgra16": 4, "rgba16": 4,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
}  # fmt: skip
# Which of the two numbers of a pixel is the brightness.
_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
_BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)_?[0-9]*")


@contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DetectError(
            f"{path}: bags are read by the package rosbags: install it by "
            "pip install 'redetect[bags]'"
        ) from None
    # Bags of older ROS 2 do not contain the definitions of their messages.
    defaults = get_typestore(Stores.LATEST)
    try:
        reader = AnyReader([path], default_typestore=defaults)
        reader.open()
    except Exception as error:  # a damaged file can raise anything
        raise DetectError(
            f"{path}: cannot be read as a bag: {_cause(error)}: expected a whole ROS 1 or 2 bag "
            "or an MCAP file of ROS messages"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def messages(reader: AnyReader, path: Path, topic: str) -> Iterator[tuple[str, float, Any]]:
    """The messages of a topic: type, time of recording (s), and content."""
    number = 0
    try:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, recorded_ns, content in reader.messages(connections):
            message = reader.deserialize(content, connection.msgtype)
            yield connection.msgtype, recorded_ns / 1e9, message
            number += 1
    except Exception as error:  # as above
        raise DetectError(
            f"{path}: message {number + 1} of {one_line(topic, LONGEST_NAME)} cannot be read: "
            f"{_cause(error)}: expected a whole bag (--frames takes the first images only)"
        ) from None


@contextmanager
def understood(name: str) -> Iterator[None]:
    """Work on a message: a bag brings its own definitions, which may be other than ROS's."""
    try:
        yield
    except OneLineError:  # reported already
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DetectError(f"{name}: a message is not as ROS defines it: {_cause(error)}") from None


def chosen_topic(
    reader: AnyReader, path: Path, kinds: tuple[str, ...], named: str | None, what: str, flag: str
) -> str:
    """The topic that was named, or the only one of some types."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in kinds})
    listed = ", ".join(one_line(topic, LONGEST_NAME) for topic in topics[:6]) or "none"
    expected = " or ".join(kind.replace("/msg", "") for kind in kinds)
    if named:
        if named in topics:
            return named
        raise DetectError(f"{path}: no {what} in {named!r}: expected {expected}, of {listed}")
    if not topics:
        there = sorted({str(c.msgtype) for c in reader.connections})[:6]
        held = ", ".join(one_line(kind, LONGEST_NAME) for kind in there) or "no messages"
        raise DetectError(f"{path}: no {what} in it, but {held}: expected {expected}")
    if len(topics) > 1:
        raise DetectError(f"{path}: several topics of {what} ({listed}): name one by {flag}")
    return topics[0]


def stamp_s(message: Any, recorded_s: float) -> float:
    """The time in a message's header (s); that of its recording where the header has none."""
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec / 1e9) if stamp.sec or stamp.nanosec else recorded_s


def _cause(error: Exception) -> str:
    return one_line(" ".join(str(error).split()) or type(error).__name__, _LONGEST_CAUSE)


def pixels_of_message(message: Any, name: object) -> NDArray[Any]:
    """The pixels of a `sensor_msgs/Image`: grey values, or blue, green, red and perhaps opacity.

    Of Bayer patterns and YUV 4:2:2 they are the brightness. A FrameError is raised if the encoding
    is another, or there is less data than the message states.
    """
    encoding, height, width = message.encoding, message.height, message.width
    bayer = _BAYER.fullmatch(encoding)
    channels = 1 if bayer else _CHANNELS.get(encoding)
    if channels is None:
        raise FrameError(
            f"{name}: encoding {excerpt(encoding)}: expected mono, bgr, rgb, bgra, rgba or bayer "
            "of 8 or 16 bits, or yuv422"
        )
    dtype = np.dtype(np.uint16 if "16" in encoding else np.uint8)
    wide = width * channels * dtype.itemsize
    data = np.asarray(message.data).view(np.uint8).ravel()
    if height < 1 or width < 1 or message.step < wide or len(data) < height * message.step:
        raise FrameError(
            f"{name}: {len(data)} bytes for {width}x{height} px of {encoding} in rows of "
            f"{message.step}: expected {wide} or more in a row"
        )
    rows = data[: height * message.step].reshape(height, message.step)[:, :wide]
    stored = dtype.newbyteorder(">" if message.is_bigendian else "<")
    pixels = np.ascontiguousarray(rows).view(stored).astype(dtype, copy=False)
    if bayer:
        code: int = getattr(cv2, f"COLOR_Bayer{bayer[1].upper()}2GRAY")
        return np.asarray(cv2.cvtColor(pixels, code))
    if channels == 1:
        return pixels
    pixels = pixels.reshape(height, width, channels)
    if encoding in _LUMA:
        return pixels[:, :, _LUMA[encoding]]
    return pixels[:, :, [2, 1, 0, 3][:channels]] if encoding.startswith("rgb") else pixels


def compressed_content(message: Any, name: object) -> bytes:
    """The image file in a `sensor_msgs/CompressedImage`."""
    if "compressedDepth" in message.format:
        raise FrameError(f"{name}: format {excerpt(message.format)}: expected jpeg, png or tiff")
    return bytes(message.data)
