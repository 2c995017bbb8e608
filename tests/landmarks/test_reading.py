"""Reading: what the rows say, and what is said about rows that are wrong."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.landmarks import (
    CircleLandmark,
    Frame,
    LandmarkFileError,
    LineLandmark,
    Step,
    parse_rows,
    read_frames,
    read_rows,
    read_steps,
)
from redetect.landmarks.files import LEVEL, read_head
from tests.landmarks.rows import parse_record

STEP = "STEP e.0067 0.00391 -0.15602 -0.00218 0.1 0.2 0.3 0.4 0.5 0.6"
CIRCLE = "LANDMARK_C -0.302229 -2.66488 0.962567 0.00169895 0.000127857 0.00293675 26"


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "run.circles"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_rows_say_what_the_format_says() -> None:
    assert parse_record(STEP) == Step(
        prefix="e.0067", dx=0.00391, dy=-0.15602, dphi=-0.00218,
        cxx=0.1, cxy=0.2, cyy=0.3, cxphi=0.4, cyphi=0.5, cphiphi=0.6,
    )  # fmt: skip
    assert parse_record(CIRCLE) == CircleLandmark(
        px=-0.302229, py=-2.66488, quality=0.962567,
        cxx=0.00169895, cxy=0.000127857, cyy=0.00293675, ids=(26,),
    )  # fmt: skip
    assert parse_record("LANDMARK_L 1 2 3 4 5 6 0 8 14 681") == LineLandmark(
        xtop=1, ytop=2, xbottom=3, ybottom=4, alpha=5, beta=6, quality=0, sigma=8, ids=(14, 681)
    )


@pytest.mark.parametrize(
    ("tail", "ids"), [("", ()), (" -1", (-1,)), (" 3 4 5", (3, 4, 5)), (" 3 # new", (3,))]
)
def test_identifiers_may_be_missing_unknown_or_several(tail: str, ids: tuple[int, ...]) -> None:
    assert parse_record("LANDMARK_C 1 2 0.5 1 0 1" + tail) == CircleLandmark(
        1, 2, 0.5, 1, 0, 1, ids
    )


def test_the_heads_name_of_the_row_means_a_circle() -> None:
    assert parse_record(CIRCLE.replace("LANDMARK_C", "LANDMARK")) == parse_record(CIRCLE)


def test_detector_settings_are_rows_without_a_record(tmp_path: Path) -> None:
    path = write(tmp_path, f"CIRCLEMARKDETECTOR c.cam nohalf 0.10000 0.50000\n{STEP}\n")
    first, _ = read_rows(path)
    assert first.record is None
    assert first.source == b"CIRCLEMARKDETECTOR c.cam nohalf 0.10000 0.50000\n"
    assert len(list(read_frames(path))) == 1


@pytest.mark.parametrize("number", ["1", "+1", "1.", "1e0", "1E+000", "0.01e2", ".1e+1"])
def test_numbers_may_be_spelt_in_all_of_cs_ways(number: str) -> None:
    record = parse_record(f"LANDMARK_C {number} 0 0 0 0 0")
    assert isinstance(record, CircleLandmark)
    assert record.px == 1


@pytest.mark.parametrize("text", ["", "   ", "# STEP", "\t#", "\v"])
def test_comments_and_blank_lines_say_nothing(text: str) -> None:
    assert parse_record(text) is None


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_frames_gather_the_landmarks_after_each_step(tmp_path: Path, line_end: str) -> None:
    text = line_end.join(["# head", STEP, CIRCLE, "", "# note", CIRCLE, STEP.replace("67", "68")])
    step, circle = parse_record(STEP), parse_record(CIRCLE)
    assert isinstance(step, Step)
    assert isinstance(circle, CircleLandmark)
    first, second = read_frames(write(tmp_path, text))
    assert first == Frame(step, (circle, circle))
    assert (second.step.prefix, second.landmarks) == ("e.0068", ())
    assert [s.prefix for s in read_steps(tmp_path / "run.circles")] == ["e.0067", "e.0068"]


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_trailing_backslash_continues_the_row(tmp_path: Path, line_end: str) -> None:
    head, tail = CIRCLE[:26], CIRCLE[26:]
    assert (head[-1], tail[0]) == ("6", "4")  # as in C, even within a number
    text = f"{STEP}\n{head}\\{line_end}{tail}{line_end}{CIRCLE}"
    rows = list(read_rows(write(tmp_path, text)))
    assert rows[1].record == rows[2].record == parse_record(CIRCLE)
    assert [row.line for row in rows] == [1, 2, 4]


def test_a_comment_is_not_continued(tmp_path: Path) -> None:
    assert len(list(read_steps(write(tmp_path, f"# C:\\data\\\n{STEP}\n")))) == 1


def test_names_that_are_no_utf8_survive(tmp_path: Path) -> None:
    (step,) = read_steps(write(tmp_path, STEP.encode().replace(b"e.0067", b"b\xfcro.0001")))
    assert step.prefix.encode("utf-8", "surrogateescape") == b"b\xfcro.0001"


def test_a_byte_order_mark_is_no_part_of_the_first_row(tmp_path: Path) -> None:
    assert len(list(read_steps(write(tmp_path, b"\xef\xbb\xbf" + STEP.encode())))) == 1


@pytest.mark.parametrize("odd", ["\ufeff# by hand", "# one\u2028two", "# one\u0085two"])
def test_the_head_is_read_to_its_end(tmp_path: Path, odd: str) -> None:
    (tmp_path / "x.circles").write_text(f"{odd}\n# settings refine=True\n# {LEVEL}\n{STEP}\n")
    head = read_head(tmp_path / "x.circles")
    assert (head.settings, head.level) == ((("refine", "True"),), True)


def test_an_empty_file_has_no_frames(tmp_path: Path) -> None:
    assert list(read_frames(write(tmp_path, ""))) == []


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ("LANDMARK_C 1 2 nan 1 0 1", "quality is 'nan': expected a finite number"),
        ("LANDMARK_C 1 inf 0 1 0 1", "py is 'inf': expected a finite number"),
        ("LANDMARK_C 1e999 0 0 1 0 1", "px is inf: expected a finite number"),
        ("LANDMARK_C -1e300 0 0 1 0 1", "px is -1e+300: expected a finite number, within +-1e+24"),
        ("LANDMARK_C 1_0 0 0 1 0 1", "px is '1_0': expected a finite number"),
        ("LANDMARK_C 1,5 0 0 1 0 1", "px is '1,5': expected a finite number"),
        ("LANDMARK_C 1 2 3 4 5", "LANDMARK_C with 5 values: expected at least 6"),
        ("LANDMARK_L 1 2 3 4 5 6 7", "LANDMARK_L with 7 values: expected at least 8"),
        ("LANDMARK_C 1 2 0 4 5 6 7.5", "ID is '7.5': expected a whole number"),
        ("LANDMARK_C 1 2 0 4 5 6 " + "9" * 5000, "ID is '99999"),
        ("LANDMARK_C 1 2 0 4 5 6 9999999999999999999", "expected at most 64 bits"),
        ("STEP e.0 1 2 3 4 5 6 7 8", "STEP with 9 values: expected 10: prefix dx dy dphi"),
        (STEP + " 7", "STEP with 11 values: expected 10"),
        ("STEP e.0 1 2 3 4 5 6 7 8 x", "cphiphi is 'x'"),
        ("LANDMARK_X 1 2", "starts with 'LANDMARK_X': expected STEP, LANDMARK_C"),
        ("\x00\x1b[31m", r"starts with '\x00\x1b[31m'"),
        ("q" * 500, "starts with 'qqqqqqqqqq"),
        (CIRCLE + "\\", "expected a line to follow"),
    ],
)
def test_a_malformed_row_is_named_with_file_and_line(
    tmp_path: Path, row: str, problem: str
) -> None:
    path = write(tmp_path, f"# head\n\n{STEP}\n{row}")
    with pytest.raises(LandmarkFileError) as caught:
        list(read_rows(path))
    message = str(caught.value)
    assert message.startswith(f"{path}:4: ")
    assert problem in message
    assert len(message) < len(str(path)) + 200
    assert message.isprintable()


def test_a_landmark_before_any_step_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, f"# head\n{CIRCLE}\n{STEP}\n")
    with pytest.raises(LandmarkFileError, match=r"run\.circles:2: landmark before any STEP"):
        list(read_frames(path))


def test_a_comment_that_ends_in_a_backslash_ends_a_continued_row(tmp_path: Path) -> None:
    (row, step) = read_rows(write(tmp_path, f"\\\n# note\\\n{STEP}\n"))
    assert row.record is None
    assert (step.record, step.line) == (parse_record(STEP), 3)


@pytest.mark.parametrize("start", [b"#", b"STEP ", STEP.encode() + b"\\\n"])
def test_an_endless_line_is_refused(tmp_path: Path, start: bytes) -> None:
    path = write(tmp_path, start + b"1" * 100_000)
    with pytest.raises(LandmarkFileError, match="longer than 65536 bytes"):
        list(read_rows(path))


def test_rows_before_the_malformed_one_are_read_first(tmp_path: Path) -> None:
    rows = read_rows(write(tmp_path, f"{STEP}\nnonsense\n"))
    assert next(rows).record == parse_record(STEP)
    with pytest.raises(LandmarkFileError, match=r"run\.circles:2:"):
        next(rows)


def test_files_that_cannot_be_opened_are_named(tmp_path: Path) -> None:
    with pytest.raises(LandmarkFileError, match=r"missing\.circles: no such landmark file"):
        list(read_steps(tmp_path / "missing.circles"))
    with pytest.raises(LandmarkFileError, match="cannot be read as a landmark file"):
        list(read_steps(tmp_path))


ROW_LIKE = st.sampled_from([STEP, CIRCLE, "LANDMARK_L", "#", "\\", "\r", " ", "1e9", "XDETECTOR"])


@given(st.lists(st.one_of(st.binary(max_size=30), ROW_LIKE.map(str.encode)), max_size=20))
def test_any_bytes_give_rows_or_one_clear_error(pieces: list[bytes]) -> None:
    content = b"\n".join(pieces)
    sources, error = sources_and_error(content)
    if error is None:
        assert b"".join(sources) == content
    else:
        assert content.startswith(b"".join(sources))
        assert error.line is not None
        assert b"".join(sources).count(b"\n") < error.line <= content.count(b"\n") + 1
        assert str(error).startswith(f"x.circles:{error.line}: ")
        assert str(error).isprintable()


def sources_and_error(content: bytes) -> tuple[list[bytes], LandmarkFileError | None]:
    sources = []
    try:
        for row in parse_rows(io.BytesIO(content), name="x.circles"):
            sources.append(row.source or b"")
    except LandmarkFileError as error:
        return sources, error
    return sources, None


def test_the_shipped_file_has_its_known_numbers_of_rows(shared_data: Path) -> None:
    frames = list(read_frames(shared_data / "dlr" / "map.circles"))
    circles = [circle for frame in frames for circle in frame.circles]
    assert len(frames) == 3297
    assert len(circles) == 14745
    assert sum(circle.identified for circle in circles) == 14309
    assert sum(circle.ids == (-1,) for circle in circles) == 436
    assert len({circle.ids[0] for circle in circles if circle.identified}) == 576
