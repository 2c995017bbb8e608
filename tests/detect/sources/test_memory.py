"""Memory does not grow with a video or a bag, nor with the odometry beside its images."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, write_camera
from tests.detect.recordings import Ros, Said, write_video
from tests.detect.runs.test_memory import peaks_mib

_REDUCED = 8


def small_images(source: Path, camera: Camera) -> list[NDArray[np.uint8]]:
    """A few frames of the demo run, reduced."""
    found = []
    for number in range(4):
        grey = cv2.imread(str(source / "images" / f"e.{number:04d}.jpg"), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        size = (camera.width, camera.height)
        found.append(np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8))
    return found


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="counts memory in Linux's units")
@pytest.mark.parametrize("kind", ["video", "bag"])
def test_memory_is_flat(
    project_root: Path, published_camera: Camera, tmp_path: Path, kind: str
) -> None:
    if kind == "bag":
        pytest.importorskip("rosbags", reason="the extra [bags] is not installed")
    k, full = _REDUCED, published_camera
    small = replace(
        full, width=full.width // k, height=full.height // k, scale_x=full.scale_x / k,
        scale_y=full.scale_y / k, offset_x=full.offset_x / k, offset_y=full.offset_y / k,
    )  # fmt: skip
    images = small_images(project_root / "images" / "e", small)
    write_camera(small, tmp_path / "small.cam")
    peaks = []
    for count in (100, 2000):
        shown = [images[number % 4] for number in range(count)]
        if kind == "video":
            path = write_video(tmp_path / f"{count}.avi", shown)
        else:
            ros, said = Ros(), []
            for number, image in enumerate(shown):
                time_s = 100.0 + 0.1 * number
                pose = ros.odometry(0.2 * number, 0.0, 0.0, time_s, np.zeros((3, 3)))
                said.append(Said("/odom", time_s, pose))
                said.append(Said("/image", time_s, ros.image(image, "mono8", time_s)))
            path = ros.write(tmp_path / str(count), said)
        peaks.append(peaks_mib(["all", str(path), "--jobs", "2"], tmp_path / "program.py"))
    (own, worker), (own_long, worker_long) = peaks
    assert 50.0 < worker_long < 300.0
    # The images of 1900 frames are 6 MiB: if they were kept, that would be seen.
    assert own_long - own < 6.0
    assert worker_long - worker < 6.0
