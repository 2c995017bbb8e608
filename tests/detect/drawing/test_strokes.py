"""Strokes and words are seen in pictures of any size."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.drawing.strokes import draw_curve, draw_text, enlargement

WHITE = (255, 255, 255)
HALF = 127


def marked(canvas: NDArray[np.uint8], above: int = 0) -> tuple[int, int]:
    """Rows and columns in which something is drawn, brighter than `above`."""
    brightest = canvas.max(axis=2)
    rows, columns = brightest.max(axis=1), brightest.max(axis=0)
    return int(np.sum(rows > above)), int(np.sum(columns > above))


@pytest.mark.parametrize(("columns", "times"), [(320, 1), (768, 1), (2000, 1), (4000, 3)])
def test_strokes_and_words_grow_with_the_picture(columns: int, times: int) -> None:
    canvas = np.zeros((200, columns, 3), np.uint8)
    assert enlargement(canvas) == times
    draw_curve(canvas, np.array([[20.0, 100.0], [200.0, 100.0]]), WHITE)
    assert times <= marked(canvas, HALF)[0] <= times + 2
    canvas[:] = 0
    draw_text(canvas, "0.98", (20, 100), WHITE)
    small = np.zeros((200, 320, 3), np.uint8)
    draw_text(small, "0.98", (20, 100), WHITE)
    for large, usual in zip(marked(canvas), marked(small)):
        assert large == pytest.approx(times * usual, rel=0.15)
