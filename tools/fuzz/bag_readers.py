"""Readers of recordings: ROS 1 and 2 bags and MCAP files, as `detect` reads them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from camera import CameraError
from detect.errors import DetectError
from detect.sources import bag as ros_bag
from detect.sources.bag import Bag, pose_in_dataset, static_transforms
from detect.sources.poses import step_between
from tools.fuzz.bag_cells import bag_with_edits
from tools.fuzz.reader import Reader

_Kind = Literal["mcap", "sqlite", "ros1"]
_WORDS = (
    b"sensor_msgs/msg/Image", b"sensor_msgs/msg/CompressedImage", b"nav_msgs/msg/Odometry",
    b"sensor_msgs/msg/CameraInfo", b"tf2_msgs/msg/TFMessage", b"std_msgs/msg/Header", b"mono8",
    b"/tf_static", b"/cam/camera_info", b"MCAP0\r\n", b"lz4", b"zstd", b"uint8[] data", b"cdr",
    b"Header header", b"float64[9] k", b"string encoding", b"#ROSBAG V2.0\n", b"op=\x02", b"conn=",
    b"ros2msg",
)  # fmt: skip


def _bag(path: Path) -> object:
    """All that `detect` asks of a bag.

    The calibration that it begins with is none, so that no camera is fitted to it, which takes
    seconds; the transforms are read all the same.
    """
    bag = Bag(path)
    images = list(bag)
    for image in images:
        assert (image.content is None) != (image.failure is None)
    bag.calibration(posed=False)
    odometry = bag.poses(None)
    poses = [] if odometry is None else list(odometry.read())
    steps = [step_between("e", *pair) for pair in pairwise(poses)]
    with ros_bag.opened_bag(path) as reader:
        transforms = static_transforms(reader, path)
    return images, steps, pose_in_dataset(transforms, "b", "o")


class Ros:
    """Some messages of ROS 1 or 2, without ROS."""

    def __init__(self, kind: _Kind) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.kind, self.is_1 = kind, kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_1 else Stores.ROS2_HUMBLE)
        if self.is_1:
            definition = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, nanoseconds: int = 1_000_000_005) -> Any:
        sec, nanosec = divmod(nanoseconds, 10**9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        extra = {"seq": 0} if self.is_1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="optical", **extra)

    def image(self) -> Any:
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(), height=8, width=8, encoding="mono8",
            is_bigendian=0, step=8, data=np.arange(64, dtype=np.uint8),
        )  # fmt: skip

    def info(self) -> Any:
        numbers = {"d": np.zeros(5), "k": np.zeros(9), "r": np.eye(3).ravel(), "p": np.zeros(12)}
        if self.is_1:
            numbers = {letter.upper(): values for letter, values in numbers.items()}
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(), height=8, width=8, roi=region,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, **numbers,
        )  # fmt: skip

    def odometry(self) -> Any:
        package = "geometry_msgs/msg/"
        zero = self.make(f"{package}Vector3", x=0.0, y=0.0, z=0.0)
        pose = self.make(
            f"{package}Pose",
            position=self.make(f"{package}Point", x=1.0, y=2.0, z=0.0),
            orientation=self.make(f"{package}Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        twist = self.make(f"{package}Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(),
            child_frame_id="base",
            pose=self.make(f"{package}PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=self.make(f"{package}TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def transforms(self) -> Any:
        package = "geometry_msgs/msg/"
        transform = self.make(
            f"{package}Transform",
            translation=self.make(f"{package}Vector3", x=0.0, y=0.0, z=1.5),
            rotation=self.make(f"{package}Quaternion", x=1.0, y=0.0, z=0.0, w=0.5),
        )
        header = self.header()
        header.frame_id = "b"
        stamped = self.make(
            f"{package}TransformStamped",
            header=header, child_frame_id="o", transform=transform,
        )  # fmt: skip
        return self.make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def write(self, place: Path, said: Iterable[tuple[str, int, Any]]) -> None:
        """Write a bag of messages with their topics and times (ns): a file, of ROS 2 a folder."""
        if self.kind == "ros1":
            from rosbags.rosbag1 import Writer as Writer1

            writer: Any = Writer1(place)
        else:
            from rosbags.rosbag2 import StoragePlugin, Writer

            plugin = StoragePlugin.SQLITE3 if self.kind == "sqlite" else StoragePlugin.MCAP
            writer = Writer(place, version=9, storage_plugin=plugin)
        serialize = self.store.serialize_ros1 if self.is_1 else self.store.serialize_cdr
        connections: dict[str, Any] = {}
        with writer as bag:
            for topic, nanoseconds, message in said:
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, name, typestore=self.store)
                bag.write(connections[topic], nanoseconds, serialize(message, name))


@cache
def _recorded(kind: _Kind) -> bytes:
    """A bag of an image, its calibration and pose, and odometry."""
    ros = Ros(kind)
    said = [
        ("/cam/image_raw", 5, ros.image()),
        ("/cam/camera_info", 5, ros.info()),
        ("/odom", 5, ros.odometry()),
        ("/tf_static", 5, ros.transforms()),
    ]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "b"
        ros.write(place, said)
        files = {"ros1": place, "sqlite": place / "b.db3", "mcap": place / "b.mcap"}
        return files[kind].read_bytes()


def _seeds(kind: _Kind) -> tuple[bytes, ...]:
    return (_recorded(kind),)


def _reader(name: str, file: str, kind: _Kind) -> Reader:
    errors = (DetectError, CameraError)
    return Reader(name, file, _bag, errors, (), _WORDS, made_seeds=partial(_seeds, kind), files=5)


BAG_READERS: tuple[Reader, ...] = (
    _reader("mcap", "b.mcap", "mcap"),
    _reader("ros1 bag", "b.bag", "ros1"),
    _reader("sqlite bag", "b.db3", "sqlite"),
    replace(
        _reader("sqlite cells", "b.db3", "sqlite"), seeds=(b"",), made_seeds=tuple, files=12,
        content=lambda recipe: bag_with_edits(_recorded("sqlite"), recipe),
    ),
)  # fmt: skip
