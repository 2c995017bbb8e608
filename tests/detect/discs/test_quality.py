"""The disc detector's kernels against exact arithmetic and brute force."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from camera import Camera, parse_camera
from detect.discs.candidates import suppress_neighbours
from detect.discs.quality import Limits, centres_of, quality_of_centres
from lut import DiscShape, build_disc_table, ring
from tools.published_camera import PUBLISHED_CAM

# The first example of a property waits for the compiler: hence no deadlines.

GreyImage = NDArray[np.uint8]


# -- quality --------------------------------------------------------------------------------------


def small_camera() -> Camera:
    """The published camera at an eighth of its size."""
    return dataclasses.replace(
        parse_camera(PUBLISHED_CAM), width=96, height=36, scale_x=464.762 / 8,
        scale_y=232.381 / 8, offset_x=48.0, offset_y=18.0,
    )  # fmt: skip


CAMERA = small_camera()
SHAPE = DiscShape(0.2, 0.5, samples=7, border_px=0, far_limit_m_per_px=0.5)
TABLE = build_disc_table(CAMERA, SHAPE)


def exact_quality(
    image: GreyImage, camera: Camera, shape: DiscShape, usable: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Quality and contrast by the definition, in fractions, straight from the camera."""
    quality, contrast = np.zeros(image.shape), np.zeros(image.shape)
    radii = (shape.inner_radius_m, shape.outer_radius_m)
    for v, u in np.argwhere(usable):
        centre = camera.floor_from_pixel([u, v])
        grey: list[list[int]] = []
        for radius in radii:
            seen = np.floor(camera.project_floor(centre + ring(radius, shape.samples)) + 0.5)
            grey.append(
                [
                    int(image[int(vs), int(us)])
                    for us, vs in seen
                    if 0 <= us < camera.width and 0 <= vs < camera.height
                ]
            )
        inner, outer = grey
        values = inner + outer
        n = len(values)
        mean = Fraction(sum(values), n)
        total = sum((value - mean) ** 2 for value in values)
        means = [Fraction(sum(group), len(group)) for group in grey]
        between = sum(
            len(group) * (group_mean - mean) ** 2 for group, group_mean in zip(grey, means)
        )
        quality[v, u] = float(between / total) if total else 0.0
        contrast[v, u] = float(means[0] - means[1])
    return quality, contrast


def random_image(seed: int, kind: str) -> GreyImage:
    rng = np.random.default_rng(seed)
    shape = (CAMERA.height, CAMERA.width)
    if kind == "random":
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if kind == "binary":
        return rng.choice(np.array([0, 255], np.uint8), shape)
    if kind == "saturated":
        return np.clip(rng.normal(255, 40, shape), 0, 255).astype(np.uint8)
    if kind == "nearly constant":
        image = np.full(shape, 200, np.uint8)
        image[rng.integers(0, shape[0], 9), rng.integers(0, shape[1], 9)] = 201
        return image
    assert kind == "blocks"
    blocks = rng.integers(0, 256, (9, 12), dtype=np.uint8)
    return np.kron(blocks, np.ones((4, 8), np.uint8))


KINDS = ["random", "binary", "saturated", "nearly constant", "blocks"]


@pytest.mark.parametrize("kind", KINDS)
def test_quality_and_contrast_are_exact_to_the_last_bit(kind: str) -> None:
    assert TABLE.usable.sum() > 500
    assert (TABLE.samples == CAMERA.width * CAMERA.height).any()  # outlines do leave the image
    image = random_image(1, kind)
    quality, contrast = quality_of_centres(image, TABLE)
    exact, exact_contrast = exact_quality(image, CAMERA, SHAPE, TABLE.usable)
    assert np.array_equal(quality, exact)
    assert np.array_equal(contrast, exact_contrast.astype(np.float32))
    assert len(np.unique(exact[TABLE.usable])) > 1


