"""Runs on disk: what is found, in which order, and what is refused with which words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, CameraError
from detect.errors import FrameError
from detect.sources.grey_images import read_image
from detect.sources.interface import RunFrame
from detect.sources.opening import open_run
from redetect.landmarks import Step

ZEROS = (0.0,) * 9
TEXTURE = np.random.default_rng(3).integers(0, 256, (288, 768)).astype(np.uint8)


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def step_row(prefix: str, dx: float = 0.25) -> str:
    return f"STEP {prefix} {dx:.5f} 0.1 0.01 1e-5 0 1e-5 0 0 1e-4\n"


@pytest.fixture
def run_folder(tmp_path: Path, published_cam_text: str) -> Path:
    folder = tmp_path / "k"
    folder.mkdir()
    (folder / "k.cam").write_text(published_cam_text)
    return folder


def test_run_folder_of_the_data_set(run_folder: Path, published_camera: Camera) -> None:
    touch(run_folder, "images/k.0000.jpg", "images/k.0001.jpg")
    (run_folder / "k.txt").write_text(
        "# odometry\n" + step_row("k.0000", 0.5) + step_row("k.0001", -0.25)
    )
    run = open_run(run_folder)
    assert run.name == "k"
    assert run.camera == published_camera
    assert run.odometry == run_folder / "k.txt"
    assert [frame.image for frame in run.frames] == [
        run_folder / "images" / "k.0000.jpg",
        run_folder / "images" / "k.0001.jpg",
    ]
    first, second = (frame.step for frame in run.frames)
    assert first == Step("k.0000", 0.5, 0.1, 0.01, 1e-5, 0.0, 1e-5, 0.0, 0.0, 1e-4)
    assert second.dx == -0.25
    assert run.frames.expected == 2
    assert run.frames.left_out == 0


def test_flat_folder_of_images(run_folder: Path) -> None:
    touch(run_folder, "b.png", "a.JPG", "notes.md", "c.tiff")
    run = open_run(run_folder)
    assert run.odometry is None
    assert [frame.step for frame in run.frames] == [Step(name, *ZEROS) for name in "abc"]
    assert [frame.image for frame in run.frames] == [
        run_folder / name for name in ("a.JPG", "b.png", "c.tiff")
    ]


def test_images_folder_goes_before_loose_images(run_folder: Path) -> None:
    touch(run_folder, "images/a.png", "preview.png")
    assert [frame.step.prefix for frame in open_run(run_folder).frames] == ["a"]


def test_white_space_in_names_does_not_break_rows(run_folder: Path) -> None:
    touch(run_folder, "left image 1.png")
    (frame,) = open_run(run_folder).frames
    assert frame.step.prefix == "left_image_1"
    assert frame.image == run_folder / "left image 1.png"


def test_names_that_are_no_words_of_a_row_cost_no_run(run_folder: Path) -> None:
    touch(run_folder, "#1.png", "a#2.png", "b\\.png", "c\\d.png")
    run = open_run(run_folder)
    assert [frame.step.prefix for frame in run.frames] == ["_1", "a_2", "b_", "c_d"]
    assert [frame.failure for frame in run.frames] == [None] * 4


def test_odometry_of_the_landmark_file(run_folder: Path) -> None:
    """Landmark rows between the steps are no concern of the run's."""
    touch(run_folder, "images/k.0000.jpg", "images/k.0001.jpg")
    (run_folder / "map.circles").write_bytes(
        (
            step_row("k.0001", 0.75)
            + "LANDMARK_C 0.1 -2 0.9 0.0016 0 0.0016 4\n"
            + step_row("k.0000", 0.125)
        )
        .replace("\n", "\r\n")
        .encode()
    )
    run = open_run(run_folder)
    assert run.odometry == run_folder / "map.circles"
    assert [(f.step.prefix, f.step.dx) for f in run.frames] == [("k.0001", 0.75), ("k.0000", 0.125)]


def test_own_odometry_goes_before_the_landmark_file(run_folder: Path) -> None:
    touch(run_folder, "images/k.0000.jpg")
    (run_folder / "k.txt").write_text(step_row("k.0000", 0.75))
    (run_folder / "map.circles").write_text(step_row("k.0000", 0.5))
    assert next(iter(open_run(run_folder).frames)).step.dx == 0.75


def test_the_only_calibration_may_have_any_name(run_folder: Path, published_camera: Camera) -> None:
    touch(run_folder, "a.png")
    (run_folder / "k.cam").rename(run_folder / "whatever.cam")
    assert open_run(run_folder).camera == published_camera


def test_of_several_calibrations_the_runs_own(run_folder: Path, published_camera: Camera) -> None:
    touch(run_folder, "a.png", "a.cam")
    assert open_run(run_folder).camera == published_camera


def test_several_calibrations_none_its_own(run_folder: Path) -> None:
    touch(run_folder, "a.png", "l.cam")
    (run_folder / "k.cam").rename(run_folder / "r.cam")
    with pytest.raises(CameraError, match=r"several calibrations \(l\.cam, r\.cam\).*--camera"):
        open_run(run_folder)


def test_named_calibration_goes_before_the_runs_own(
    run_folder: Path, tmp_path: Path, published_cam_text: str
) -> None:
    touch(run_folder, "a.png")
    other = tmp_path / "other.cam"
    other.write_text(published_cam_text.replace("offsetX: 384", "offsetX: 380"))
    assert open_run(run_folder, other).camera.offset_x == 380


# -- images ---------------------------------------------------------------------------------


def frame_of(path: Path) -> RunFrame:
    return RunFrame(Step(path.stem, *ZEROS), path)


def refusal(path: Path, camera: Camera) -> str:
    with pytest.raises(FrameError) as error:
        read_image(frame_of(path), camera)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def written(path: Path, image: NDArray[np.integer[Any]]) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize("suffix", ["png", "pgm", "bmp", "tif"])
def test_grey_values_are_those_of_the_file(
    tmp_path: Path, published_camera: Camera, suffix: str
) -> None:
    path = written(tmp_path / f"a.{suffix}", TEXTURE)
    image = read_image(frame_of(path), published_camera)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, TEXTURE)


def test_jpeg_is_decoded(tmp_path: Path, published_camera: Camera) -> None:
    v, u = np.indices((288, 768))
    smooth = (40 + u / 6 + v / 6).astype(np.uint8)
    image = read_image(frame_of(written(tmp_path / "a.jpg", smooth)), published_camera)
    assert np.abs(image.astype(int) - smooth).max() <= 3


def test_colours_become_their_brightness(tmp_path: Path, published_camera: Camera) -> None:
    colours = np.random.default_rng(5).integers(0, 256, (288, 768, 3)).astype(np.uint8)
    image = read_image(frame_of(written(tmp_path / "a.png", colours)), published_camera)
    luma = colours @ np.array([0.114, 0.587, 0.299])
    assert np.abs(image - luma).max() <= 1.1


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "pgm", "tif"])
def test_truncated_image(
    tmp_path: Path, published_camera: Camera, suffix: str, share: float
) -> None:
    path = written(tmp_path / f"a.{suffix}", TEXTURE)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    message = refusal(path, published_camera)
    assert "truncated" in message or "cannot be decoded" in message
