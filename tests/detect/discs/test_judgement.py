"""Discs beside sun patches and glare, and under cables, against the truth; and what is no disc."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from camera.kernels import camera_numbers
from camera.model_checks import checked_pose
from detect.circles import CircleDetections, candidates_of, classify, detect_circles, scene_of
from detect.discs.evidence import paleness_penalty, sign_penalty
from detect.discs.hough import HoughCandidates
from detect.discs.judgement import SPARSE_RADII, Outcome, sparse_profiles
from detect.settings import CircleSettings
from lut import VoteTable
from tests.detect.painted_floor import DARK, FLOOR, LIGHT, SHAPES, PaintedFloor, Shape

SETTINGS = CircleSettings(polarity="light")
PLACES = np.array([(0.3, -2.0), (-0.5, -2.6), (0.5, -3.2)])
#: Of the sun on the floor.
SUN = 255.0


def beside(angle: float) -> Shape:
    """A patch that touches the disc's rim over nearly a quarter of it."""
    cos, sin = np.cos(angle), np.sin(angle)

    def inside(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        along, across = cos * x + sin * y, cos * y - sin * x
        outside_disc = np.hypot(x, y) > 0.1
        return np.asarray(outside_disc & (along > 0.075) & (along < 0.25) & (abs(across) < 0.2))

    return inside


def found_at(found: CircleDetections, place: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*(found.floor_xy - place).T))


@pytest.mark.parametrize("place", PLACES[:2])
def test_a_disc_that_a_sun_patch_touches_is_a_row(
    published_camera: Camera, table: VoteTable, place: NDArray[np.float64]
) -> None:
    rows = 0
    for seed, angle in enumerate(np.arange(8) * np.pi / 4.0):
        floor = PaintedFloor(published_camera).disc(place, LIGHT).shape(place, beside(angle), SUN)
        found = detect_circles(floor.image(seed=seed), published_camera, table, SETTINGS)
        distance = found_at(found, place)
        rows += bool((distance < 0.03).any())
        assert (distance < 0.14).sum() <= 1
    assert rows >= 7


def test_a_disc_with_a_leg_on_its_middle_is_a_row(
    published_camera: Camera, table: VoteTable
) -> None:
    """Only beside the leg is the disc seen: in most directions its middle is dark."""
    found_here = 0
    for seed in range(8):
        place, lean = PLACES[seed % 2], 0.1 * (seed - 4)

        def leg(
            x: NDArray[np.float64], y: NDArray[np.float64], lean: float = lean
        ) -> NDArray[np.bool_]:
            return np.asarray((abs(x + lean * y) < 0.055) & (y < 0.085))

        def on_disc(
            x: NDArray[np.float64], y: NDArray[np.float64], leg: Shape = leg
        ) -> NDArray[np.bool_]:
            return np.asarray(leg(x, y) & (np.hypot(x, y) < 0.1))

        # What is painted adds up.
        floor = PaintedFloor(published_camera).disc(place, LIGHT).shape(place, leg, DARK)
        floor.shape(place, on_disc, FLOOR - (LIGHT - FLOOR))
        found = detect_circles(floor.image(seed=seed), published_camera, table, SETTINGS)
        found_here += bool((found_at(found, place) < 0.03).any())
    assert found_here >= 7


CLEAR_PLACES = [(-0.3, -1.4), (0.4, -1.5), (-0.9, -2.2)]


@pytest.mark.parametrize("dark", [(), (0,), (0, 1)])
def test_without_a_polarity_discs_of_both_signs_are_found(
    published_camera: Camera, table: VoteTable, dark: tuple[int, ...]
) -> None:
    place = PLACES[0]
    found_here = 0
    for seed, angle in enumerate(np.arange(8) * np.pi / 4.0):
        floor = PaintedFloor(published_camera).disc(place, LIGHT).shape(place, beside(angle), SUN)
        for k, other in enumerate(CLEAR_PLACES):
            floor.disc(other, DARK if k in dark else LIGHT)
        image = floor.image(seed=seed)
        found = detect_circles(image, published_camera, table, CircleSettings())
        assert all(found_at(found, np.array(other)).min() < 0.01 for other in CLEAR_PLACES)
        found_here += bool((found_at(found, place) < 0.03).any())
    assert found_here >= 7


@pytest.mark.parametrize("shape", ["square", "ring", "small disc"])
def test_what_is_no_disc_stays_out_beside_a_sun_patch(
    published_camera: Camera, table: VoteTable, shape: str
) -> None:
    for seed, place in enumerate(PLACES):
        floor = PaintedFloor(published_camera).shape(place, SHAPES[shape], LIGHT)
        floor.shape(place, beside(seed), FLOOR + 40.0)
        found = detect_circles(floor.image(seed=seed), published_camera, table, SETTINGS)
        assert not (found_at(found, place) < 0.1).any()


def test_a_pool_of_light_is_no_disc(published_camera: Camera, table: VoteTable) -> None:
    floor = PaintedFloor(published_camera)
    v, u = np.mgrid[: published_camera.height, : published_camera.width]
    for place in PLACES:
        at = published_camera.project_floor(place)
        floor.grey += 120.0 * np.exp(-0.5 * (((u - at[0]) / 14.0) ** 2 + ((v - at[1]) / 7.0) ** 2))
    assert len(detect_circles(floor.image(), published_camera, table, SETTINGS)) == 0


