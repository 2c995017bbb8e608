"""ROS 1 and 2 bags and MCAP files as a source, read by the package ``rosbags``, without ROS.

The images are those of a topic of sensor_msgs/Image or sensor_msgs/CompressedImage, in the order of
the recording; the odometry is a topic of nav_msgs/Odometry, read in parallel. The time of a message
is that of its header or, if that is zero, of its recording.

A bag may also contain the lens calibration, camera_info: it is converted to the project's model, or
rejected if that does not fit. Without a pose, only landmarks that need no floor can be detected.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera
from camera.errors import ConversionError
from camera.formats.conversion import convert_to_camera
from camera.formats.yaml_files import camera_of_info
from detect.errors import DetectError, FrameError
from detect.sources.grey_images import grey_of_pixels
from detect.sources.interface import RunFrame, Source, numbered_prefix, still
from detect.sources.poses import FARTHEST, PoseStream, TimedPose, carried, heading_rad
from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.messages import OneLineError, excerpt, imported_for, one_line
from redetect.plane import rotation

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_LONGEST_CAUSE = 200  #: Of an excerpt from another package's message, characters.
LONGEST_NAME = 60  #: Of one from a topic or type in a bag.

#: Channels of each encoding; they have 16 bits if the encoding's name says so, else 8.
_CHANNELS = {
    "mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1,
    "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "8UC3": 3, "8UC4": 4,
    "bgr16": 3, "rgb16": 3, "bgra16": 4, "rgba16": 4,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
}  # fmt: skip
# Index of the luminance in the two bytes of a pixel.
_LUMA = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
_BAYER = re.compile("bayer_(rggb|bggr|gbrg|grbg)_?[0-9]*")

#: Largest deviation of a conversion from the camera_info, anywhere in the image.
LIMIT_PX = 0.05
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_ODOMETRY, _INFO = "nav_msgs/msg/Odometry", "sensor_msgs/msg/CameraInfo"
# x, y and the rotation about z, in the 6x6 covariances of ROS.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
# Least relative eigenvalue of a growth of a pose's covariance; below, it counts as constant.
_INDEFINITE = 1e-9


@contextmanager
def opened_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag."""
    with imported_for(f"{path}: bags are read by the package rosbags", "bags", DetectError):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
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


def messages(reader: AnyReader, path: Path, topic: str) -> Iterator[tuple[float, Any]]:
    """The messages of a topic: time of recording (s), and content."""
    number = 0
    try:
        connections = [c for c in reader.connections if c.topic == topic]
        for connection, recorded_ns, content in reader.messages(connections):
            yield recorded_ns / 1e9, reader.deserialize(content, connection.msgtype)
            number += 1
    except Exception as error:  # as above
        raise DetectError(
            f"{path}: message {number + 1} of {one_line(topic, LONGEST_NAME)} cannot be read: "
            f"{_cause(error)}: expected a whole bag (--frames takes the first images only)"
        ) from None


@contextmanager
def understood(name: str) -> Iterator[None]:
    """Process a message: a bag has its own definitions, which may differ from those of ROS."""
    try:
        yield
    except OneLineError:  # reported already
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DetectError(f"{name}: a message differs from ROS's type: {_cause(error)}") from None


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
    """The time in a message's header (s); that of its recording if the header has none."""
    stamp = message.header.stamp
    return (stamp.sec + stamp.nanosec / 1e9) if stamp.sec or stamp.nanosec else recorded_s


def _cause(error: Exception) -> str:
    return one_line(" ".join(str(error).split()) or type(error).__name__, _LONGEST_CAUSE)


def pixels_of_message(message: Any, name: object) -> NDArray[Any]:
    """The pixels of a `sensor_msgs/Image`: grey values, or blue, green, red and perhaps opacity.

    For Bayer patterns and YUV 4:2:2 they are the luminance. Raises FrameError for other encodings,
    or if there is less data than the message states.
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


def content_of_message(message: Any, name: object) -> bytes | NDArray[Any]:
    """The grey values of a `sensor_msgs/Image`, or the file in a `sensor_msgs/CompressedImage`."""
    if not hasattr(message, "format"):
        return grey_of_pixels(pixels_of_message(message, name), name)
    if "compressedDepth" in message.format:
        raise FrameError(f"{name}: format {excerpt(message.format)}: expected jpeg, png or tiff")
    return bytes(message.data)


class Bag(Source):
    """Images of a bag, named ``<bag>.0000`` and so on.

    A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag; the topic as in `SourceOptions`.
    """

    def __init__(self, path: Path, image_topic: str = "") -> None:
        self.path = path
        self.name = str(path)
        self.stem = path.name if path.is_dir() else path.stem
        self.beside = path.parent, self.stem
        self.output_base = path.with_name(f"{self.stem}.detected")
        with opened_bag(path) as reader:
            self.topic = chosen_topic(
                reader, path, (_IMAGE, _COMPRESSED), image_topic, "images", "--image-topic"
            )
            self.expected = sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with opened_bag(self.path) as reader:
            stored_messages = messages(reader, self.path, self.topic)
            for number, (recorded_s, message) in enumerate(stored_messages):
                prefix = numbered_prefix(self.stem, number)
                name = f"{self.name}: {prefix}"
                content: bytes | NDArray[Any] | None = None
                failure = None
                try:
                    with understood(name):
                        time_s = stamp_s(message, recorded_s)
                        content = content_of_message(message, name)
                except FrameError as error:
                    failure = str(error)
                yield RunFrame(still(prefix), None, content, time_s, failure)

    def calibration(self, *, posed: bool) -> Camera | None:
        """The ``.cam`` file beside the bag, of its name or the only one; else its own, unposed."""
        beside = super().calibration(posed=posed)
        if beside is not None or posed:
            return beside
        with opened_bag(self.path) as reader:
            topics = sorted({c.topic for c in reader.connections if c.msgtype == _INFO})
            # That of the images' namespace, or the only one.
            own = self.topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
            if own not in topics and len(topics) != 1:
                return None
            topic = own if own in topics else topics[0]
            found = next(messages(reader, self.path, topic), None)
        name = f"{self.path}: {one_line(topic, LONGEST_NAME)}"
        with understood(name):
            # ROS 1 has capital letters. Drivers that are not calibrated publish a matrix of zeros.
            info = {} if found is None else {k.lower(): v for k, v in vars(found[1]).items()}
            return _camera_of_info(info, name) if info and np.any(info["k"]) else None

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry of a topic, or of the only one that has any."""
        with opened_bag(self.path) as reader:
            if topic is None and all(c.msgtype != _ODOMETRY for c in reader.connections):
                return None
            found = chosen_topic(reader, self.path, (_ODOMETRY,), topic, "odometry", "--odometry")
        name = f"{self.path}: {one_line(found, LONGEST_NAME)}"
        return PoseStream(name, self.path, lambda: _summed(_odometry_poses(self.path, found, name)))


