"""Calibration files: read generously, written as the data set's, refused with file and line."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import (
    Camera,
    CameraError,
    camera_in,
    format_camera,
    parse_camera,
    read_camera,
    write_camera,
)
from redetect.storage import OutputExistsError
from tests.camera.strategies import cameras
from tools.published_camera import PUBLISHED_CAM

NUMBERS = {
    "sensor2Tcp": "0.99992 -0.00994383 -0.00778315 -0.0820676 0.00718218 -0.0591054 0.998226 "
    "0.142944 -0.0103862 -0.998202 -0.0590291 0.0522051",
    "sensor2World": "-0.99992 0.00994383 0.00778315 0.0179777 -0.00211987 0.475426 -0.879753 "
    "-0.0808609 -0.0124484 -0.879699 -0.475367 1.50354",
    "mountIndex": "0",
    "width": "768",
    "height": "288",
    "scaleX": "464.762",
    "scaleY": "232.381",
    "offsetX": "384",
    "offsetY": "144",
    "coef": "-0.0620672 -0.324903 0.314764 1.52524 -0.480806",
}


def test_the_published_text_says_what_the_report_says(published_cam_text: str) -> None:
    camera = parse_camera(published_cam_text)
    assert (camera.width, camera.height, camera.mount_index) == (768, 288, 0)
    assert (camera.scale_x, camera.scale_y) == (464.762, 232.381)
    assert (camera.offset_x, camera.offset_y) == (384.0, 144.0)
    assert camera.coef == (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)
    assert camera.robot_from_camera[0] == (-0.99992, 0.00994383, 0.00778315, 0.0179777)
    assert camera.robot_from_camera[2] == (-0.0124484, -0.879699, -0.475367, 1.50354)
    assert camera.sensor_to_tcp is not None
    assert camera.sensor_to_tcp[1] == (0.00718218, -0.0591054, 0.998226, 0.142944)
    assert camera.unknown == ()


def test_the_published_text_is_written_as_it_was(published_cam_text: str) -> None:
    assert format_camera(parse_camera(published_cam_text)) == published_cam_text


# -- one content, any layout --------------------------------------------------------------------

BLANK = st.text(" \t\n\r\v\f", min_size=1, max_size=4)
COMMENT = st.text(
    st.characters(codec="utf-8", exclude_characters="\r\n"), max_size=12
).map(lambda text: f" #{text}\n")  # fmt: skip
GAP = st.lists(BLANK | COMMENT | st.just(" , "), min_size=1, max_size=3).map("".join)


@st.composite
def layouts(draw: st.DrawFn) -> str:
    """The published camera, its keys in any order and anything between its tokens."""

    def gap() -> str:
        return draw(GAP)

    parts = ["{", gap(), "SmRadialDistortedCamera", gap()]
    for key in draw(st.permutations(list(NUMBERS))):
        parts += [key, draw(st.just("") | GAP), ":", draw(st.just("") | GAP)]
        numbers = NUMBERS[key].split()
        bracket = draw(st.sampled_from(["", "[]", "{}"]))
        if bracket:
            numbers = [bracket[0], *numbers, bracket[1]]
        parts += [part for number in numbers for part in (number, gap())]
    return "".join([*parts, "}", draw(st.just("") | GAP)])


@given(layouts())
def test_white_space_commas_comments_brackets_and_order_make_no_difference(text: str) -> None:
    assert parse_camera(text) == parse_camera(PUBLISHED_CAM)


@given(cameras(), st.integers(0, 9))
def test_any_camera_comes_back_from_its_text(camera: Camera, mount_index: int) -> None:
    camera = dataclasses.replace(camera, mount_index=mount_index)
    text = format_camera(camera)
    assert parse_camera(text) == camera
    assert format_camera(parse_camera(text)) == text


WORD = st.from_regex(r"[A-Za-z_][A-Za-z0-9_.+/-]{0,11}", fullmatch=True)


@st.composite
def unknown_entries(draw: st.DrawFn) -> list[tuple[str, str]]:
    keys = draw(st.lists(WORD.filter(lambda w: w not in NUMBERS), unique=True, max_size=4))
    values = st.lists(WORD | st.just("[ 1 2 ]") | st.just("{ a : 1 b : { 2 } }"), max_size=3)
    return [(key, " ".join(draw(values))) for key in keys]


@given(unknown_entries(), st.booleans())
def test_unknown_keys_are_kept_and_written_back(
    entries: list[tuple[str, str]], first: bool
) -> None:
    added = "".join(f"{key}: {text}\n" for key, text in entries)
    head, body = PUBLISHED_CAM.split("\n", 1)
    parts = [head, "\n", added, body] if first else [head, "\n", body[:-2], added, "}"]
    camera = parse_camera("".join(parts))
    assert camera.unknown == tuple(entries)
    assert parse_camera(format_camera(camera)) == camera
    assert camera.content_hash == parse_camera(PUBLISHED_CAM).content_hash


def test_what_may_be_missing(published_cam_text: str) -> None:
    text = published_cam_text.replace("mountIndex: 0\n", "")
    text = re.sub(r"sensor2Tcp:( *\[[^]]*\]\s*){3}", "", text)
    camera = parse_camera(text)
    assert camera.mount_index == 0
    assert camera.sensor_to_tcp is None
    assert parse_camera(format_camera(camera)) == camera


# -- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("width: 768 ", "", "e.cam: lacks width"),
        ("width: 768", "width: 768 768", r"e.cam:9: width has 2 numbers: expected 1"),
        ("width: 768", "width: ", r"e.cam: width has 0 numbers: expected 1"),
        ("width: 768", "width: 768.5", r"e.cam:9: width is 768.5: expected a whole number"),
        ("width: 768", "width: wide", r"e.cam:9: width has 'wide': expected a number"),
        ("width: 768", "width: 7_68", r"e.cam:9: width has '7_68': expected a number"),
        ("width: 768", "width: ٧٦٨", r"e.cam:9: width has '.*': expected a number"),
        ("width: 768", "width: 768 width: 768", r"e.cam:9: 'width' is given twice"),
        ("width: 768", "width: 0", "e.cam: width is 0: expected 1 to"),
        ("scaleX: 464.762", "scaleX: nan", r"e.cam:9: scaleX has 'nan': expected a number"),
        ("scaleX: 464.762", "scaleX: 1e999", r"e.cam:9: scaleX has '1e999': expected a number th"),
        ("scaleX: 464.762", "scaleX: -464.762", "e.cam: scaleX is -464.762: expected a positive"),
        ("-0.480806 }", "}", r"e.cam:10: coef has 4 numbers: expected 5"),
        ("-0.480806 }", "-0.480806 ]", r"e.cam:10: unexpected \]"),
        ("1.50354 ]", "1.50354", r"e.cam:\d+: "),
        ("-0.475367", "0.475367", "e.cam: sensor2World is not a rotation"),
        ("SmRadialDistortedCamera", "Pinhole", "e.cam: begins with '{ Pinhole': expected"),
        ("{ SmRadial", "SmRadial", "e.cam: begins with"),
        ("}\n}", "}\n", "e.cam: ends before its closing brace"),
        ("}\n}", "}\n}\nmore", r"e.cam:12: text after the closing brace"),
        ("Camera\n", "Camera\n 7\n", r"e.cam:2: unexpected '7': expected 'key: value'"),
        ("mountIndex: 0", "mountIndex: : 0", r"e.cam:8: unexpected ':'"),
    ],
)
def test_errors_name_file_line_and_what_was_expected(
    tmp_path: Path, published_cam_text: str, old: str, new: str, complaint: str
) -> None:
    assert published_cam_text.count(old) == 1
    path = tmp_path / "e.cam"
    path.write_text(published_cam_text.replace(old, new), encoding="utf-8")
    with pytest.raises(CameraError, match=complaint) as caught:
        read_camera(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_line_numbers_are_an_editor_s(published_cam_text: str) -> None:
    text = "# page one\f page two \x1c still the comment\r\n" + published_cam_text
    with pytest.raises(CameraError, match=r"<text>:10: width has 'x'"):
        parse_camera(text.replace("width: 768", "width: x"))


def test_a_missing_file_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(CameraError) as caught:
        read_camera(tmp_path / "none.cam")
    assert str(caught.value) == f"{tmp_path / 'none.cam'}: no such calibration file"


def test_what_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.cam"
    path.write_bytes(b"\xff\xd8\xff\xe0 not a calibration")
    with pytest.raises(CameraError, match=r"cannot be read as a calibration file"):
        read_camera(path)
    path.write_bytes(b" " * (1 << 20) + b"{")
    with pytest.raises(CameraError, match="larger than 1048576 bytes"):
        read_camera(path)
    with pytest.raises(CameraError, match=r"cannot be read as a calibration file"):
        read_camera(tmp_path)


def test_a_byte_order_mark_does_not_matter(tmp_path: Path, published_cam_text: str) -> None:
    path = tmp_path / "e.cam"
    path.write_text(published_cam_text, encoding="utf-8-sig")
    assert read_camera(path) == parse_camera(published_cam_text)


SCRAPS = ["{", "}", "[", "]", ":", "#", ",", "\n", "width:", "coef", "1e308", "-1e308", "nan",
          "5e-324", "1e99999", "-0", "0x10", "\x00", "\u2028", "99999999999999999999"]  # fmt: skip


@st.composite
def damaged_texts(draw: st.DrawFn) -> str:
    """The published text after a few cuts and insertions."""
    text = PUBLISHED_CAM
    for _ in range(draw(st.integers(1, 5))):
        begin = draw(st.integers(0, len(text)))
        end = min(len(text), begin + draw(st.sampled_from([0, 1, 2, 5, 30, 200])))
        scrap = draw(st.sampled_from(SCRAPS) | st.text(max_size=5) | st.floats().map(str))
        text = text[:begin] + scrap + text[end:]
    return text


@given(damaged_texts() | st.text())
def test_any_text_is_a_camera_or_a_camera_error(text: str) -> None:
    complaint = "e.cam: fine"
    try:
        camera = parse_camera(text, name="e.cam")
        assert parse_camera(format_camera(camera)) == camera
    except CameraError as error:
        complaint = str(error)
    assert complaint.startswith("e.cam:")
    assert "\n" not in complaint


@given(st.sampled_from(sorted(NUMBERS)), st.integers(0, 11), st.floats().map(repr))
def test_any_number_anywhere_is_a_camera_or_a_camera_error(key: str, at: int, number: str) -> None:
    """Extreme numbers may not surface as warnings or errors of the arithmetic."""
    entries = {k: v.split() for k, v in NUMBERS.items()}
    entries[key][at % len(entries[key])] = number
    body = " ".join(f"{k}: {' '.join(v)}" for k, v in entries.items())
    with contextlib.suppress(CameraError):
        camera = parse_camera(f"{{ SmRadialDistortedCamera {body} }}")
        assert parse_camera(format_camera(camera)) == camera


# -- writing ------------------------------------------------------------------------------------


def test_a_written_camera_is_read_back(tmp_path: Path, published_camera: Camera) -> None:
    path = tmp_path / "out.cam"
    write_camera(published_camera, path)
    assert read_camera(path) == published_camera
    assert path.read_bytes().decode() == format_camera(published_camera)
    assert [p.name for p in tmp_path.iterdir()] == ["out.cam"]


def test_hidden_files_beside_a_calibration_are_none(
    tmp_path: Path, published_camera: Camera
) -> None:
    write_camera(published_camera, tmp_path / "front.cam")
    (tmp_path / "._front.cam").write_bytes(b"notes")
    assert camera_in(tmp_path) == published_camera


def test_an_existing_file_stays_unless_told_otherwise(
    tmp_path: Path, published_camera: Camera
) -> None:
    path = tmp_path / "out.cam"
    path.write_text("precious")
    with pytest.raises(OutputExistsError, match="exists already"):
        write_camera(published_camera, path)
    assert path.read_text() == "precious"
    write_camera(published_camera, path, overwrite=True)
    assert read_camera(path) == published_camera
    assert [p.name for p in tmp_path.iterdir()] == ["out.cam"]