@pytest.mark.parametrize("grey", [0, 1, 127, 255])
def test_an_image_of_one_grey_has_no_quality_even_where_outlines_leave_it(grey: int) -> None:
    quality, contrast = quality_of_centres(np.full((36, 96), grey, np.uint8), TABLE)
    assert not quality.any()
    assert not contrast.any()


@pytest.mark.parametrize(("inside", "outside"), [(255, 0), (0, 255), (101, 100)])
def test_a_disc_has_quality_one_at_its_centre_and_the_sign_of_its_contrast(
    published_camera: Camera, inside: int, outside: int
) -> None:
    v, u = np.mgrid[0:288, 0:768]
    floor_xy = published_camera.floor_from_pixel(np.stack([u, v], axis=-1).astype(float))
    table = build_disc_table(published_camera, DiscShape())
    for centre in ((384, 200), (120, 180), (700, 240)):
        there = published_camera.floor_from_pixel(centre)
        distance = np.hypot(*np.moveaxis(floor_xy - there, -1, 0))
        image = np.where(distance < 0.10, inside, outside).astype(np.uint8)
        quality, contrast = quality_of_centres(image, table)
        assert quality[centre[1], centre[0]] == 1.0
        assert quality.max() == 1.0
        assert contrast[centre[1], centre[0]] == inside - outside


@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS))
def test_quality_is_between_0_and_1_and_0_where_no_centre_is_usable(seed: int, kind: str) -> None:
    quality, contrast = quality_of_centres(random_image(seed, kind), TABLE)
    assert quality.min() >= 0.0
    assert quality.max() <= 1.0
    assert not quality[~TABLE.usable].any()
    assert not contrast[~TABLE.usable].any()
    assert np.array_equal(quality > 0.0, contrast != 0.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.data())
