"""A live camera of this machine as a source, until it is stopped.

The camera is read all the time, so that an image's time is that of its arrival; images that could
not be processed in time are dropped. The first Ctrl-C ends the stream: the images so far are
processed and the results written. A second one ends the program, which then writes nothing.
"""

from __future__ import annotations

import itertools
import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import cv2
from numpy.typing import NDArray

from detect.errors import DetectError
from detect.run import RunFrame
from detect.sources.gray import gray_of_pixels
from detect.sources.interface import Source, numbered_prefix, still
from detect.sources.video import quiet_opencv

_log = logging.getLogger("redetect")

#: How long a camera may be silent (s).
PATIENCE_S = 10.0

# How often a new image, or an interrupt, is noticed (s).
_LOOK_S = 0.002


class Capture(Protocol):
    """The interface of an OpenCV capture that is used."""

    def read(self) -> tuple[bool, NDArray[Any] | None]: ...

    def release(self) -> None: ...


class LiveCamera(Source):
    """Images of a camera as they come, named ``camera0.0000`` and so on; times are UNIX time."""

    def __init__(self, index: int) -> None:
        self.name = f"camera:{index}"
        self.output_base = Path(f"camera{index}.detected")
        self._index = index
        _open_camera(index).release()

    def __iter__(self) -> Generator[RunFrame, None, None]:
        newest = _Newest(_open_camera(self._index))
        try:
            with _stoppable() as stop:
                for number in itertools.count():
                    taken = newest.next(stop)
                    if taken is None:
                        return
                    time_s, pixels = taken
                    prefix = numbered_prefix(f"camera{self._index}", number)
                    gray = gray_of_pixels(pixels, prefix)
                    yield RunFrame(still(prefix), None, gray, time_s)
        finally:
            newest.close()


class _Newest:
    """The newest image of a camera that a thread reads."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self._image: deque[tuple[float, NDArray[Any]]] = deque(maxlen=1)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def next(self, stop: threading.Event) -> tuple[float, NDArray[Any]] | None:
        """Wait for an image that was not given yet; None when there will be none."""
        latest_s = time.monotonic() + PATIENCE_S
        while not stop.is_set():
            ended = self._ended.is_set()
            if self._image:
                return self._image.popleft()
            if ended:
                _log.info("the camera gives no more images: the results so far are written")
                return None
            if time.monotonic() >= latest_s:
                _log.info(f"no image came within {PATIENCE_S:g} s: the results so far are written")
                return None
            time.sleep(_LOOK_S)
        return None

    def close(self) -> None:
        self._ended.set()
        self._thread.join(PATIENCE_S)
        self._capture.release()

    def _read(self) -> None:
        while not self._ended.is_set():
            there, pixels = self._capture.read()
            if there and pixels is not None:
                self._image.append((time.time(), pixels))
            else:
                self._ended.set()


@contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """Take an interrupt as the wish to stop, for the time of a block."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def note(_: int, __: FrameType | None) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)  # the next one interrupts the program

    signal.signal(signal.SIGINT, note)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def _open_camera(index: int) -> Capture:
    with quiet_opencv():
        capture = cv2.VideoCapture(index)
    if not capture.isOpened():
        raise DetectError(
            f"camera:{index}: no camera of that number answers: "
            "expected one that is plugged in, not in use, and open to you (often camera:0)"
        )
    return capture
