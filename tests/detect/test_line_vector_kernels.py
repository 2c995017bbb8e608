"""Operations on vectors against the same sums, written out."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from detect.line_vector_kernels import LANES, WORD, add_products, slope_and_bend


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
def add(
    pixels: NDArray[np.uint8],
    at: int,
    weights: NDArray[np.float32],
    at_weight: int,
    words: int,
    sums: NDArray[np.float32],
    to: int,
) -> None:
    add_products(pixels, at, weights, at_weight, words, sums, to)


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
        sums = np.arange(2.0 * LANES, dtype=np.float32)
        add(pixels, at, weights[0], at_weight, words, sums, LANES)
        np.testing.assert_array_equal(sums[:LANES], np.arange(LANES))
        added = sums[LANES:] - np.arange(LANES, 2.0 * LANES)
        products = (own[0] * grey).reshape(words, LANES).sum(axis=0)
        np.testing.assert_allclose(added, products, atol=2e-3)