def test_quality_does_not_change_with_affine_brightness(
    seed: int, levels: int, data: st.DataObject
) -> None:
    """Exactly: no tolerance."""
    image = np.random.default_rng(seed).integers(0, levels + 1, (36, 96))
    gain = data.draw(st.integers(1, 255 // levels), label="gain")
    offset = data.draw(st.integers(0, 255 - gain * levels), label="offset")
    brighter = (gain * image + offset).astype(np.uint8)
    quality, contrast = quality_of_centres(image.astype(np.uint8), TABLE)
    again, brighter_contrast = quality_of_centres(brighter, TABLE)
    negative, negative_contrast = quality_of_centres(np.asarray(255 - brighter), TABLE)
    assert quality.any()
    assert np.array_equal(again, quality)
    assert np.array_equal(negative, quality)
    assert np.allclose(brighter_contrast, gain * contrast, rtol=1e-6, atol=0.0)
    assert np.array_equal(negative_contrast, -brighter_contrast)


def test_the_largest_possible_sums_do_not_overflow() -> None:
    shape = DiscShape(0.2, 0.5, samples=128, border_px=0, far_limit_m_per_px=0.5)
    table = build_disc_table(CAMERA, shape)
    image = random_image(2, "binary")
    image[:, :48] = 255
    usable = table.usable.copy()
    usable[::2] = False  # half of the centres will do
    quality, _ = quality_of_centres(image, table)
    exact, _ = exact_quality(image, CAMERA, shape, usable)
    assert np.array_equal(quality[usable], exact[usable])


def test_an_image_whose_memory_is_not_contiguous_is_the_same_image() -> None:
    image = random_image(3, "random")
    turned = np.asfortranarray(image)
    sliced = np.repeat(image, 2, axis=1)[:, ::2]
    expected, expected_contrast = quality_of_centres(image, TABLE)
    for other in (turned, sliced):
        quality, contrast = quality_of_centres(other, TABLE)
        assert np.array_equal(quality, expected)
        assert np.array_equal(contrast, expected_contrast)


def test_an_empty_table_finds_nothing() -> None:
    nothing = build_disc_table(CAMERA, DiscShape(far_limit_m_per_px=1e-9))
    quality, contrast = quality_of_centres(random_image(4, "random"), nothing)
    assert not quality.any()
    assert not contrast.any()


# -- limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [7, 9, 16])
@pytest.mark.parametrize("threshold", [0.5, 0.6, 0.8])
def test_half_of_the_samples_rules_out_nothing_that_counts(samples: int, threshold: float) -> None:
    table = build_disc_table(CAMERA, dataclasses.replace(SHAPE, samples=samples))
    for seed, kind in enumerate(KINDS):
        image = random_image(seed, kind)
        every = centres_of(image, table, Limits(threshold))
        some = centres_of(image, table, Limits(threshold, 2.0 * threshold - 1.0))
        for left, right in zip(every, some):
            np.testing.assert_array_equal(left, right, strict=True)


@pytest.mark.parametrize("stride", [0.05, 0.3, 1.0, 2.5])
def test_centres_at_strides_are_found_as_on_the_map(stride: float) -> None:
    some = build_disc_table(CAMERA, dataclasses.replace(SHAPE, stride_m=stride))
    assert np.all(TABLE.usable[some.usable])
    image = random_image(1, "blocks")
    quality, contrast = quality_of_centres(image, TABLE)
    found = centres_of(image, some, Limits(0.3, contrast=20.0))
    expected = some.usable & (quality >= 0.3) & (abs(contrast) > 20.0)
    rows, columns = np.nonzero(expected)
    assert len(rows) > 5
    np.testing.assert_array_equal(found.pixels, np.column_stack([columns, rows]))
    np.testing.assert_array_equal(found.quality, quality[expected])
    np.testing.assert_array_equal(found.contrast, contrast[expected])


# -- suppression ----------------------------------------------------------------------------------


def plain_suppression(
    floor_xy: NDArray[np.float64], score: NDArray[np.float64], separation: float
) -> NDArray[np.bool_]:
    """From the best to the worst, the first of equal ones first."""
    kept = np.zeros(len(score), bool)
    for i in sorted(range(len(score)), key=lambda i: (-score[i], i)):
        gap = floor_xy[kept] - floor_xy[i]
        kept[i] = not np.any((gap * gap).sum(axis=1) < separation * separation)
    return kept


# A lattice of eighths: distances and their comparison with the separation are exact.
POSITIONS = hnp.arrays(
    np.int8, st.tuples(st.integers(0, 40), st.just(2)), elements=st.integers(0, 24)
)


@settings(max_examples=300)
@given(POSITIONS, st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_the_best_stay_and_no_two_are_too_close(
    lattice: NDArray[np.int8], eighths: int, seed: int
) -> None:
    floor_xy, separation = lattice / 8.0, eighths / 8.0
    score = np.random.default_rng(seed).integers(-3, 4, len(lattice)) / 2.0
    kept = suppress_neighbours(floor_xy, score, separation)
    assert np.array_equal(kept, plain_suppression(floor_xy, score, separation))

    gap = np.linalg.norm(floor_xy[:, None] - floor_xy, axis=-1)
    np.fill_diagonal(gap, np.inf)
    close = gap < separation
    assert not np.any(close[np.ix_(kept, kept)])
    # Who went had somebody at least as good close by.
    for i in np.flatnonzero(~kept):
        assert np.any(close[i] & kept & (score >= score[i]))


def test_exactly_the_separation_apart_is_apart() -> None:
    floor_xy = np.array([[0.0, 0.0], [0.25, 0.0], [0.375, 0.0]])
    kept = suppress_neighbours(floor_xy, np.array([0.9, 0.8, 0.7]), 0.25)
    assert kept.tolist() == [True, True, False]


def test_of_equal_ones_the_first_stays() -> None:
    kept = suppress_neighbours(np.zeros((4, 2)), np.full(4, 0.7), 0.1)
    assert kept.tolist() == [True, False, False, False]


def test_one_that_was_suppressed_suppresses_nobody() -> None:
    floor_xy = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]])
    kept = suppress_neighbours(floor_xy, np.array([0.9, 0.8, 0.7]), 0.15)
    assert kept.tolist() == [True, False, True]
