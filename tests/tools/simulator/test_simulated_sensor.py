"""Light to grey values, and the quality of discs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from tools.simulator.files import encoded
from tools.simulator.observation import disc_quality
from tools.simulator.renderer import Sensor, grey_values
from tools.simulator.single_disc import render_disc

PLAIN = Sensor(
    blur_px=0.0, video_blur_px=0.0, glare=0.0, vignetting=0.0, gain_jitter=0.0, gamma=1.0,
    noise_grey=0.0, shot_noise_grey=0.0,
)  # fmt: skip


def _even(level: float) -> NDArray[np.float32]:
    return np.full((576, 768), level, dtype=np.float32)


def test_gain_aims_at_the_target() -> None:
    dark, light = (
        grey_values(_even(level), PLAIN, np.random.default_rng(0)).mean() for level in (0.1, 0.9)
    )
    # (target / mean)^0.8: of ninefold light a factor 9^0.2 is left.
    assert light / dark == pytest.approx(9.0**0.2, rel=0.02)
    at_target = grey_values(_even(0.42), PLAIN, np.random.default_rng(0))
    assert at_target.mean() == pytest.approx(255.0 * 0.42, abs=0.5)


def test_only_even_lines_are_kept() -> None:
    light = _even(0.3)
    light[1::2] = 0.6
    grey = grey_values(light, PLAIN, np.random.default_rng(0))
    assert grey.shape == (288, 768)
    assert np.ptp(grey) == 0


def test_noise_grows_with_light_and_is_seeded() -> None:
    sensor = replace(PLAIN, noise_grey=2.0, shot_noise_grey=3.0)
    light = _even(0.1)
    light[:, 384:] = 0.7
    first = grey_values(light, sensor, np.random.default_rng(5))
    np.testing.assert_array_equal(first, grey_values(light, sensor, np.random.default_rng(5)))
    assert np.any(first != grey_values(light, sensor, np.random.default_rng(6)))
    for half in (first[:, :384], first[:, 384:]):
        expected = np.sqrt(2.0**2 + 3.0**2 * half.mean() / 255.0 + 1.0 / 12.0)
        assert half.std() == pytest.approx(expected, rel=0.03)


def test_blur_of_a_step_is_gaussian() -> None:
    light = _even(0.2)
    light[:, 384:] = 0.6
    blurred = grey_values(light, replace(PLAIN, blur_px=3.0), np.random.default_rng(0))[144]
    sharp = grey_values(light, PLAIN, np.random.default_rng(0))[144]
    share = (blurred.astype(float) - sharp[0]) / (float(sharp[-1]) - float(sharp[0]))
    width = np.sum(np.diff(share) * (np.arange(767) - 383.0) ** 2)
    assert width == pytest.approx(9.0, rel=0.1)


def test_vignetting_darkens_the_corners() -> None:
    grey = grey_values(_even(0.42), replace(PLAIN, vignetting=0.3), np.random.default_rng(0))
    assert grey[0, 0] == pytest.approx(0.7 * grey[144, 384], rel=0.02)


def test_jpeg_can_be_read_and_is_deterministic() -> None:
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (36, 96)).astype(np.uint8)
    grey = np.asarray(cv2.resize(coarse, (768, 288)), dtype=np.uint8)
    data = encoded(grey, quality=90)
    assert data == encoded(grey, quality=90)
    back = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert back is not None
    assert back.shape == (288, 768)
    assert np.abs(back.astype(int) - grey).max() <= 4


def _image(
    camera: Camera, noise: float = 0.0, seed: int = 0
) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """An image of one light disc centred on a pixel."""
    pixel = (300, 190)
    place = camera.floor_from_pixel(np.array(pixel, dtype=np.float64))
    crop = render_disc(camera, place, 0.1, 180.0, 60.0)
    grey = np.full((camera.height, camera.width), 60.0)
    grey[crop.window] = np.rint(crop.grey)
    grey += noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), pixel


def test_quality_of_a_clean_disc_is_one(published_camera: Camera) -> None:
    grey, pixel = _image(published_camera)
    assert disc_quality(grey, published_camera, pixel) == pytest.approx(1.0)
    assert disc_quality(255 - grey, published_camera, pixel) == pytest.approx(1.0)


def test_quality_falls_with_noise_as_variances_say(published_camera: Camera) -> None:
    # Contrast 120 gives 3600 between the classes; noise 20 gives 400 within.
    images = [_image(published_camera, noise=20.0, seed=seed) for seed in range(60)]
    qualities = [disc_quality(grey, published_camera, pixel) for grey, pixel in images]
    assert np.mean(qualities) == pytest.approx(3600.0 / 4000.0, abs=0.015)


def test_quality_of_an_even_floor_is_zero(published_camera: Camera) -> None:
    grey = np.full((288, 768), 90, dtype=np.uint8)
    assert disc_quality(grey, published_camera, (300, 190)) == 0.0
