"""Arrays of pixels: those that are taken, and those that are refused in one line."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detect.errors import FrameError
from detect.sources.grey_images import eight_bits, grey_of_pixels

COLOURS = np.random.default_rng(3).integers(0, 256, (6, 8, 4)).astype(np.uint8)
GRAY = COLOURS[:, :, 0]
BGR = COLOURS[:, :, :3]
DEEP = GRAY.astype(np.uint16) << 4


def read_only(pixels: NDArray[Any]) -> NDArray[Any]:
    copy = pixels.copy()
    copy.flags.writeable = False
    return copy


@pytest.mark.parametrize(
    ("pixels", "expected"),
    [
        (GRAY.copy(), GRAY),
        (read_only(GRAY), GRAY),
        (GRAY[::2, 1:5], GRAY[::2, 1:5]),
        (GRAY[::-1, ::-1], GRAY[::-1, ::-1]),
        (np.asfortranarray(GRAY), GRAY),
        (GRAY[:, :, np.newaxis], GRAY),
        (BGR, cv2.cvtColor(BGR.copy(), cv2.COLOR_BGR2GRAY)),
        (read_only(BGR)[::-1], cv2.cvtColor(BGR[::-1].copy(), cv2.COLOR_BGR2GRAY)),
        (BGR[:, ::-1], cv2.cvtColor(BGR[:, ::-1].copy(), cv2.COLOR_BGR2GRAY)),
        (COLOURS, cv2.cvtColor(COLOURS, cv2.COLOR_BGRA2GRAY)),
        (DEEP, GRAY),
        (DEEP.astype(">u2"), GRAY),
        (DEEP[::-1], GRAY[::-1]),
    ],
)
def test_arrays_that_are_taken(pixels: NDArray[Any], expected: NDArray[np.uint8]) -> None:
    before = pixels.copy()
    grey = eight_bits(grey_of_pixels(pixels, "image"), "image")
    np.testing.assert_array_equal(grey, expected)
    np.testing.assert_array_equal(pixels, before)
    assert grey.dtype == np.uint8
    assert grey.flags.c_contiguous
    assert grey.flags.writeable


@pytest.mark.parametrize(
    ("pixels", "told"),
    [
        (GRAY / 255.0, r"image: holds float64: expected images of 8 or 16 bits \(uint8, uint16\)"),
        (GRAY > 9, "holds bool: expected images of 8 or 16 bits"),
        (GRAY.astype(np.int16), "holds int16: expected"),
        (GRAY[0], r"image: is an array of shape \(8,\): expected \(height, width\) grey values"),
        (COLOURS[:, :, :2], r"shape \(6, 8, 2\): expected .* in the order blue, green, red"),
        (COLOURS[np.newaxis], r"shape \(1, 6, 8, 4\): expected"),
        (GRAY[:0], r"shape \(0, 8\): expected"),
    ],
)
def test_arrays_that_are_refused(pixels: NDArray[Any], told: str) -> None:
    with pytest.raises(FrameError, match=told) as caught:
        grey_of_pixels(pixels, "image")
    assert "\n" not in str(caught.value)
