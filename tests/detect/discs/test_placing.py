"""Where partly hidden discs are placed, against the truth, and how sure that is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera
from detect.circles import detect_circles
from detect.discs.fit import eliminate
from detect.discs.placing import size_of_disc
from detect.discs.rim import DIRECTIONS, best_circle
from detect.settings import CircleSettings
from lut import VoteTable
from redetect.array_types import FloatArray
from redetect.compiled import kernel
from tests.detect.discs.test_rim import PLACES
from tests.detect.painted_floor import LIGHT, PaintedFloor

SETTINGS = CircleSettings(tilt_sigma_deg=0.0)


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_a_door_over_a_disc_does_not_move_it(
    published_camera: Camera, table: VoteTable, share: float
) -> None:
    rng = np.random.default_rng(3)
    off_px, squares = [], []
    for seed in range(40):
        place = PLACES[seed % len(PLACES)] + rng.uniform(-0.05, 0.05, 2)
        floor = PaintedFloor(published_camera).disc(place, LIGHT).door(place, share)
        found = detect_circles(floor.image(seed=seed), published_camera, table, SETTINGS)
        distance = np.hypot(*(found.floor_xy - place).T)
        if distance.min(initial=1.0) > 0.05:
            continue
        k = int(distance.argmin())
        seen = published_camera.project_floor(np.array([found.floor_xy[k], place]))
        off_px.append(seen[0] - seen[1])
        error = found.floor_xy[k] - place
        squares.append(error @ np.linalg.solve(found.covariance[k], error) / 2.0)
    assert len(squares) >= 36
    assert np.sqrt(np.median(np.square(off_px))) < 0.06
    assert 0.03 < np.median(squares) / np.log(2.0) < 2.0


def errors_of(
    camera: Camera, table: VoteTable, floors: list[tuple[PaintedFloor, NDArray[np.float64]]]
) -> tuple[float, float]:
    """Root mean square error of a coordinate, pixels, and mean normalised error squared."""
    off_px, squares = [], []
    for seed, (floor, place) in enumerate(floors):
        found = detect_circles(floor.image(seed=seed), camera, table, SETTINGS)
        k = int(np.hypot(*(found.floor_xy - place).T).argmin())
        off_px.append(np.subtract(*camera.project_floor(np.array([found.floor_xy[k], place]))))
        error = found.floor_xy[k] - place
        squares.append(error @ np.linalg.solve(found.covariance[k], error) / 2.0)
    return float(np.sqrt(np.mean(np.square(off_px)))), float(np.mean(squares))


def places(count: int) -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(7)
    return [PLACES[k % len(PLACES)] + rng.uniform(-0.05, 0.05, 2) for k in range(count)]


def test_a_shadow_over_half_of_a_disc_does_not_move_it(
    published_camera: Camera, table: VoteTable
) -> None:
    floors = []
    for k, place in enumerate(places(24)):
        floor = PaintedFloor(published_camera).disc(place, LIGHT)
        u, v = published_camera.project_floor(place)
        along = np.cos(k) * (np.arange(published_camera.width) - u)
        across = np.sin(k) * (np.arange(published_camera.height) - v)
        light = np.clip(0.5 + (along + across[:, None]) / 4.0, 0.0, 1.0)
        floor.grey *= 0.55 + 0.45 * light
        floors.append((floor, place))
    error_px, normalised = errors_of(published_camera, table, floors)
    assert error_px < 0.05  # the fit of a whole disc is half a pixel off
    assert 0.2 < normalised < 2.0


def test_light_that_falls_off_across_a_disc_does_not_move_it(
    published_camera: Camera, table: VoteTable
) -> None:
    floors = []
    for place in places(24):
        floor = PaintedFloor(published_camera).disc(place, LIGHT)
        u, _ = published_camera.project_floor(place)
        floor.grey *= np.exp(-np.square(np.arange(published_camera.width) - u - 20.0) / 3000.0)
        floors.append((floor, place))
    error_px, normalised = errors_of(published_camera, table, floors)
    assert error_px < 0.08
    assert 0.1 < normalised < 2.0


@pytest.mark.parametrize("length_px", [7, 11])
def test_movement_leaves_a_disc_in_its_place_and_its_covariance_right(
    published_camera: Camera, table: VoteTable, length_px: int
) -> None:
    floors = []
    for place in places(24):
        floor = PaintedFloor(published_camera).disc(place, LIGHT)
        floor.grey = np.asarray(cv2.blur(floor.grey, (length_px, 1)))
        floors.append((floor, place))
    error_px, normalised = errors_of(published_camera, table, floors)
    assert error_px < 0.1
    assert 0.1 < normalised < 2.0


@kernel()
def _eliminate_first(products: FloatArray, count: int) -> None:
    eliminate(products, range(count))  # a range cannot be passed from outside


@given(st.integers(0, 2**32 - 1), st.integers(1, 7))
def test_elimination_leaves_what_the_eliminated_do_not_explain(seed: int, eliminated: int) -> None:
    several = np.random.default_rng(seed).normal(size=(3, 30, 8))
    products = np.stack([rows.T @ rows for rows in several], axis=-1)
    _eliminate_first(products, eliminated)
    for rows, rest in zip(several, np.moveaxis(products, -1, 0), strict=True):
        first, later = rows[:, :eliminated], rows[:, eliminated:]
        left = later - first @ np.linalg.lstsq(first, later, rcond=None)[0]
        np.testing.assert_allclose(
            np.tril(rest[eliminated:, eliminated:]), np.tril(left.T @ left), rtol=1e-8, atol=1e-8
        )


def test_a_circle_of_another_size_needs_more_points() -> None:
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    radius = np.where(np.arange(DIRECTIONS) < 15, 1.0, 0.72)
    chosen = np.zeros(DIRECTIONS)
    tolerance: NDArray[np.float64] = np.full(DIRECTIONS, 0.05)
    circle, count, _ = best_circle(
        radius * np.cos(angle), radius * np.sin(angle), np.ones(DIRECTIONS), tolerance, chosen
    )
    assert count == pytest.approx(15, abs=1)
    assert circle.radius == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("points", "expected"), [(16, 0.5), (12, 0.119), (8, 0.018)])
def test_a_second_circle_casts_doubt_on_the_first(points: int, expected: float) -> None:
    """Half of the squared distance where both have as many points, and less where it has fewer."""
    angle = 2.0 * np.pi * (np.arange(DIRECTIONS) + 0.01) / DIRECTIONS
    first: NDArray[np.bool_] = np.cos(angle) > 0.0
    x, y = np.where(first, 0.25, -0.25) + np.cos(angle), np.sin(angle)
    weight = np.ones(DIRECTIONS)
    weight[np.flatnonzero(~first)[points:]] = 0.0
    tolerance: NDArray[np.float64] = np.full(DIRECTIONS, 0.03)
    circle, count, doubt = best_circle(x, y, weight, tolerance, np.zeros(DIRECTIONS))
    assert count == 16
    np.testing.assert_allclose(circle[:3], [0.25, 0.0, 1.0], atol=0.01)
    assert np.square(doubt).sum() / 0.5**2 == pytest.approx(expected, rel=0.1)


def known(radii: list[float], sigma: float) -> NDArray[np.float64]:
    return np.stack([radii, np.full(len(radii), sigma**-2)], axis=-1)


def test_other_discs_say_how_large_a_disc_is() -> None:
    radius, sigma = size_of_disc(0.1, known([0.09], 1e-4), 0)
    assert radius == 0.1
    assert sigma == pytest.approx(0.1 * np.hypot(0.02, 0.01))
    seen = known([0.03, 0.096, 0.0961, 0.0959, 0.096, 0.096], 1e-4)
    radius, sigma = size_of_disc(0.1, seen, 0)
    assert radius == pytest.approx(0.096, abs=2e-4)
    assert sigma < 0.0007
    unknown = seen * [1.0, 0.0]
    assert size_of_disc(0.1, unknown, 0) == size_of_disc(0.1, known([0.09], 1e-4), 0)


def test_the_size_of_a_disc_is_as_sure_as_stated() -> None:
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(600):
        common = 0.1 * (1.0 + rng.normal(0.0, 0.02))
        radii = common * (1.0 + rng.normal(0.0, 0.01, 6))
        sigma = rng.uniform(2e-4, 2e-3, 6)
        seen = np.stack([radii + rng.normal(0.0, sigma), sigma**-2], axis=-1)
        size, size_sigma = size_of_disc(0.1, seen, 0)
        squares.append(((size - radii[0]) / size_sigma) ** 2)
    assert 0.8 < np.mean(squares) < 1.4


def test_one_other_disc_that_is_none_does_not_change_the_size() -> None:
    good = [0.0965, 0.097, 0.0968, 0.0972, 0.0966, 0.0971]
    without, sigma = size_of_disc(0.1, known(good, 3e-4), 0)
    with_it, _ = size_of_disc(0.1, known([*good, 0.06], 3e-4), 0)
    assert with_it == pytest.approx(without, abs=0.5 * sigma)
