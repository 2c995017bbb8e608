"""Values that are stored in 16 bits: one scale in all images of a run, found or stated."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from detect.cli import main
from detect.errors import DetectError, FrameError
from detect.options import SourceOptions
from detect.sources.grey_images import read_image
from detect.sources.opening import open_source
from tests.detect.commands import Captured
from tools.ros_bags import Ros, Said


def ramp(brightest: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint16]]:
    return np.linspace(0, brightest, 64 * 48).reshape(48, 64).astype(np.uint16)


def write(folder: Path, *brightest: int) -> Path:
    for number, each in enumerate(brightest):
        assert cv2.imwrite(str(folder / f"s.{number:04d}.png"), ramp(each))
    return folder


@pytest.mark.parametrize("dark_first", [True, False])
def test_dark_and_bright_images_have_one_scale(tmp_path: Path, dark_first: bool) -> None:
    brightest = (500, 4000, 0) if dark_first else (4000, 500, 0)
    run = open_source(write(tmp_path, *brightest))
    assert run.bit_depth == 12
    for frame, each in zip(run.frames, brightest, strict=True):
        np.testing.assert_array_equal(read_image(frame, None), ramp(each) >> 4)


def test_images_of_all_of_a_long_run_are_considered(tmp_path: Path) -> None:
    for number in range(64):
        assert cv2.imwrite(
            str(tmp_path / f"s.{number:04d}.png"), ramp(500 if number < 60 else 4000)
        )
    assert open_source(tmp_path).bit_depth == 12


def test_messages_of_a_bag_have_one_scale(tmp_path: Path) -> None:
    ros, brightest = Ros(), (900, 4000)
    said = [
        Said("/i", 1.0 + k, ros.image(ramp(b), "mono16", 1.0 + k)) for k, b in enumerate(brightest)
    ]
    run = open_source(ros.write(tmp_path / "d", said))
    for frame, each in zip(run.frames, brightest, strict=True):
        np.testing.assert_array_equal(read_image(frame, None), ramp(each) >> 4)


def test_a_stated_depth_counts(tmp_path: Path) -> None:
    run = open_source(write(tmp_path, 500, 900), None, SourceOptions(bit_depth=14))
    assert run.bit_depth == 14
    for frame, each in zip(run.frames, (500, 900), strict=True):
        np.testing.assert_array_equal(read_image(frame, None), ramp(each) >> 6)
    with pytest.raises(DetectError, match="bit_depth is 7: expected a whole number, 8 to 16"):
        SourceOptions(bit_depth=7)


def test_the_first_frames_of_a_run_have_its_scale(tmp_path: Path) -> None:
    (frame,) = open_source(write(tmp_path, 500, 4000), None, SourceOptions(frames=1)).frames
    np.testing.assert_array_equal(read_image(frame, None), ramp(500) >> 4)


def test_values_beyond_the_depth_are_no_grey_values(tmp_path: Path) -> None:
    run = open_source(write(tmp_path, 500, 4000), None, SourceOptions(bit_depth=10))
    first, second = run.frames
    assert read_image(first, None).max() == 500 >> 2
    with pytest.raises(FrameError, match=r"s\.0001\.png: values of 12 bits: expected 10"):
        read_image(second, None)


def test_images_of_8_bits_need_no_depth(small_run: Path) -> None:
    run = open_source(small_run)
    assert run.bit_depth is None
    assert {frame.bit_depth for frame in run.frames} == {None}


def test_the_results_say_the_depth_whatever_the_number_of_processes(
    small_run: Path, capsys: Captured
) -> None:
    for number, path in enumerate(sorted((small_run / "images").iterdir())):
        values = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)).astype(np.uint16)
        assert cv2.imwrite(str(path), values << (2, 4, 3)[number])
    contents = []
    for jobs in ("1", "2"):
        assert main(["circles", str(small_run), "--jobs", jobs, "--force"]) == 0
        assert "the 8 highest of 12 bits are used (--bit-depth)" in capsys.readouterr().out
        contents.append((small_run / "detected.circles").read_bytes())
    assert contents[0] == contents[1]
    assert b"the 8 highest of 12 bits are used" in contents[0]
    log = json.loads((small_run / "detected.circles.log.json").read_text())
    assert log["bit_depth"] == 12
