"""Pictures of a report: frames with their rows, and cut-outs round missed and extra discs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.drawing.frame import EXTRA_COLOUR, MISSED_COLOUR, draw_rows
from detect.drawing.inputs import picture_name
from detect.drawing.strokes import Colour, draw_curve
from detect.errors import FrameError
from detect.report.inputs import ReportInputs
from detect.report.parts import Part, image_part
from detect.run import Run, RunFrame, read_image
from detect.seen import circle_on_floor
from redetect.landmarks import circle_arrays

_JPEG_QUALITY = 88
_MOST, _IN_A_ROW = 18, 6
_HALF_PX = (48, 32)
_TIMES, _GAP_PX = 2, 4
#: Outlines are drawn larger than the disc by this factor, so that they do not hide its edge.
_WIDER = 1.6
_FATES = {
    "missed": (MISSED_COLOUR, "reference rows that are missing"),
    "extra": (EXTRA_COLOUR, "rows that fit no reference row"),
}


def frame_picture(inputs: ReportInputs, prefix: str, words: str) -> Part:
    """The picture of a frame with its rows; or a note that says why there is none."""
    frame = next(frame for frame in inputs.run.frames if frame.step.prefix == prefix)
    try:
        image = _read(inputs, frame)
    except FrameError as error:
        return Part("note", f"{words}: {error}")
    rows, settings = inputs.files.of(prefix), inputs.files.circle_settings
    return _jpeg(words, draw_rows(image, inputs.sight, rows, settings, inputs.options))


def gallery(inputs: ReportInputs, fate: Literal["missed", "extra"]) -> list[Part]:
    """An image of cut-outs of some missed or extra discs, evenly over the run, if there are any."""
    edges = list(_edges(inputs, fate))
    if not edges:
        return []
    frames = {picture_name(frame.step.prefix): frame for frame in inputs.run.frames}
    chosen = np.unique(np.linspace(0, len(edges) - 1, min(_MOST, len(edges))).round().astype(int))
    tiles = []
    colour, words = _FATES[fate]
    for name, edge in (edges[k] for k in chosen):
        try:
            tiles.append(_tile(_read(inputs, frames[name]), edge, colour))
        except FrameError:
            continue
    if not tiles:
        return []
    words = (
        f"{len(tiles)} of the {len(edges)} {words}, evenly over the run; the outline is wider than "
        "the disc."
    )
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % _IN_A_ROW)
    rows = [np.hstack(tiles[k : k + _IN_A_ROW]) for k in range(0, len(tiles), _IN_A_ROW)]
    return [_jpeg(words, np.vstack(rows))]


def _read(inputs: ReportInputs, frame: RunFrame) -> NDArray[np.uint8]:
    return read_image(frame, inputs.run.camera if isinstance(inputs.run, Run) else None)


def _jpeg(words: str, picture: NDArray[np.uint8]) -> Part:
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return image_part(words, encoded.tobytes(), "jpeg", picture.shape[1], picture.shape[0])


def _edges(inputs: ReportInputs, fate: str) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Frame and image of a circle round each disc that was missed, or is extra."""
    for match in () if inputs.discs is None else inputs.discs.frames:
        view = match.frame.view
        if view is None:
            continue
        rows, seen_at = match.missed, view.reference_px
        if fate == "extra":
            rows, seen_at = match.extra, view.detected_px
        rings = circle_on_floor(circle_arrays(rows).xy, _WIDER * view.radius_m)
        for edge in seen_at(rings):
            if np.isfinite(edge).all():
                yield picture_name(match.frame.name), edge


def _tile(image: NDArray[np.uint8], edge: NDArray[np.float64], colour: Colour) -> NDArray[np.uint8]:
    """A cut-out, enlarged, with a curve drawn in and a gap beside it; white beyond the image."""
    begin = np.rint(edge.mean(axis=0)) - _HALF_PX
    # Pixels are squares round their centres.
    shift = 0.5 * (_TIMES - 1) - _TIMES * begin
    enlarge = np.column_stack([_TIMES * np.eye(2), shift])
    size = (2 * _TIMES * _HALF_PX[0], 2 * _TIMES * _HALF_PX[1])
    cut = cv2.warpAffine(image, enlarge, size, flags=cv2.INTER_CUBIC, borderValue=(255,))
    canvas = np.asarray(cv2.cvtColor(cut, cv2.COLOR_GRAY2BGR), np.uint8)
    draw_curve(canvas, _TIMES * edge + shift, colour, closed=True)
    return np.pad(canvas, ((0, _GAP_PX), (0, _GAP_PX), (0, 0)), constant_values=255)
