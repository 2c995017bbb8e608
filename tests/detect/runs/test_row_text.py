"""Rows straight from arrays: byte by byte what the records give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from detect.runs.row_text import unknown_circles, unknown_lines
from detect.runs.row_text_kernels import circle_numbers
from landmarks import CircleLandmark, LineLandmark, circle_landmarks, format_record

FINITE = st.floats(allow_nan=False, allow_infinity=False)
#: Whatever has few decimals stands near numbers that end in 5, where rounding is a close call.
DECIMALS = st.builds(
    lambda n, k: n / 10**k, st.integers(-12_000_000, 12_000_000), st.integers(0, 20)
)


def circle_rows(numbers: NDArray[np.float64]) -> bytes | None:
    """Rows of (N, 6) numbers, in the order in which they stand there."""
    px, py, quality, cxx, cxy, cyy = numbers.T
    covariance = np.stack([cxx, cxy, cxy, cyy], axis=-1).reshape(-1, 2, 2)
    return unknown_circles(np.stack([px, py], axis=-1), quality, covariance)


def expected(numbers: list[float]) -> bytes:
    px, py, quality, cxx, cxy, cyy = numbers
    record = CircleLandmark(px, py, quality, cxx, cxy, cyy, ids=(-1,))
    return f"{format_record(record)}\n".encode()


@given(rows=st.lists(st.lists(FINITE | DECIMALS, min_size=6, max_size=6), max_size=4))
def test_rows_are_those_of_records_or_none(rows: list[list[float]]) -> None:
    numbers = np.array(rows, np.float64).reshape(-1, 6)
    written = circle_rows(numbers)
    assert written in (None, b"".join(map(expected, rows)))


def test_what_a_frame_holds_is_written() -> None:
    rng = np.random.default_rng(5)
    sizes = 10.0 ** rng.uniform(-12.0, 7.0, (400, 6))
    numbers = rng.choice([-1.0, 1.0], sizes.shape) * sizes
    numbers[::7] = [0.0, -0.0, 1.0, 1e-5, 123456.0, 1e6]
    numbers[1::7] = [0.999999, 0.9999999, 9.999996e-5, 999999.4, 999999.6, 100000.0]
    written = circle_rows(numbers)
    assert written == b"".join(expected(row) for row in numbers.tolist())
    assert circle_rows(numbers[:0]) == b""


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1.000005, -0.1234565, 1e-300, 1e300])
def test_what_needs_a_second_look_gets_it(number: float) -> None:
    assert circle_rows(np.full((1, 6), number)) is None


def test_numbers_of_discs_stand_in_the_order_of_their_rows() -> None:
    rng = np.random.default_rng(6)
    xy, quality, spread = rng.normal(size=(5, 2)), rng.random(5), rng.normal(size=(5, 2, 2))
    landmarks = circle_landmarks(xy, quality, spread)
    expected = [(c.px, c.py, c.quality, c.cxx, c.cxy, c.cyy) for c in landmarks]
    np.testing.assert_array_equal(circle_numbers(xy, quality, spread), expected)


def test_lines_are_written_as_their_records() -> None:
    lines = np.random.default_rng(7).normal(size=(8, 5))
    landmarks = [
        LineLandmark(xtop, ytop, xbottom, ybottom, alpha, beta, 0.0, sigma, (-1,))
        for xtop, ytop, xbottom, ybottom, alpha, beta, sigma, _ in lines.T.tolist()
    ]
    assert unknown_lines(lines) == "".join(f"{format_record(r)}\n" for r in landmarks).encode()
    assert unknown_lines(lines[:, :0]) == b""
    lines[3, 2] = np.nan
    assert unknown_lines(lines) is None
