"""The node `redetect`: discs, verticals and tilt in each image of a topic, as standard messages.

`detect.ros_messages` converts rows to messages, also for files of messages; this module has the
parameters, topics and life cycle of the node.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message
from scipy.spatial.transform import Rotation

import redetect as rd
from detect.options import SourceOptions
from detect.ros_messages import TOPICS, Values, header_of, ros_messages, transform_of
from detect.settings_files import SettingsFile, read_settings
from detect.sources.bag import content_of_message
from detect.sources.grey_images import read_image
from detect.sources.interface import RunFrame, still
from redetect.landmarks.axes import from_dataset
from redetect.landmarks.columns import TableName, values_of

#: The parameters with their defaults; README.md describes them.
PARAMETERS = {
    "camera": "",
    "settings": "",
    "radius_m": 0.0,
    "polarity": "",
    "image_transport": "raw",
    "bit_depth": 0,
    "frame_prefix": "",
    "publish_tf": False,
}
_IMAGES = {
    "raw": ("", "sensor_msgs/msg/Image"),
    "compressed": ("/compressed", "sensor_msgs/msg/CompressedImage"),
}
_PUBLISHED: tuple[TableName, ...] = ("circles", "lines", "tilts")


def make(kind: str, **fields: Any) -> Any:
    """A message of a type such as `geometry_msgs/msg/Pose`."""
    return get_message(kind)(**fields)


def tables_of(found: rd.Detection) -> dict[TableName, list[Values]]:
    """The rows of an image, in the data set's axes."""
    tables: dict[TableName, list[Values]] = {
        "circles": [values_of(row) for row in found.frame.circles],
        "lines": [values_of(row) for row in found.frame.lines],
    }
    if found.frame_tilt is not None:
        tables["tilts"] = [values_of(found.frame_tilt)]
    return tables


def camera_transform(camera: rd.Camera, header: Any, image_frame: str) -> Any:
    """The camera's pose on the robot, whose frame is in the header, as `tf2_msgs/TFMessage`.

    The camera's frame has x to the right, y down and z forward: REP 103's suffix `_optical`.
    """
    turn = Rotation.from_matrix(from_dataset(camera.rotation.T).T)
    return transform_of(make, header, image_frame, from_dataset(camera.centre), turn)


class Redetect(Node):  # type: ignore[misc]  # ROS comes without types
    """Processes the newest image; others that arrive meanwhile are dropped.

    Raises
    ------
    rd.Error
        If the calibration or the settings cannot be read, or are impossible.
    """

    def __init__(self) -> None:
        super().__init__("redetect")
        given = {
            name: self.declare_parameter(name, default).value
            for name, default in PARAMETERS.items()
        }
        if not given["camera"] or given["image_transport"] not in _IMAGES:
            raise rd.Error(
                "parameters camera and image_transport: expected a .cam file, and raw or compressed"
            )
        self._camera = rd.Camera.read(given["camera"])
        settings = read_settings(Path(given["settings"])) if given["settings"] else SettingsFile()
        self._detect = partial(
            rd.detect,
            camera=self._camera,
            radius_m=given["radius_m"] or None,
            polarity=given["polarity"] or None,
            settings=settings.circles,
            line_settings=settings.lines,
        )
        self._bit_depth = SourceOptions(bit_depth=given["bit_depth"] or None).bit_depth
        # Compiles the kernels and makes the tables before the first image arrives.
        self._detect(np.zeros((self._camera.height, self._camera.width), np.uint8))
        self._frame_prefix = given["frame_prefix"]
        self._outputs = {
            topic: self.create_publisher(
                get_message(kind), topic.replace("/redetect", "~"), QoSProfile(depth=100)
            )
            for table in _PUBLISHED
            for topic, kind in TOPICS[table].items()
        }
        self._mounting = self._mounting_output() if given["publish_tf"] else None
        ending, kind = _IMAGES[given["image_transport"]]
        self.create_subscription(
            get_message(kind),
            self.resolve_topic_name("image") + ending,
            self.on_image,
            QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
        )

    def on_image(self, message: Any) -> None:
        """Process an image and publish the detections, with the image's time."""
        try:
            content = content_of_message(message, "image")
            frame = RunFrame(still("image"), None, content, bit_depth=self._bit_depth)
            found = self._detect(read_image(frame, self._camera))
        except rd.Error as error:
            self.get_logger().warning(str(error), throttle_duration_sec=5.0)
            return
        stamp = message.header.stamp
        time_ns = stamp.sec * 10**9 + stamp.nanosec
        if self._mounting is not None:
            robot = header_of(make, time_ns, f"{self._frame_prefix}base_link")
            image_frame = message.header.frame_id
            self._mounting.publish(camera_transform(self._camera, robot, image_frame))
            self._mounting = None  # it is latched for late subscribers
        frames = [(time_ns, tables_of(found))]
        for _, topic, made in ros_messages(make, frames, self._frame_prefix):
            self._outputs[topic].publish(made)

    def _mounting_output(self) -> Any:
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self.create_publisher(get_message("tf2_msgs/msg/TFMessage"), "/tf_static", kept)


def main(args: list[str] | None = None) -> None:
    """Run the node until it is stopped."""
    rclpy.init(args=args)
    try:
        rclpy.spin(Redetect())
    except rd.Error as error:
        sys.exit(f"error: {error}")
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
