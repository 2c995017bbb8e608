"""Tries settings on the same frames, and compares each with the same reference rows."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from detect.comparison.compare import compare_frames, compare_line_frames
from detect.comparison.result import CompareOptions, DiscComparison, LineComparison
from detect.line_settings import LineSettings
from detect.run import Run, RunFrame
from detect.runs.dispatch import Workers, detect_chunks
from detect.runs.frame import tables_of
from detect.runs.known import ByPrefix, Known
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import CircleSettings
from redetect.landmarks import Frame, FrameTilt, frames_of_rows, parse_rows

Settings = CircleSettings | LineSettings


@dataclass(frozen=True)
class Trial:
    """Result of one setting, as in `detect.comparison.result.Comparison`.

    `matched` are the reference rows that were found. The median error is in metres (discs) or
    degrees (verticals), the normalised one squared per degree of freedom. Frames in `failures`
    could not be worked on: they count as frames without detections.
    """

    reference: int
    detected: int
    matched: int
    recall: float | None
    precision: float | None
    error_median: float | None
    normalised_error: float | None
    failures: tuple[str, ...] = ()


def tune_run(
    run: Run,
    frames: Sequence[tuple[RunFrame, Frame]],
    settings: Sequence[Settings],
    options: CompareOptions,
    workers: Workers,
    *,
    tilts: ByPrefix[FrameTilt] | None = None,
    on_progress: Callable[[], None] | None = None,
) -> Iterator[Trial]:
    """Detect in frames of a run with each setting, all of one kind; yields the trial of each.

    `frames` come with their reference rows; `tilts`, by image prefix, correct positions of discs.
    `workers` are started once for all settings, and again where some of them have died;
    `on_progress` is called after every frame of every setting.
    """
    kind = "circles" if isinstance(settings[0], CircleSettings) else "lines"
    changes: list[dict[str, Any]] = [{kind: each} for each in settings]
    plan = FramePlan(run.camera)
    plans = [replace(plan, **change) for change in changes]
    known = Known(tilts=tilts)
    tasks = [FrameTask(frame, known.of(frame.step.prefix)) for frame, _ in frames]
    reference = [rows for _, rows in frames]
    tables_of(plans[0])
    with _kept(workers, plans[0]) as same:
        for plan in plans:
            found: list[Frame] = []
            failures: list[str] = []
            with closing(detect_chunks(tasks, plan, same())) as chunks:
                for _, each in chain.from_iterable(chunks):
                    found += frames_of_rows(
                        parse_rows(io.BytesIO(each.rows[kind].encode("utf-8", "surrogateescape")))
                    )
                    failures += [] if each.error is None else [each.error]
                    if on_progress is not None:
                        on_progress()
            result: DiscComparison | LineComparison
            if kind == "circles":
                discs = compare_frames(reference, found, options)
                result, error_median = discs, discs.error_median_m
            else:
                lines = compare_line_frames(reference, found, options)
                result, error_median = lines, lines.bearing_median_deg
            yield Trial(
                result.reference, result.detected, result.found, result.recall, result.precision,
                error_median, result.normalised_error.per_dof, tuple(failures),
            )  # fmt: skip


@contextmanager
def _kept(workers: Workers, plan: FramePlan) -> Iterator[Callable[[], Workers]]:
    """Keep workers for all settings; yields a function that returns those of the next setting.

    If some of them have died, they are requested again during a setting, and then replaced.
    """
    crew: Executor | None = None

    def of_next_setting() -> Workers:
        asked_before = False

        @contextmanager
        def start(_: FramePlan) -> Iterator[Executor]:
            nonlocal crew, asked_before
            if crew is None or asked_before:
                started.close()
                crew = started.enter_context(workers.start(plan))
            asked_before = True
            yield crew

        return replace(workers, start=start)

    with ExitStack() as started:
        yield of_next_setting
