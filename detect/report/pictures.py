"""Pictures of a report: frames with their rows, and cut-outs round missed and extra discs."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.comparison.circles import pair_discs
from detect.drawing.frame import draw_rows
from detect.drawing.strokes import Colour, draw_curve
from detect.errors import FrameError
from detect.report.inputs import ReportInputs
from detect.report.page import Gallery, Picture
from detect.run import Run, read_image
from detect.seen import circle_on_floor, image_positions
from detect.settings import CircleSettings
from landmarks import circle_arrays

_JPEG_QUALITY = 88
_MOST, _IN_A_ROW = 18, 6
_HALF_PX = (48, 32)
_TIMES = 3
_SHOWN = 0.5
_GAP_PX = 4
#: Outlines are drawn larger than the disc by this factor, so that they do not hide its edge.
_WIDER = 1.6
_COLOUR: dict[str, Colour] = {"missed": (60, 60, 255), "extra": (255, 60, 255)}


def frame_picture(inputs: ReportInputs, prefix: str) -> Picture:
    """The picture of a frame as JPEG, its width and height; or why there is none."""
    frame = next((f for f in inputs.run.frames if f.step.prefix == prefix), None)
    if frame is None:
        return "no such frame in the run"
    camera = _camera(inputs)
    try:
        image = read_image(frame, camera)
    except FrameError as error:
        return str(error)
    head = inputs.files.heads.get("circles")
    settings = CircleSettings() if head is None else head.circle_settings
    rows = inputs.rows[inputs.names.index(prefix)]
    return _jpeg(draw_rows(image, camera, rows, settings, inputs.gate, inputs.line_gate))


def gallery(inputs: ReportInputs, fate: str) -> Gallery | None:
    """Cut-outs of some of a run's missed or extra discs, evenly over the run.

    Parameters
    ----------
    inputs : ReportInputs
    fate : {"missed", "extra"}

    Returns
    -------
    Gallery or None
        None without any that can be read.
    """
    rows = list(_rows(inputs, fate))
    if not rows:
        return None
    frames = {frame.step.prefix: frame for frame in inputs.run.frames}
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(_MOST, len(rows))).round().astype(int))
    tiles = []
    for k in chosen:
        prefix, edge = rows[k]
        try:
            image = read_image(frames[prefix], _camera(inputs))
        except FrameError:
            continue
        tiles.append(_tile(image, edge, _COLOUR[fate]))
    if not tiles:
        return None
    shown = len(tiles)
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % _IN_A_ROW)
    lines = [np.hstack(tiles[k : k + _IN_A_ROW]) for k in range(0, len(tiles), _IN_A_ROW)]
    return Gallery(fate, *_jpeg(np.vstack(lines)), shown, len(rows))


def _camera(inputs: ReportInputs) -> Camera | None:
    return inputs.run.camera if isinstance(inputs.run, Run) else None


def _jpeg(picture: NDArray[np.uint8]) -> tuple[bytes, int, int]:
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes(), picture.shape[1], picture.shape[0]


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
