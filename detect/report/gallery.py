"""Cut-outs of images round rows that were missed, or that are extra."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.comparison.circles import pair_discs
from detect.drawing.strokes import Colour, draw_curve
from detect.report.inputs import ReportInputs
from detect.seen import circle_on_floor, image_positions
from landmarks import circle_arrays

_MOST, _IN_A_ROW = 18, 6
_HALF_PX = (48, 32)
_TIMES = 3
_SHOWN = 0.5
_GAP_PX = 4
#: Outlines are drawn larger than the disc by this factor, so that they do not hide its edge.
_WIDER = 1.6
_COLOUR: dict[str, Colour] = {"missed": (60, 60, 255), "extra": (255, 60, 255)}


def gallery(
    inputs: ReportInputs, fate: str, image_of: Callable[[str], NDArray[np.uint8] | None]
) -> tuple[NDArray[np.uint8], int, int] | None:
    """Cut-outs of some of a run's missed or extra discs, evenly over the run.

    Parameters
    ----------
    inputs : ReportInputs
    fate : {"missed", "extra"}
    image_of : callable
        The grey image of a frame; None where it cannot be read.

    Returns
    -------
    picture, shown, all : (H, W, 3) uint8, int, int
        In OpenCV's order of colours, with how many there are in it and in all; None without any.
    """
    rows = list(_rows(inputs, fate))
    if not rows:
        return None
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(_MOST, len(rows))).round().astype(int))
    tiles = []
    for k in chosen:
        prefix, edge = rows[k]
        image = image_of(prefix)
        if image is not None:
            tiles.append(_tile(image, edge, _COLOUR[fate]))
    if not tiles:
        return None
    shown = len(tiles)
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % _IN_A_ROW)
    lines = [np.hstack(tiles[k : k + _IN_A_ROW]) for k in range(0, len(tiles), _IN_A_ROW)]
    return np.vstack(lines), shown, len(rows)


def _rows(inputs: ReportInputs, fate: str) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Frame and image of the edge of each row that was missed, or is extra."""
    for prefix, seen in zip(inputs.names, inputs.rows):
        view = inputs.view_of(seen)
        if view is None or seen.circles is None or seen.reference_circles is None:
            continue
        pairs = pair_discs(seen.reference_circles, seen.circles, inputs.gate, view)
        if fate == "missed":
            alone, by = [seen.reference_circles[i] for i in pairs.first_alone], view.reference_by
        else:
            alone, by = [seen.circles[j] for j in pairs.second_alone], view.detected_by
        for xy in circle_arrays(alone).xy:
            edge = image_positions(view.camera, circle_on_floor(xy, _WIDER * view.radius_m), by)
            if np.isfinite(edge).all():
                yield prefix, edge


def _tile(image: NDArray[np.uint8], edge: NDArray[np.float64], colour: Colour) -> NDArray[np.uint8]:
    half = np.array(_HALF_PX)
    corner = np.rint(edge.mean(axis=0)).astype(int) - half
    (u, v), (width, height) = corner, 2 * half
    padded = cv2.copyMakeBorder(
        image, height, height, width, width, cv2.BORDER_CONSTANT, value=(255,)
    )
    v, u = np.clip([v + height, u + width], 0, np.array(padded.shape) - (height, width))
    cut = padded[v : v + height, u : u + width]
    large = cv2.resize(cut, None, fx=_TIMES, fy=_TIMES, interpolation=cv2.INTER_CUBIC)
    canvas = np.repeat(large[:, :, None], 3, axis=2).astype(np.uint8)
    at = (edge + np.array([width - u, height - v]) + 0.5) * _TIMES - 0.5
    draw_curve(canvas, at, colour, closed=True)
    small = cv2.resize(canvas, None, fx=_SHOWN, fy=_SHOWN, interpolation=cv2.INTER_AREA)
    gap = _GAP_PX
    framed = cv2.copyMakeBorder(small, 0, gap, 0, gap, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    return np.asarray(framed, dtype=np.uint8)