@pytest.mark.parametrize(("light", "dark"), [(0, 0), (1, 0), (30, 0), (3, 5)])
def test_signs_are_as_likely_as_they_are_seen(light: int, dark: int) -> None:
    contrast = np.array([50.0] * light + [-50.0] * dark + [20.0, -20.0])
    sure = np.abs(contrast) > 30.0
    lost = sign_penalty(contrast, sure)[-2:]
    np.testing.assert_allclose(np.exp(-lost).sum(), 1.0)
    assert np.exp(-lost[0]) == pytest.approx((light + 1) / (light + dark + 2))


def lost(contrast: float, floor_grey: float, clear: int = 3) -> float:
    """What one more disc loses beside clear ones of 100 grey levels on a floor of 80."""
    contrasts = np.array([100.0] * clear + [contrast])
    floors = np.array([80.0] * clear + [floor_grey])
    losses = paleness_penalty(contrasts, floors, np.arange(clear + 1) < clear)
    assert (losses[:clear] == 0.0).all()
    return float(losses[clear])


def test_pale_discs_lose_the_more_the_paler_they_are() -> None:
    losses = [lost(contrast, 80.0) for contrast in (10.0, 20.0, 40.0, 60.0, 100.0, 150.0)]
    assert losses == sorted(losses, reverse=True)
    assert losses[0] > 6.0
    assert losses[3:] == [0.0, 0.0, 0.0]


def test_discs_in_shadow_are_not_pale_and_others_need_comparison() -> None:
    assert lost(25.0, 20.0) == pytest.approx(0.0)  # a quarter of the light, for disc and floor
    assert lost(25.0, 80.0) > 2.0
    assert lost(-25.0, 80.0) == 0.0  # none of its sign to compare with
    assert lost(25.0, 80.0, clear=1) == 0.0


@pytest.mark.parametrize(("others", "rows"), [([], 6), (CLEAR_PLACES, 0)])
def test_a_very_pale_disc_is_one_only_where_no_others_are_clear(
    published_camera: Camera, table: VoteTable, others: list[tuple[float, float]], rows: int
) -> None:
    found_here = 0
    for seed in range(6):
        floor = PaintedFloor(published_camera).disc(PLACES[0], FLOOR + 9.0, blur_px=1.0)
        for other in others:
            floor.disc(other, LIGHT)
        found = detect_circles(floor.image(seed=seed), published_camera, table, CircleSettings())
        found_here += bool((found_at(found, PLACES[0]) < 0.03).any())
    assert abs(found_here - rows) <= 1


@pytest.mark.parametrize(("row", "listed"), [(284.0, True), (287.0, True), (289.5, False)])
def test_a_disc_is_listed_if_its_centre_is_in_sight(
    published_camera: Camera, table: VoteTable, row: float, listed: bool
) -> None:
    place = published_camera.floor_from_pixel(np.array([400.0, row]))
    floor = PaintedFloor(published_camera).disc(place, LIGHT)
    for other in CLEAR_PLACES:
        floor.disc(other, LIGHT)
    for settings in (SETTINGS, CircleSettings()):
        found = detect_circles(floor.image(), published_camera, table, settings)
        assert (found_at(found, place) < 0.02).any() == listed
        assert len(found) == len(CLEAR_PLACES) + listed


def test_sparse_profiles_of_a_near_disc_follow_perspective(published_camera: Camera) -> None:
    pose = np.array(published_camera.robot_from_camera)
    pose[2, 3] = 0.25  # metres
    low = replace(published_camera, robot_from_camera=checked_pose("sensor2World", pose))
    place = (0.0, -0.4)
    image = PaintedFloor(low).disc(place, LIGHT).image(noise=0.0)
    [grey], scale = sparse_profiles(image, camera_numbers(low), np.array([place]), 0.1)
    assert scale.min() > 20.0  # pixels
    assert np.all(grey[:, SPARSE_RADII < 1.0] > 0.5 * (LIGHT + FLOOR))
    assert np.all(grey[:, SPARSE_RADII > 1.0] < 0.5 * (LIGHT + FLOOR))


def test_candidates_that_lead_to_one_rim_are_one_disc(
    published_camera: Camera, table: VoteTable
) -> None:
    """Each candidate again, shifted; in cluttered images some meet only when traced again."""
    rng = np.random.default_rng(1)
    judged = 0
    for seed in range(6):
        floor = PaintedFloor(published_camera)
        for place in PLACES:
            floor.disc(place, LIGHT)
        for place in rng.uniform([-1.2, -3.6], [1.2, -1.0], (60, 2)):
            floor.disc(place, rng.uniform(0.0, 255.0), rng.uniform(0.03, 0.13))
        scene = scene_of(floor.image(seed=seed), published_camera, table, SETTINGS)
        found = candidates_of(scene, table, SETTINGS)
        shifted = found.floor_xy + rng.uniform(-0.03, 0.03, found.floor_xy.shape)
        twice = HoughCandidates(
            np.concatenate([found.floor_xy, shifted]), np.tile(found.score, 2),
            np.tile(found.sign, 2),
        )  # fmt: skip
        rims = classify(scene, SETTINGS, twice)
        assert (rims.outcome == Outcome.SAME_RIM).any()
        place = rims.floor_xy[rims.outcome == Outcome.JUDGED]
        apart = np.hypot(*(place[:, None] - place).transpose(2, 0, 1))
        assert (apart[~np.eye(len(place), dtype=bool)] >= 0.01).all()
        judged += len(place)
    assert judged > 60
