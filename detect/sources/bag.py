"""ROS 1 and 2 bags and MCAP files as a source, read by the package ``rosbags``: no ROS is needed.

The images are one topic of sensor_msgs/Image or sensor_msgs/CompressedImage, in the order of the
recording; the odometry is a topic of nav_msgs/Odometry, read beside them. The time of a message is
that of its header or, where that is zero, of its recording.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detect.errors import DetectError, FrameError
from detect.sources.bag_camera import BASE_FRAME, recorded_calibration
from detect.sources.bag_images import pixels_of_message
from detect.sources.gray import gray_of_pixels, significant_bits
from detect.sources.interface import (
    FARTHEST,
    Calibration,
    PoseStream,
    SourceImage,
    TimedPose,
    numbered_prefix,
    only_calibration,
)
from detect.sources.tum import heading_rad
from storage.messages import OneLineError, excerpt, one_line

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

#: Characters that are shown of what another package says, and of topics and types in a bag.
_LONGEST_CAUSE, LONGEST_NAME = 200, 60

#: Endings of bags that are one file.
BAG_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_ODOMETRY = "nav_msgs/msg/Odometry"

# x, y and the rotation about z, in the 6x6 covariances of ROS.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


class Bag:
    """Images of a bag, named ``<bag>.0000`` and so on.

    Parameters
    ----------
    path : path
        A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
    image_topic : str or None
        Which topic of images, if there are several.
    bits : int or None
        Significant bits of 16-bit images; by default what the first one needs.
    base_frame : str
        The frame of the robot's base, on the floor, among the static transforms.

    Raises
    ------
    DetectError
        If the package is not installed, the bag cannot be read, or has no such images.
    """

    ships_images = True

    def __init__(
        self,
        path: Path,
        image_topic: str | None = None,
        bits: int | None = None,
        base_frame: str = BASE_FRAME,
    ) -> None:
        self.path = path
        self.name = str(path)
        self.stem = path.name if path.is_dir() else path.stem
        self.output_base = path.with_name(f"{self.stem}.detected")
        self._bits = bits
        self._base_frame = base_frame
        with opened_bag(path) as reader:
            self.topic = chosen_topic(
                reader, path, (_IMAGE, _COMPRESSED), image_topic, "images", "--image-topic"
            )
            self._count = sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    @property
    def expected(self) -> int | None:
        """How many images there are."""
        return self._count

    def images(self) -> Generator[SourceImage, None, None]:
        """The images of the topic: raw ones as grey values, compressed ones as they are."""
        bits = self._bits
        with opened_bag(self.path) as reader:
            for number, (kind, recorded_s, message) in enumerate(
                messages(reader, self.path, self.topic)
            ):
                prefix = numbered_prefix(self.stem, number)
                name = f"{self.name}: {prefix}"
                try:
                    with understood(name):
                        time_s = stamp_s(message, recorded_s)
                        if kind == _COMPRESSED:
                            content = compressed_content(message, name)
                            # Of compressed images the bits are those of PNG files: 16, or named.
                            image = SourceImage(prefix, time_s, content=content, bits=bits or 16)
                        else:
                            pixels = pixels_of_message(message, name)
                            bits = significant_bits(pixels) if bits is None else bits
                            gray = gray_of_pixels(pixels, name, bits)
                            image = SourceImage(prefix, time_s, content=gray)
                except FrameError as error:
                    image = SourceImage(prefix, time_s, failure=str(error))
                yield image

    def calibration(self) -> Calibration | None:
        """The ``.cam`` file beside it: of its name, or the only one; else what it holds itself."""
        beside = only_calibration(self.path.parent, self.stem)
        if beside is not None:
            return beside
        return recorded_calibration(self.path, self.topic, self._base_frame)

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry of a topic, or of the only one that has any."""
        with opened_bag(self.path) as reader:
            kinds = {c.msgtype for c in reader.connections}
            if topic is None and _ODOMETRY not in kinds:
                return None
            found = chosen_topic(reader, self.path, (_ODOMETRY,), topic, "odometry", "--odometry")
        return BagOdometry(self.path, found)


