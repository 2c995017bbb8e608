"""A video file as a source: its frames in order, decoded by OpenCV on demand."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2

from camera import Camera
from detect.errors import DetectError
from detect.run import RunFrame
from detect.sources.gray import gray_of_pixels
from detect.sources.interface import Source, numbered_prefix, only_calibration, still

_log = logging.getLogger("redetect")


class VideoFile(Source):
    """Frames of a video file, named ``<stem>.0000`` and so on; times count from its beginning."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = str(path)
        self.output_base = path.with_name(f"{path.stem}.detected")
        with _opened(path) as capture:
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
            self.size = (width, int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.expected = int(count) if math.isfinite(count) and 0 < count < 2**31 else None

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with _opened(self.path) as capture:
            per_second = capture.get(cv2.CAP_PROP_FPS)
            number, last_s = 0, -math.inf
            while True:
                there, pixels = capture.read()
                if not there:
                    break
                time_s = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                if time_s <= last_s and per_second > 0.0:  # a container without time stamps
                    time_s = number / per_second
                prefix = numbered_prefix(self.path.stem, number)
                gray = gray_of_pixels(pixels, f"{self.name}: {prefix}")
                yield RunFrame(still(prefix), None, gray, time_s)
                number, last_s = number + 1, time_s
        if self.expected is not None and number < self.expected:
            _log.info(f"{self.name}: only {number} of {self.expected} frames can be read")

    def calibration(self, *, posed: bool) -> Camera | None:
        """The ``.cam`` file beside it: of its name, or the only one."""
        return only_calibration(self.path.parent, self.path.stem)


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    with quiet_opencv():
        capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise DetectError(
                f"{path}: no video that OpenCV can read: expected a run folder, images, a video "
                "(avi, mp4, mkv), or a bag (.bag, .mcap, or the folder of a ROS 2 bag)"
            )
        # A calibration is of the sensor's pixels, whichever way up a telephone would show them.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Suppress messages of OpenCV, and of FFmpeg in it, for errors that are reported here."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    levels: Any = getattr(cv2.utils, "logging", cv2)  # where OpenCV 4 has them
    before = levels.getLogLevel()
    levels.setLogLevel(0)  # silent
    try:
        yield
    finally:
        levels.setLogLevel(before)
