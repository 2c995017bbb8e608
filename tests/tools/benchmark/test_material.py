"""The pictures that are measured on are what they are said to be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera
from detect.circles import detect_circles, disc_table
from detect.lines import detect_lines
from detect.settings import CircleSettings
from detect.sources.opening import open_run
from lut import build_vertical_table
from tools.benchmark.material import (
    contents_of,
    disc_places,
    floor_with_discs,
    noise_pictures,
    photograph_pictures,
    repeated_run,
    run_pictures,
    scaled_camera,
    scaled_picture,
    wall_with_edges,
)
from tools.evaluation.figures import StudyError


def test_a_scaled_camera_sees_the_same_directions(published_camera: Camera) -> None:
    camera = scaled_camera(published_camera, 2.5)
    assert (camera.width, camera.height) == (1920, 720)
    pixels = np.array([[-0.5, -0.5], [100.0, 20.0], [383.5, 143.5], [767.5, 287.5]])
    finer = (pixels + 0.5) * 2.5 - 0.5
    np.testing.assert_allclose(
        camera.directions_robot(finer), published_camera.directions_robot(pixels), atol=1e-9
    )


def test_a_picture_is_scaled_to_the_camera_it_is_for(
    published_camera: Camera, project_root: Path
) -> None:
    picture = run_pictures(open_run(project_root / "images/e"), 1)[0]
    camera = scaled_camera(published_camera, 2.0)
    enlarged = scaled_picture(picture, camera, seed=1).grey
    assert enlarged.shape == (576, 1536)
    # Pixel (0, 0) covers the first 2 x 2 of the larger picture: averaging them brings it back.
    again = enlarged.reshape(288, 2, 768, 2).mean(axis=(1, 3))
    difference = again - picture.grey
    assert abs(float(difference.mean())) < 0.2
    assert float(np.median(np.abs(difference))) < 2.0


def test_noise_is_uniform_and_the_same_again(published_camera: Camera) -> None:
    first, second = noise_pictures(published_camera, 2, seed=4)
    assert not np.array_equal(first.grey, second.grey)
    again = noise_pictures(published_camera, 2, seed=4)
    np.testing.assert_array_equal(again[1].grey, second.grey)
    assert float(first.grey.std()) == pytest.approx(256 / np.sqrt(12), rel=0.05)


def test_photographs_get_the_cameras_size(published_camera: Camera, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    rng = np.random.default_rng(0)
    for number in range(5):
        photograph = rng.integers(0, 256, (60, 80 + number, 3), dtype=np.uint8)
        assert cv2.imwrite(str(tmp_path / "deep" / f"{number}.png"), photograph)
    pictures = photograph_pictures(tmp_path, published_camera, 3)
    assert [p.grey.shape for p in pictures] == [(288, 768)] * 3


def test_a_folder_without_photographs_is_an_error(published_camera: Camera, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no photographs"):
        photograph_pictures(tmp_path, published_camera, 3)


def test_a_broken_photograph_is_an_error(published_camera: Camera, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"a\.jpg: cannot be decoded"):
        photograph_pictures(tmp_path, published_camera, 3)


def test_a_repeated_run_holds_the_frames_over_and_over(project_root: Path, tmp_path: Path) -> None:
    run = open_run(project_root / "images/e")
    sources = [frame.image for frame in run.frames if frame.image is not None]
    longer = open_run(repeated_run(run, tmp_path / "longer", len(sources) + 2))
    images = [frame.image for frame in longer.frames if frame.image is not None]
    assert longer.camera == run.camera
    assert len(images) == len(sources) + 2
    for place, image in enumerate(images):
        assert image.read_bytes() == sources[place % len(sources)].read_bytes()


def test_a_long_run_takes_no_more_room_on_the_disk_than_a_processor_notices(
    project_root: Path, tmp_path: Path
) -> None:
    run = open_run(project_root / "images/e")
    sources = [frame.image for frame in run.frames if frame.image is not None]
    longer = open_run(repeated_run(run, tmp_path / "longer", 250, 100))
    images = [frame.image for frame in longer.frames if frame.image is not None]
    assert len(images) == 250
    assert len({image.stat().st_ino for image in images}) == 100
    contents = contents_of(images)
    assert len({id(content) for content in contents}) == 100
    for image, content in zip(images, contents):
        assert image.read_bytes() == content.tobytes()
    assert images[180].read_bytes() == sources[0].read_bytes()


@pytest.mark.parametrize("count", [0, 50])
def test_as_many_discs_are_painted_as_were_asked_for(published_camera: Camera, count: int) -> None:
    settings = CircleSettings()
    table = disc_table(published_camera, settings)
    places = disc_places(published_camera, count, seed=0)
    found = detect_circles(
        floor_with_discs(published_camera, places, seed=0), published_camera, table, settings
    )
    assert len(found) == count
    for place in places:
        assert float(np.min(np.hypot(*(found.floor_xy - place).T))) < 0.01


def test_more_discs_are_fewer_discs_and_some(published_camera: Camera) -> None:
    np.testing.assert_array_equal(
        disc_places(published_camera, 30, seed=2)[:7], disc_places(published_camera, 7, seed=2)
    )


def test_more_discs_than_have_room_are_an_error(published_camera: Camera) -> None:
    with pytest.raises(StudyError, match="500 discs"):
        disc_places(published_camera, 500, seed=0)


@pytest.mark.parametrize("count", [0, 1, 20])
def test_as_many_edges_are_painted_as_were_asked_for(published_camera: Camera, count: int) -> None:
    image = wall_with_edges(published_camera, count, seed=0)
    found = detect_lines(image, build_vertical_table(published_camera))
    assert len(found) == count
