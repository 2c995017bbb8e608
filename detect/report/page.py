"""The page of a run: its rows, their comparison with the reference, and some frames."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from detect.comparison.compare import compare_with_file
from detect.comparison.report import floor_table, summary_rows, worst_frames_table
from detect.comparison.result import Comparison, DiscComparison, Kind, LineComparison
from detect.drawing.frame import draw_rows, processed
from detect.errors import DetectError, FrameError
from detect.line_settings import LineSettings
from detect.options import RowFiles
from detect.projection import DiscProjection, summed_steps
from detect.report import figures
from detect.row_files import ImageRows, RunRows, open_rows
from detect.sources.grey_images import read_image
from detect.sources.image_files import image_name, picture_name
from detect.sources.interface import ImageRun, Run, RunFrame
from redetect import __version__
from redetect.landmarks import circle_arrays
from redetect.messages import counted
from redetect.reporting.page import Part, Section, image_part, page_of

_NAMES = {
    "circles": "discs", "lines": "verticals", "markers": "markers", "tilt": "frames with a tilt"
}  # fmt: skip
_KEY = (
    ("#ffaa00", f"disc's edge; ±1 {figures.SIGMA} of a vertical"),
    ("#3cc83c", "outlines; vertical"),
    ("#ff3cff", "matches no reference row"),
    ("#ff3c3c", "missed reference row"),
)
_LABELS = (
    "Beside a disc: quality, distance to its reference row in the image. Below a vertical: error "
    "of the bearing in standard deviations."
)
_LISTED = 10
_NO_REFERENCE = "No reference rows: expected {} in the run folder, or a file named by {}."


@dataclass(frozen=True)
class ReportInputs:
    """A run's rows, and their comparison with the reference.

    `names` are the prefixes of the frames in order, `rows` the rows of each. `projection` is None
    without a calibration, comparisons are None without reference rows.
    """

    run: ImageRun
    files: RunRows
    names: tuple[str, ...]
    rows: tuple[ImageRows, ...]
    projection: DiscProjection | None
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
    projection = files.projection(run.camera) if isinstance(run, Run) else None

    def compared(kind: Kind) -> Comparison | None:
        both = [(getattr(each, kind), getattr(each, f"reference_{kind}")) for each in rows]
        if not any(detected and reference for detected, reference in both):
            return None
        reference = files.reference[kind]
        return compare_with_file(
            kind,
            reference,
            [detected for detected, _ in both if detected],
            projection=projection,
            names=(reference.name, files.detected[kind].name),
        )

    discs, lines = compared("circles"), compared("lines")
    assert isinstance(discs, DiscComparison | None)
    assert isinstance(lines, LineComparison | None)
    return ReportInputs(run, files, names, rows, projection, discs, lines)


def frame_picture(inputs: ReportInputs, frame: RunFrame, words: str) -> Part:
    """The picture of a frame with its rows, or a note on why there is none."""
    try:
        image = read_image(frame, None if inputs.projection is None else inputs.projection.camera)
    except FrameError as error:
        return Part("note", f"{words}: {error}")
    picture = draw_rows(image, inputs.projection, inputs.files.of(frame.step.prefix))
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return image_part(words, encoded.tobytes(), "jpeg", picture.shape[1], picture.shape[0])


def report_page(inputs: ReportInputs, worst: int) -> bytes:
    """The whole page, UTF-8, with `worst` frames shown; the same inputs give the same bytes."""
    tables, shown = _shown_frames(inputs, worst)
    frames: dict[str, RunFrame] = {}
    for frame in inputs.run.frames:  # once, since a video is decoded each time
        if frame.step.prefix in shown:
            frames.setdefault(frame.step.prefix, frame)
    pictures = [
        frame_picture(inputs, frames[prefix], f"Frame {picture_name(prefix)} ({why})")
        for prefix, why in shown.items()
    ]
    steps = tuple((step,) for step in _next_steps(inputs))
    sections = [
        Section("summary", "What was found", _summary(inputs, pictures[:1])),
        Section("next", "What to do next", [Part("list", rows=steps)] if steps else []),
        Section("discs", "Discs against the reference", _discs(inputs.discs)),
        Section("verticals", "Verticals against the reference", _lines(inputs.lines)),
        Section("uncertainty", "Stated covariances of discs", _uncertainty(inputs)),
        Section("frames", f"{'Worst' if tables else 'Some'} frames", [*tables, *pictures[1:]]),
        Section("tilt", "Tilt", _tilt(inputs)),
        Section("settings", "Effective configuration", _settings(inputs)),
    ]
    return page_of(f"Detections of {inputs.run.name}", sections)


def _summary(inputs: ReportInputs, pictures: list[Part]) -> list[Part]:
    """Sentences and figures, a picture, and the map of the floor."""
    done = sum(map(processed, inputs.rows))
    shown, beside = [("frames", done)], ""
    if done < len(inputs.rows):
        shown.append(("not processed", len(inputs.rows) - done))
    for kind in inputs.files.detected:
        frames = [frame for each in inputs.rows if (frame := getattr(each, kind)) is not None]
        count = len(frames) if kind == "tilt" else sum(len(getattr(f, kind)) for f in frames)
        shown.append((_NAMES[kind], count))
    results = [result for result in (inputs.discs, inputs.lines) if result is not None]
    for c in results:
        shown += [(f"{c.what} found", c.found), (f"{c.what} missed", c.missed)]
        if c.on_lookalikes is not None:
            shown += [("look-alikes", c.on_lookalikes), ("clutter", c.extra - c.on_lookalikes)]
        else:
            shown.append((f"{c.what} matching nothing", c.extra))
        shown.append((f"{c.what} set aside", c.set_aside))
    if (discs := inputs.discs) is not None:
        beside = (
            f" Ellipses without a cross: {discs.set_aside} on discs that the reference does not "
            f"list (set aside), {discs.extra} on look-alikes or clutter."
        )
    plan = figures.floor_map(inputs.rows, beside) if len(inputs.rows) > 1 else None
    return [
        *(Part("text", " ".join(result.sentences())) for result in results),
        Part("figures", rows=tuple((name, str(count)) for name, count in shown)),
        *pictures,
        *([Part("key", rows=_KEY), Part("note", _LABELS)] if results else []),
        *([] if plan is None else [plan]),
    ]


def _next_steps(inputs: ReportInputs) -> Iterator[str]:
    """What the run lacks, and what to do about it."""
    files, without = inputs.files, _without_tilt(inputs)
    if left := len(inputs.rows) - sum(map(processed, inputs.rows)):
        yield f"{counted(left, 'frame')} not processed: no file has rows of them."
    for kind, flag in (("circles", "--reference"), ("lines", "--reference-lines")):
        if kind in files.detected and kind not in files.reference:
            yield _NO_REFERENCE.format(f"map.{kind}", flag)
    if "tilt" in files.detected and without:
        yield f"{counted(len(without), 'frame')} without a tilt by verticals: see Tilt."
    frames = [each.circles for each in inputs.rows if each.circles is not None]
    if not frames:
        return
    if not summed_steps(frame.step for frame in frames).any():
        yield "No odometry: the steps are zeros. Detect with --odometry; maps need it."
    if 3 * (count := sum(len(frame.circles) for frame in frames)) < len(frames):
        yield f"Few discs: {count} in {counted(len(frames), 'frame')}. Ask `detect explain` why."
    if isinstance(inputs.run, Run) and inputs.run.camera.covariance is None:
        px = files.circle_settings.calibration_px
        yield f"The calibration has no covariance: its error is assumed to be {px:g} px."
    if "tilt" not in files.detected:
        yield "No tilts: `detect all` finds them, and levels the discs by them."


def _without_tilt(inputs: ReportInputs) -> list[str]:
    """The processed frames in which too few verticals agree for a tilt."""
    least = LineSettings.least_lines
    rows = [(name, each) for name, each in zip(inputs.names, inputs.rows) if processed(each)]
    return [name for name, each in rows if each.tilt is None or each.tilt.lines < least]


def _uncertainty(inputs: ReportInputs) -> list[Part]:
    """The stated sigmas over distance, and how well they predict differences between frames."""
    discs = circle_arrays([row for s in inputs.rows if s.circles for row in s.circles.circles])
    if len(discs.xy) < 2:
        return []
    parts = [figures.sigma_figure(discs)]
    if (found := figures.repeated(inputs.rows)) is not None:
        pairs, rms_m, stated_m, per_dof = found
        words = (
            f"Repeatability: {pairs} pairs of rows of one disc in successive frames, chained "
            f"by the odometry, differ by {1e3 * rms_m:.1f} mm (rms) beyond the step's error, "
            f"with {1e3 * stated_m:.1f} mm stated. The mean squared normalised difference is "
            f"{per_dof:.2f}: 1 if covariances are right, less if frames share errors."
        )
        parts.append(Part("text", words))
    return parts


def _discs(result: DiscComparison | None) -> list[Part]:
    """Rates and errors of discs, and consistency of the covariances."""
    if result is None:
        return []
    parts = [_all_figures(result)]
    quality = [row.quality for match in result.frames for row in match.detected]
    if len(set(quality)) > 1:
        levels = np.linspace(min(quality), max(quality), 41)
        parts.append(figures.rates_figure(levels, *figures.rates_over(result, levels)))
    if result.matched:
        parts.append(figures.floor_figure(result.pairs))
        if result.pairs.levelled_apart:
            parts.append(Part("table", *floor_table(result)))
    return [*parts, *_consistency(result, "two components for each matched disc")]


def _lines(result: LineComparison | None) -> list[Part]:
    """Errors of verticals, and consistency of the standard deviations."""
    if result is None:
        return []
    bearings = [figures.bearings_figure(result.pairs)] if result.matched else []
    consistency = _consistency(result, "one for each matched vertical")
    return [_all_figures(result), *consistency, *bearings]


def _all_figures(result: Comparison) -> Part:
    """The figures of `detect compare`."""
    rows, head = tuple(summary_rows(result).items()), ("what", "value")
    return Part("details", "All figures, by their names in the JSON", head, rows, left=(0, 1))


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


def _shown_frames(inputs: ReportInputs, worst: int) -> tuple[list[Part], dict[str, str]]:
    """Tables of the worst frames, and the frames to be shown with the reasons.

    The first one has most discs. Without a reference to rank them, the others are some frames.
    """
    done = {name: each for name, each in zip(inputs.names, inputs.rows) if processed(each)}
    named = {image_name(prefix): prefix for prefix in inputs.names}
    parts: list[Part] = []
    shown: dict[str, str] = {}
    if done:
        most = max(done, key=lambda name: _sizes(done[name]))
        shown[most] = f"most {'discs' if _sizes(done[most])[0] else 'rows'}"
    for result in (inputs.discs, inputs.lines):
        if result is None:
            continue
        kind = result.what
        table = worst_frames_table(result, worst)
        parts.append(Part("table", f"{table.caption}: {kind}", table.head, table.rows))
        for rank, match in enumerate(result.worst_frames(worst), 1):
            prefix, place = named[match.name], f"number {rank} of {kind}"
            shown[prefix] = f"{shown[prefix]}, {place}" if prefix in shown else place
    if not parts:
        names = tuple(done)
        for k in np.unique(np.linspace(0, len(names) - 1, min(worst, len(names))).astype(int)):
            shown.setdefault(names[k], "no reference rows")
    return parts, shown


def _sizes(rows: ImageRows) -> list[int]:
    """Numbers of discs, verticals and markers in a frame."""
    kinds = ("circles", "lines", "markers")
    return [len(getattr(getattr(rows, kind), kind, ())) for kind in kinds]


def _tilt(inputs: ReportInputs) -> list[Part]:
    if "tilt" not in inputs.files.detected:
        return []
    tilts = [each.tilt for each in inputs.rows if each.tilt is not None]
    if not tilts:
        return [Part("note", "No frame has a tilt: too few verticals agreed.")]
    lines = np.median([t.lines for t in tilts])
    words = (
        f"{len(tilts)} of {counted(len(inputs.rows), 'frame')}; {lines:g} verticals agree (median)."
    )
    if without := [picture_name(name) for name in _without_tilt(inputs)]:
        others = f" and {len(without) - _LISTED} more" if len(without) > _LISTED else ""
        words += f" Too few agree in {', '.join(without[:_LISTED])}{others}."
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
