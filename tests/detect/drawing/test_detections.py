"""Drawn detections: outlines where they belong, the rest of the image untouched."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.drawing.frame import draw_rows
from detect.row_files import SeenRows
from detect.seen import Sight
from detect.settings import CircleSettings
from lut import ring
from redetect.landmarks import Frame, Step, circle_landmarks
from tests.pictures import changed

SETTINGS = CircleSettings()


def drawn(
    image: NDArray[np.uint8], camera: Camera, *places: tuple[float, float]
) -> NDArray[np.uint8]:
    """The image with discs of quality 0.87, without the line of words below."""
    xy = np.array(places, float).reshape(-1, 2)
    covariance = np.tile(1e-4 * np.eye(2), (len(xy), 1, 1))
    discs = circle_landmarks(xy, np.full(len(xy), 0.87), covariance, np.full(len(xy), -1))
    rows = SeenRows(circles=Frame(Step("x", *[0.0] * 9), discs))
    picture = draw_rows(image, Sight(camera), rows, SETTINGS)
    return picture[: image.shape[0]]


@pytest.fixture
def image() -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(60, 130, (288, 768)).astype(np.uint8)


def test_outlines_and_number_are_drawn(image: NDArray[np.uint8], published_camera: Camera) -> None:
    place = (0.2, -1.3)
    before = image.copy()
    canvas = drawn(image, published_camera, place)
    assert canvas.shape == (288, 768, 3)
    assert canvas.dtype == np.uint8
    np.testing.assert_array_equal(image, before)
    marked = changed(canvas, image)
    for radius in (SETTINGS.inner_radius_m, SETTINGS.radius_m, SETTINGS.outer_radius_m):
        u, v = np.rint(published_camera.project_floor(place + ring(radius, 48))).astype(int).T
        assert marked[v, u].mean() > 0.95
    # Between the outlines the image shows.
    u, v = np.rint(published_camera.project_floor(place + ring(0.03, 16))).astype(int).T
    assert not marked[v, u].any()
    # The quality stands above the outline.
    top = published_camera.project_floor(np.array([0.2, -1.3 - SETTINGS.outer_radius_m]))
    u0, v0 = np.rint(top).astype(int)
    assert marked[v0 - 14 : v0 - 2, u0 - 14 : u0 + 14].sum() > 30


def test_the_rest_is_the_image(image: NDArray[np.uint8], published_camera: Camera) -> None:
    place = (0.2, -1.3)
    canvas = drawn(image, published_camera, place)
    v, u = np.nonzero(changed(canvas, image))
    seen = published_camera.project_floor(place + ring(SETTINGS.outer_radius_m, 64))
    left, top = seen.min(axis=0)
    right, bottom = seen.max(axis=0)
    assert u.min() >= left - 20
    assert u.max() <= right + 20
    assert v.min() >= top - 16
    assert v.max() <= bottom + 2


def test_each_disc_is_drawn(image: NDArray[np.uint8], published_camera: Camera) -> None:
    places = [(0.2, -1.3), (-0.7, -2.2)]
    both = changed(drawn(image, published_camera, *places), image)
    single = [changed(drawn(image, published_camera, place), image) for place in places]
    np.testing.assert_array_equal(both, single[0] | single[1])
    assert not np.any(single[0] & single[1])


def test_discs_at_the_border_are_cut(image: NDArray[np.uint8], published_camera: Camera) -> None:
    """Of a disc half outside, the half inside is drawn; one behind the camera is not."""
    place = published_camera.floor_from_pixel(np.array([3.0, 200.0]))
    canvas = drawn(image, published_camera, (place[0], place[1]))
    _, u = np.nonzero(changed(canvas, image))
    assert u.min() == 0
    assert 3 < u.max() < 80
    behind = drawn(image, published_camera, (0.0, 3.0))
    assert not changed(behind, image).any()
