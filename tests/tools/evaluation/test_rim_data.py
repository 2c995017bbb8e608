"""Samples of known truth: floors of photographs, and a disc's contrast."""

from __future__ import annotations

import numpy as np
import pytest

from camera import Camera
from lut.outlines import floor_positions
from tools.evaluation import rim_data
from tools.evaluation.disturbances import with_disc


def test_a_photographed_floor_repeats_and_has_no_seams() -> None:
    rng, seed = np.random.default_rng(1), 2
    photograph = rng.integers(0, 256, (24, 32)).astype(np.uint8)
    x = np.linspace(-3.0, 3.0, 20_001)
    floor_xy = np.stack([x, 0.2 * x], axis=-1)[None]
    [grey] = rim_data._photographed(photograph, floor_xy, np.random.default_rng(seed))
    assert grey.min() >= 0.0
    assert 60.0 < grey.max() <= 200.0
    # 0.3 mm apart, less than a hundredth of a pixel of the photograph.
    assert np.abs(np.diff(grey)).max() < 10.0
    nowhere = rim_data._photographed(photograph, floor_xy * np.nan, np.random.default_rng(seed))
    assert np.isfinite(nowhere).all()


@pytest.mark.parametrize("polarity", [1, -1])
def test_contrast_is_that_of_disc_and_floor(published_camera: Camera, polarity: int) -> None:
    camera = published_camera
    [place] = camera.floor_from_pixel(np.array([[300.0, 190.0]]))
    floor = np.full((camera.height, camera.width), 90 if polarity > 0 else 165, np.uint8)
    light = floor if polarity > 0 else 255 - floor
    floor_xy = floor_positions(camera).astype(np.float32)
    with_light = with_disc(light, floor_xy, place, 0.1, np.random.default_rng(3))
    image = with_light if polarity > 0 else np.asarray(255 - with_light, np.uint8)
    contrast = rim_data._contrast(image, camera, place)
    u, v = np.rint(camera.project_floor(place[None])[0]).astype(int)
    expected = float(image[v, u]) - float(floor[0, 0])
    assert contrast == pytest.approx(expected, abs=2.0)
    assert contrast * polarity > 15.0


def test_dark_discs_are_seen_as_light_ones(published_camera: Camera) -> None:
    camera = published_camera
    [place] = camera.floor_from_pixel(np.array([[300.0, 190.0]]))
    floor = np.full((camera.height, camera.width), 90, np.uint8)
    floor_xy = floor_positions(camera).astype(np.float32)
    dark = 255 - with_disc(floor, floor_xy, place, 0.1, np.random.default_rng(3))
    gathering = rim_data._Gathering(np.random.default_rng(4))
    truth = rim_data.Truth(dark=rim_data._images(camera, place))
    gathering.add(np.asarray(dark, np.uint8), camera, truth, (1.0, 1.0))
    for rows in (gathering.sparse, gathering.rims):
        [disc] = [grey for _, grey, _, is_disc, *_ in rows if is_disc]
        assert np.nanmin(disc) >= 0.0
        assert np.nanmean(disc[:, :, :3]) > np.nanmean(disc[:, :, -2:]) + 15.0
