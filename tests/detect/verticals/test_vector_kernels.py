"""Operations on vectors against the same sums, written out."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from detect.vector_code import LANES, WORD
from detect.verticals.filter_vector_kernels import (
    moments_across,
    moments_across_two,
    response_along,
    response_along_two,
)
from detect.verticals.refine_vector_kernels import (
    ROWS,
    SUBPIXELS,
    heights,
    move_crossings,
    newton_sums,
)
from detect.verticals.refinement import step_filters


@njit(error_model="numpy")
def sums_of_rows(
    pixels: NDArray[np.uint8],
    row_begin: NDArray[np.int32],
    crossing: NDArray[np.float64],
    by_a: NDArray[np.float64],
    by_b: NDArray[np.float64],
    filters: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]],
    left: float,
    right: float,
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    derivatives, height, begin, half = filters
    blocks = len(crossing) // ROWS
    newton = newton_sums(
        pixels, row_begin, crossing, by_a, by_b, blocks, derivatives, 2 * begin[1], half[1], left,
        right,
    )  # fmt: skip
    of_steps = heights(
        pixels, row_begin, crossing, blocks, height, begin[0], half[0], begin[1], half[1], left,
        right,
    )  # fmt: skip
    return newton, of_steps


@pytest.mark.parametrize("sigma", [0.8, 1.2, 3.0])
def test_sums_over_the_rows_of_a_line(sigma: float) -> None:
    rng = np.random.default_rng(2)
    filters = step_filters((0.8, sigma) if sigma != 0.8 else (1.8, sigma), ())
    rows, width = 3 * ROWS, 50
    grey = rng.integers(0, 256, (rows, width)).astype(np.uint8)
    margin = 16.0
    crossing = rng.uniform(12.0, width - 12.0, rows)
    crossing[-4:] = np.nan
    by_a, by_b = np.where(np.isnan(crossing), 0.0, rng.normal(size=(2, rows)))
    tables = (filters.derivatives, filters.height, filters.begin, filters.half)
    row_begin = np.where(np.isnan(crossing), 0, width * np.arange(rows)).astype(np.int32)
    newton, of_steps = sums_of_rows(
        grey.reshape(-1), row_begin, crossing, by_a, by_b, tables, margin, width - 1 - margin
    )
    expected = np.zeros(9)
    total = np.zeros(3)
    words = filters.derivatives.reshape(-1, 2, WORD)
    for row in np.flatnonzero((crossing > margin) & (crossing < width - 1 - margin)):
        whole = int(crossing[row])
        node = int((crossing[row] - whole) * SUBPIXELS)
        off = crossing[row] - whole - (node + 0.5) / SUBPIXELS
        of_row: list[float] = []
        for table, k in (
            (words[:, 0], 1),
            (words[:, 1], 1),
            (filters.height, 0),
            (filters.height, 1),
        ):
            reach = filters.half[k]
            at = filters.begin[k] + node * 2 * reach
            values = grey[row, whole - reach + 1 : whole + reach + 1] - 128.0
            own = table.reshape(-1)[at : at + 2 * reach].astype(np.float64)
            of_row.append(float(own @ values))
        bend = of_row[1]
        slope = of_row[0] + off * bend
        a, b = by_a[row], by_b[row]
        expected += [
            bend * a * a, bend * a * b, bend * b * b, slope * a, slope * b,
            (slope * a) ** 2, slope * a * slope * b, (slope * b) ** 2, 1.0,
        ]  # fmt: skip
        total += (of_row[2], of_row[3], 1.0)
    assert 5 < total[2] < rows - 4
    np.testing.assert_allclose(newton, expected, rtol=1e-4)
    np.testing.assert_allclose(of_steps, total, rtol=1e-4)


@njit(error_model="numpy")
def moved(
    crossing: NDArray[np.float64],
    by_a: NDArray[np.float64],
    by_b: NDArray[np.float64],
    change_a: float,
    change_b: float,
) -> float:
    return float(move_crossings(crossing, by_a, by_b, len(crossing) // ROWS, change_a, change_b))


def test_crossings_move_as_the_line_does() -> None:
    rng = np.random.default_rng(5)
    crossing, by_a, by_b = rng.normal(size=(3, 2 * ROWS))
    crossing[3], by_a[3], by_b[3] = np.nan, 0.0, 0.0
    change = 0.3 * by_a - 0.7 * by_b
    expected = crossing + change
    assert moved(crossing, by_a, by_b, 0.3, -0.7) == pytest.approx(np.abs(change).max())
    np.testing.assert_allclose(crossing, expected)


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
