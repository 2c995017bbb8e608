"""Discs before random cameras: their sizes, and that all of them are found."""

from __future__ import annotations

import numpy as np
import pytest

from lut import ring
from tools.evaluation.cameras import Cameras, radius_px, random_camera


def test_sizes_are_those_of_the_outlines() -> None:
    camera = random_camera(np.random.default_rng(0))
    place = camera.floor_from_pixel([0.5 * camera.width, 0.7 * camera.height])
    x, y = camera.project_floor(place + ring(0.05, 64)).T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert radius_px(camera, 0.05, place) == pytest.approx(np.sqrt(area / np.pi), rel=0.01)


@pytest.mark.long
def test_discs_of_all_sizes_are_found() -> None:
    figures = Cameras(cameras=1, scenes=3).measured()
    classes = [values for name, values in figures.items() if name != "elsewhere"]
    shown = sum(values["shown"] for values in classes)
    assert shown > 5
    assert sum(values["found"] * values["shown"] for values in classes) > 0.9 * shown
    assert figures["elsewhere"] <= 1
