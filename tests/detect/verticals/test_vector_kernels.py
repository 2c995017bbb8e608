"""Operations on vectors against the same sums, written out."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from detect.verticals.filter_vector_kernels import (
    moments_across,
    moments_across_two,
    response_along,
    response_along_two,
)
from detect.verticals.vector_kernels import LANES, WORD, slope_and_bend, sum_of_products


@njit(error_model="numpy")
def both_sums(
    pixels: NDArray[np.uint8],
    at: int,
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    at_weight: int,
    words: int,
) -> tuple[float, float]:
    sums = slope_and_bend(pixels, at, first, second, at_weight, words)
    return float(sums[0]), float(sums[1])


@njit(error_model="numpy")
def sum_at_places(
    pixels: NDArray[np.uint8],
    at: NDArray[np.int64],
    weights: NDArray[np.float32],
    node: NDArray[np.int64],
    count: int,
    begin: int,
    half: int,
) -> float:
    return float(sum_of_products(pixels, at, weights, node, count, begin, half))


@pytest.mark.parametrize("words", [1, 2, 5])
def test_weighted_sums_of_grey_values(words: int) -> None:
    rng = np.random.default_rng(words)
    pixels = rng.integers(0, 256, 200).astype(np.uint8)
    taps = words * WORD
    weights = rng.normal(size=(2, 64)).astype(np.float32)
    for at, at_weight in ((0, 0), (3, 5), (200 - taps, 64 - taps)):
        grey = pixels[at : at + taps].astype(np.float64) - 128.0
        own = weights[:, at_weight : at_weight + taps].astype(np.float64)
        np.testing.assert_allclose(
            both_sums(pixels, at, weights[0], weights[1], at_weight, words), own @ grey, atol=2e-3
        )


@pytest.mark.parametrize("half", [4, 8])
def test_sum_of_weighted_grey_values_at_several_places(half: int) -> None:
    rng = np.random.default_rng(half)
    pixels = rng.integers(0, 256, 200).astype(np.uint8)
    begin = 5
    weights = rng.normal(size=begin + 6 * 2 * half).astype(np.float32)
    at = np.array([half, 200 - half, 60, 61, 7])
    node = np.array([0, 5, 2, 2, 99])
    # The last of these is not counted.
    expected = sum(
        weights[begin + 2 * half * n :][: 2 * half].astype(np.float64)
        @ (pixels[u - half : u + half].astype(np.float64) - 128.0)
        for u, n in zip(at[:4], node[:4])
    )
    assert sum_at_places(pixels, at, weights, node, 4, begin, half) == pytest.approx(
        expected, abs=5e-3
    )
    assert sum_at_places(pixels, at, weights, node, 0, begin, half) == 0.0


@njit(error_model="numpy")
def filter_rows(
    pixels: NDArray[np.uint8],
    width: int,
    strip: NDArray[np.float32],
    weights: NDArray[np.float32],
    along: NDArray[np.float32],
    rows: int,
    together: bool,
    moments: NDArray[np.float32],
    response: NDArray[np.float32],
) -> None:
    words = weights.shape[1] // WORD
    plane = rows * LANES
    one = np.float32(1.0)
    left = np.float32(3.0)
    right = np.float32(width - 4.0)
    for y in range(0, rows, 2 if together else 1):
        begin, at = y * width - 3, y * LANES
        if together:
            moments_across_two(
                pixels, begin, width, strip, at, left, right, weights, words, moments, plane, at
            )
        else:
            moments_across(
                pixels, begin, width, strip, at, left, right, weights, words, moments, plane, at
            )
    taps = len(along)
    for y in range(0, rows - taps, 2 if together else 1):
        at = y * LANES
        if together:
            response_along_two(
                moments, plane, at, along, 0, taps, one, one, strip, at, left, right, response, at
            )
        else:
            response_along(
                moments, plane, at, along, 0, taps, one, one, strip, at, left, right, response, at
            )


def test_two_rows_at_once_are_filtered_like_one_after_the_other() -> None:
    rng = np.random.default_rng(3)
    rows, width = 24, 64
    pixels = rng.integers(0, 256, rows * width).astype(np.uint8)
    strip = (10.0 + np.arange(LANES) + rng.uniform(-12.0, 46.0, (rows, 1))).astype(np.float32)
    strip[5, 3] = np.nan
    weights = rng.normal(size=(4, WORD)).astype(np.float32)
    along = rng.uniform(size=6).astype(np.float32)
    results = []
    for together in (False, True):
        moments = np.full(3 * strip.size, -1.0, np.float32)
        response = np.full(strip.size, -1.0, np.float32)
        filter_rows(
            pixels, width, strip.reshape(-1), weights, along, rows, together, moments, response
        )
        results.append((moments, response))
    np.testing.assert_array_equal(results[1][0], results[0][0])
    np.testing.assert_array_equal(results[1][1], results[0][1])
    mean = results[0][0][: strip.size].reshape(strip.shape)
    inside = (strip >= 3.0) & (strip < width - 4.0)
    assert 20 < inside.sum() < strip.size
    assert np.all(mean[~inside] == 0.0)
    # The definition, written out.
    grey = pixels.reshape(rows, width).astype(np.float64) - 128.0
    for y, lane in np.argwhere(inside):
        whole = int(strip[y, lane])
        own = weights[0] + (strip[y, lane] - whole) * weights[1]
        expected = own @ grey[y, whole - 3 : whole - 3 + WORD]
        assert mean[y, lane] == pytest.approx(expected, abs=1e-2)
