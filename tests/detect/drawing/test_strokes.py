"""Strokes and words are seen in pictures of any size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from detect.drawing.frame import canvas_of, draw_curve, draw_text, enlargement, with_legend

WHITE = (255, 255, 255)
HALF = 127


def marked(canvas: NDArray[np.uint8], above: int = 0) -> tuple[int, int]:
    """Rows and columns in which something is drawn, brighter than `above`."""
    brightest = canvas.max(axis=2)
    rows, columns = brightest.max(axis=1), brightest.max(axis=0)
    return int(np.sum(rows > above)), int(np.sum(columns > above))


@pytest.mark.parametrize(
    ("columns", "times"), [(320, 1), (768, 1), (1536, 2), (2250, 3), (4000, 5)]
)
def test_strokes_and_words_grow_with_the_picture(columns: int, times: int) -> None:
    canvas = np.zeros((200, columns, 3), np.uint8)
    assert enlargement(canvas) == times
    draw_curve(canvas, np.array([[20.0, 100.0], [200.0, 100.0]]), WHITE)
    wide = max(1, times // 2)
    assert wide <= marked(canvas, HALF)[0] <= wide + 2
    canvas[:] = 0
    draw_text(canvas, "0.98", (20, 100), WHITE)
    small = np.zeros((200, 320, 3), np.uint8)
    draw_text(small, "0.98", (20, 100), WHITE)
    draw_text(small, "far outside", (1e300, -1e300), WHITE)
    for large, usual in zip(marked(canvas), marked(small)):
        assert large == pytest.approx(times * usual, rel=0.2)


def test_so_do_legends() -> None:
    words = [("found: 4", WHITE), ("left out: 12", WHITE), ("alone: 1", WHITE)]
    small = with_legend(np.zeros((9, 400, 3), np.uint8), words, 190, 0.38)
    assert small.shape == (9 + 2 * 14 + 4, 400, 3)  # two columns of words
    assert np.any(small[9 : 9 + 16, 190:])
    assert not np.any(small[9 + 16 :, 190:])
    large = with_legend(np.zeros((9, 4000, 3), np.uint8), words, 190, 0.38)
    assert large.shape == (9 + 5 * (14 + 4), 4000, 3)  # one row of them, five times as large
    assert marked(large)[0] == pytest.approx(5 * marked(small[:25])[0], rel=0.15)
    assert with_legend(np.zeros((9, 50, 3), np.uint8), [], 190, 0.38).shape == (13, 50, 3)


def test_what_the_lens_does_not_see_is_dark_and_red(published_camera: Camera) -> None:
    folded = replace(published_camera, coef=(0.0,) * 5, polynomial=(-0.33, 0.0, 0.0))
    image = np.full((288, 768), 120, np.uint8)

    canvas = canvas_of(image, folded)

    assert canvas[144, 384].tolist() == [120, 120, 120]
    assert canvas[0, 0].tolist() == [40, 40, 120]
    dark = np.all(canvas == [40, 40, 120], axis=-1)
    assert 1.0 - dark.mean() == pytest.approx(folded.seen_share, abs=0.01)
    np.testing.assert_array_equal(canvas_of(image, published_camera), canvas_of(image))