class BagOdometry:
    """Poses of a nav_msgs/Odometry topic: X forward, Y left, with covariance.

    Parameters
    ----------
    path : path
    topic : str
    """

    def __init__(self, path: Path, topic: str) -> None:
        self.path = path
        self.name = f"{path}: {one_line(topic, LONGEST_NAME)}"
        self._topic = topic

    def __iter__(self) -> Generator[TimedPose, None, None]:
        with opened_bag(self.path) as reader:
            for _, recorded_s, message in messages(reader, self.path, self._topic):
                with understood(self.name):
                    pose = message.pose.pose
                    q, p = pose.orientation, pose.position
                    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
                    planar = covariance[_PLANAR]
                    numbers = [p.x, p.y, q.x, q.y, q.z, q.w, *planar.ravel()]
                    values = np.array(numbers, dtype=np.float64)
                    time_s = stamp_s(message, recorded_s)
                if not np.abs(values).max() <= FARTHEST or not np.any(values[2:6] ** 2 > 0.0):
                    raise DetectError(
                        f"{self.name}: at {time_s:.6f} s: expected a finite pose with an "
                        f"orientation and a finite covariance, no number above {FARTHEST:g}"
                    )
                theta = heading_rad(q.x, q.y, q.z, q.w)
                yield TimedPose(time_s, float(p.x), float(p.y), theta, planar)


@contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag.

    Raises
    ------
    DetectError
        If the package is not installed, or the bag cannot be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DetectError(
            f"{path}: bags are read by the package rosbags: install it by "
            "pip install 'redetect[bags]'"
        ) from None
    # Bags of older ROS 2 do not say what their messages look like.
    defaults = get_typestore(Stores.LATEST)
    try:
        reader = AnyReader([path], default_typestore=defaults)
        reader.open()
    except Exception as error:  # what a damaged file raises is as manifold as its bytes
        raise DetectError(
            f"{path}: cannot be read as a bag: {_one_line(error)}: expected a whole ROS 1 or 2 bag "
            "or an MCAP file of ROS messages"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def messages(reader: AnyReader, path: Path, topic: str) -> Iterator[tuple[str, float, Any]]:
    """The messages of a topic: type, time of recording (s), and what they say.

    Raises
    ------
    DetectError
        If the bag is damaged.
    """
    connections = [c for c in reader.connections if c.topic == topic]
    stream = reader.messages(connections)
    number = 0
    while True:
        try:
            connection, recorded_ns, content = next(stream)
            recorded_s = recorded_ns / 1e9  # whatever stands in a database's column
            message = reader.deserialize(content, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:  # as above
            raise DetectError(
                f"{path}: message {number + 1} of {one_line(topic, LONGEST_NAME)} cannot be read: "
                f"{_one_line(error)}: "
                f"expected a whole bag (--frames takes the first images only)"
            ) from None
        number += 1
        yield connection.msgtype, recorded_s, message


@contextmanager
def understood(name: str) -> Iterator[None]:
    """Work on a message: a bag brings its own definitions, which may be other than ROS's.

    Raises
    ------
    DetectError
        If the message lacks what ROS's has, or has something else there.
    """
    try:
        yield
    except OneLineError:  # that has been said already
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DetectError(
            f"{name}: a message is not as ROS defines it: {_one_line(error)}"
        ) from None


def chosen_topic(
    reader: AnyReader,
    path: Path,
    kinds: tuple[str, ...],
    named: str | None,
    what: str,
    flag: str,
) -> str:
    """The topic that was named, or the only one of some types.

    Raises
    ------
    DetectError
        If there is no such topic, or there are several and none was named.
    """
    topics = sorted({c.topic for c in reader.connections if c.msgtype in kinds})
    listed = ", ".join(one_line(topic, LONGEST_NAME) for topic in topics[:6]) or "none"
    expected = " or ".join(kind.replace("/msg", "") for kind in kinds)
    if named is not None:
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


def stamp_s(message: Any, recorded_s: float) -> float:
    """The time in a message's header (s); that of its recording where the header has none."""
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec / 1e9) if stamp.sec or stamp.nanosec else recorded_s


def _one_line(error: Exception) -> str:
    return one_line(" ".join(str(error).split()) or type(error).__name__, _LONGEST_CAUSE)
