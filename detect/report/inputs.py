"""Inputs of a report: all rows of a run, frame by frame, and the reference rows."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from functools import cached_property

from detect.comparison.circles import Sight, beside_reference, compare_frames
from detect.comparison.lines import compare_line_frames
from detect.comparison.result import CompareOptions, Comparison, LineCompareOptions, LineComparison
from detect.drawing.inputs import SeenFiles, SeenRows, find_files, open_rows
from detect.errors import DetectError, FrameError
from detect.report.statistics import FramePair
from detect.run import ImageRun, Run, RunFrame, read_image
from detect.runs.frame import FramePlan, FrameTask, detect_batch, tables_of
from detect.seen import FrameView
from detect.viewing_options import Gates, RowFiles
from landmarks import CircleLandmark, Frame, LineLandmark, Step


@dataclass(frozen=True)
class Timing:
    """Processor time per frame, medians (ms): decoding the image, and everything else."""

    frames: int
    decoding_ms: float
    detecting_ms: float
    what: str


@dataclass(frozen=True)
class ReportInputs:
    """A run's rows.

    Attributes
    ----------
    run : ImageRun
    files : SeenFiles
    names : tuple of str
        Prefixes of the frames, in the run's order.
    rows : tuple of SeenRows
        Of each.
    gate : CompareOptions
    line_gate : LineCompareOptions
    timing : Timing or None
    """

    run: ImageRun
    files: SeenFiles
    names: tuple[str, ...]
    rows: tuple[SeenRows, ...]
    gate: CompareOptions
    line_gate: LineCompareOptions
    timing: Timing | None = None

    @cached_property
    def sight(self) -> Sight | None:
        """How discs come back into the images; None without a calibration."""
        if not isinstance(self.run, Run):
            return None
        return Sight(self.run.camera, self.files.radius_m, self.files.reference_level)

    def view_of(self, rows: SeenRows) -> FrameView | None:
        """How the discs of a frame come back into its image."""
        return None if self.sight is None else self.sight.of(rows.reference_by, rows.levelled_by)

    @cached_property
    def disc_pairs(self) -> list[FramePair[CircleLandmark]]:
        """The frames that both files of discs have."""
        return [
            FramePair(rows.reference_circles, rows.circles, self.view_of(rows))
            for rows in self.rows
            if rows.circles is not None and rows.reference_circles is not None
        ]

    @cached_property
    def line_pairs(self) -> list[FramePair[LineLandmark]]:
        """The frames that both files of verticals have."""
        return [
            FramePair(rows.reference_lines, rows.lines)
            for rows in self.rows
            if rows.lines is not None and rows.reference_lines is not None
        ]

    @cached_property
    def discs(self) -> Comparison | None:
        """The figures of `detect compare`; None without reference rows."""
        if self.files.reference_circles is None or not self.disc_pairs:
            return None
        both = [
            (
                Frame(_step(name), rows.reference_circles, rows.reference_by),
                Frame(_step(name), rows.circles, rows.levelled_by),
            )
            for name, rows in zip(self.names, self.rows)
            if rows.circles is not None and rows.reference_circles is not None
        ]
        return compare_frames(
            [reference for reference, _ in both],
            [detected for _, detected in both],
            self.gate,
            sight=self.sight,
            beside=beside_reference(self.files.reference_circles),
            reference_name=self.files.reference_circles.name,
            detected_name=self.files.detected["circles"].name,
        )

    @cached_property
    def lines(self) -> LineComparison | None:
        """The figures of `detect compare --lines`; None without reference rows."""
        if self.files.reference_lines is None or not self.line_pairs:
            return None
        both = [
            (Frame(_step(name), rows.reference_lines), Frame(_step(name), rows.lines))
            for name, rows in zip(self.names, self.rows)
            if rows.lines is not None and rows.reference_lines is not None
        ]
        return compare_line_frames(
            [reference for reference, _ in both],
            [detected for _, detected in both],
            self.line_gate,
            reference_name=self.files.reference_lines.name,
            detected_name=self.files.detected["lines"].name,
        )


def gather(run: ImageRun, options: RowFiles, gates: Gates, time_frames: int) -> ReportInputs:
    """Read all rows of a run.

    Parameters
    ----------
    run : ImageRun
        The run.
    options : RowFiles
        Which files.
    gates : Gates
        What counts as the same landmark.
    time_frames : int
        Number of frames that are detected again to measure the time.

    Returns
    -------
    ReportInputs

    Raises
    ------
    DetectError, landmarks.LandmarkFileError
        If a file is missing or malformed.
    """
    files = find_files(run, options)
    source = open_rows(files)
    names = tuple(frame.step.prefix for frame in run.frames)
    if not names:
        raise DetectError(f"{run.folder}: no frames: expected some of them")
    return ReportInputs(
        run,
        files,
        names,
        tuple(source.of(name) for name in names),
        gates.discs,
        LineCompareOptions(tolerance_deg=gates.tolerance_deg, sigmas=gates.sigmas),
        _timing(run, files, len(names), time_frames),
    )


def _timing(run: ImageRun, files: SeenFiles, count: int, wanted: int) -> Timing | None:
    if wanted < 0:
        raise DetectError(f"time_frames is {wanted}: expected 0 or more")
    if wanted == 0:
        return None
    heads = files.heads
    circles = heads["circles"].circle_settings if "circles" in heads else None
    lines = heads["lines"].line_settings if "lines" in heads else None
    if not isinstance(run, Run) or (circles is None and lines is None):
        raise DetectError("--time-frames: expected a calibration, and rows of discs or verticals")
    plan = FramePlan(run.camera, lines=lines, circles=circles)
    tables = tables_of(plan)
    every = max(1, count // wanted)
    chosen: list[RunFrame] = []
    for position, frame in enumerate(run.frames):
        if position % every == 0 and len(chosen) < wanted:
            chosen.append(frame)
    decoding, detecting = [], []
    # The first time does what later ones find done.
    for frame in [chosen[0], *chosen]:
        try:
            start = time.thread_time()
            read_image(frame, run.camera)
            between = time.thread_time()
            detect_batch([FrameTask(frame)], plan, tables)
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


def _step(prefix: str) -> Step:
    return Step(prefix, *[0.0] * 9)
