"""The best centres, and the map they are the peaks of, against plain computations of the same."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import detect.circles
from camera import Camera, parse_camera, read_camera
from detect.circles import detect_circles, disc_shape
from detect.discs.candidates import Centres, best_centres, local_maxima
from detect.discs.quality import quality_of_centres
from detect.errors import FrameError
from detect.settings import REPORT, CircleSettings, Polarity
from lut import DiscShape, DiscTable, build_disc_table
from tests.camera.strategies import cameras
from tests.conftest import PUBLISHED_CAM
from tests.reference.centres import (
    PlainOutlines,
    plain_best_centres,
    plain_outlines,
    plain_quality,
)

GreyImage = NDArray[np.uint8]
Found = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float32]] | Centres

PUBLISHED_CAMERA = parse_camera(PUBLISHED_CAM)
#: An eighth of it: outlines leave the image everywhere.
SMALL_CAMERA = dataclasses.replace(
    PUBLISHED_CAMERA, width=96, height=36, scale_x=464.762 / 8,
    scale_y=232.381 / 8, offset_x=48.0, offset_y=18.0,
)  # fmt: skip
POLARITIES: list[Polarity] = ["any", "light", "dark"]
KINDS = ["random", "binary", "saturated", "constant", "nearly constant", "blocks", "stripes"]


def image_of(kind: str, shape: tuple[int, int], seed: int = 0) -> GreyImage:
    rng = np.random.default_rng(seed)
    if kind == "random":
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if kind == "binary":
        return rng.choice(np.array([0, 255], np.uint8), shape)
    if kind == "saturated":
        return np.clip(rng.normal(255, 40, shape), 0, 255).astype(np.uint8)
    if kind == "constant":
        return np.full(shape, rng.integers(0, 256), np.uint8)
    if kind == "nearly constant":
        image = np.full(shape, 200, np.uint8)
        image[rng.integers(0, shape[0], 9), rng.integers(0, shape[1], 9)] = 201
        return image
    if kind == "stripes":
        return np.tile(rng.choice(np.array([0, 255], np.uint8), (shape[0], 1)), shape[1])
    assert kind == "blocks"
    few = rng.integers(0, 256, (shape[0] // 4 + 1, shape[1] // 8 + 1), dtype=np.uint8)
    return np.kron(few, np.ones((4, 8), np.uint8))[: shape[0], : shape[1]].copy()


@lru_cache(maxsize=8)
def both(camera: Camera, shape: DiscShape) -> tuple[DiscTable, PlainOutlines]:
    table = build_disc_table(camera, shape)
    return table, plain_outlines(camera, shape, table.usable)


def assert_same(found: Found, expected: Found) -> None:
    for left, right in zip(found, expected):
        np.testing.assert_array_equal(left, right, strict=True)


# -- the small camera, and any other --------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("samples", [3, 4, 5, 8, 13, 16, 30, 64, 128])
def test_the_best_centres_are_those_of_a_plain_computation(samples: int, kind: str) -> None:
    shape = DiscShape(0.2, 0.5, samples=samples, border_px=0, far_limit_m_per_px=0.5)
    table, outlines = both(SMALL_CAMERA, shape)
    voting = table.votes.sum(axis=0)
    assert np.any((voting > 0) & (voting < 2 * samples)) or samples < 4
    image = image_of(kind, (36, 96), seed=samples)
    quality, contrast = quality_of_centres(image, table)
    expected_quality, expected_contrast = plain_quality(image, outlines)
    np.testing.assert_array_equal(quality, expected_quality)
    np.testing.assert_array_equal(contrast, expected_contrast)
    for threshold in (0.05, 0.4, 0.6, 1.0):
        for polarity in POLARITIES:
            expected = plain_best_centres(image, outlines, threshold, polarity)
            assert_same(best_centres(image, table, threshold, polarity), expected)


def test_the_cases_above_have_maxima_plateaus_and_both_polarities() -> None:
    shape = DiscShape(0.2, 0.5, samples=16, border_px=0, far_limit_m_per_px=0.5)
    _, outlines = both(SMALL_CAMERA, shape)
    maxima = {
        (kind, polarity): len(
            plain_best_centres(image_of(kind, (36, 96), 16), outlines, 0.05, polarity)[0]
        )
        for kind in KINDS
        for polarity in POLARITIES
    }
    assert maxima["constant", "any"] == 0
    for kind in set(KINDS) - {"constant"}:
        assert maxima[kind, "any"] > 0
    assert maxima["random", "light"] > 10
    assert maxima["random", "dark"] > 10
    quality, _ = plain_quality(image_of("stripes", (36, 96), 16), outlines)
    assert np.count_nonzero((quality[:, 1:] == quality[:, :-1]) & (quality[:, 1:] > 0.05)) > 100


@settings(deadline=None)
@given(
    cameras(largest_side=90, down_deg=(10.0, 90.0)),
    st.integers(3, 24),
    st.sampled_from(KINDS),
    st.integers(0, 2**32 - 1),
    st.sampled_from(POLARITIES),
    st.data(),
)
def test_any_camera_image_and_threshold(
    camera: Camera, samples: int, kind: str, seed: int, polarity: Polarity, data: st.DataObject
) -> None:
    middle_m = float(np.nan_to_num(np.abs(np.diff(camera.floor_from_pixel(
        [[camera.width / 2, camera.height / 2], [camera.width / 2 + 1, camera.height / 2]]
    ), axis=0)).max(), nan=0.1))  # fmt: skip
    shape = DiscShape(
        middle_m, 3.0 * middle_m, samples=samples, border_px=0, far_limit_m_per_px=10.0 * middle_m
    )
    table, outlines = both(camera, shape)
    image = image_of(kind, (camera.height, camera.width), seed)
    quality, contrast = quality_of_centres(image, table)
    plain, plain_contrast = plain_quality(image, outlines)
    # Where a sample falls on the border of two pixels, rounding decides.
    assume(np.array_equal(quality, plain) or _samples_are_clear(camera, shape, table))
    np.testing.assert_array_equal(quality, plain)
    np.testing.assert_array_equal(contrast, plain_contrast)
    # A threshold that is reached exactly is the hardest.
    reached = np.unique(plain[plain > 0.0])
    choices = st.floats(0.01, 1.0)
    if len(reached):
        choices |= st.sampled_from(reached.tolist())
        choices |= st.sampled_from(np.nextafter(reached, 2.0).tolist())
    threshold = min(1.0, data.draw(choices))
    expected = plain_best_centres(image, outlines, threshold, polarity)
    event(f"maxima: {min(len(expected[0]), 3)}")
    assert_same(best_centres(image, table, threshold, polarity), expected)


def _samples_are_clear(camera: Camera, shape: DiscShape, table: DiscTable) -> bool:
    from lut import ring

    rows, columns = np.nonzero(table.usable)
    rings = np.concatenate(
        [ring(radius, shape.samples) for radius in (shape.inner_radius_m, shape.outer_radius_m)]
    )
    centres = camera.floor_from_pixel(np.stack([columns, rows], axis=-1).astype(float))
    seen = camera.project_floor(centres[:, None] + rings) + 0.5
    return bool(np.nanmin(np.abs(seen - np.rint(seen)), initial=1.0) > 1e-9)


@pytest.mark.parametrize("kind", ["random", "nearly constant", "blocks"])
def test_a_threshold_that_is_reached_exactly_is_enough(kind: str) -> None:
    shape = DiscShape(0.2, 0.5, samples=16, border_px=0, far_limit_m_per_px=0.5)
    table, outlines = both(SMALL_CAMERA, shape)
    image = image_of(kind, (36, 96), seed=3)
    quality, _ = plain_quality(image, outlines)
    peaks = plain_best_centres(image, outlines, 0.05)[1]
    assert len(peaks) > 3
    for threshold in np.unique(peaks)[:: max(1, len(peaks) // 20)]:
        for just_above in (threshold, float(np.nextafter(threshold, 2.0))):
            found = best_centres(image, table, just_above)[1]
            columns, rows = local_maxima(quality, just_above)
            np.testing.assert_array_equal(found, quality[rows, columns])
        assert threshold in best_centres(image, table, threshold)[1]
        assert threshold not in found


# -- the published camera -------------------------------------------------------------------------


def demo_images(project_root: Path) -> list[GreyImage]:
    paths = sorted((project_root / "images" / "e" / "images").glob("*.jpg"))[3::25]
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    assert len(images) > 2
    return [np.asarray(image, np.uint8) for image in images if image is not None]


@pytest.mark.long
@pytest.mark.parametrize("preset", [REPORT, CircleSettings()], ids=["report", "default"])
def test_maps_and_best_centres_at_full_size(preset: CircleSettings, project_root: Path) -> None:
    table, outlines = both(PUBLISHED_CAMERA, disc_shape(preset))
    assert np.count_nonzero(outlines.index == 288 * 768) > 1000
    images = demo_images(project_root)
    images += [image_of(kind, (288, 768)) for kind in ("random", "binary", "saturated", "blocks")]
    count = 0
    for image in images:
        quality, contrast = quality_of_centres(image, table)
        expected_quality, expected_contrast = plain_quality(image, outlines)
        np.testing.assert_array_equal(quality, expected_quality)
        np.testing.assert_array_equal(contrast, expected_contrast)
        for polarity in POLARITIES:
            expected = plain_best_centres(image, outlines, preset.threshold, polarity)
            assert_same(best_centres(image, table, preset.threshold, polarity), expected)
            count += len(expected[0])
    assert count > 100


@pytest.mark.parametrize("preset", [REPORT, CircleSettings()], ids=["report", "default"])
def test_landmarks_are_those_of_plain_centres(
    preset: CircleSettings, project_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    preset = dataclasses.replace(preset, rows_apart=0.0)
    table, outlines = both(PUBLISHED_CAMERA, disc_shape(preset))
    image = demo_images(project_root)[0]
    found = detect_circles(image, PUBLISHED_CAMERA, table, preset)
    assert len(found) > 5

    def plain(
        image: GreyImage,
        table: DiscTable,
        threshold: float,
        polarity: Polarity,
        rows: object = None,
        votes: object = None,
    ) -> Centres:
        pixels, quality, contrast = plain_best_centres(image, outlines, threshold, polarity)
        return Centres(pixels, quality, contrast, quality)

    monkeypatch.setattr(detect.circles, "best_centres", plain)
    expected = detect_circles(image, PUBLISHED_CAMERA, table, preset)
    for field in dataclasses.fields(expected):
        left, right = getattr(found, field.name), getattr(expected, field.name)
        np.testing.assert_array_equal(left, right, strict=True)


@pytest.mark.long
@pytest.mark.parametrize("group", ["asym", "rct", "robvis", "sym"])
def test_photographs(group: str, shared_data: Path) -> None:
    folder = min((shared_data / "discs" / "dev").glob(f"{group}_*"))
    (path,) = (folder / "images").iterdir()
    camera = read_camera(folder / f"{folder.name}.cam")
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    table, outlines = both(camera, disc_shape(REPORT))
    expected = plain_best_centres(image, outlines, 0.6)
    assert len(expected[0]) > 30
    assert_same(best_centres(image, table, 0.6), expected)


def test_more_centres_than_there_is_room_for_at_a_time() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    image = image_of("random", (288, 768))
    quality, contrast = quality_of_centres(image, table)
    for threshold in (1e-9, 0.1):
        assert np.count_nonzero(quality >= threshold) > 2 * 4096
        columns, rows = local_maxima(quality, threshold)
        expected = np.stack([columns, rows], axis=-1), quality[rows, columns]
        assert_same(best_centres(image, table, threshold), (*expected, contrast[rows, columns]))


@pytest.mark.long
def test_an_image_of_eight_megapixels() -> None:
    camera = dataclasses.replace(
        PUBLISHED_CAMERA, width=4608, height=1728, scale_x=464.762 * 6,
        scale_y=232.381 * 6, offset_x=384.0 * 6, offset_y=144.0 * 6,
    )  # fmt: skip
    shape = DiscShape(samples=5, border_px=72, far_limit_m_per_px=0.05 / 6)
    table = build_disc_table(camera, shape)
    assert np.count_nonzero(table.usable) > 4_000_000
    some = table.usable & (np.random.default_rng(2).random(table.usable.shape) < 0.02)
    outlines = plain_outlines(camera, shape, some)
    image = np.kron(image_of("random", (432, 1152)), np.ones((4, 4), np.uint8))
    quality, contrast = quality_of_centres(image, table)
    expected_quality, expected_contrast = plain_quality(image, outlines)
    np.testing.assert_array_equal(quality[some], expected_quality[some])
    np.testing.assert_array_equal(contrast[some], expected_contrast[some])
    columns, rows = local_maxima(quality, 0.6)
    assert len(columns) > 1000
    expected = np.stack([columns, rows], axis=-1), quality[rows, columns], contrast[rows, columns]
    assert_same(best_centres(image, table, 0.6), expected)


# -- what goes in ---------------------------------------------------------------------------------


def test_tables_of_very_large_images_are_worked_on_alike() -> None:
    # Their copies have 64 bits.
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    wide = dataclasses.replace(table, copies=table.copies.astype(np.uint64))
    image = image_of("blocks", (288, 768))
    assert_same(best_centres(image, wide, 0.3), best_centres(image, table, 0.3))


def test_an_image_whose_memory_is_not_contiguous_or_read_only_is_the_same_image() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    image = image_of("blocks", (288, 768))
    expected = best_centres(image, table, 0.3)
    fixed = image.copy()
    fixed.setflags(write=False)
    for other in (np.asfortranarray(image), np.repeat(image, 2, axis=1)[:, ::2], fixed):
        assert_same(best_centres(other, table, 0.3), expected)
    assert np.array_equal(image, image_of("blocks", (288, 768)))


def test_threads_do_not_disturb_each_other() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    images = [image_of("blocks", (288, 768), seed) for seed in range(12)]
    expected = [best_centres(image, table, 0.3) for image in images]
    assert len({len(found[0]) for found in expected}) > 3
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            for found, right in zip(
                pool.map(lambda i: best_centres(i, table, 0.3), images), expected
            ):
                assert_same(found, right)


def test_only_what_comes_before_the_first_source_does_not_matter() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    image = image_of("random", (288, 768))
    first = table.first_source
    assert first > 768
    before, at = image.copy(), image.copy()
    before.reshape(-1)[:first] ^= 255
    at.reshape(-1)[first] ^= 128
    expected = quality_of_centres(image, table)[0]
    np.testing.assert_array_equal(quality_of_centres(before, table)[0], expected)
    assert not np.array_equal(quality_of_centres(at, table)[0], expected)


def test_an_empty_table_finds_nothing() -> None:
    nothing = build_disc_table(SMALL_CAMERA, DiscShape(far_limit_m_per_px=1e-9))
    pixels, quality, contrast, _ = best_centres(image_of("random", (36, 96)), nothing, 0.1)
    assert (pixels.shape, quality.shape, contrast.shape) == ((0, 2), (0,), (0,))
    assert pixels.dtype == np.int64
    assert contrast.dtype == np.float32


@pytest.mark.parametrize(
    ("image", "complaint"),
    [
        (np.zeros((36, 95), np.uint8), r"uint8 of shape \(36, 95\): the table is for uint8 of"),
        (np.zeros((36, 96, 1), np.uint8), r"uint8 of shape \(36, 96, 1\): the table is for"),
        (np.zeros((36, 96)), r"float64 of shape \(36, 96\): the table is for uint8 of shape"),
    ],
)
def test_an_image_that_is_not_the_table_s_is_refused(image: Any, complaint: str) -> None:
    shape = DiscShape(0.2, 0.5, samples=16, border_px=0, far_limit_m_per_px=0.5)
    table, _ = both(SMALL_CAMERA, shape)
    with pytest.raises(FrameError, match=complaint):
        best_centres(image, table, 0.5)
    with pytest.raises(FrameError, match=complaint):
        quality_of_centres(image, table)
