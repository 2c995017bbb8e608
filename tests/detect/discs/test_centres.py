"""Quality and contrast of centres against exact arithmetic and plain computations of the same."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from camera import Camera, parse_camera
from detect.circles import detect_circles, disc_shape
from detect.discs.quality import Limits, centres_of
from detect.projection import circle_on_floor
from detect.settings import REPORT, CircleSettings, Polarity
from lut import DiscShape, DiscTable, build_disc_table
from tests.camera.strategies import cameras
from tests.reference.centres import PlainOutlines, plain_best_centres, plain_outlines, plain_quality
from tools.benchmark.material import scaled_camera
from tools.detector_maps import quality_of_centres
from tools.published_camera import PUBLISHED_CAM

GreyImage = NDArray[np.uint8]

PUBLISHED_CAMERA = parse_camera(PUBLISHED_CAM)
#: An eighth of it: outlines leave the image everywhere.
SMALL_CAMERA = scaled_camera(PUBLISHED_CAMERA, 1 / 8)
SHAPE = DiscShape(0.2, 0.5, samples=7, border_px=0, far_limit_m_per_px=0.5)
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


def assert_quality(image: GreyImage, table: DiscTable, outlines: PlainOutlines) -> None:
    for found, expected in zip(quality_of_centres(image, table), plain_quality(image, outlines)):
        np.testing.assert_array_equal(found, expected)


def assert_centres(
    image: GreyImage, table: DiscTable, outlines: PlainOutlines, threshold: float, sign: int
) -> None:
    quality, contrast = plain_quality(image, outlines)
    v, u = np.nonzero((quality >= threshold) & (contrast * sign >= 0.0) & (quality > 0.0))
    # What the first samples rule out is none of them.
    found = centres_of(image, table, Limits(threshold, sign=sign))
    np.testing.assert_array_equal(found.pixels, np.column_stack([u, v]))
    np.testing.assert_array_equal(found.quality, quality[v, u])
    np.testing.assert_array_equal(found.contrast, contrast[v, u])


# -- the small camera, and any other --------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("samples", [3, 4, 5, 8, 13, 16, 30, 64, 128])
def test_centres_are_those_of_a_plain_computation(samples: int, kind: str) -> None:
    table, outlines = both(SMALL_CAMERA, dataclasses.replace(SHAPE, samples=samples))
    assert (table.samples == SMALL_CAMERA.width * SMALL_CAMERA.height).any()
    image = image_of(kind, (36, 96), seed=samples)
    assert_quality(image, table, outlines)
    for threshold in (0.05, 0.4, 0.6, 1.0):
        for sign in (-1, 0, 1):
            assert_centres(image, table, outlines, threshold, sign)


def exact_quality(image: GreyImage, outlines: PlainOutlines) -> list[tuple[Fraction, Fraction]]:
    """Quality and contrast of each centre by their definition, in fractions."""
    values, samples = image.ravel().tolist(), outlines.index.shape[1] // 2
    found = []
    for index in outlines.index.tolist():
        of_index = index[:samples], index[samples:]
        inner, outer = ([values[i] for i in part if i < image.size] for part in of_index)
        grey = inner + outer
        mean = Fraction(sum(grey), len(grey))
        means = [Fraction(sum(part), len(part)) for part in (inner, outer)]
        between = sum(len(p) * (m - mean) ** 2 for p, m in zip((inner, outer), means))
        total = sum((value - mean) ** 2 for value in grey)
        found.append((between / total if total else Fraction(0), means[0] - means[1]))
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_quality_and_contrast_are_exact_to_the_last_bit(kind: str) -> None:
    table, outlines = both(SMALL_CAMERA, SHAPE)
    assert len(outlines.rows) > 500
    image = image_of(kind, (36, 96), seed=1)
    exact = np.array(exact_quality(image, outlines), np.float64)
    quality, contrast = quality_of_centres(image, table)
    at = outlines.rows, outlines.columns
    np.testing.assert_array_equal(quality[at], exact[:, 0])
    np.testing.assert_array_equal(contrast[at], exact[:, 1].astype(np.float32))


@pytest.mark.parametrize("stride", [0.05, 0.3, 1.0, 2.5])
def test_centres_at_strides_are_found_as_on_the_map(stride: float) -> None:
    every = build_disc_table(SMALL_CAMERA, SHAPE)
    some = build_disc_table(SMALL_CAMERA, dataclasses.replace(SHAPE, stride_m=stride))
    assert np.all(every.usable[some.usable])
    image = image_of("blocks", (36, 96), seed=1)
    quality, contrast = quality_of_centres(image, every)
    found = centres_of(image, some, Limits(0.3, contrast=20.0))
    expected = some.usable & (quality >= 0.3) & (abs(contrast) > 20.0)
    rows, columns = np.nonzero(expected)
    assert len(rows) > 5
    np.testing.assert_array_equal(found.pixels, np.column_stack([columns, rows]))
    np.testing.assert_array_equal(found.quality, quality[expected])
    np.testing.assert_array_equal(found.contrast, contrast[expected])


@given(
    cameras(largest_side=90, down_deg=(10.0, 90.0)),
    st.integers(3, 24),
    st.sampled_from(KINDS),
    st.integers(0, 2**32 - 1),
    st.sampled_from([-1, 0, 1]),
    st.data(),
)
def test_any_camera_image_and_threshold(
    camera: Camera, samples: int, kind: str, seed: int, sign: int, data: st.DataObject
) -> None:
    middle_m = float(np.nan_to_num(np.abs(np.diff(camera.floor_from_pixel(
        [[camera.width / 2, camera.height / 2], [camera.width / 2 + 1, camera.height / 2]]
    ), axis=0)).max(), nan=0.1))  # fmt: skip
    shape = DiscShape(
        middle_m, 3.0 * middle_m, samples=samples, border_px=0, far_limit_m_per_px=10.0 * middle_m
    )
    table, outlines = both(camera, shape)
    image = image_of(kind, (camera.height, camera.width), seed)
    quality, _ = quality_of_centres(image, table)
    plain, _ = plain_quality(image, outlines)
    # Where a sample falls on the border of two pixels, rounding decides.
    assume(np.array_equal(quality, plain) or _samples_are_clear(camera, shape, table))
    assert_quality(image, table, outlines)
    # A threshold that is reached exactly is the hardest.
    reached = np.unique(plain[plain > 0.0])
    choices = st.floats(0.01, 1.0)
    if len(reached):
        choices |= st.sampled_from(reached.tolist())
        choices |= st.sampled_from(np.nextafter(reached, 2.0).tolist())
    assert_centres(image, table, outlines, min(1.0, data.draw(choices)), sign)


def _samples_are_clear(camera: Camera, shape: DiscShape, table: DiscTable) -> bool:
    rows, columns = np.nonzero(table.usable)
    rings = np.concatenate(
        [
            circle_on_floor((0.0, 0.0), radius, shape.samples)
            for radius in (shape.inner_radius_m, shape.outer_radius_m)
        ]
    )
    centres = camera.floor_from_pixel(np.stack([columns, rows], axis=-1).astype(float))
    seen = camera.project_floor(centres[:, None] + rings) + 0.5
    return bool(np.nanmin(np.abs(seen - np.rint(seen)), initial=1.0) > 1e-9)


# -- the published camera -------------------------------------------------------------------------


def demo_images(project_root: Path) -> list[GreyImage]:
    paths = sorted((project_root / "images" / "e" / "images").glob("*.jpg"))[3::25]
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    assert len(images) > 2
    return [np.asarray(image, np.uint8) for image in images if image is not None]


@pytest.mark.long
@pytest.mark.parametrize("preset", [REPORT, CircleSettings()], ids=["report", "default"])
def test_centres_at_full_size(preset: CircleSettings, project_root: Path) -> None:
    table, outlines = both(PUBLISHED_CAMERA, disc_shape(preset))
    for image in demo_images(project_root):
        assert_quality(image, table, outlines)
        assert_centres(image, table, outlines, preset.threshold, 0)


@pytest.mark.parametrize("polarity", POLARITIES)
def test_landmarks_of_the_report_are_the_plain_maxima(
    polarity: Polarity, project_root: Path
) -> None:
    table, outlines = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    settings = dataclasses.replace(REPORT, polarity=polarity)
    image = demo_images(project_root)[0]
    found = detect_circles(image, PUBLISHED_CAMERA, table, settings)
    pixels, quality, _ = plain_best_centres(image, outlines, settings.threshold, polarity)
    assert len(pixels) > 1
    above = quality > settings.threshold
    np.testing.assert_array_equal(found.pixels, pixels[above])
    np.testing.assert_array_equal(found.quality, quality[above])


# -- what goes in ---------------------------------------------------------------------------------


def found_in(image: GreyImage, table: DiscTable) -> tuple[NDArray[Any], ...]:
    """Pixels, quality and contrast of the best, and the maps of both."""
    return (*centres_of(image, table, Limits(0.3)), *quality_of_centres(image, table))


def test_an_image_whose_memory_is_not_contiguous_or_read_only_is_the_same_image() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    image = image_of("blocks", (288, 768))
    fixed = image.copy()
    fixed.setflags(write=False)
    for other in (np.asfortranarray(image), np.repeat(image, 2, axis=1)[:, ::2], fixed):
        for left, right in zip(found_in(other, table), found_in(image, table)):
            np.testing.assert_array_equal(left, right, strict=True)
    assert np.array_equal(image, image_of("blocks", (288, 768)))


def test_threads_do_not_disturb_each_other() -> None:
    table, _ = both(PUBLISHED_CAMERA, disc_shape(REPORT))
    images = [image_of("blocks", (288, 768), seed) for seed in range(12)]
    expected = [found_in(image, table) for image in images]
    assert len({len(pixels) for pixels, *_ in expected}) > 3
    with ThreadPoolExecutor(4) as pool:
        for found, right in zip(pool.map(lambda i: found_in(i, table), images), expected):
            np.testing.assert_array_equal(found[1], right[1])


def test_an_empty_table_finds_nothing() -> None:
    nothing = build_disc_table(SMALL_CAMERA, DiscShape(far_limit_m_per_px=1e-9))
    pixels, quality, contrast, *maps = found_in(image_of("random", (36, 96)), nothing)
    assert (pixels.shape, quality.shape, contrast.shape) == ((0, 2), (0,), (0,))
    assert pixels.dtype == np.int64
    assert contrast.dtype == np.float32
    assert not np.any(maps)
