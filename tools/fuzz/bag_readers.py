"""Readers of recordings: ROS 1 and 2 bags and MCAP files, as `detect` reads them."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from camera import CameraError
from detect.errors import DetectError
from detect.sources.bag import Bag
from tools.fuzz.bag_cells import bag_with_edits
from tools.fuzz.detect_readers import steps_of
from tools.fuzz.reader import Reader
from tools.ros_bags import BagKind, Ros, Said

_WORDS = (
    b"sensor_msgs/msg/Image", b"sensor_msgs/msg/CompressedImage", b"nav_msgs/msg/Odometry",
    b"sensor_msgs/msg/CameraInfo", b"tf2_msgs/msg/TFMessage", b"std_msgs/msg/Header", b"mono8",
    b"/cam/camera_info", b"MCAP0\r\n", b"lz4", b"zstd", b"uint8[] data", b"cdr",
    b"Header header", b"float64[9] k", b"string encoding", b"#ROSBAG V2.0\n", b"op=\x02", b"conn=",
    b"ros2msg",
)  # fmt: skip


def _bag(path: Path) -> object:
    """All that `detect` reads from a bag.

    The calibration of the seeds is all zeros, so that no camera is fitted to it, which takes
    seconds.
    """
    bag = Bag(path)
    images = list(bag)
    for image in images:
        assert (image.content is None) != (image.failure is None)
    bag.calibration(posed=False)
    odometry = bag.poses(None)
    return images, steps_of([] if odometry is None else odometry.read())


@cache
def _recorded(kind: BagKind) -> bytes:
    """A bag of an image, its calibration, and odometry."""
    ros = Ros(kind)
    pixels = np.arange(64, dtype=np.uint8).reshape(8, 8)
    said = [
        Said("/cam/image_raw", 5e-9, ros.image(pixels, "mono8", 1.0)),
        Said("/cam/camera_info", 5e-9,
             ros.camera_info(8, 8, "plumb_bob", [0.0] * 5, [0.0] * 9, "frame")),
        Said("/odom", 5e-9, ros.odometry(1.0, 2.0, 0.0, 1.0, np.zeros((3, 3)))),
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        bag = ros.write(Path(folder) / "b", said)
        return (bag / "b.db3" if kind == "sqlite" else bag).read_bytes()


def _reader(name: str, file: str, kind: BagKind) -> Reader:
    errors = (DetectError, CameraError)
    return Reader(name, file, _bag, errors, (), _WORDS, made_seeds=lambda: (_recorded(kind),),
                  files=5)  # fmt: skip


BAG_READERS: tuple[Reader, ...] = (
    _reader("mcap", "b.mcap", "mcap"),
    _reader("ros1 bag", "b.bag", "ros1"),
    _reader("sqlite bag", "b.db3", "sqlite"),
    replace(
        _reader("sqlite cells", "b.db3", "sqlite"), seeds=(b"",), made_seeds=tuple, files=12,
        content=lambda recipe: bag_with_edits(_recorded("sqlite"), recipe),
    ),
)  # fmt: skip
