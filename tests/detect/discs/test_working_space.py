"""Memory that is kept from image to image: what an earlier one left there changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from camera import read_camera
from detect.circles import detect_circles, disc_table
from detect.discs.fit import working_space
from detect.discs.patch import CAPACITY
from detect.settings import CircleSettings
from tests.pictures import read_grey


@pytest.mark.parametrize("left", [np.nan, 1e30, -7.0])
def test_what_is_left_in_the_memory_of_fits_does_not_matter(
    project_root: Path, left: float
) -> None:
    camera, settings = read_camera(project_root / "images" / "e" / "e.cam"), CircleSettings()
    table = disc_table(camera, settings)
    file = project_root / "images" / "e" / "images" / "e.0010.jpg"
    image = read_grey(file)
    work = working_space()
    found = []
    for number in (0.0, left):
        work["rows"] = number
        for name in ("weight", "grey", "x", "y", "x1", "y2", "growth", "shares", "row_x", "row_y"):
            work["patch"][name] = number
        # Such as would be neighbours.
        for name in ("pixel", "sector", "taken"):
            work["patch"][name] = np.arange(CAPACITY) if number else 0
        found.append(detect_circles(image, camera, table, settings))
    clean, dirty = found
    assert len(clean) > 0
    for name in ("pixels", "floor_xy", "covariance", "evidence"):
        assert getattr(clean, name).tobytes() == getattr(dirty, name).tobytes()
