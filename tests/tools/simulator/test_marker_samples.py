"""Random frames of markers: the same whatever else was rendered, and true."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import read_camera
from detect.markers.dictionaries import marker_dictionary
from tests.pictures import read_grey
from tools.simulator.__main__ import main
from tools.simulator.markers.samples import (
    SampleSettings,
    sample_cameras,
    sample_frame,
)
from tools.simulator.markers.surface import Texture, marker_texture, texture_distance
from tools.simulator.markers.things import THINGS, near_marker, thing
from tools.simulator.markers.truth import marker_corners, mean_side_px, slant_deg
from tools.simulator.parallel import in_order

SETTINGS = SampleSettings(width=320, height=240, width_px=(12.0, 90.0))


def test_a_frame_depends_on_seed_and_number_alone() -> None:
    first = sample_frame(SETTINGS, 3, 5)
    sample_frame(SETTINGS, 3, 4)
    again = sample_frame(SETTINGS, 3, 5)
    np.testing.assert_array_equal(first.image, again.image)
    assert first.as_json() == again.as_json()
    for seed, index in ((3, 6), (4, 5)):
        assert not np.array_equal(first.image, sample_frame(SETTINGS, seed, index).image)


@pytest.mark.long
def test_other_processes_render_the_same() -> None:
    render = partial(sample_frame, SETTINGS, 2)
    here, there = (list(in_order(render, range(3), jobs)) for jobs in (1, 2))
    for one, other in zip(here, there):
        np.testing.assert_array_equal(one.image, other.image)
        assert one.as_json() == other.as_json()


def test_truth_is_what_was_asked_for() -> None:
    frames = [sample_frame(SETTINGS, 1, index) for index in range(60)]
    markers = [(frame, marker) for frame in frames for marker in frame.markers]
    assert 8 <= sum(not frame.markers for frame in frames) <= 25
    assert len(markers) > 40
    assert 0.5 < np.mean([marker.clear for _, marker in markers]) < 0.97
    for frame, marker in markers:
        assert frame.dictionary == marker.dictionary == "rawseeds"
        assert marker.id in marker_dictionary("rawseeds").ids
        corners = marker_corners(frame.camera, marker.camera_from_marker, marker.width_m)
        np.testing.assert_array_equal(corners, marker.corners)
        assert mean_side_px(corners) == marker.width_px
        assert slant_deg(marker.camera_from_marker) == marker.slant_deg <= 70.0 + 1e-6
        # Markers so near that the lens would bend them out of sight are put farther away.
        assert 9.0 < marker.width_px < 91.0
        assert 0.0 <= marker.visible <= 1.0
    for value, low, high in (
        (np.array([frame.imaging.blur_px for frame in frames]), 0.3, 3.0),
        (np.array([frame.imaging.noise_grey for frame in frames]), 1.0, 5.0),
    ):
        assert low <= value.min() < 1.5 * low
        assert 0.75 * high < value.max() <= high


@pytest.mark.parametrize("uneven", [0.0, 1.0])
def test_contrast_is_the_one_in_the_image(uneven: float) -> None:
    """Black border against white rim, without noise and as sharp as can be."""
    settings = replace(
        SETTINGS, blur_px=(0.3, 0.31), noise_grey=(0.0, 0.0), width_px=(60.0, 90.0), empty=0.0,
        slant_deg=(0.0, 30.0), occluded=0.0, cut=0.0, motion=0.0, markers=(1, 1), uneven=uneven,
        things=(0, 0), cameras="pinhole",
    )  # fmt: skip
    ratios = []
    for index in range(14):
        frame = sample_frame(settings, 9, index)
        for marker in frame.markers:
            # In the middle of each side, just inside and outside of it.
            middle = marker.corners.mean(axis=0)
            sides = 0.5 * (marker.corners + np.roll(marker.corners, 1, axis=0))
            means = []
            for factor in (0.86, 1.09):
                u, v = np.rint(middle + factor * (sides - middle)).astype(int).T
                means.append(frame.image[v, u].astype(float).mean())
            ratios.append((means[1] - means[0]) / marker.contrast_grey)
    assert len(ratios) >= 10
    if uneven:
        # The light differs from side to side.
        assert np.median(ratios) == pytest.approx(1.0, abs=0.08)
    else:
        np.testing.assert_allclose(ratios, 1.0, atol=0.06)


def test_motion_blurs_along_its_way_and_keeps_the_middle() -> None:
    settings = replace(
        SETTINGS, motion=1.0, motion_px=(6.0, 6.0), blur_px=(0.3, 0.3), noise_grey=(0.0, 0.0),
        uneven=0.0, things=(0, 0), markers=(1, 1), empty=0.0, occluded=0.0, cut=0.0,
        width_px=(60.0, 80.0), slant_deg=(0.0, 10.0), contrast_grey=(150.0, 150.0),
    )  # fmt: skip
    offsets = []
    for index in range(6):
        moving = sample_frame(settings, 3, index)
        still = sample_frame(replace(settings, motion=0.0), 3, index)
        assert moving.motion_px == pytest.approx(6.0)
        for one, other in zip(moving.markers, still.markers):
            np.testing.assert_array_equal(one.corners, other.corners)
        difference = np.abs(moving.image.astype(float) - still.image)
        assert difference.max() > 20.0
        # What one side of an edge loses the other gains: the image does not move as a whole.
        shift, _ = cv2.phaseCorrelate(still.image.astype(float), moving.image.astype(float))
        offsets.append(shift)
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.2


def test_pinhole_and_distorted_cameras_can_be_asked_for() -> None:
    pinhole, *distorted = sample_cameras(320, 240)
    for kind, expected in (("pinhole", [pinhole]), ("distorted", distorted)):
        settings = replace(SETTINGS, cameras=kind)  # type: ignore[arg-type]
        seen = {sample_frame(settings, 1, index).camera for index in range(12)}
        assert seen == set(expected)


def test_things_are_textures() -> None:
    rng = np.random.default_rng(0)
    for kind in THINGS:
        for _ in range(5):
            values = kind(rng).values
            assert values.dtype == np.float32
            assert values.ndim == 2
            assert 0.0 <= values.min() < values.max() < 1.3
    assert near_marker(rng, marker_dictionary("4x4_50")).values.shape[0] >= 8


def test_things_are_no_markers_even_by_chance() -> None:
    """A black square with one hole of two cells is marker 17 of 4x4_50."""
    rng = np.random.default_rng(0)
    for name in ("4x4_50", "rawseeds", "apriltag_16h5"):
        dictionary = marker_dictionary(name)
        for number in (0, 17):
            printed = marker_texture(dictionary, number)
            assert texture_distance(dictionary, printed) == pytest.approx(0.0, abs=1e-6)
            turned = Texture(np.rot90(printed.values, 1))
            assert texture_distance(dictionary, turned) == pytest.approx(0.0, abs=1e-6)
        for _ in range(40):
            _, texture = thing(rng, dictionary)
            assert texture_distance(dictionary, texture) >= 3.0


def test_photographs_become_backgrounds(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(250, dtype=np.uint8), (200, 1))
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    settings = replace(SETTINGS, photographs=tmp_path, things=(0, 0), empty=1.0, uneven=0.0)
    slopes = []
    for index in range(8):
        image = sample_frame(settings, 1, index).image.astype(float)
        slopes.append(abs(image[:, 260:].mean() - image[:, :60].mean()))
    assert np.count_nonzero(np.array(slopes) > 5.0) >= 2
    with pytest.raises(ValueError, match="holds no photographs"):
        sample_frame(replace(settings, photographs=tmp_path / "none"), 1, 0)


def test_frames_on_disk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "frames"
    arguments = ["marker-frames", str(folder), "--count", "4", "--seed", "7",
                 "--sample.width", "320", "--sample.height", "240"]  # fmt: skip
    assert main(arguments) == 0
    truth = json.loads((folder / "truth.json").read_text())
    assert [frame["index"] for frame in truth["frames"]] == [0, 1, 2, 3]
    settings = SampleSettings(width=320, height=240)
    for row in truth["frames"]:
        image = read_grey(folder / "images" / f"{row['image']}.png")
        frame = sample_frame(settings, 7, row["index"])
        np.testing.assert_array_equal(image, frame.image)
        camera = read_camera(folder / row["camera"])
        for marker in row["markers"]:
            pose = np.vstack([marker["camera_from_marker"], [0.0, 0.0, 0.0, 1.0]])
            corners = marker_corners(camera, pose, marker["width_m"])
            np.testing.assert_allclose(corners, marker["corners"], atol=2e-4)
    capsys.readouterr()
    assert main(arguments) == 1
    assert "exists already" in capsys.readouterr().err
