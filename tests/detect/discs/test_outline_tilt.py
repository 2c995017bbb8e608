"""The tilt by outlines of discs: what tilted the camera comes back, in spite of what hides rims."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.discs.outline_tilt import (
    DISC_SIGMA_RAD,
    FLOOR_SIGMA_RAD,
    fit_outline,
    mean_of_tilts,
    tilt_of_outlines,
)
from detect.projection import image_positions, leaning_camera
from redetect.landmarks import FrameTilt
from tests.detect.painted_floor import PaintedFloor

FloatArray = NDArray[np.float64]
DISCS = np.array([(0.4, -1.3), (-0.6, -1.6), (0.1, -2.1), (0.9, -2.6), (-0.8, -2.9)])


def seen_from(
    camera: Camera, tilt: tuple[float, float], paint: Callable[[PaintedFloor], None]
) -> FrameTilt | None:
    """The tilt found in an image that a robot tilted so takes of the discs."""
    floor = PaintedFloor(leaning_camera(camera, tilt))
    for place in DISCS:
        floor.disc(place)
    paint(floor)
    rows_xy = camera.floor_from_pixel(image_positions(camera, DISCS, tilt))
    return tilt_of_outlines(floor.image(), camera, rows_xy, 0.10)


def off(found: FrameTilt | None, tilt: tuple[float, float]) -> FloatArray:
    assert found is not None
    return np.degrees(np.array([found.pitch, found.roll]) - tilt)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (-0.045, 0.012), (0.06, -0.03), (-0.1, 0.02)])
def test_tilt_comes_back(published_camera: Camera, tilt: tuple[float, float]) -> None:
    found = seen_from(published_camera, tilt, lambda floor: None)

    assert found is not None
    assert found.lines == len(DISCS)
    assert np.abs(off(found, tilt)).max() < 0.3


def test_what_hides_a_rim_hardly_counts(published_camera: Camera) -> None:
    """A dark bar lies across the edge of one disc, and light paper beside another."""
    tilt = (-0.045, 0.012)

    def paint(floor: PaintedFloor) -> None:
        x, y = DISCS[1]
        floor.shape((x + 0.09, y), lambda dx, dy: (abs(dx) < 0.02) & (abs(dy) < 0.15), 30.0)

    assert np.abs(off(seen_from(published_camera, tilt, paint), tilt)).max() < 0.4


def test_a_floor_without_discs_shows_nothing(published_camera: Camera) -> None:
    bare = np.full((published_camera.height, published_camera.width), 90, np.uint8)

    assert tilt_of_outlines(bare, published_camera, DISCS, 0.10) is None
    assert tilt_of_outlines(bare, published_camera, DISCS[:0], 0.10) is None


def test_errors_of_points_are_as_large_as_stated(published_camera: Camera) -> None:
    """Exact outlines with independent noise of the stated size, for which four are counted."""
    rng = np.random.default_rng(2)
    tilt = (-0.03, 0.02)
    centre = np.array(published_camera.centre)
    angle = 2.0 * np.pi * np.arange(32) / 32
    x, y = 0.3, -2.0
    ring = np.array([x, y]) + 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = published_camera.floor_from_pixel(image_positions(published_camera, ring, tilt))
    middle = seen.mean(axis=0)
    squared = []
    for _ in range(300):
        noise = 0.25 * rng.standard_normal(32)
        away = seen - middle
        distance = np.linalg.norm(away, axis=1)
        px_per_m = np.full(32, 120.0)
        points = away * (1.0 + noise / px_per_m / distance)[:, None]
        outline = fit_outline(points, px_per_m, centre, middle[0], middle[1], 0.1)
        assert outline.found
        error = outline.tilt - tilt
        squared.append(error @ np.linalg.solve(outline.covariance, error) / 2.0)
    assert 0.15 < np.mean(squared) < 0.45


def test_mean_leaves_one_disc_of_many_aside() -> None:
    tilt = np.tile([0.02, -0.01], (6, 1))
    tilt[4] = 0.2, 0.1
    covariance = np.tile(np.eye(2) * 0.005**2, (6, 1, 1))

    mean, of_mean = mean_of_tilts(tilt, covariance)

    np.testing.assert_allclose(mean, tilt[0], atol=6e-4)
    assert of_mean[0, 0] < 0.005**2 / 3


def test_errors_of_discs_and_of_floors_are_stated(published_camera: Camera) -> None:
    found = seen_from(published_camera, (0.0, 0.0), lambda floor: None)

    assert found is not None
    least = math.sqrt(FLOOR_SIGMA_RAD**2 + DISC_SIGMA_RAD**2 / len(DISCS) * 0.6)
    assert math.sqrt(found.cpp) > least
    assert math.sqrt(found.crr) > least
