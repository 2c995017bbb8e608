"""Blank columns at the sides of images, and discs that are cut there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.circles import detect_circles, disc_table, vote_shape
from detect.grey_values import blank_margins
from detect.settings import CircleSettings
from lut import build_vote_table
from tests.detect.painted_floor import PaintedFloor

LIGHT = 200.0


def with_margin(image: NDArray[np.uint8], columns: int) -> NDArray[np.uint8]:
    """The image with its first columns blank, and one half so."""
    image = image.copy()
    noise = np.random.default_rng(1).integers(-3, 4, (len(image), columns))
    image[:, :columns] = 43 + noise
    image[:, columns] = (43 + image[:, columns].astype(int)) // 2
    return image


def floor_with_disc(camera: Camera, u: float, v: float) -> tuple[NDArray[np.uint8], np.ndarray]:
    place = camera.floor_from_pixel([u, v])
    return PaintedFloor(camera).disc(place, LIGHT).image(seed=2), place


def test_margins_are_where_the_image_begins_at_a_sharp_edge(published_camera: Camera) -> None:
    image, _ = floor_with_disc(published_camera, 400.0, 200.0)
    # A wall at the side, whose columns are all alike.
    rows = np.arange(len(image))[:, None]
    image = np.where(rows < 60, 180, image).astype(np.uint8)
    assert blank_margins(image) == (0, 0)
    for columns, margin in ((3, 8), (7, 8), (8, 16)):
        blank = with_margin(image, columns)
        assert blank_margins(blank) == (margin, 0)
        assert blank_margins(np.ascontiguousarray(blank[:, ::-1])) == (0, margin)
    assert blank_margins(np.full_like(image, 90)) == (0, 0)
    assert blank_margins(with_margin(image, 60)) == (0, 0)
    ramp = np.broadcast_to(np.linspace(40.0, 200.0, image.shape[1]), image.shape)
    assert blank_margins(ramp.astype(np.uint8)) == (0, 0)


@pytest.mark.parametrize("u", [12.0, 20.0])
def test_a_disc_that_a_margin_cuts_is_found_in_its_place(
    published_camera: Camera, u: float
) -> None:
    settings = CircleSettings()
    table = disc_table(published_camera, settings)
    image, place = floor_with_disc(published_camera, u, 190.0)
    found = detect_circles(with_margin(image, 7), published_camera, table, settings)
    assert len(found) == 1
    assert np.linalg.norm(found.floor_xy[0] - place) < 0.01
    assert np.abs(found.pixels[0] - [u, 190.0]).max() <= 3.0


def test_no_table_is_kept_on_disk_for_a_margin(
    published_camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Walls at the side may look like one, and a search for the radius tries many."""
    monkeypatch.setenv("REDETECT_CACHE", str(tmp_path))
    settings = CircleSettings(radius_m=0.105)
    table = build_vote_table(published_camera, vote_shape(settings))
    image, _ = floor_with_disc(published_camera, 400.0, 190.0)
    assert len(detect_circles(with_margin(image, 7), published_camera, table, settings)) == 1
    assert not list(tmp_path.iterdir())


def test_the_least_images_have_no_margins() -> None:
    assert blank_margins(np.zeros((1, 1), np.uint8)) == (0, 0)
    assert blank_margins(np.arange(5, dtype=np.uint8)[None]) == (0, 0)
