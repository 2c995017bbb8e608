"""A video file, and a live camera, as sources: frames by OpenCV, decoded on demand.

An image of a live camera has the time of its arrival. The first Ctrl-C ends the stream: the images
so far are processed and the results written. A second one ends the program without output.
"""

from __future__ import annotations

import itertools
import logging
import math
import signal
import threading
import time
from collections.abc import Generator
from contextlib import AbstractContextManager
from pathlib import Path

import cv2

from detect.errors import DetectError
from detect.sources.grey_images import grey_of_pixels
from detect.sources.interface import RunFrame, Source, numbered_prefix, still
from redetect.interrupts import interrupts_call
from redetect.storage.images import opened_video, quiet_opencv

_log = logging.getLogger("redetect")


class VideoFile(Source):
    """Frames of a video file, named ``<stem>.0000`` and so on; times count from its beginning."""

    is_8_bit = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name, self.beside = str(path), (path.parent, path.stem)
        self.output_base = path.with_name(f"{path.stem}.detected")
        with self._opened() as capture:
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.expected = int(count) if math.isfinite(count) and 0 < count < 2**31 else None

    def __iter__(self) -> Generator[RunFrame, None, None]:
        with self._opened() as capture:
            per_second = capture.get(cv2.CAP_PROP_FPS)
            last_s = -math.inf
            for number in itertools.count():
                there, pixels = capture.read()
                if not there:
                    break
                time_s = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                if time_s <= last_s and per_second > 0.0:  # a container without timestamps
                    time_s = number / per_second
                prefix = numbered_prefix(self.path.stem, number)
                grey = grey_of_pixels(pixels, f"{self.name}: {prefix}")
                yield RunFrame(still(prefix), None, grey, time_s)
                last_s = time_s
        if self.expected is not None and number < self.expected:
            _log.info(f"{self.name}: only {number} of {self.expected} frames can be read")

    def _opened(self) -> AbstractContextManager[cv2.VideoCapture]:
        error = DetectError(
            f"{self.path}: no video that OpenCV can read: expected a run folder, images, a video "
            "(avi, mp4, mkv), or a bag (.bag, .mcap, or the folder of a ROS 2 bag)"
        )
        return opened_video(self.path, error)


class LiveCamera(Source):
    """Images of a camera as they come, named ``camera0.0000`` and so on; times are UNIX time."""

    is_8_bit = True
    is_recorded = False

    def __init__(self, index: int) -> None:
        self.name = f"camera:{index}"
        self.output_base = Path(f"camera{index}.detected")
        self._index = index
        _open_camera(index).release()

    def __iter__(self) -> Generator[RunFrame, None, None]:
        capture = _open_camera(self._index)
        try:
            stop = threading.Event()
            before = signal.getsignal(signal.SIGINT)

            def end_stream(*_: object) -> None:
                stop.set()
                signal.signal(signal.SIGINT, before)  # the next one interrupts the program

            with interrupts_call(end_stream):
                for number in itertools.count():
                    there, pixels = capture.read()
                    time_s = time.time()
                    if stop.is_set():
                        return
                    if not there:
                        _log.info("the camera yields no more images: writing the results so far")
                        return
                    prefix = numbered_prefix(f"camera{self._index}", number)
                    yield RunFrame(still(prefix), None, grey_of_pixels(pixels, prefix), time_s)
        finally:
            capture.release()


def _open_camera(index: int) -> cv2.VideoCapture:
    with quiet_opencv():
        capture = cv2.VideoCapture(index)
    if not capture.isOpened():
        raise DetectError(
            f"camera:{index}: no camera of that number answers: "
            "expected one that is plugged in, not in use, and open to you (often camera:0)"
        )
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # buffered images are older than their arrival
    return capture
