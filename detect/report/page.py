"""The command ``detect report``: files of rows in, one HTML page out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from detect.comparison.compare import compare_with_file
from detect.comparison.report import floor_table, summary_rows, worst_frames_table
from detect.comparison.result import Comparison, DiscComparison, Kind, LineComparison, number
from detect.drawing.frame import draw_rows, picture_name
from detect.errors import DetectError, FrameError
from detect.options import Report, RowFiles
from detect.report import figures
from detect.row_files import RunRows, SeenRows, open_rows
from detect.seen import Sight
from detect.sources.image_files import image_name
from detect.sources.interface import ImageRun, Run, RunFrame, read_image
from detect.sources.opening import demand_recording, open_source
from redetect import __version__
from redetect.reporting.page import Part, Section, image_part, page_of
from redetect.storage import demand_place, write_bytes

_NAMES = {
    "circles": "discs", "lines": "verticals", "markers": "markers", "tilt": "frames with a tilt"
}  # fmt: skip
_NO_REFERENCE = "No reference rows: expected {} in the run folder, or a file named by {}."


@dataclass(frozen=True)
class ReportInputs:
    """A run's rows, and their comparison with the reference.

    `names` are the prefixes of the frames in order, `rows` the rows of each. `sight` is None
    without a calibration, comparisons are None without reference rows.
    """

    run: ImageRun
    files: RunRows
    names: tuple[str, ...]
    rows: tuple[SeenRows, ...]
    sight: Sight | None
    discs: DiscComparison | None
    lines: LineComparison | None


def gather(run: ImageRun, options: RowFiles) -> ReportInputs:
    """Read and compare all rows of a run.

    Raises DetectError or redetect.landmarks.LandmarkFileError if a file is missing or malformed.
    """
    files = open_rows(run, options)
    names = tuple(frame.step.prefix for frame in run.frames)
    if not names:
        raise DetectError(f"{run.folder}: no frames: expected some of them")
    rows = tuple(files.of(name) for name in names)
    sight = files.sight(run.camera) if isinstance(run, Run) else None

    def compared(kind: Kind) -> Comparison | None:
        both = [(getattr(seen, kind), getattr(seen, f"reference_{kind}")) for seen in rows]
        if not any(detected and reference for detected, reference in both):
            return None
        reference = files.reference[kind]
        return compare_with_file(
            kind,
            reference,
            [detected for detected, _ in both if detected],
            sight=sight,
            names=(reference.name, files.detected[kind].name),
        )

    discs, lines = compared("circles"), compared("lines")
    assert isinstance(discs, DiscComparison | None)
    assert isinstance(lines, LineComparison | None)
    return ReportInputs(run, files, names, rows, sight, discs, lines)


def frame_picture(inputs: ReportInputs, frame: RunFrame, words: str) -> Part:
    """The picture of a frame with its rows, or a note on why there is none."""
    try:
        image = read_image(frame, None if inputs.sight is None else inputs.sight.camera)
    except FrameError as error:
        return Part("note", f"{words}: {error}")
    rows, settings = inputs.files.of(frame.step.prefix), inputs.files.circle_settings
    picture = draw_rows(image, inputs.sight, rows, settings)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return image_part(words, encoded.tobytes(), "jpeg", picture.shape[1], picture.shape[0])


def perform(options: Report) -> int:
    """Execute the command; returns the exit code."""
    demand_recording(options.run)
    run = open_source(options.run, options.camera, options.source)
    output = run.output("html") if options.output is None else options.output
    demand_place(output, overwrite=options.force)
    inputs = gather(run, options.files)
    write_bytes(output, report_page(inputs, options.worst), overwrite=options.force)
    names = [path.name for path in inputs.files.reference.values()]
    against = f" against {' and '.join(names)}" if names else ", no reference rows"
    print(f"{output}: {len(inputs.rows)} frames, {', '.join(inputs.files.detected)}{against}")
    return 0


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
    sections.append(Section("settings", "Effective configuration", _settings(inputs)))
    return page_of(f"Detections of {inputs.run.name}", sections)


def _summary(inputs: ReportInputs) -> list[Part]:
    shown = [("frames", str(len(inputs.rows)))]
    for kind in inputs.files.detected:
        frames = [frame for seen in inputs.rows if (frame := getattr(seen, kind)) is not None]
        count = len(frames) if kind == "tilt" else sum(len(getattr(f, kind)) for f in frames)
        shown.append((_NAMES[kind], str(count)))
    for name, result in (("discs", inputs.discs), ("verticals", inputs.lines)):
        if result is not None:
            shown.append((f"recall of {name}", number(result.recall, 3)))
            shown.append((f"precision of {name}", number(result.precision, 3)))
    parts = [Part("figures", rows=tuple(shown))]
    if len(inputs.rows) < 2:
        return parts
    plan = figures.floor_map(inputs.rows)
    return parts if plan is None else [*parts, plan]


# -- against the reference --------------------------------------------------------------------


def _discs(inputs: ReportInputs) -> list[Part]:
    """Rates and errors of discs, and consistency of the covariances."""
    result = inputs.discs
    if result is None:
        return [Part("note", _NO_REFERENCE.format("map.circles", "--reference"))]
    parts = [*_summary_of(result)]
    quality = [row.quality for match in result.frames for row in match.detected]
    if len(set(quality)) > 1:
        levels = np.linspace(min(quality), max(quality), 41)
        parts.append(figures.rates_figure(levels, *figures.rates_over(result, levels)))
    if result.matched:
        parts.append(figures.floor_figure(result.pairs))
        if result.pairs.levelled_apart:
            parts.append(Part("table", *floor_table(result)))
    return [*parts, *_consistency(result, "two components for each matched disc")]


def _lines(inputs: ReportInputs) -> list[Part]:
    """Rates and errors of verticals, and consistency of the standard deviations."""
    result = inputs.lines
    if result is None:
        return [Part("note", _NO_REFERENCE.format("map.lines", "--reference-lines"))]
    return [
        *_summary_of(result),
        *_consistency(result, "one for each matched vertical"),
        *([figures.bearings_figure(result.pairs)] if result.matched else []),
    ]


def _summary_of(result: Comparison) -> list[Part]:
    """The sentences and figures of `detect compare`."""
    rows = tuple(summary_rows(result).items())
    table = Part(
        "details", "All figures, by their names in the JSON", ("what", "value"), rows, left=(0, 1)
    )
    return [Part("text", " ".join(result.sentences())), table]


def _consistency(result: DiscComparison | LineComparison, what: str) -> list[Part]:
    """Consistency of the stated covariances."""
    residuals = figures.whitened(result)
    if not len(residuals):
        return [Part("note", "No matched rows with a usable covariance: nothing to whiten.")]
    rows = [("mean", f"{residuals.mean():.3f}"), ("deviation", f"{residuals.std():.3f}")]
    for k in (1, 2, 3):
        normal = math.erf(k / math.sqrt(2.0))
        share = np.mean(np.abs(residuals) <= k)
        rows.append((f"within {k} {figures.SIGMA} (normal: {normal:.3f})", f"{share:.3f}"))
    return [figures.whitened_figure(residuals, what), Part("figures", rows=tuple(rows))]


# -- frames, tilt, settings -------------------------------------------------------------


def _frames(inputs: ReportInputs, worst: int) -> Section:
    """The worst frames, or some frames if there is no reference to rank them."""
    named = {image_name(prefix): prefix for prefix in inputs.names}
    parts: list[Part] = []
    shown: dict[str, str] = {}
    for kind, result in (("discs", inputs.discs), ("verticals", inputs.lines)):
        if result is None:
            continue
        matches = result.worst_frames(worst)
        table = worst_frames_table(result, worst)
        parts.append(Part("table", f"{table.caption}: {kind}", table.head, table.rows))
        for rank, match in enumerate(matches, 1):
            prefix, place = named[match.name], f"number {rank} of {kind}"
            shown[prefix] = f"{shown[prefix]}, {place}" if prefix in shown else place
    if parts:
        key = (
            ("#ffaa00", f"disc's edge; ±1 {figures.SIGMA} of a vertical"),
            ("#3cc83c", "outlines; vertical"),
            ("#ff3cff", "matches no reference row"),
            ("#ff3c3c", "missed reference row"),
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
    frames: dict[str, RunFrame] = {}
    for frame in inputs.run.frames:  # once, since a video is decoded each time
        if frame.step.prefix in shown:
            frames.setdefault(frame.step.prefix, frame)
    parts += [
        frame_picture(inputs, frames[prefix], f"Frame {picture_name(prefix)} ({why})")
        for prefix, why in shown.items()
    ]
    return Section("frames", title, parts)


def _tilt(inputs: ReportInputs) -> list[Part]:
    tilts = [seen.tilt for seen in inputs.rows if seen.tilt is not None]
    if not tilts:
        return [Part("note", "No frame has a tilt: too few verticals agreed.")]
    lines = np.median([t.lines for t in tilts])
    words = f"{len(tilts)} of {len(inputs.rows)} frames; {lines:g} verticals agree (median)."
    figure = [figures.tilt_figure(inputs.rows)] if len(tilts) > 1 else []
    return [*figure, Part("note", words)]


def _settings(inputs: ReportInputs) -> list[Part]:
    parts: list[Part] = []
    for kind, head in inputs.files.heads.items():
        name = inputs.files.detected[kind].name
        parts.append(Part("heading", name))
        if head.settings:
            caption = f"Settings in the head of {name}"
            parts.append(Part("table", caption, ("setting", "value"), head.settings))
        words = [line for line in head.comments if line and not line.startswith("settings ")]
        parts += [Part("note", line) for line in words] or [Part("note", "No head in the file.")]
    parts.append(Part("note", f"Page written by detect report, version {__version__}."))
    return parts