def _odometry_poses(path: Path, topic: str, name: str) -> Iterator[tuple[TimedPose, FloatArray]]:
    """Poses of a topic, each with the (3, 3) covariance of its twist, in the robot's frame."""
    theta = 0.0
    with opened_bag(path) as reader:
        for recorded_s, message in messages(reader, path, topic):
            with understood(name):
                pose = message.pose.pose
                q, p = pose.orientation, pose.position
                planar, twist = (
                    np.array(part.covariance, dtype=np.float64).reshape(6, 6)[_PLANAR]
                    for part in (message.pose, message.twist)
                )
                numbers = [p.x, p.y, q.x, q.y, q.z, q.w, *planar.ravel(), *twist.ravel()]
                values = np.array(numbers, dtype=np.float64)
                time_s = stamp_s(message, recorded_s)
            if not np.abs(values).max() <= FARTHEST or not np.any(values[2:6] ** 2 > 0.0):
                raise DetectError(
                    f"{name}: at {time_s:.6f} s: expected a finite pose with an orientation and a "
                    f"finite covariance, no number above {FARTHEST:g}"
                )
            theta += float(wrap_angle(heading_rad(q.x, q.y, q.z, q.w) - theta))
            yield TimedPose(time_s, float(p.x), float(p.y), theta, planar), twist


def _summed(poses: Iterator[tuple[TimedPose, FloatArray]]) -> Generator[TimedPose, None, None]:
    """Poses with covariances accumulated over the movements since the first pose.

    Each movement adds the growth of the pose's covariance, by a movement or, if it is diagonal (a
    driver that ignores how errors of the heading move positions), of its diagonal; if that has not
    grown (a driver that publishes a constant), the twist's covariance over the time step. If that
    is zero, too, the movement is of unknown covariance, and so is a step that contains it.

    A filter that corrects a pose moves it, too: by errors of the covariance that it takes away.
    """
    before: TimedPose | None = None
    total, unknown = np.zeros((3, 3)), 0.0
    for pose, twist in poses:
        if before is not None:
            by_rate = np.eye(3)
            by_rate[:2, :2] = rotation(pose.theta)
            by_rate *= pose.time_s - before.time_s
            by_twist = by_rate @ twist @ by_rate.T
            grown = pose.covariance - carried(before.covariance, before, pose)
            values, axes = np.linalg.eigh(grown)
            is_growth = values[0] >= -_INDEFINITE * float(np.abs(pose.covariance).max())
            if not is_growth:
                diagonal = np.diagonal(pose.covariance - before.covariance)
                if np.count_nonzero(pose.covariance) == 3:
                    grown = np.diag(diagonal) * (diagonal.min() >= 0.0)
                elif np.any(diagonal):
                    grown = (axes * np.abs(values)) @ axes.T + by_twist
                else:
                    grown = np.zeros((3, 3))
            if not np.any(grown):
                grown = by_twist
            unknown += not (is_growth or np.any(grown))
            total = carried(total, before, pose) + grown
        yield replace(pose, covariance=total, unknown=unknown)
        before = pose


def _camera_of_info(info: dict[str, Any], name: str) -> Camera:
    """The camera of a whole image's camera_info, without its pose, in the project's model."""
    try:
        foreign = camera_of_info({**info, "roi": vars(info["roi"])}, name)
    except ConversionError as error:
        raise DetectError(f"{error}: name a calibration by --camera") from None
    converted = convert_to_camera(foreign)
    if not converted.deviation_px <= LIMIT_PX:
        raise DetectError(
            f"{name}: this project's model differs from it by up to {converted.deviation_px:.3g} "
            f"px, more than {LIMIT_PX:g}: name a calibration by --camera (`camera convert` makes "
            "one with a wider --limit-px)"
        )
    assert isinstance(converted.camera, Camera)
    return converted.camera
