"""Drawn detections: outlines where they belong, the rest of the image untouched."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from camera import Camera
from detect.drawing.frame import draw_rows
from detect.projection import DiscProjection, circle_on_floor
from detect.row_files import ImageRows
from detect.settings import CircleSettings
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
    rows = ImageRows(circles=Frame(Step("x", *[0.0] * 9), discs))
    picture = draw_rows(image, DiscProjection(camera, SETTINGS), rows)
    return picture[: 2 * image.shape[0]]


def drawn_at(camera: Camera, xy: ArrayLike) -> NDArray[np.float64]:
    """Pixels of the picture, which is twice as large as the image."""
    return 2.0 * camera.project_floor(xy) + 0.5


@pytest.fixture
def image() -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(60, 130, (288, 768)).astype(np.uint8)


def test_outlines_and_number_are_drawn(image: NDArray[np.uint8], published_camera: Camera) -> None:
    place = (0.2, -1.3)
    before = image.copy()
    canvas = drawn(image, published_camera, place)
    assert canvas.shape == (576, 1536, 3)
    assert canvas.dtype == np.uint8
    np.testing.assert_array_equal(image, before)
    marked = changed(canvas, image)
    for radius in (SETTINGS.inner_radius_m, SETTINGS.radius_m, SETTINGS.outer_radius_m):
        u, v = np.rint(drawn_at(published_camera, circle_on_floor(place, radius, 48))).astype(int).T
        assert marked[v, u].mean() > 0.95
    # Between the outlines the image shows.
    u, v = np.rint(drawn_at(published_camera, circle_on_floor(place, 0.03, 16))).astype(int).T
    assert not marked[v, u].any()
    # The quality is to the right of the outline.
    outline = drawn_at(published_camera, circle_on_floor(place, SETTINGS.outer_radius_m, 64))
    u0, v0 = np.rint([outline[:, 0].max(), outline[:, 1].mean()]).astype(int)
    assert marked[v0 - 8 : v0 + 8, u0 + 4 : u0 + 50].sum() > 60


def test_the_rest_is_the_image(image: NDArray[np.uint8], published_camera: Camera) -> None:
    place = (0.2, -1.3)
    canvas = drawn(image, published_camera, place)
    v, u = np.nonzero(changed(canvas, image))
    seen = drawn_at(published_camera, circle_on_floor(place, SETTINGS.outer_radius_m, 64))
    left, top = seen.min(axis=0)
    right, bottom = seen.max(axis=0)
    assert u.min() >= left - 2
    assert u.max() <= right + 60
    assert v.min() >= top - 2
    assert v.max() <= bottom + 2


def test_labels_are_beside_each_other(published_camera: Camera) -> None:
    """The words of discs close together do not cover each other, and are within the picture."""
    image = np.full((288, 768), 90, np.uint8)
    row = [(x, -4.0) for x in np.arange(-1.0, 1.0, 0.2)]
    border = published_camera.floor_from_pixel(np.array([740.0, 200.0]))
    places = [*row, (border[0], border[1])]

    def words(*shown: tuple[float, float]) -> int:
        picture = drawn(image, published_camera, *shown).astype(int)
        return int(np.sum((picture == [0, 230, 255]).all(axis=2)))

    assert words(*places) >= 0.97 * sum(words(place) for place in places)
    assert words(places[-1]) >= 0.97 * words((0.2, -1.3))


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
    assert 3 < u.max() < 180
    behind = drawn(image, published_camera, (0.0, 3.0), (0.0, 3.0))
    assert not changed(behind, image).any()
