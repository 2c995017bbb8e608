"""Bags as ROS 1 and 2 write them, without ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

BagKind = Literal["mcap", "mcap folder", "sqlite", "ros1"]
BAG_KINDS: tuple[BagKind, ...] = ("mcap", "mcap folder", "sqlite", "ros1")

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ODOMETRY = "nav_msgs/msg/Odometry"
INFO = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True)
class Said:
    """A message to be recorded: topic, time of recording (s), and what it says."""

    topic: str
    time_s: float
    message: Any


class Ros:
    """Messages of ROS 1 or 2, without ROS."""

    def __init__(self, kind: BagKind = "mcap") -> None:
        from rosbags.typesys import Stores, get_typestore

        self.kind = kind
        self.is1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is1 else Stores.ROS2_HUMBLE)

    def make(self, name: str, **fields: Any) -> Any:
        return self.store.types[name](**fields)

    def header(self, time_s: float) -> Any:
        nanoseconds = round(time_s * 1e9)
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
        )
        extra = {"seq": 0} if self.is1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="frame", **extra)

    def image(self, pixels: NDArray[Any], encoding: str, time_s: float, *, padding: int = 0) -> Any:
        """A raw image; rows are padded with bytes that mean nothing."""
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
        return self.make(
            IMAGE,
            header=self.header(time_s),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=int(pixels.dtype.byteorder == ">"),
            step=rows.shape[1],
            data=rows.ravel(),
        )

    def compressed(self, content: bytes, form: str, time_s: float) -> Any:
        data = np.frombuffer(content, np.uint8)
        return self.make(COMPRESSED, header=self.header(time_s), format=form, data=data)

    def odometry(
        self, x: float, y: float, theta: float, time_s: float, covariance: NDArray[Any],
        twist_covariance: NDArray[Any] | None = None,
    ) -> Any:  # fmt: skip
        """A pose on the floor; covariances of (x, y, theta) and of its rates."""
        planar, wide, wide_twist = np.ix_([0, 1, 5], [0, 1, 5]), np.zeros((6, 6)), np.zeros((6, 6))
        wide[planar] = covariance
        wide_twist[planar] = 0.0 if twist_covariance is None else twist_covariance
        name = "geometry_msgs/msg/"
        pose = self.make(
            f"{name}Pose",
            position=self.make(f"{name}Point", x=x, y=y, z=0.0),
            orientation=self.make(
                f"{name}Quaternion", x=0.0, y=0.0, z=np.sin(theta / 2), w=np.cos(theta / 2)
            ),
        )
        zero = self.make(f"{name}Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            ODOMETRY,
            header=self.header(time_s),
            child_frame_id="base_link",
            pose=self.make(f"{name}PoseWithCovariance", pose=pose, covariance=wide.ravel()),
            twist=self.make(
                f"{name}TwistWithCovariance",
                twist=self.make(f"{name}Twist", linear=zero, angular=zero),
                covariance=wide_twist.ravel(),
            ),
        )

    def camera_info(
        self, width: int, height: int, model: str, d: Sequence[float], k: Sequence[float],
        frame: str, **changed: Any,
    ) -> Any:  # fmt: skip
        """A calibration; ROS 1 calls its numbers by capital letters."""
        numbers = {
            "d": np.array(d, float),
            "k": np.array(k, float),
            "r": np.eye(3).ravel(),
            "p": np.zeros(12),
        }
        if self.is1:
            numbers = {letter.upper(): values for letter, values in numbers.items()}
        header = self.header(1.0)
        header.frame_id = frame
        region = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=changed.pop("roi_width", 0), do_rectify=False,
        )  # fmt: skip
        fields = {"binning_x": 0, "binning_y": 0, **changed}
        return self.make(
            INFO, header=header, height=height, width=width, distortion_model=model,
            roi=region, **numbers, **fields,
        )  # fmt: skip

    def write(self, path: Path, said: Sequence[Said]) -> Path:
        """Record messages; gives the path by which the bag is read."""
        if self.is1:
            from rosbags.rosbag1 import Writer as Writer1

            with Writer1(path.with_suffix(".bag")) as bag1:
                places = {(item.topic, item.message.__msgtype__): None for item in said}
                made = {key: bag1.add_connection(*key, typestore=self.store) for key in places}
                for item in said:
                    kind = item.message.__msgtype__
                    content = self.store.serialize_ros1(item.message, kind)
                    bag1.write(made[item.topic, kind], round(item.time_s * 1e9), content)
            return path.with_suffix(".bag")
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.SQLITE3 if self.kind == "sqlite" else StoragePlugin.MCAP
        with Writer(path, version=9, storage_plugin=plugin) as bag:
            keys = dict.fromkeys((item.topic, item.message.__msgtype__) for item in said)
            opened = {key: bag.add_connection(*key, typestore=self.store) for key in keys}
            for item in said:
                kind = item.message.__msgtype__
                content = self.store.serialize_cdr(item.message, kind)
                bag.write(opened[item.topic, kind], round(item.time_s * 1e9), content)
        if self.kind == "mcap":
            return (path / f"{path.name}.mcap").rename(path.with_suffix(".mcap"))
        return path
