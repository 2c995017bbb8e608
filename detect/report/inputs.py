"""Inputs of a report: all rows of a run, frame by frame, their comparisons, and the time."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from itertools import islice

from detect.comparison.compare import beside_reference, compare_frames, compare_line_frames
from detect.comparison.result import CompareOptions, DiscComparison, Gates, LineComparison
from detect.drawing.inputs import RunRows, SeenRows, open_rows
from detect.errors import DetectError, FrameError
from detect.run import ImageRun, Run, read_image
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.seen import Sight
from detect.viewing_options import RowFiles


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
            beside=beside_reference(path),
            names=(path.name, files.detected["circles"].name),
        )
    if both := [seen for seen in rows if seen.lines and seen.reference_lines]:
        lines = compare_line_frames(
            [seen.reference_lines for seen in both if seen.reference_lines],
            [seen.lines for seen in both if seen.lines],
            compare,
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
