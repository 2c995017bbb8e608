"""Rows straight from arrays: byte by byte what the records give."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.errors import FrameError
from detect.runs.frame import disc_numbers, landmark_rows
from redetect.landmarks import CircleLandmark, LineLandmark, circle_landmarks, format_record

FINITE = st.floats(allow_nan=False, allow_infinity=False)
IDS = st.lists(st.integers(-1, 10**6), max_size=3).map(tuple)


@given(rows=st.lists(st.tuples(st.lists(FINITE, min_size=6, max_size=6), IDS), max_size=4))
def test_discs_are_written_as_their_records(
    rows: list[tuple[list[float], tuple[int, ...]]],
) -> None:
    numbers = np.array([values for values, _ in rows]).reshape(-1, 6)
    written = landmark_rows("LANDMARK_C", numbers, [ids for _, ids in rows])
    records = [CircleLandmark(x, y, q, a, b, c, ids) for (x, y, q, a, b, c), ids in rows]
    assert written == "".join(f"{format_record(record)}\n" for record in records)


def test_lines_are_written_as_their_records() -> None:
    numbers = np.random.default_rng(7).normal(size=(5, 8))
    rows: list[Any] = numbers.tolist()
    records = [replace(LineLandmark(*row), ids=(-1,)) for row in rows]
    written = landmark_rows("LANDMARK_L", numbers, [(-1,)] * 5)
    assert written == "".join(f"{format_record(record)}\n" for record in records)


def test_numbers_of_discs_stand_in_the_order_of_their_rows() -> None:
    rng = np.random.default_rng(6)
    xy, quality, spread = rng.normal(size=(5, 2)), rng.random(5), rng.normal(size=(5, 2, 2))
    landmarks = circle_landmarks(xy, quality, spread)
    expected = [(c.px, c.py, c.quality, c.cxx, c.cxy, c.cyy) for c in landmarks]
    np.testing.assert_array_equal(disc_numbers(xy, quality, spread), expected)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_costs_the_frame(number: float) -> None:
    with pytest.raises(FrameError, match="not finite"):
        landmark_rows("LANDMARK_C", np.full((1, 6), number), [(-1,)])
