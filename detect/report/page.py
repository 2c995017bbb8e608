"""The command ``detect report``: files of rows in, one HTML page out."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from detect import __version__
from detect.comparison.compare import compare_frames, compare_line_frames, rows_beside
from detect.comparison.report import (
    floor_table,
    summary_rows,
    worst_frames_table,
)
from detect.comparison.result import Comparison, DiscComparison, LineComparison, number
from detect.drawing.frame import EXTRA_COLOUR, MISSED_COLOUR, Colour, draw_curve, draw_rows
from detect.drawing.inputs import RunRows, SeenRows, open_rows, picture_name
from detect.errors import DetectError, FrameError
from detect.line_settings import LineSettings
from detect.report.figures import (
    RateCurve,
    bearings_figure,
    counts_figure,
    disc_rates,
    distance_figure,
    floor_figure,
    floor_map,
    knee,
    line_rates,
    rates_figure,
    tilt_figure,
    whitened,
    whitened_figure,
)
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.seen import Sight, circle_on_floor
from detect.settings import CircleSettings, MarkerSettings
from detect.sources.interface import ImageRun, Run, RunFrame, read_image
from detect.sources.opening import demand_recording, open_source
from detect.viewing_options import CompareOptions, Gates, Report, RowFiles
from redetect.landmarks import circle_arrays
from redetect.reporting.page import Part, Section, image_part, page_of
from redetect.storage import demand_place, write_bytes


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
    timing = _measured(run, files, len(names), time_frames)
    return ReportInputs(run, files, names, rows, compare, sight, discs, lines, timing)


def _measured(run: ImageRun, files: RunRows, count: int, wanted: int) -> Timing | None:
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


def perform(options: Report) -> int:
    """Carry the command out; returns the exit code."""
    if options.worst < 0:
        raise DetectError(f"worst is {options.worst}: expected 0 or more")
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    demand_place(output, overwrite=options.force)
    inputs = gather(run, options.files, options.gates, options.time_frames)
    page = report_page(inputs, options.worst)
    write_bytes(output, page, overwrite=options.force)
    names = [path.name for path in inputs.files.reference.values()]
    against = f" against {' and '.join(names)}" if names else ", no reference rows"
    print(f"{output}: {len(inputs.rows)} frames, {', '.join(inputs.files.detected)}{against}")
    return 0


_NAMES = {"circles": "Discs", "lines": "Verticals", "markers": "Markers", "tilt": "Tilt"}
_SETTINGS = {"circles": CircleSettings, "lines": LineSettings, "markers": MarkerSettings}
_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
_NO_REFERENCE = "No reference rows: expected {} in the run folder, or a file named by {}."
_CURVE_POINTS = 41
_TABLE_POINTS = 5


def report_page(inputs: ReportInputs, worst: int) -> bytes:
    """The whole page, UTF-8, with `worst` frames shown; the same inputs give the same bytes."""
    detected = inputs.files.detected
    sections = [Section("summary", "What was found", _summary(inputs))]
    if "circles" in detected:
        sections.append(Section("discs", "Discs against the reference", _discs(inputs)))
    if "lines" in detected:
        sections.append(Section("verticals", "Verticals against the reference", _lines(inputs)))
    sections.append(_frames(inputs, worst))
    if "tilt" in detected:
        sections.append(Section("tilt", "Tilt", _tilt(inputs)))
    sections.append(Section("timing", "Timing", [_timing(inputs)]))
    sections.append(Section("settings", "Effective configuration", _settings(inputs)))
    return page_of(f"Detections of {inputs.run.name}", sections)


def _summary(inputs: ReportInputs) -> list[Part]:
    figures = [("frames", str(len(inputs.rows)))]
    rows = []
    for kind, path in inputs.files.detected.items():
        frames = [getattr(seen, kind) for seen in inputs.rows]
        counts = [
            0 if frame is None else 1 if kind == "tilt" else len(getattr(frame, kind))
            for frame in frames
        ]
        name = "frames with a tilt" if kind == "tilt" else _NAMES[kind].lower()
        figures.append((name, str(sum(counts))))
        rows.append(
            (_NAMES[kind], path.name, str(sum(counts)), str(sum(count > 0 for count in counts)))
        )
    for name, result in (("discs", inputs.discs), ("verticals", inputs.lines)):
        if result is not None:
            figures.append((f"recall of {name}", number(result.recall, 3)))
            figures.append((f"precision of {name}", number(result.precision, 3)))
    head = ("what", "file", "rows", "frames with some")
    parts = [
        Part("figures", rows=tuple(figures)),
        Part("table", "Files of rows", head, tuple(rows), left=(0, 1)),
    ]
    if len(inputs.rows) < 2:
        return parts
    plan = floor_map(inputs.rows)
    return [*parts, counts_figure(inputs.rows), *([] if plan is None else [plan])]


# -- against the reference --------------------------------------------------------------------


def _discs(inputs: ReportInputs) -> list[Part]:
    """Rates and errors of discs, whether covariances are right, and discs cut out."""
    result = inputs.discs
    if result is None:
        return [Part("note", _NO_REFERENCE.format("map.circles", "--reference"))]
    parts = [_summary_of(result)]
    if result.reference or result.detected:
        parts.append(distance_figure(result.bins))
    quality = [row.quality for match in result.frames for row in match.frame.detected]
    levels = np.linspace(min(quality), max(quality), _CURVE_POINTS) if quality else np.zeros(0)
    parts += _rates(disc_rates(result, np.unique(levels)), "least quality", "quality")
    if result.matched:
        parts.append(floor_figure(result.pairs, lean=result.lean is not None))
    what = "two components for each matched disc"
    if result.lean is not None:
        what += ", after the common lean"
        parts.append(Part("table", *floor_table(result)))
    parts += _honesty(result, what)
    return [*parts, *gallery(inputs, "missed"), *gallery(inputs, "extra")]


def _lines(inputs: ReportInputs) -> list[Part]:
    """Rates and errors of verticals, and whether standard deviations are right."""
    result = inputs.lines
    if result is None:
        return [Part("note", _NO_REFERENCE.format("map.lines", "--reference-lines"))]
    sigma = [row.sigma for match in result.frames for row in match.frame.detected]
    levels = np.quantile(sigma, np.linspace(0.0, 1.0, _CURVE_POINTS)) if sigma else np.zeros(0)
    # Quantiles between rows may round below the greatest.
    curve = line_rates(result, np.nextafter(np.unique(levels), np.inf))
    return [
        _summary_of(result),
        *_rates(curve, f"largest {_SIGMA} of the bearing / deg", f"{_SIGMA} / deg"),
        *_honesty(result, "one for each matched vertical"),
        *([bearings_figure(result.pairs)] if result.matched else []),
    ]


def _summary_of(result: Comparison) -> Part:
    """What `detect compare` says."""
    rows = tuple(summary_rows(result).items())
    return Part(
        "table", "Detected rows against reference rows", ("what", "value"), rows, left=(0, 1)
    )


def _rates(curve: RateCurve, axis: str, name: str) -> list[Part]:
    count = len(curve.threshold)
    if not count:
        return [Part("note", "No rows: no rates over thresholds.")]
    best = knee(curve.recall, curve.precision)
    chosen = set(np.linspace(0, count - 1, _TABLE_POINTS).astype(int).tolist())
    chosen |= {best} - {None}
    rows = tuple(
        (
            f"{curve.threshold[k]:.3g}" + (" (knee)" if k == best else ""),
            str(curve.kept[k]),
            *("-" if np.isnan(v) else f"{v:.3f}" for v in (curve.recall[k], curve.precision[k])),
        )
        for k in sorted(chosen)
    )
    head = (name, "rows kept", "recall", "precision")
    table = Part("table", f"Rates over the threshold ({axis})", head, rows)
    return [table] if count < 2 else [rates_figure(curve, axis), table]


def _honesty(result: DiscComparison | LineComparison, what: str) -> list[Part]:
    """Whether the stated covariances are right."""
    residuals = whitened(result)
    if not len(residuals):
        return [Part("note", "No matched rows with a usable covariance: nothing to whiten.")]
    rows = [("mean", f"{residuals.mean():.3f}"), ("deviation", f"{residuals.std():.3f}")]
    for k in (1, 2, 3):
        normal = math.erf(k / math.sqrt(2.0))
        share = np.mean(np.abs(residuals) <= k)
        rows.append((f"within {k} {_SIGMA} (normal: {normal:.3f})", f"{share:.3f}"))
    return [whitened_figure(residuals, what), Part("figures", rows=tuple(rows))]


# -- frames, tilt, time, settings -------------------------------------------------------------


def _frames(inputs: ReportInputs, worst: int) -> Section:
    """The worst frames, or some frames if there is no reference to rank them."""
    named = {picture_name(prefix): prefix for prefix in inputs.names}
    parts: list[Part] = []
    shown: dict[str, str] = {}
    for kind, result in (("discs", inputs.discs), ("verticals", inputs.lines)):
        if result is None:
            continue
        matches = result.worst_frames(worst)
        table = worst_frames_table(result, worst)
        parts.append(Part("table", f"{table.caption}: {kind}", table.head, table.rows))
        for rank, match in enumerate(matches, 1):
            prefix, place = named[picture_name(match.frame.name)], f"number {rank} of {kind}"
            shown[prefix] = f"{shown[prefix]}, {place}" if prefix in shown else place
    if parts:
        key = (
            ("#ffaa00", f"disc's edge; ±1 {_SIGMA} of a vertical"),
            ("#3cc83c", "outlines; vertical"),
            ("#ff3cff", "fits no reference row"),
            ("#ff3c3c", "reference row that is missing"),
        )
        words = (
            "Above a disc: quality, distance to its reference row in the image. Below a "
            "vertical: error of the bearing in standard deviations."
        )
        parts += [Part("key", rows=key), Part("note", words)]
    else:
        count = min(worst, len(inputs.names))
        for k in np.unique(np.linspace(0, len(inputs.names) - 1, count).astype(int)):
            shown[inputs.names[k]] = "no reference rows"
    title = "Worst frames" if parts else "Some frames"
    parts += [
        frame_picture(inputs, prefix, f"Frame {picture_name(prefix)} ({why})")
        for prefix, why in shown.items()
    ]
    return Section("frames", title, parts)


def _tilt(inputs: ReportInputs) -> list[Part]:
    tilts = [seen.tilt for seen in inputs.rows if seen.tilt is not None]
    if not tilts:
        return [Part("note", "No frame has a tilt: too few verticals agreed.")]
    rows = []
    for name, value, variance in (
        ("pitch", [t.pitch for t in tilts], [t.cpp for t in tilts]),
        ("roll", [t.roll for t in tilts], [t.crr for t in tilts]),
    ):
        angle, sigma = np.degrees(value), np.degrees(np.sqrt(variance))
        figures = (angle.mean(), angle.std(), np.abs(angle).max(), np.median(sigma))
        rows.append((name, *(f"{figure:.3f}" for figure in figures)))
    head = ("degrees", "mean", "deviation", "largest", f"median of its {_SIGMA}")
    lines = np.median([t.lines for t in tilts])
    caption = f"{len(tilts)} of {len(inputs.rows)} frames; {lines:g} verticals agree (median)"
    figure = [tilt_figure(inputs.rows)] if len(tilts) > 1 else []
    return [*figure, Part("table", caption, head, tuple(rows))]


def _timing(inputs: ReportInputs) -> Part:
    timing = inputs.timing
    if timing is None:
        words = "Not measured: --time-frames 20 detects 20 of the frames again and states it."
        return Part("note", words)
    rows = tuple(
        (what, f"{ms:.2f}", f"{ms / timing.decoding_ms:.2f}")
        for what, ms in (
            ("decoding the image", timing.decoding_ms),
            (f"detecting {timing.what}", timing.detecting_ms),
        )
    )
    caption = f"Processor time, medians of {timing.frames} frames, on the machine of this report"
    return Part("table", caption, ("", "ms", "x decoding"), rows)


def _settings(inputs: ReportInputs) -> list[Part]:
    parts: list[Part] = []
    for kind, head in inputs.files.heads.items():
        default = _SETTINGS[kind]() if kind in _SETTINGS else None
        # As heads write them.
        usual = (
            {name: str(value).replace(" ", "") for name, value in vars(default).items()}
            if default
            else {}
        )
        name = inputs.files.detected[kind].name
        parts.append(Part("heading", name))
        if head.settings:
            changed = [usual.get(key, value) != value for key, value in head.settings]
            rows = tuple(
                (key, value, usual.get(key, "") if differs else "")
                for (key, value), differs in zip(head.settings, changed)
            )
            bold = tuple(np.flatnonzero(changed).tolist())
            caption = f"Settings in the head of {name}; bold where not the default"
            parts.append(Part("table", caption, ("setting", "value", "default"), rows, bold=bold))
        words = [line for line in head.comments if line and not line.startswith("settings ")]
        parts += [Part("note", line) for line in words] or [Part("note", "No head in the file.")]
    parts.append(Part("note", f"Page written by detect report, version {__version__}."))
    return parts
