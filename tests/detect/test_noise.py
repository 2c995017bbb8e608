"""The noise estimate against images whose noise is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import typeof
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.grey_values import estimate_noise, plain_image

SHAPE = (288, 768)


def noisy(grey: NDArray[np.float64], sigma: float, seed: int = 0) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0.0, sigma, grey.shape)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)


def plane() -> NDArray[np.float64]:
    v, u = np.indices(SHAPE)
    return np.asarray(40.0 + 0.15 * u + 0.2 * v)


def straight_edges() -> NDArray[np.float64]:
    """Tiles: the mask sees neither horizontal nor vertical edges, only the tiles' corners."""
    v, u = np.indices(SHAPE)
    return np.where((u // 24 + v // 16) % 2 == 0, 60.0, 190.0)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.5, 6.0, 12.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gaussian_noise_is_measured(sigma: float, seed: int) -> None:
    image = noisy(np.full(SHAPE, 120.0), sigma, seed)
    assert estimate_noise(image) == pytest.approx(np.hypot(sigma, np.sqrt(1 / 12)), rel=0.10)


@pytest.mark.parametrize("sigma", [1.5, 3.0, 8.0])
def test_planes_and_straight_edges_are_no_noise(sigma: float) -> None:
    for grey in (plane(), straight_edges()):
        assert estimate_noise(noisy(grey, sigma)) == pytest.approx(sigma, rel=0.10)


def test_without_noise_there_is_none() -> None:
    for grey in (np.full(SHAPE, 77.0), straight_edges(), np.full(SHAPE, 255.0)):
        assert estimate_noise(noisy(grey, 0.0)) == 0.0


def test_saturated_parts_do_not_count() -> None:
    """Half of the image is white and so hides its noise: the other half tells."""
    grey = np.full(SHAPE, 120.0)
    grey[:, :420] = 290.0
    assert estimate_noise(noisy(grey, 3.0)) == pytest.approx(3.0, rel=0.10)


@pytest.mark.parametrize("shape", [(1, 1), (2, 40), (3, 3)])
def test_tiny_images_have_a_number(shape: tuple[int, int]) -> None:
    assert estimate_noise(np.full(shape, 9, np.uint8)) == 0.0


def reference(image: NDArray[np.uint8]) -> float:
    """The definition: the median absolute response where a pixel is neither black nor white."""
    inner = image[1:-1, 1:-1]
    countable = (inner > 2) & (inner < 253)
    grey = image.astype(np.int16)
    rows = grey[:-2] - 2 * grey[1:-1] + grey[2:]
    response = np.abs(rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:])
    values = response[countable]
    if values.size < 100:
        values = response.ravel()
    return float(np.median(values) / 0.6745 / 6.0)


@given(
    height=st.integers(3, 40),
    width=st.integers(3, 60),
    sigma=st.floats(0.0, 120.0),
    middle=st.floats(-20.0, 280.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_estimate_is_the_median_exactly(
    height: int, width: int, sigma: float, middle: float, seed: int
) -> None:
    image = noisy(np.full((height, width), middle), sigma, seed)
    assert estimate_noise(image) == reference(image)


def test_the_widest_response_there_is() -> None:
    v, u = np.indices((50, 70))
    image = np.where((u + v) % 2 == 0, 3, 252).astype(np.uint8)
    assert estimate_noise(image) == reference(image) == 16 * 249 / 2 / 0.6745 / 6.0


def test_some_rows_tell_nearly_as_much_as_all() -> None:
    image = noisy(np.full((300, 400), 120.0), 6.0)
    assert estimate_noise(image, 96) == pytest.approx(estimate_noise(image), rel=0.05)
    # Of an image that has no more rows, all are looked at.
    assert estimate_noise(image[:60], 96) == estimate_noise(image[:60])


def read_only(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = image.copy()
    image.flags.writeable = False
    return image


@pytest.mark.parametrize(
    "seen", [read_only, np.asfortranarray, lambda image: np.repeat(image, 2, axis=1)[:, ::2]]
)
def test_kernels_get_one_kind_of_image(
    seen: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
) -> None:
    image = noisy(plane(), 2.0)
    plain = plain_image(seen(image), SHAPE)
    assert typeof(plain) == typeof(image)
    np.testing.assert_array_equal(plain, image)
    assert plain_image(image) is image


NO_IMAGES = [np.zeros(9), np.zeros(SHAPE), np.zeros((*SHAPE, 3), np.uint8), np.zeros((0, 5), "u1")]


@pytest.mark.parametrize("image", NO_IMAGES)
def test_other_arrays_are_no_images(image: NDArray[np.uint8]) -> None:
    with pytest.raises(
        FrameError, match=r"the image is \w+ of shape .*: expected grey values, uint8"
    ):
        plain_image(image)
