"""A live camera, played by a capture that is none: its times, its end, its interrupt."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detect.cli import main
from detect.options import SourceOptions
from detect.sources import video as live
from detect.sources.grey_images import read_image
from detect.sources.opening import open_source
from redetect.landmarks import read_frames
from redetect.landmarks.frame_files import read_times
from tests.detect.commands import Captured, assert_refused
from tests.detect.recordings import images_of, write_video
from tests.pictures import read_grey


class Played:
    """Gives images one after the other, then again; or ends after some."""

    def __init__(self, images: list[NDArray[np.uint8]], last: int | None, pause_s: float) -> None:
        self.images, self.last, self.pause_s = images, last, pause_s
        self.given = 0
        self.released = threading.Event()

    def read(self) -> tuple[bool, NDArray[Any] | None]:
        assert not self.released.is_set()
        self.released.wait(self.pause_s)
        if self.given == self.last:
            return False, None
        image = self.images[self.given % len(self.images)]
        self.given += 1
        return True, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)

    def release(self) -> None:
        self.released.set()


Plugged = Callable[..., list[Played]]


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Plugged:
    """Plug a camera in; gives the captures that were opened."""

    def plug(
        images: list[NDArray[np.uint8]], last: int | None = None, pause_s: float = 0.002
    ) -> list[Played]:
        opened: list[Played] = []

        def open_camera(index: int) -> Played:
            assert index == 0
            opened.append(Played(images, last, pause_s))
            return opened[-1]

        monkeypatch.setattr(live, "_open_camera", open_camera)
        return opened

    return plug


def blank(value: int) -> NDArray[np.uint8]:
    return np.full((288, 768), value, np.uint8)


def test_so_many_frames_and_their_times(plugged: Plugged) -> None:
    opened = plugged([blank(40), blank(80)])
    before = time.time()
    frames = list(open_source(Path("camera:0"), None, SourceOptions(frames=5)).frames)
    assert [frame.step.prefix for frame in frames] == [f"camera0.{k:04d}" for k in range(5)]
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    assert before < times[0] < times[-1] < time.time()
    assert times == sorted(set(times))
    assert {int(read_image(frame, None)[0, 0]) for frame in frames} <= {40, 80}
    assert all(capture.released.is_set() for capture in opened)


def test_no_image_of_a_camera_is_taken_twice(
    plugged: Plugged, small_run: Path, tmp_path: Path, capsys: Captured
) -> None:
    """A recording would be read before and after the detection, for its tilt and for hints."""
    opened = plugged([blank(40)])
    command = ["circles", "camera:0", "--camera", str(small_run / "s.cam"), "--frames", "24"]
    assert main([*command, "-o", str(tmp_path / "live.circles"), "--jobs", "1"]) == 0
    assert sum(capture.given for capture in opened) == 24
    capsys.readouterr()
    command = [*command, "-o", str(tmp_path / "again.circles"), "--radius-m", "auto"]
    assert_refused(command, small_run, "--radius-m auto: expected recorded images", capsys)


def test_a_camera_that_ends(plugged: Plugged, caplog: pytest.LogCaptureFixture) -> None:
    plugged([blank(1)], last=3, pause_s=0.03)
    with caplog.at_level("INFO", logger="redetect"):
        frames = list(open_source(Path("camera:0")).frames)
    assert len(frames) == 3
    assert "yields no more images" in caplog.text


def test_an_interrupt_finishes_cleanly(
    plugged: Plugged, small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first interrupt ends the stream; what was seen is written, and the exit code is 0."""
    image = read_grey(small_run / "images" / "s.0000.png")
    opened = plugged([image])
    output = tmp_path / "live.circles"
    framed = live.LiveCamera.__iter__

    def interrupted(self: live.LiveCamera) -> Any:
        for number, found in enumerate(framed(self)):
            if number == 3:
                signal.raise_signal(signal.SIGINT)
            yield found

    monkeypatch.setattr(live.LiveCamera, "__iter__", interrupted)
    before = signal.getsignal(signal.SIGINT)
    arguments = ["circles", "camera:0", "--camera", str(small_run / "s.cam"), "-o", str(output)]
    assert main(arguments) == 0
    assert signal.getsignal(signal.SIGINT) is before
    found = list(read_frames(output))
    assert [len(frame.circles) for frame in found] == [2] * 4
    assert list(read_times(f"{output}.times")) == [frame.step.prefix for frame in found]
    assert all(capture.released.is_set() for capture in opened)


def test_a_second_interrupt_is_meant(
    plugged: Plugged, small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged([blank(40)])
    output = tmp_path / "live.circles"
    framed = live.LiveCamera.__iter__

    def interrupted(self: live.LiveCamera) -> Any:
        for found in framed(self):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            yield found

    monkeypatch.setattr(live.LiveCamera, "__iter__", interrupted)
    arguments = ["circles", "camera:0", "--camera", str(small_run / "s.cam"), "-o", str(output)]
    assert main(arguments) == 130
    assert not output.exists()


@pytest.mark.long
def test_the_number_is_opencvs_and_frames_come_as_from_a_device(
    small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    images = images_of(small_run)
    film = write_video(tmp_path / "device.avi", images)
    plain, asked = cv2.VideoCapture, []

    def capture_of(number: int) -> cv2.VideoCapture:
        asked.append(number)
        return plain(str(film)) if number == 3 else plain(str(tmp_path / "none"))

    monkeypatch.setattr(cv2, "VideoCapture", capture_of)
    monkeypatch.chdir(tmp_path)
    camera = ["--camera", str(small_run / "s.cam")]
    assert main(["circles", "camera:3", *camera]) == 0
    assert set(asked) == {3}
    found = list(read_frames(tmp_path / "camera3.detected.circles"))
    assert len(found) == len(images)
    assert [frame.step.prefix for frame in found] == [f"camera3.{k:04d}" for k in range(len(found))]
    assert len(read_times("camera3.detected.circles.times")) == len(found)
    capsys.readouterr()
    assert main(["circles", "camera:12", *camera]) == 1
    told = capsys.readouterr().err
    assert asked[-1] == 12
    assert told.count("\n") == 1
    assert "camera:12: no camera of that number answers" in told
