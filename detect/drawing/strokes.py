"""Strokes and words on pictures, at fractions of a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera import Camera

FloatArray = NDArray[np.float64]
Colour = tuple[int, int, int]

_SUBPIXEL_BITS = 4
# OpenCV's fixed-point coordinates have 32 bits; curves that go far outside are not drawn.
_FARTHEST_PX = 1e6
# Up to this many columns strokes are one pixel wide; wider pictures (of phones) get wider strokes.
_COLUMNS = 1500


def canvas_of(image: NDArray[np.uint8], camera: Camera | None = None) -> NDArray[np.uint8]:
    """A grey image (H, W) as a picture to draw into, (H, W, 3) in OpenCV's order blue, green, red.

    Pixels that see nothing through the lens of the calibrated camera are dark and red.
    """
    canvas = np.repeat(image[:, :, None], 3, axis=2)
    if camera is not None and camera.seen_share < 1.0:
        unseen = _unseen(camera)
        canvas[unseen] //= 3
        canvas[unseen] += np.array([0, 0, 80], np.uint8)
    return canvas


@lru_cache(maxsize=2)
def _unseen(camera: Camera) -> NDArray[np.bool_]:
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    return np.isnan(camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))[..., 0])


def enlargement(canvas: NDArray[np.uint8]) -> int:
    """How many times as wide strokes and words are, to be seen when the picture is shown whole."""
    return max(1, round(int(canvas.shape[1]) / _COLUMNS))


def draw_curve(
    canvas: NDArray[np.uint8], points: FloatArray, colour: Colour, *, closed: bool = False
) -> None:
    """Draw a curve through (N, 2) points u, v; nothing is drawn if one is not finite."""
    if np.all(np.abs(points) < _FARTHEST_PX):
        fixed = np.rint(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        width = enlargement(canvas)
        cv2.polylines(canvas, [fixed], closed, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)


def draw_bar(canvas: NDArray[np.uint8], ends: FloatArray, colour: Colour) -> None:
    """Draw an error bar between two points (2, 2) u, v, with a tick at each."""
    tick = enlargement(canvas) * np.array([[0.0, -2.0], [0.0, 2.0]])
    for points in (ends, ends[0] + tick, ends[1] + tick):
        draw_curve(canvas, points, colour)


def draw_text(
    canvas: NDArray[np.uint8],
    text: str,
    at: ArrayLike,
    colour: Colour,
    size: float = 0.35,
    shift: tuple[int, int] = (0, 0),
) -> None:
    """Write in ASCII from u, v, the left end of the base line, if these are finite.

    `shift` moves the words, by more in wide pictures.
    """
    place = np.asarray(at, dtype=np.float64)
    if np.isfinite(place).all():
        times = enlargement(canvas)
        u, v = (np.rint(place) + times * np.array(shift)).astype(int).tolist()
        cv2.putText(
            canvas, text.encode("ascii", "replace").decode(), (u, max(v, 10 * times)),
            cv2.FONT_HERSHEY_SIMPLEX, times * size, colour, times, cv2.LINE_AA,
        )  # fmt: skip


def with_legend(
    canvas: NDArray[np.uint8], words: Sequence[tuple[str, Colour]], column_px: int, size: float
) -> NDArray[np.uint8]:
    """The picture, and below it words in columns of some width."""
    times = enlargement(canvas)
    width = int(canvas.shape[1])
    per_row = max(1, width // (column_px * times))
    rows = -(-len(words) // per_row)
    legend = np.zeros(((14 * rows + 4) * times, width, 3), np.uint8)
    for k, (text, colour) in enumerate(words):
        shift = 4 + column_px * (k % per_row), 13 + 14 * (k // per_row)
        draw_text(legend, text, (0, 0), colour, size, shift)
    return np.concatenate([canvas, legend])
