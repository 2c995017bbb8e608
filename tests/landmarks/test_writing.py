"""Writing: the data set's layout, and files that come back byte by byte."""

from __future__ import annotations

import io
import tempfile
from dataclasses import astuple, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.landmarks import (
    CircleLandmark,
    Record,
    Row,
    format_record,
    frames_of_rows,
    parse_rows,
    read_frames,
    read_rows,
    write_frames,
    write_rows,
)
from redetect.storage import OutputExistsError
from tests.landmarks.rows import parse_record

# The report's figures 7, 10 and 11, and a row of run c. Where the report's print has one blank
# between columns, files have two before a positive number of a pose.
PUBLISHED = """\
STEP dlr-spatial_cognition-e.0067  0.00391 -0.15602 -0.00218 \
0.000014424957 0.000000041534 0.000012538057 0.000018179117 0.000000374277 0.000233656364
LANDMARK_C -0.302229 -2.66488 0.962567 0.00169895 0.000127857 0.00293675 26
LANDMARK_C 1.0116 -2.15034 0.951867 0.00175878 -0.000250459 0.00238307 25
LANDMARK_C -0.96104 -1.69011 0.993179 0.00171485 0.000154117 0.00202176 24
STEP dlr-spatial_cognition-e.0068  0.00234 -0.15677 -0.00241 \
0.000014516278 0.000000028754 0.000012599615 0.000018361033 0.000000288615 0.000234812837
LANDMARK_C -0.176652 -3.54651 0.756458 0.00174355 0.000174856 0.00500673 28
LANDMARK_C -0.302829 -2.53982 0.978849 0.0016918 0.000113261 0.00275804 26
LANDMARK_C 1.01062 -2.01621 0.96499 0.00174479 -0.00021812 0.00226073 25
LANDMARK_C 0.67972 -2.87676 0.600235 0.00176143 -0.000314459 0.00334762 -1
STEP dlr-spatial_cognition-e.0000  0.00088 -0.15647  0.01153 \
0.000016397281 -0.000000002137 0.000014026487 0.000021731727 -0.000000042656 0.000261252446
LANDMARK_L -0.80286 -0.625259 -0.694207 -0.273645 0.600694 0.0251159 0 0.00291193 1
LANDMARK_L -0.474484 -0.583026 -0.397523 -0.148873 0.39069 0.0302675 0 0.00574867 4
LANDMARK_L -0.300722 -0.586752 -0.220978 0.0441848 0.255339 0.00867793 0 0.0027596 9
LANDMARK_L -0.169833 -0.58019 -0.147315 -0.254943 0.14735 0.0130423 0 0.00289818 14 681
LANDMARK_L -0.0350638 -0.571825 -0.0321665 -0.22555 0.0318137 0.0194733 0 0.002966 20
LANDMARK_L 0.144026 -0.576694 0.118327 -0.0896802 -0.122526 0.00451754 0 0.00954949 17 18 19
STEP dlr-spatial_cognition-e.0001 -0.00470 -0.18707  0.06820 \
0.000019834605 -0.000000084074 0.000016337711 0.000028153298 -0.000000708950 0.000304450153
LANDMARK_L -0.73896 -0.618702 -0.641319 -0.255913 0.5639 0.040412 0 0.00277288 1
LANDMARK_L -0.518443 -0.592225 -0.469403 -0.325537 0.421207 0.0414013 0 0.00273231 2
LANDMARK_C -0.782228 -1.24079 0.986223 0.00166334 7.09189e-05 0.00181023 5
"""


@pytest.mark.parametrize("row", PUBLISHED.splitlines())
def test_published_rows_are_written_as_they_are_printed(row: str) -> None:
    record = parse_record(row)
    assert record is not None
    assert format_record(record) == row


def test_frames_are_written_in_the_data_sets_layout(tmp_path: Path) -> None:
    path = tmp_path / "out.circles"
    frames = list(frames_of_rows(parse_rows(io.BytesIO(PUBLISHED.encode()))))
    write_frames(path, iter(frames), head="Simulated.\n\nSee README.")
    assert path.read_text() == "# Simulated.\n#\n# See README.\n" + PUBLISHED
    assert list(read_frames(path)) == frames


def test_an_existing_file_is_kept_unless_told_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "out.circles"
    path.write_text("precious")
    with pytest.raises(OutputExistsError):
        write_frames(path, [])
    with pytest.raises(OutputExistsError):
        write_rows(path, [])
    assert path.read_text() == "precious"


def test_a_failure_halfway_leaves_no_file(tmp_path: Path) -> None:
    source = tmp_path / "broken.circles"
    source.write_text(PUBLISHED + "nonsense\n")
    with pytest.raises(ValueError, match="nonsense"):
        write_frames(tmp_path / "out.circles", read_frames(source))
    assert [path.name for path in tmp_path.iterdir()] == ["broken.circles"]


