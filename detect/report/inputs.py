"""What a report shows: all rows of a run, their comparisons, the time, and pictures of frames."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.comparison.compare import compare_frames, compare_line_frames, rows_beside
from detect.comparison.result import DiscComparison, LineComparison
from detect.drawing.frame import EXTRA_COLOUR, MISSED_COLOUR, Colour, draw_curve, draw_rows
from detect.drawing.inputs import RunRows, SeenRows, open_rows, picture_name
from detect.errors import DetectError, FrameError
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.seen import Sight, circle_on_floor
from detect.sources.interface import ImageRun, Run, RunFrame, read_image
from detect.viewing_options import CompareOptions, Gates, RowFiles
from redetect.landmarks import circle_arrays
from redetect.reporting.page import Part, image_part


@dataclass(frozen=True)
class Timing:
    """Processor time per frame, medians (ms): decoding the image, and everything else."""

    frames: int
    decoding_ms: float
    detecting_ms: float
    what: str


@dataclass(frozen=True)
class ReportInputs:
    """A run's rows, and how they compare with the reference.

    `names` are the prefixes of its frames in their order, `rows` the rows of each. `sight` is None
    without a calibration, comparisons without reference rows.
    """

    run: ImageRun
    files: RunRows
    names: tuple[str, ...]
    rows: tuple[SeenRows, ...]
    options: CompareOptions
    sight: Sight | None
    discs: DiscComparison | None
    lines: LineComparison | None
    timing: Timing | None


def gather(run: ImageRun, options: RowFiles, gates: Gates, time_frames: int) -> ReportInputs:
    """Read and compare all rows of a run, and detect `time_frames` frames to measure the time.

    Raises DetectError or redetect.landmarks.LandmarkFileError if a file is missing or malformed.
    """
    files = open_rows(run, options)
    names = tuple(frame.step.prefix for frame in run.frames)
    if not names:
        raise DetectError(f"{run.folder}: no frames: expected some of them")
    rows = tuple(files.of(name) for name in names)
    compare = CompareOptions(**vars(gates))
    sight = files.sight(run.camera) if isinstance(run, Run) else None
    discs, lines = None, None
    if both := [seen for seen in rows if seen.circles and seen.reference_circles]:
        path = files.reference["circles"]
        discs = compare_frames(
            [seen.reference_circles for seen in both if seen.reference_circles],
            [seen.circles for seen in both if seen.circles],
            compare,
            sight=sight,
            unlisted=rows_beside(path, "unlisted.circles"),
            lookalikes=rows_beside(path, "lookalikes.circles"),
            names=(path.name, files.detected["circles"].name),
        )
    if both := [seen for seen in rows if seen.lines and seen.reference_lines]:
        lines = compare_line_frames(
            [seen.reference_lines for seen in both if seen.reference_lines],
            [seen.lines for seen in both if seen.lines],
            compare,
            unlisted=rows_beside(files.reference["lines"], "unlisted.lines"),
            names=(files.reference["lines"].name, files.detected["lines"].name),
        )
    timing = _timing(run, files, len(names), time_frames)
    return ReportInputs(run, files, names, rows, compare, sight, discs, lines, timing)


def _timing(run: ImageRun, files: RunRows, count: int, wanted: int) -> Timing | None:
    if wanted < 0:
        raise DetectError(f"time_frames is {wanted}: expected 0 or more")
    if wanted == 0:
        return None
    circles = files.circle_settings if "circles" in files.heads else None
    lines = files.heads["lines"].line_settings if "lines" in files.heads else None
    if not isinstance(run, Run) or (circles is None and lines is None):
        raise DetectError("--time-frames: expected a calibration, and rows of discs or verticals")
    plan = FramePlan(run.camera, lines=lines, circles=circles)
    every = max(1, count // wanted)
    chosen = list(islice(run.frames, 0, every * wanted, every))
    decoding, detecting = [], []
    # The first frame, which compiles and fills caches, is processed twice.
    for frame in [chosen[0], *chosen]:
        try:
            start = time.thread_time()
            read_image(frame, run.camera)
            between = time.thread_time()
            detect_batch([FrameTask(frame)], plan)
            end = time.thread_time()
        except FrameError:
            continue
        decoding.append(between - start)
        detecting.append((end - between) - (between - start))
    if len(decoding) < 2:
        raise DetectError("--time-frames: no image can be read: expected some of them")
    what = " and ".join(
        kind for kind, settings in (("discs", circles), ("verticals", lines)) if settings
    )
    return Timing(
        len(decoding) - 1,
        1e3 * statistics.median(decoding[1:]),
        1e3 * statistics.median(detecting[1:]),
        what,
    )


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
