"""Recordings of known images: bags, and videos without loss."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.pictures import read_grey
from tools.ros_bags import Ros, Said


def write_bag(path: Path, images: Sequence[NDArray[np.uint8]]) -> Path:
    """A bag of grey images, one a second from 1 s on; skips the test without `rosbags`."""
    pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    ros = Ros()
    return ros.write(
        path, [Said("/i", k, ros.image(image, "mono8", k)) for k, image in enumerate(images, 1)]
    )


def images_of(run: Path) -> list[NDArray[np.uint8]]:
    """The images of a run folder, in order."""
    return [read_grey(path) for path in sorted((run / "images").iterdir())]


def write_video(
    path: Path, images: Sequence[NDArray[np.uint8]], per_second: float = 10.0, codec: str = "FFV1"
) -> Path:
    """A video of grey images; of the codecs that OpenCV has, FFV1 loses nothing."""
    height, width = images[0].shape
    fourcc = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), fourcc, per_second, (width, height), isColor=True)
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path