def test_only_the_changed_row_changes(tmp_path: Path) -> None:
    original = b"# Head\r\n \r\n" + PUBLISHED.replace("\n", "\r\n").encode()
    path = tmp_path / "map.circles"
    path.write_bytes(original)
    rows = []
    for row in read_rows(path):
        record = row.record
        if isinstance(record, CircleLandmark):
            ids = (260,) if record.ids == (26,) else record.ids
            row = row.with_record(replace(record, ids=ids))
        rows.append(row)
    write_rows(path, rows, overwrite=True)
    assert path.read_bytes() == original.replace(b" 26\r\n", b" 260\r\n")


def test_a_last_line_without_end_gets_one_when_rows_follow(tmp_path: Path) -> None:
    step = PUBLISHED.splitlines()[0]
    source = tmp_path / "a.circles"
    source.write_bytes(f"# head\r\n{step}".encode())
    circle = CircleLandmark(1, -2, 0.5, 1, 0, 1, (3,))
    write_rows(tmp_path / "b.circles", [*read_rows(source), Row(circle)])
    expected = f"# head\r\n{step}\r\nLANDMARK_C 1 -2 0.5 1 0 1 3\r\n"
    assert (tmp_path / "b.circles").read_bytes() == expected.encode()


def test_the_shipped_file_comes_back_byte_by_byte(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "dlr" / "map.circles"
    rows = list(read_rows(path))
    write_rows(tmp_path / "copied.circles", rows)
    assert (tmp_path / "copied.circles").read_bytes() == path.read_bytes()
    laid_out_anew = (row if row.record is None else Row(row.record) for row in rows)
    write_rows(tmp_path / "anew.circles", laid_out_anew)
    assert (tmp_path / "anew.circles").read_bytes() == path.read_bytes()


# Files as people and programs may write them: any order of digits, blanks, comments, line ends.
NUMBER = st.floats(-1e6, 1e6).flatmap(
    lambda x: st.sampled_from([f"{x:g}", f"{x:.5f}", f"{x:.12f}", repr(x), f"{x:e}", f"{x:+G}"])
)
BLANKS = st.sampled_from([" ", "  ", "\t", " \\\n", "\\\r\n "])
PREFIX = st.from_regex(r"[A-Za-z0-9._/\-äß]{1,30}", fullmatch=True)
IDS = st.lists(st.integers(-1, 2**62).map(str), max_size=3)
WORDS = st.one_of(
    st.builds(lambda p, n: ["STEP", p, *n], PREFIX, st.lists(NUMBER, min_size=9, max_size=9)),
    st.builds(lambda n, i: ["LANDMARK_C", *n, *i], st.lists(NUMBER, min_size=6, max_size=6), IDS),
    st.builds(lambda n, i: ["LANDMARK_L", *n, *i], st.lists(NUMBER, min_size=8, max_size=8), IDS),
)
COMMENT = st.binary(max_size=40).map(lambda b: b"#" + b.replace(b"\n", b""))


@st.composite
def data_row(draw: st.DrawFn) -> bytes:
    words = draw(WORDS)
    text = "".join(word + draw(BLANKS) for word in words[:-1]) + words[-1]
    start: str = draw(st.sampled_from(["", " "]))
    end: str = draw(st.sampled_from(["", "  ", " # note"]))
    return f"{start}{text}{end}".encode()


@st.composite
def landmark_file(draw: st.DrawFn) -> bytes:
    rows = draw(st.lists(st.one_of(data_row(), COMMENT, st.just(b""), st.just(b" ")), max_size=12))
    content = PUBLISHED.splitlines()[0].encode()
    for row in rows:
        content += draw(st.sampled_from([b"\n", b"\r\n"])) + row
    return content + draw(st.sampled_from([b"", b"\n", b"\r\n"]))


@given(landmark_file())
def test_any_file_comes_back_byte_by_byte(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "copy"
        write_rows(path, parse_rows(io.BytesIO(content)))
        assert path.read_bytes() == content


@given(data_row())
def test_written_rows_are_read_with_the_digits_written(row: bytes) -> None:
    first_step = PUBLISHED.splitlines()[0].encode()
    _, parsed = parse_rows(io.BytesIO(first_step + b"\n" + row))
    assert parsed.record is not None
    text = format_record(parsed.record)
    again = parse_record(text)
    assert again is not None
    assert type(again) is type(parsed.record)
    assert format_record(again) == text
    assert words_of(again) == words_of(parsed.record)
    # Half of the last digit, and what binary numbers are off by.
    assert numbers_of(again) == pytest.approx(numbers_of(parsed.record), rel=5e-6, abs=5.001e-6)


def numbers_of(record: Record) -> list[float]:
    return [value for value in astuple(record) if isinstance(value, float)]


def words_of(record: Record) -> list[object]:
    return [value for value in astuple(record) if not isinstance(value, float)]
