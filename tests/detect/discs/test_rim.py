"""The rim of rendered discs against the truth: whole, cut, and of things that are no discs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from detect.discs.rim import DIRECTIONS, RADIUS_SIGMA, Circle, fit_circle, follow_rims, profiles
from tests.detect.painted_floor import DARK, FLOOR, LIGHT, PaintedFloor

PLACES = np.array([(0.0, -1.2), (0.5, -1.5), (-0.6, -1.9), (0.4, -2.3)])
RADIUS = 0.1


def rim_of(camera: Camera, image: NDArray[np.uint8], near: NDArray[np.float64], grey: float) -> Any:
    numbers = camera_numbers(camera)
    seen = profiles(image, numbers, near[None], np.full(1, RADIUS))
    return follow_rims(image, numbers, seen, np.full(1, grey - FLOOR)).view(np.recarray)[0]


@pytest.mark.parametrize("grey", [LIGHT, DARK])
def test_a_whole_rim_lies_on_one_circle(published_camera: Camera, grey: float) -> None:
    for seed, place in enumerate(PLACES):
        image = PaintedFloor(published_camera).disc(place, grey).image(seed=seed)
        rim = rim_of(published_camera, image, place + np.array([0.015, -0.01]), grey)
        assert rim.agreeing > 0.9
        assert rim.runs <= 1
        assert np.hypot(*(rim.floor_xy - place)) < 0.003
        assert rim.radius == pytest.approx(RADIUS, rel=0.06)


def test_a_door_takes_a_stretch_of_the_rim_and_leaves_the_circle(published_camera: Camera) -> None:
    for seed, place in enumerate(PLACES):
        floor = PaintedFloor(published_camera).disc(place, LIGHT).door(place, 0.4)
        rim = rim_of(published_camera, floor.image(seed=seed), place + np.array([0.02, 0.0]), LIGHT)
        assert 0.5 < rim.agreeing < 0.9
        assert rim.runs <= 1
        assert np.hypot(*(rim.floor_xy - place)) < 0.008


def test_what_is_no_disc_has_no_such_rim(published_camera: Camera) -> None:
    place = PLACES[1]
    plate = PaintedFloor(published_camera).disc(place, LIGHT, 0.14).image(seed=1)
    assert rim_of(published_camera, plate, place, LIGHT).radius > 0.12
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 255, plate.shape, dtype=np.uint8)
    assert rim_of(published_camera, noise, place, LIGHT).agreeing < 0.6
    flat = np.full_like(plate, 90)
    assert rim_of(published_camera, flat, place, LIGHT).agreeing == 0.0


def test_outside_the_image_nothing_is_visible(published_camera: Camera) -> None:
    image = np.full((published_camera.height, published_camera.width), 90, np.uint8)
    rim = rim_of(published_camera, image, np.array([0.0, 3.0]), FLOOR + 50.0)
    assert rim.agreeing == 0.0


def test_a_step_to_the_circle_is_that_of_the_normal_equations() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        angle = rng.uniform(0.0, rng.uniform(1.0, 6.0), DIRECTIONS)
        distance = 1.0 + 0.02 * rng.standard_normal(DIRECTIONS)
        x, y = distance * np.cos(angle) + 0.05, distance * np.sin(angle) - 0.03
        weight = rng.uniform(10.0, 400.0, DIRECTIONS) * (rng.random(DIRECTIONS) < 0.8)
        beside = rng.normal(0.0, 0.02, 2)
        before = Circle(beside[0], beside[1], 1.02, 0.0, 0.0, 0.0)
        to = np.stack([x - before.x, y - before.y], axis=-1)
        length = np.linalg.norm(to, axis=1)
        slope = np.column_stack([to / length[:, None], np.ones(DIRECTIONS)])
        normal = slope.T @ (weight[:, None] * slope)
        right = slope.T @ (weight * (length - before.radius))
        normal[2, 2] += 1.0 / RADIUS_SIGMA**2
        right[2] += (1.0 - before.radius) / RADIUS_SIGMA**2
        after = fit_circle(x, y, weight, before, RADIUS_SIGMA)
        np.testing.assert_allclose(
            np.subtract(after[:3], before[:3]), np.linalg.solve(normal, right), rtol=1e-6, atol=1e-9
        )
        covariance = np.linalg.inv(normal)
        np.testing.assert_allclose(
            after[3:], [covariance[0, 0], covariance[0, 1], covariance[1, 1]], rtol=1e-6, atol=1e-12
        )


def test_covariances_of_the_rim_cover_its_errors(published_camera: Camera) -> None:
    rng = np.random.default_rng(5)
    squares = []
    for seed in range(80):
        place = PLACES[seed % len(PLACES)] + rng.uniform(-0.05, 0.05, 2)
        floor = PaintedFloor(published_camera).disc(place, LIGHT).door(place, 0.4)
        rim = rim_of(published_camera, floor.image(seed=seed), place, LIGHT)
        error = rim.floor_xy - place
        squares.append(error @ np.linalg.solve(rim.covariance, error) / 2.0)
    # They place discs only where sectors of the edge disagree: there they are worse than here.
    assert 0.1 < np.median(squares) / np.log(2.0) < 1.6
