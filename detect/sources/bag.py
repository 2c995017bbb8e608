"""ROS 1 and 2 bags and MCAP files as a source, read by the package ``rosbags``: no ROS is needed.

The images are one topic of sensor_msgs/Image or sensor_msgs/CompressedImage, in the order of the
recording; the odometry is a topic of nav_msgs/Odometry, read beside them. The time of a message is
that of its header or, where that is zero, of its recording.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import numpy as np

from detect.errors import DetectError, FrameError
from detect.sources.bag_camera import BASE_FRAME, recorded_calibration
from detect.sources.bag_messages import (
    LONGEST_NAME,
    chosen_topic,
    compressed_content,
    messages,
    opened_bag,
    pixels_of_message,
    stamp_s,
    understood,
)
from detect.sources.gray import gray_of_pixels, significant_bits
from detect.sources.interface import (
    Calibration,
    Source,
    SourceImage,
    numbered_prefix,
    only_calibration,
)
from detect.sources.poses import FARTHEST, PoseStream, TimedPose, heading_rad
from storage.messages import one_line

#: Endings of bags that are one file.
BAG_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_ODOMETRY = "nav_msgs/msg/Odometry"

# x, y and the rotation about z, in the 6x6 covariances of ROS.
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])


class Bag(Source):
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
            self.expected = sum(c.msgcount for c in reader.connections if c.topic == self.topic)

    def images(self) -> Generator[SourceImage, None, None]:
        """The images of the topic: raw ones as grey values, compressed ones unchanged."""
        bits = self._bits
        with opened_bag(self.path) as reader:
            said = messages(reader, self.path, self.topic)
            for number, (kind, recorded_s, message) in enumerate(said):
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
                            bits = bits or significant_bits(pixels)
                            gray = gray_of_pixels(pixels, name, bits)
                            image = SourceImage(prefix, time_s, content=gray)
                except FrameError as error:
                    image = SourceImage(prefix, time_s, failure=str(error))
                yield image

    def calibration(self) -> Calibration | None:
        """The ``.cam`` file beside it: of its name, or the only one; else what it holds itself."""
        beside = only_calibration(self.path.parent, self.stem)
        return beside or recorded_calibration(self.path, self.topic, self._base_frame)

    def poses(self, topic: str | None) -> PoseStream | None:
        """The odometry of a topic, or of the only one that has any."""
        with opened_bag(self.path) as reader:
            if topic is None and all(c.msgtype != _ODOMETRY for c in reader.connections):
                return None
            found = chosen_topic(reader, self.path, (_ODOMETRY,), topic, "odometry", "--odometry")
        return BagOdometry(self.path, found)


class BagOdometry:
    """Poses of a nav_msgs/Odometry topic of a bag: X forward, Y left, with covariance."""

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
                    covariance = np.array(message.pose.covariance, dtype=np.float64)
                    planar = covariance.reshape(6, 6)[_PLANAR]
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
