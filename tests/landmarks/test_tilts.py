"""Tilt files: what is written is read, and what is wrong is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.landmarks import (
    FrameTilt,
    LandmarkFileError,
    format_no_tilt,
    format_outline_tilt,
    format_tilt,
    read_tilts,
    tilt_as_written,
)
from redetect.landmarks.frame_files import numbered_tilts

ANGLE = st.floats(-0.2, 0.2)
VARIANCE = st.floats(1e-9, 1e-3)


@given(pitch=ANGLE, roll=ANGLE, cpp=VARIANCE, crr=VARIANCE, c=st.floats(-0.9, 0.9))
def test_written_tilts_are_read(
    tmp_path_factory: pytest.TempPathFactory,
    pitch: float,
    roll: float,
    cpp: float,
    crr: float,
    c: float,
) -> None:
    tilt = FrameTilt("e.0001", pitch, roll, cpp, c * (cpp * crr) ** 0.5, crr, 7)
    path = tmp_path_factory.mktemp("tilt") / "e.tilt"
    path.write_text(f"# head\n\n{format_no_tilt('e.0000', 2)}\n{format_tilt(tilt)}\n")
    (read,) = read_tilts(path).values()
    assert (read.prefix, read.lines) == ("e.0001", 7)
    assert read.pitch == pytest.approx(pitch, abs=5e-7)
    assert read.roll == pytest.approx(roll, abs=5e-7)
    assert read.cpp == pytest.approx(cpp, rel=1e-5)
    assert read.crr == pytest.approx(crr, rel=1e-5)


@pytest.mark.parametrize(
    "row",
    [
        "TILT e.0000 0.01 0.02 1e-6 0 1e-6",
        "TILT e.0000 0.01 0.02 1e-6 0 1e-6 many",
        "TILT e.0000 nan 0.02 1e-6 0 1e-6 5",
        "TILT e.0000 0.01 0.02 1e-6 2e-6 1e-6 5",
        "TILT e.0000 0.01 0.02 -1e-6 0 1e-6 5",
        "STEP e.0000 0 0 0",
    ],
)
def test_malformed_rows_are_named(tmp_path: Path, row: str) -> None:
    path = tmp_path / "e.tilt"
    path.write_text(f"# head\n{row}\n")
    with pytest.raises(LandmarkFileError, match=r"e\.tilt:2: "):
        read_tilts(path)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(LandmarkFileError, match=r"none\.tilt: no such tilt file"):
        read_tilts(tmp_path / "none.tilt")


def test_what_outlines_show_is_passed_over(tmp_path: Path) -> None:
    tilt = FrameTilt("a/b", 0.01, -0.02, 1e-6, 0.0, 2e-6, 4)
    path = tmp_path / "x.tilt"
    rows = format_tilt(tilt), format_outline_tilt(tilt), "NOTILT c 2", "TILT d 0 0 1 0 1 3"
    path.write_text("\n".join(rows) + "\n")

    assert [(number, found.prefix) for number, found in numbered_tilts(path)] == [
        (0, "a/b"),
        (2, "d"),
    ]


@pytest.mark.parametrize("prefix", ["a#1", "a\u00a0b"])
def test_any_prefix_of_a_step_may_have_a_tilt(tmp_path: Path, prefix: str) -> None:
    tilt = FrameTilt(prefix, 0.01, -0.02, 1e-6, 0.0, 2e-6, 4)
    assert tilt_as_written(tilt) == tilt
    path = tmp_path / "x.tilt"
    path.write_text(format_tilt(tilt) + "\r\n", newline="")
    assert read_tilts(path) == {prefix: tilt}
