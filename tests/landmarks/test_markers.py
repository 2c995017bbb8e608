"""Rows of square markers: what they say, what is refused, and that they come back unchanged."""

from __future__ import annotations

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.landmarks import (
    Frame,
    LandmarkError,
    MarkerCorner,
    MarkerLandmark,
    Step,
    format_record,
)
from tests.landmarks.rows import parse_record

ROW = (
    "LANDMARK_M rawseeds 31 0.987 "
    "215.7970 148.0580 0.0012 -0.0001 0.0011 270.4580 191.1130 0.0012 0 0.0011 "
    "186.3920 221.7070 0.0012 2e-05 0.0011 140.0860 170.6460 0.0012 0 0.0011"
)

pixels = st.integers(-100_000_000, 100_000_000).map(lambda n: n / 10_000)
variances = st.integers(-999_999, 999_999).map(lambda n: n / 1_000_000)
corners = st.builds(MarkerCorner, pixels, pixels, variances, variances, variances)
markers = st.builds(
    MarkerLandmark,
    dictionary=st.from_regex(r"[a-z0-9_:]{1,20}", fullmatch=True),
    id=st.integers(0, 2**40),
    quality=variances,
    corners=st.tuples(corners, corners, corners, corners),
)


def test_a_row_says_which_marker_and_where_its_corners_are() -> None:
    marker = parse_record(ROW)
    assert isinstance(marker, MarkerLandmark)
    assert (marker.dictionary, marker.id, marker.quality) == ("rawseeds", 31, 0.987)
    assert marker.corners[0] == MarkerCorner(215.797, 148.058, 0.0012, -0.0001, 0.0011)
    assert marker.corners[3] == MarkerCorner(140.086, 170.646, 0.0012, 0.0, 0.0011)
    assert format_record(marker) == ROW


@given(markers)
def test_what_is_written_is_read_back(marker: MarkerLandmark) -> None:
    text = format_record(marker)
    read = parse_record(text)
    assert read == marker
    assert read is not None
    assert format_record(read) == text


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        (ROW.rsplit(" ", 1)[0], "with 22 values: expected 23"),
        (ROW + " 1", "with 24 values: expected 23"),
        (ROW.replace(" 31 ", " -1 "), "ID is -1: expected 0 or more"),
        (ROW.replace(" 31 ", " 3.1 "), "ID is '3.1': expected a whole number"),
        (ROW.replace("215.7970", "nan"), "u is 'nan': expected a finite number"),
        (ROW.replace("0.987", "inf"), "quality is 'inf': expected a finite number"),
    ],
)
def test_what_is_no_marker_is_refused(row: str, complaint: str) -> None:
    with pytest.raises(LandmarkError, match=complaint):
        parse_record(row)


def test_a_marker_has_four_corners_and_a_dictionary_of_one_word() -> None:
    marker = parse_record(ROW)
    assert isinstance(marker, MarkerLandmark)
    with pytest.raises(LandmarkError, match="3 corners"):
        dataclasses.replace(marker, corners=marker.corners[:3])  # type: ignore[arg-type]
    with pytest.raises(LandmarkError, match="one word"):
        dataclasses.replace(marker, dictionary="two words")


def test_markers_are_found_among_a_frames_landmarks() -> None:
    marker = parse_record(ROW)
    assert isinstance(marker, MarkerLandmark)
    frame = Frame(Step("a", *[0.0] * 9), (marker,))
    assert frame.markers == (marker,)
    assert frame.circles == ()
    assert frame.lines == ()
