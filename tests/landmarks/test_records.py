"""Records refuse what a file could not say."""

from __future__ import annotations

import math
from dataclasses import astuple

import pytest

from redetect.landmarks import (
    CircleLandmark,
    Frame,
    LandmarkError,
    LineLandmark,
    Row,
    Step,
)

STEP = Step("e.0000", 0.1, -0.2, 0.3, 1e-5, 0, 1e-5, 0, 0, 1e-4)
CIRCLE = CircleLandmark(0.5, -2.0, 0.9, 0.002, 0.0, 0.003, (7,))
LINE = LineLandmark(-0.8, -0.6, -0.7, -0.3, 0.6, 0.02, 0.0, 0.003, (1, 2))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("record", "fields"), [(STEP, 10), (CIRCLE, 6), (LINE, 8)])
def test_no_number_may_be_infinite_or_nan(
    record: Step | CircleLandmark | LineLandmark, fields: int, bad: float
) -> None:
    values = list(astuple(record))
    for index in range(isinstance(record, Step), fields):
        changed = [*values[:index], bad, *values[index + 1 :]]
        name = list(type(record).__dataclass_fields__)[index]
        with pytest.raises(LandmarkError, match=f"{name} is {bad}: expected a finite number"):
            type(record)(*changed)


@pytest.mark.parametrize("prefix", ["", "a b", "a\tb", "a\nb", "#a", "a\\"])
def test_prefixes_that_a_file_would_not_give_back_are_refused(prefix: str) -> None:
    with pytest.raises(LandmarkError, match="image prefix is"):
        Step(prefix, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def test_identifiers_have_64_bits() -> None:
    assert CircleLandmark(0, 0, 0, 0, 0, 0, (2**63 - 1,)).ids == (2**63 - 1,)
    with pytest.raises(LandmarkError, match="64 bits"):
        CircleLandmark(0, 0, 0, 0, 0, 0, (2**63,))


@pytest.mark.parametrize(
    ("ids", "identified"), [((), False), ((-1,), False), ((0,), True), ((-1, 4), True)]
)
def test_identified_needs_a_known_identifier(ids: tuple[int, ...], identified: bool) -> None:
    assert CircleLandmark(0, 0, 0, 0, 0, 0, ids).identified is identified
    assert LineLandmark(0, 0, 0, 0, 0, 0, 0, 0, ids).identified is identified


def test_a_frame_sorts_its_landmarks_by_kind() -> None:
    frame = Frame(STEP, (LINE, CIRCLE, LINE))
    assert frame.circles == (CIRCLE,)
    assert frame.lines == (LINE, LINE)


def test_a_row_keeps_its_text_only_while_it_says_the_same() -> None:
    row = Row(CIRCLE, b"LANDMARK_C ...\r\n", 5)
    equal = CircleLandmark(0.5, -2.0, 0.9, 0.002, 0.0, 0.003, (7,))
    assert row.with_record(equal) is row
    changed = row.with_record(CircleLandmark(0.5, -2.0, 0.9, 0.002, 0.0, 0.003, (8,)))
    assert changed.source is None
    assert changed.line == 5
