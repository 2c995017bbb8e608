"""The disc detector's kernels against exact arithmetic and brute force."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit
from numpy.typing import NDArray

from camera import Camera, parse_camera
from detect.discs.candidates import suppress_neighbours
from detect.discs.gathering import gather
from detect.discs.quality import (
    Wanted,
    blocks_of,
    compare,
    compare_whole,
    find_centres,
    memory_for,
    quality_of_centres,
    sum_and_gather,
    vote,
    with_zeros,
)
from lut import DiscShape, build_disc_table, ring
from lut.kernels import ADVANCE_BITS, COPIED, GROUP, LARGEST_STRIDE, PITCH
from tests.conftest import PUBLISHED_CAM

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
    voting = TABLE.votes.sum(axis=0)
    assert np.any((voting > 0) & (voting < 14))  # outlines do reach outside the image
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


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS))
def test_quality_is_between_0_and_1_and_0_where_no_centre_is_usable(seed: int, kind: str) -> None:
    quality, contrast = quality_of_centres(random_image(seed, kind), TABLE)
    assert quality.min() >= 0.0
    assert quality.max() <= 1.0
    assert not quality[~TABLE.usable].any()
    assert not contrast[~TABLE.usable].any()
    assert np.array_equal(quality > 0.0, contrast != 0.0)


@settings(deadline=None)
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


# -- step by step ---------------------------------------------------------------------------------


@njit(error_model="numpy")
def _gathered(
    pixels: GreyImage, copies: NDArray[Any], gathered: GreyImage, stride: int, first: int,
    count: int, to: int,
) -> int:  # fmt: skip
    return gather(pixels, copies, gathered, stride, first, count, to)


@pytest.mark.parametrize("stride", range(1, LARGEST_STRIDE + 1))
@pytest.mark.parametrize("bits", [32, 64])
def test_copies_are_carried_out_one_after_the_other(bits: int, stride: int) -> None:
    rng = np.random.default_rng(bits)
    pixels = rng.integers(0, 256, 1000, dtype=np.uint8)
    source, advance = rng.integers(0, 1000 - COPIED, 40), rng.integers(0, 64 // stride, 40)
    copies = ((source << ADVANCE_BITS) | advance).astype(f"uint{bits}")
    expected, gathered = np.full(4000, 7, np.uint8), np.full(4000, 7, np.uint8)
    place = 13
    for s, a in zip(source[4:32].tolist(), advance[4:32].tolist()):
        expected[place : place + a] = pixels[s : s + COPIED : stride][:a]
        place += a
    assert _gathered(pixels, copies, gathered, stride, 4, 28, 13) == place
    assert np.array_equal(gathered[:place], expected[:place])
    # What is in excess stays within 64 bytes.
    assert np.all(gathered[place + COPIED :] == 7)


def outlines_of(samples: int, seed: int) -> NDArray[np.int64]:
    """(2, samples, 256) grey values of all sorts, random votes being none and so zeros."""
    rng = np.random.default_rng(seed)
    level = rng.integers(0, 256, (2, 1, PITCH))
    scatter = rng.choice([0.0, 0.7, 5.0, 30.0, 100.0], PITCH)
    x = np.clip(np.rint(level + rng.normal(0.0, 1.0, (2, samples, PITCH)) * scatter), 0, 255)
    x[:, :, :2] = [0.0, 255.0]
    x[0, :, 2], x[1, :, 2] = 255.0, 0.0
    return np.asarray(x, np.int64)


@pytest.mark.parametrize("samples", [3, 16, 40, 128])
@pytest.mark.parametrize("threshold", [1e-6, 0.4, 0.6, 1.0])
@pytest.mark.parametrize("contrast", [0.0, 5.0])
@pytest.mark.parametrize("all_vote", [True, False])
def test_what_may_matter_is_noted_and_hardly_anything_else(
    samples: int, threshold: float, contrast: float, all_vote: bool
) -> None:
    rng = np.random.default_rng(samples)
    votes = rng.integers((samples + 1) // 2, samples + 1, (2, PITCH))
    votes[:, ::3] = samples
    votes[:, rng.random(PITCH) < 0.2] = 0
    if all_vote:
        votes[:] = samples
    x = outlines_of(samples, samples) * (np.arange(samples)[:, None] < votes[:, None])
    memory = memory_for(samples)
    padded = -(-samples // GROUP) * GROUP
    rows = np.zeros((2, padded, PITCH), np.uint8)
    rows[:, :samples] = x
    memory.gathered[5 : 5 + rows.size] = rows.ravel()
    nothing = np.zeros(COPIED, np.uint8)
    sum_and_gather(memory, 5, samples, PITCH, nothing, blocks_of(TABLE), -1, 0)
    assert np.array_equal([memory.inner, memory.outer], x.sum(axis=1))
    assert np.array_equal(memory.products, (x * (255 - x)).sum(axis=(0, 1)))
    wanted = Wanted(threshold, contrast, 0.0, 0, 0)
    if np.all(votes == samples):
        compare_whole(memory, samples, PITCH, wanted)
    else:
        compare(memory, votes.astype(np.uint8).ravel(), 0, PITCH, wanted)
    noted = memory.matters > 0
    n, total = votes.sum(axis=0), x.sum(axis=(0, 1))
    spread = n * (x**2).sum(axis=(0, 1)) - total**2
    difference = votes[1] * x[0].sum(axis=0) - votes[0] * x[1].sum(axis=0)
    pairs = votes[0] * votes[1]
    good = (difference**2 >= threshold * pairs * spread) & (spread > 0) & (pairs > 0)
    assert np.all(noted[good & (abs(difference) > contrast * pairs)])
    assert not np.any(noted[difference**2 < threshold * (1.0 - 1e-5) * pairs * spread])
    assert not np.any(noted[abs(difference) < contrast * (1.0 - 1e-5) * pairs])
    assert not np.any(noted[(spread == 0) | (pairs == 0)])
    assert 0 < np.count_nonzero(noted) < PITCH


@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_votes_are_counted(sign: float) -> None:
    samples, wide = 13, 96
    rng = np.random.default_rng(5)
    memory = memory_for(samples)
    grey = np.zeros((2, -(-samples // GROUP) * GROUP, PITCH), np.uint8)
    grey[:, :samples] = rng.integers(0, 256, (2, samples, PITCH))
    grey[1, rng.random(grey[1].shape) < 0.2] = 0
    memory.gathered[: grey.size] = grey.ravel()
    memory.matters[:] = 0
    lacking = rng.random(wide) < 0.5
    memory.lacking[:wide] = lacking
    vote(memory, 0, samples, wide, Wanted(0.5, 0.0, sign, 10, 6))
    inner, outer = grey[:, :samples, :wide].astype(int)
    light = (inner - outer + lacking > 10) & ((outer > 0) | ~lacking)
    dark = outer - inner > 10
    counts = light.sum(axis=0) * (sign >= 0.0), dark.sum(axis=0) * (sign <= 0.0)
    np.testing.assert_array_equal(memory.light[:wide], counts[0])
    np.testing.assert_array_equal(memory.dark[:wide], counts[1])
    np.testing.assert_array_equal(memory.matters[:wide] > 0, np.maximum(*counts) >= 6)
    assert 0 < np.count_nonzero(memory.matters[:wide]) < wide


@pytest.mark.parametrize("stride", [0.05, 0.3, 1.0, 2.5])
def test_centres_at_strides_are_found_as_on_the_map(stride: float) -> None:
    some = build_disc_table(CAMERA, dataclasses.replace(SHAPE, stride_m=stride))
    assert np.all(TABLE.usable[some.usable])
    image = random_image(1, "blocks")
    quality, contrast = quality_of_centres(image, TABLE)
    wanted = Wanted(0.3, 20.0, 0.0, 0, 0)
    every = np.arange(len(some.block_row))
    found = find_centres(with_zeros(image, some), blocks_of(some), every, wanted)
    expected = some.usable & (quality >= 0.3) & (abs(contrast) > 20.0)
    rows, columns = np.nonzero(expected)
    assert len(rows) > 5
    assert list(zip(found["v"], found["u"])) == list(zip(rows, columns))
    np.testing.assert_array_equal(found["quality"], quality[expected])
    np.testing.assert_array_equal(found["contrast"], contrast[expected])


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


@settings(max_examples=300, deadline=None)
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
