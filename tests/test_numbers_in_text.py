"""Numbers in files: Python reads 1_000 as a number, readers of files refuse it on one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from camera.formats.colmap import parse_colmap
from detect.settings import CircleSettings
from detect.settings_files import word_value
from redetect.bounds import number_in, whole_number_in
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import read_frames, read_tilts
from redetect.landmarks.frame_files import read_times
from redetect.landmarks.map_file import read_map, read_path
from redetect.messages import OneLineError
from redetect.slam.formats.g2o import read_g2o
from redetect.slam.formats.tum import read_tum


def _read_colmap(path: Path) -> Any:
    return parse_colmap(path.read_text(), str(path))


FILES: list[tuple[Callable[[Path], Any], str]] = [
    (_read_colmap, "1 PINHOLE @ 480 500 500 320 240"),
    (_read_colmap, "1 PINHOLE 640 480 500 500 320 @"),
    (lambda path: list(read_frames(path)), "STEP a @ 0 0 1 0 1 0 0 1"),
    (read_tilts, "TILT a 0 0 1e-4 0 1e-4 @"),
    (read_tilts, "TILT a @ 0 1e-4 0 1e-4 9"),
    (read_times, "a @"),
    (read_map, "id,x_m,y_m,rows\n1,@,0,1"),
    (read_map, "id,x_m,y_m,rows\n@,0,0,1"),
    (read_path, "prefix,x_m,y_m,theta_rad\na,0,@,0"),
    (read_tum, "0 @ 0 0 0 0 0 1"),
    (read_g2o, "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 @ 0 0 0\nEDGE_SE2 0 @ 1 0 0 1 0 0 1 0 1"),
    (read_g2o, "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 @ 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"),
    (read_planar_poses, "0 @ 0 0"),
]


@pytest.mark.parametrize(("read", "content"), FILES)
def test_an_underscore_is_in_no_number(
    tmp_path: Path, read: Callable[[Path], Any], content: str
) -> None:
    path = tmp_path / "file.txt"
    path.write_text(content.replace("@", "10") + "\n")
    read(path)
    path.write_text(content.replace("@", "1_0") + "\n")
    with pytest.raises(OneLineError, match=r"^.*file\.txt:\d.*$"):
        read(path)


def test_a_setting_with_an_underscore_is_a_word() -> None:
    with pytest.raises(OneLineError, match="'1_0'"):
        word_value(CircleSettings, "radius_m", "1_0")


@pytest.mark.parametrize("word", ["1_0", "_1", "1_", "1e1_0", "", "x"])
def test_words_that_are_no_numbers(word: str) -> None:
    for read in (number_in, whole_number_in):
        with pytest.raises(ValueError, match=r"could not convert|invalid literal"):
            read(word)


def test_words_that_are_numbers() -> None:
    assert number_in("-1.5e-3") == -0.0015
    assert whole_number_in("+12") == 12
