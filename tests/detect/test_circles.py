"""The disc detector on images whose discs are known exactly."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera
from detect.circles import (
    CircleDetections,
    detect_circles,
    disc_shape,
    disc_table,
)
from detect.errors import DetectError, FrameError
from detect.lines import detect_lines
from detect.projection import circle_on_floor
from detect.settings import REPORT, CircleSettings, Polarity
from lut import DiscTable, VoteTable, build_vertical_table, cached_disc_table
from tests.detect.line_scene import mirrored
from tests.detect.painted_floor import DARK, LIGHT, SHAPES, PaintedFloor
from tools.detector_maps import quality_of_centres
from tools.evaluation.accuracy import measure_accuracy

FloatArray = NDArray[np.float64]

DEFAULT = CircleSettings(tilt_sigma_deg=0.0)

#: Near and far, left and right, no two in each other's outlines.
PLACES = np.array(
    [(0.0, -1.0), (0.5, -1.3), (-0.6, -1.7), (0.9, -2.2), (-0.2, -2.6), (1.0, -3.2), (-1.1, -3.3)]
)
LIGHT_ONES = np.array([0, 2, 3, 5])
DARK_ONES = np.array([1, 4, 6])


@lru_cache(maxsize=8)
def table_of(camera: Camera, settings: CircleSettings) -> VoteTable | DiscTable:
    return disc_table(camera, settings)


def detect(
    image: NDArray[np.uint8], camera: Camera, settings: CircleSettings = DEFAULT
) -> CircleDetections:
    return detect_circles(image, camera, table_of(camera, settings), settings)


@pytest.fixture(scope="module")
def discs_image(published_camera: Camera) -> NDArray[np.uint8]:
    floor = PaintedFloor(published_camera)
    for number, place in enumerate(PLACES):
        floor.disc(place, LIGHT if number in LIGHT_ONES else DARK)
    return floor.image()


def assert_found_once(found: CircleDetections, places: FloatArray, within_m: float) -> None:
    """One row for each place and no other."""
    distance = np.linalg.norm(found.floor_xy[:, None] - places, axis=-1)
    assert len(found) == len(places)
    assert sorted(distance.argmin(axis=1)) == list(range(len(places)))
    assert distance.min(axis=1).max() <= within_m


# -- what is found --------------------------------------------------------------------------


def test_discs_are_found_where_they_are(
    discs_image: NDArray[np.uint8], published_camera: Camera
) -> None:
    found = detect(discs_image, published_camera)
    assert_found_once(found, PLACES, within_m=0.002)
    order = found.pixels[:, 1] * published_camera.width + found.pixels[:, 0]
    assert np.all(np.diff(order) > 0)
    pixel_xy = published_camera.floor_from_pixel(found.pixels)
    assert np.linalg.norm(pixel_xy - found.floor_xy, axis=1).max() < 0.06
    assert np.all((found.quality >= DEFAULT.threshold) & (found.quality <= 1.0))
    assert np.all(found.evidence >= DEFAULT.evidence)


def test_covariances_of_refined_discs_fit_their_errors(
    discs_image: NDArray[np.uint8], published_camera: Camera
) -> None:
    found = detect(discs_image, published_camera)
    nearest = np.linalg.norm(found.floor_xy[:, None] - PLACES, axis=-1).argmin(axis=1)
    error = found.floor_xy - PLACES[nearest]
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0)
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    # 14 degrees of freedom: outside of 2 and 43 with a probability of 1e-4 on either side; there is
    # none of the tilt that the covariances allow for.
    assert 1.0 < normalised.sum() < 43.0


@pytest.mark.parametrize(
    ("polarity", "wanted"), [("light", LIGHT_ONES), ("dark", DARK_ONES), ("any", np.arange(7))]
)
@pytest.mark.parametrize("refine", [True, False])
def test_polarity_chooses(
    discs_image: NDArray[np.uint8],
    published_camera: Camera,
    polarity: Polarity,
    wanted: NDArray[np.int64],
    refine: bool,
) -> None:
    asked = replace(DEFAULT, polarity=polarity, refine=refine)
    found = detect(discs_image, published_camera, asked)
    assert_found_once(found, PLACES[wanted], within_m=0.002 if refine else 0.06)


def test_published_detector_obeys_polarity(
    discs_image: NDArray[np.uint8], published_camera: Camera
) -> None:
    rows = {
        polarity: {
            tuple(pixel)
            for pixel in detect(
                discs_image, published_camera, replace(REPORT, polarity=polarity)
            ).pixels.tolist()
        }
        for polarity in ("any", "light", "dark")
    }
    assert rows["light"]
    assert rows["dark"]
    assert not rows["light"] & rows["dark"]
    assert rows["any"] == rows["light"] | rows["dark"]


def test_suppression_alone_makes_one_disc_one_row(
    discs_image: NDArray[np.uint8], published_camera: Camera
) -> None:
    plain = replace(REPORT, separation=1.4)
    found = detect(discs_image, published_camera, plain)
    assert_found_once(found, PLACES, within_m=0.06)
    assert len(detect(discs_image, published_camera, REPORT)) > len(PLACES)


@pytest.mark.parametrize(
    ("pixel", "grey", "within_m"),
    [((380.0, 276.0), LIGHT, 0.005), ((14.0, 200.0), DARK, 0.01), ((753.0, 200.0), DARK, 0.01)],
    ids=["lower", "left", "right"],
)
def test_disc_partly_behind_a_border(
    published_camera: Camera, pixel: tuple[float, float], grey: float, within_m: float
) -> None:
    """The lower one is as near as centres may be: 12 px above the border, which cuts it."""
    place = published_camera.floor_from_pixel(np.array(pixel))
    outline = published_camera.project_floor(circle_on_floor(place, 0.10, 64))
    size = (published_camera.width, published_camera.height)
    assert np.any((outline < 0.0) | (outline > np.array(size) - 1.0))
    image = PaintedFloor(published_camera).disc(place, grey).image()
    assert_found_once(detect(image, published_camera), place[None], within_m=within_m)


@settings(max_examples=15)
@given(
    x=st.floats(-0.8, 0.8),
    y=st.floats(-3.0, -0.95),
    grey=st.sampled_from([20.0, 50.0, 140.0, 240.0]),
    blur=st.floats(0.4, 1.2),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_disc_anywhere_is_one_row(
    published_camera: Camera, x: float, y: float, grey: float, blur: float, seed: int
) -> None:
    image = PaintedFloor(published_camera).disc((x, y), grey, blur_px=blur).image(seed=seed)
    assert_found_once(detect(image, published_camera), np.array([[x, y]]), within_m=0.006)


# -- what is not found ----------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.5, 2.0, 8.0, 25.0])
def test_nothing_on_a_bare_floor(published_camera: Camera, noise: float) -> None:
    floor = PaintedFloor(published_camera)
    for seed in range(8):
        assert len(detect(floor.image(noise, seed), published_camera)) == 0


@pytest.mark.parametrize("preset", [DEFAULT, REPORT], ids=["default", "published"])
@pytest.mark.parametrize("grey", [0, 1, 128, 254, 255])
def test_nothing_in_an_even_image(
    published_camera: Camera, grey: int, preset: CircleSettings
) -> None:
    image = np.full((published_camera.height, published_camera.width), grey, np.uint8)
    found = detect(image, published_camera, preset)
    assert len(found) == 0
    assert found.pixels.shape == found.floor_xy.shape == (0, 2)
    assert found.covariance.shape == (0, 2, 2)


def test_a_light_disc_in_a_saturated_image_cannot_be_seen(published_camera: Camera) -> None:
    floor = PaintedFloor(published_camera, floor=270.0)
    assert len(detect(floor.disc((0.2, -1.5), 300.0).image(), published_camera)) == 0


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("place", [(0.2, -1.1), (-0.4, -1.8), (0.1, -2.4)])
def test_what_is_no_disc_is_not_reported(
    published_camera: Camera, shape: str, place: tuple[float, float]
) -> None:
    """Beside each a true disc, which is."""
    disc = np.array([place[0] - 0.7, place[1]])
    floor = PaintedFloor(published_camera).shape(place, SHAPES[shape]).disc(disc)
    assert_found_once(detect(floor.image(), published_camera), disc[None], within_m=0.004)


def test_large_discs_on_a_floor_with_texture() -> None:
    """Their rims are 80 to 150 pixels wide, the grains of the floor some."""
    pose = (-1.0, 0.0, 0.0, 0.0), (0.0, 0.7071, -0.7071, 0.0), (0.0, -0.7071, -0.7071, 1.2)
    camera = Camera(960, 720, 900.0, 900.0, 479.5, 359.5, (0.0,) * 5, pose)
    places = np.array([(0.0, -1.15), (-0.35, -0.85), (0.45, -1.4), (-0.45, -1.5), (0.1, -2.2)])
    floor = PaintedFloor(camera)
    for place in places:
        floor.disc(place, radius_m=0.15)
    noise = np.random.default_rng(0).normal(size=floor.grey.shape)
    floor.grey += 60.0 * scipy.ndimage.gaussian_filter(noise, 1.5)
    assert_found_once(detect(floor.image(), camera, CircleSettings(radius_m=0.15)), places, 1e-3)


def test_discs_larger_than_the_image() -> None:
    pose = (-1.0, 0.0, 0.0, 0.0), (0.0, 0.7071, -0.7071, 0.0), (0.0, -0.7071, -0.7071, 0.1)
    camera = Camera(96, 40, 60.0, 60.0, 48.0, 20.0, (0.0,) * 5, pose)
    image = np.random.default_rng(0).integers(0, 256, (40, 96), np.uint8)
    assert len(detect(image, camera, CircleSettings(radius_m=5.0))) == 0


def test_verification_is_what_drops_the_square(published_camera: Camera) -> None:
    image = PaintedFloor(published_camera).shape((0.2, -1.1), SHAPES["square"]).image()
    assert len(detect(image, published_camera, replace(DEFAULT, refine=False))) >= 1
    assert len(detect(image, published_camera)) == 0


def test_noise_floor_drops_what_is_hardly_there(published_camera: Camera) -> None:
    place = np.array([(0.1, -1.2)])
    image = PaintedFloor(published_camera).disc(place[0], 100.0).image(noise=2.0)
    assert_found_once(detect(image, published_camera), place, within_m=0.02)
    assert len(detect(image, published_camera, replace(DEFAULT, noise_floor=10.0))) == 0


def test_image_of_another_size_is_refused(published_camera: Camera) -> None:
    with pytest.raises(FrameError, match="768x576 px: the calibration is for 768x288"):
        detect(np.zeros((576, 768), np.uint8), published_camera)


# -- the published detector -----------------------------------------------------------------


def test_published_rows_are_pixels(
    discs_image: NDArray[np.uint8], published_camera: Camera
) -> None:
    found = detect(discs_image, published_camera, REPORT)
    table = cached_disc_table(published_camera, disc_shape(REPORT))
    quality, _ = quality_of_centres(discs_image, table)
    columns, rows = found.pixels.T
    assert np.issubdtype(found.pixels.dtype, np.integer)
    np.testing.assert_array_equal(found.floor_xy, published_camera.floor_from_pixel(found.pixels))
    np.testing.assert_array_equal(found.quality, quality[rows, columns])
    assert np.all(np.isnan(found.evidence))
    order = rows * published_camera.width + columns
    assert np.all(np.diff(order) > 0)
    # 0.6 at least, and none of the 8 neighbours higher: all such pixels, and no others.
    highest = quality == scipy.ndimage.maximum_filter(quality, size=3, mode="constant")
    expected = np.flatnonzero((highest & (quality >= 0.6)).ravel())
    np.testing.assert_array_equal(order, expected)


# -- laws -----------------------------------------------------------------------------------

FLIP = np.diag([-1.0, 1.0])


def image_and_mirror_image(
    camera: Camera, shift: float, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    floor = PaintedFloor(camera)
    for number, place in enumerate(PLACES):
        floor.disc(place + np.array([shift, 0.0]), LIGHT if number in LIGHT_ONES else DARK)
    image = floor.image(noise=2.0, seed=seed)
    return image, np.ascontiguousarray(image[:, ::-1])


def mirrored_rows(found: CircleDetections, width: int) -> CircleDetections:
    """The rows of the mirrored world, in scan order."""
    pixels = np.stack([width - 1 - found.pixels[:, 0], found.pixels[:, 1]], axis=-1)
    order = np.lexsort((pixels[:, 0], pixels[:, 1]))
    return CircleDetections(
        pixels=pixels[order],
        floor_xy=found.floor_xy[order] @ FLIP,
        covariance=FLIP @ found.covariance[order] @ FLIP,
        quality=found.quality[order],
        evidence=found.evidence[order],
    )


@settings(max_examples=6, phases=[Phase.explicit, Phase.generate])
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-0.2, 0.2))
def test_mirrored_image_and_camera_give_mirrored_rows(
    published_camera: Camera, seed: int, shift: float
) -> None:
    """An even number of samples from +X on is its own mirror image, and so is every row.

    But for what depends on the scan's direction: half pixels are rounded up (no sample of the
    published camera lies that near to one), of neighbours of equal quality the first is reported
    (such images are passed over), and the border's limits are 12 px and 13 px.
    """
    image, mirror_image = image_and_mirror_image(published_camera, shift, seed)
    width = published_camera.width
    quality, _ = quality_of_centres(image, cached_disc_table(published_camera, disc_shape(REPORT)))
    found = detect(image, published_camera, REPORT)
    for u, v in found.pixels:
        around = quality[v - 1 : v + 2, u - 1 : u + 2]
        assume(np.count_nonzero(around == quality[v, u]) == 1)
    back = mirrored_rows(detect(mirror_image, mirrored(published_camera), REPORT), width)
    a, b = ((rows.pixels[:, 0] > 13) & (rows.pixels[:, 0] < width - 14) for rows in (found, back))
    assert np.count_nonzero(a) >= len(PLACES)
    np.testing.assert_array_equal(back.pixels[b], found.pixels[a])
    np.testing.assert_array_equal(back.quality[b], found.quality[a])
    np.testing.assert_allclose(back.floor_xy[b], found.floor_xy[a], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(back.covariance[b], found.covariance[a], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_mirrored_discs_are_refined_alike(published_camera: Camera, seed: int) -> None:
    """The fit's pixels depend a little on the scan's direction: less than the fit is worth."""
    image, mirror_image = image_and_mirror_image(published_camera, 0.03 * seed, seed)
    found = detect(image, published_camera)
    back = mirrored_rows(detect(mirror_image, mirrored(published_camera)), published_camera.width)
    assert len(found) == len(back) == len(PLACES)
    distance = np.linalg.norm(found.floor_xy[:, None] - back.floor_xy, axis=-1)
    partner = distance.argmin(axis=1)
    assert sorted(partner) == list(range(len(PLACES)))
    moved = distance.min(axis=1)
    deviation = np.sqrt(np.linalg.eigvalsh(found.covariance)[:, 0])
    assert np.all(moved < deviation)
    assert moved.max() < 1e-4
    largest = np.abs(found.covariance).max(axis=(1, 2))
    turned = np.abs(back.covariance[partner] - found.covariance).max(axis=(1, 2))
    # Of a large disc, other pixels are taken from the other side, and what states the smaller
    # covariance, fit or rim, places it.
    assert np.all(turned < 2.0 * largest)
    np.testing.assert_allclose(back.quality[partner], found.quality, rtol=0.0, atol=0.02)


# -- accuracy -------------------------------------------------------------------------------


@pytest.mark.long
def test_refined_discs_are_accurate_and_their_covariance_honest(published_camera: Camera) -> None:
    result = measure_accuracy(published_camera, DEFAULT, discs=200, seed=4)
    assert result.failed <= 2  # four rows high, and alone in their images
    assert np.sqrt(np.mean(result.error_px**2)) <= 0.02
    assert 0.5 <= float(np.mean(result.normalised_error)) <= 1.5


def test_a_table_that_is_not_that_of_camera_and_settings_is_refused(
    published_camera: Camera,
) -> None:
    image = np.zeros((published_camera.height, published_camera.width), np.uint8)
    lower = replace(published_camera, scale_x=published_camera.scale_x + 1.0)
    tables: dict[str, Any] = {
        "VoteTable": table_of(published_camera, DEFAULT),
        "DiscTable": table_of(published_camera, REPORT),
        "VerticalTable": build_vertical_table(published_camera),
    }
    for camera, asked, names in (
        (published_camera, DEFAULT, ("DiscTable", "VerticalTable")),
        (published_camera, REPORT, ("VoteTable", "VerticalTable")),
        (published_camera, replace(DEFAULT, radius_m=0.06), tables),
        (published_camera, replace(REPORT, radius_m=0.06), tables),
        (lower, DEFAULT, tables),
    ):
        for name in names:
            with pytest.raises(DetectError, match=f"the {name} is for another"):
                detect_circles(image, camera, tables[name], asked)
    with pytest.raises(DetectError, match="a VoteTable: expected a VerticalTable"):
        detect_lines(image, tables["VoteTable"])


@pytest.mark.parametrize("radius_m", [1, np.float32(1.0), np.int64(1), np.array(1.0)])
def test_numbers_of_other_types_are_the_same_settings(
    published_camera: Camera, radius_m: Any
) -> None:
    image = np.zeros((published_camera.height, published_camera.width), np.uint8)
    settings = CircleSettings(radius_m=radius_m)
    assert type(settings.radius_m) is float
    assert len(detect(image, published_camera, settings)) == 0
