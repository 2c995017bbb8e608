"""What peers of other libraries find where the truth is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tools.benchmark.functions import peers
from tools.benchmark.material import jpeg_picture


@pytest.mark.lowest
def test_hough_circles_of_scikit_image_are_where_they_were_painted() -> None:
    hough = peers()["skimage hough_circle"]
    grey = np.full((90, 120), 60, np.uint8)
    cv2.circle(grey, (70, 40), 18, 200, -1, cv2.LINE_AA)
    votes = np.asarray(hough(jpeg_picture(grey)))
    assert votes.shape == (10, 90, 120)  # radii of 6, 12, ... 60 pixels
    radius, row, column = np.unravel_index(int(votes.argmax()), votes.shape)
    assert radius == 2
    assert (row, column) == pytest.approx((40, 70), abs=1)
