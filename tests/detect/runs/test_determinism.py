"""The same image gives the same bytes, wherever arrays lie in memory.

Whether kernels were compiled or loaded is tried by `make kernels`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import read_camera
from detect.circles import detect_circles, disc_table
from detect.lines import detect_lines
from detect.markers.detect import detect_markers
from detect.settings import CircleSettings, MarkerSettings
from lut import build_vertical_table
from tests.pictures import read_grey

Image = NDArray[np.uint8]


def _bytes(found: object) -> bytes:
    """All arrays of a result."""
    assert dataclasses.is_dataclass(found)
    values = (getattr(found, field.name) for field in dataclasses.fields(found))
    return b"".join(value.tobytes() for value in values if isinstance(value, np.ndarray))


def _detector(project_root: Path, kind: str) -> tuple[Path, Callable[[Image], bytes]]:
    if kind == "markers":
        lens = read_camera(project_root / "images" / "m" / "a" / "a.cam")
        settings = MarkerSettings(dictionary="rawseeds")
        return project_root / "images" / "m" / "a" / "images", lambda image: repr(
            detect_markers(image, settings, lens).landmarks()
        ).encode()
    folder = project_root / "images" / "e" / "images"
    camera = read_camera(project_root / "images" / "e" / "e.cam")
    if kind == "lines":
        verticals = build_vertical_table(camera)
        return folder, lambda image: _bytes(detect_lines(image, verticals))
    discs = disc_table(camera, CircleSettings())
    return folder, lambda image: _bytes(detect_circles(image, camera, discs, CircleSettings()))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["circles", "lines", "markers"])
def test_the_same_image_gives_the_same_bytes(project_root: Path, kind: str) -> None:
    folder, detect = _detector(project_root, kind)
    rng = np.random.default_rng(3)
    for path in sorted(folder.iterdir())[:2]:
        image = read_grey(path)
        seen = set()
        for _ in range(6):
            # What stays allocated and what is freed decides where later arrays will lie, and what
            # was there before.
            freed = [
                np.full(rng.integers(100, 400_000), rng.choice([np.nan, 1e30, 0.0, 255.0]))
                for _ in range(6)
            ]
            del freed
            kept = [np.empty(rng.integers(1, 60_000), np.uint8) for _ in range(rng.integers(9))]
            seen.add(detect(np.array(image, np.uint8)))
            assert len(kept) < 9
        assert len(seen) == 1, path.name
