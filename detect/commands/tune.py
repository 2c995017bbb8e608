"""The command ``detect tune``: settings over a grid, each compared with the same reference rows."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from decimal import Decimal
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from detect.comparison.compare import compare_frames, rows_beside
from detect.comparison.result import DiscComparison
from detect.errors import DetectError
from detect.options import Tune
from detect.projection import DiscProjection
from detect.report.figures import DATA, MARK
from detect.runs.plan import FramePlan, FramesByImage, FrameTask
from detect.runs.stream import with_initial_tilt
from detect.runs.workers import WorkerPool, Workers, default_jobs, local_workers
from detect.settings import UNREFINED, CircleSettings
from detect.settings_files import read_settings, word_value
from detect.sources.interface import Run, RunFrame, SomeFrames
from detect.sources.opening import demand_recording, open_run
from detect.terminal import progress_bar, report_failures
from redetect import __version__
from redetect.array_types import FloatArray
from redetect.json_text import json_text
from redetect.landmarks import Frame, LandmarkFileError, frames_of_rows, parse_rows
from redetect.landmarks.files import read_head
from redetect.reporting.page import figure_file
from redetect.storage import demand_free, write_bytes

_MOST_TRIALS = 100_000
# Largest number of labelled points.
_MOST_NAMED = 12


def perform(options: Tune) -> int:
    """Execute the command; returns the exit code."""
    if options.serve and options.vary:
        raise DetectError("--serve and --vary: expected one of them")
    base = CircleSettings() if options.settings is None else read_settings(options.settings).circles
    words = list(chain.from_iterable(options.vary))
    varied = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise DetectError(f"{word!r}: expected NAME=VALUES, as evidence=-1:3:0.5")
        varied[name.replace("-", "_")] = text
    if len(varied) < len(words):
        raise DetectError(f"--vary {' '.join(words)}: expected each parameter once")
    grid = () if options.serve else combinations(varied)
    settings = [replace(base, **combination) for combination in grid]
    if idle := sorted({*varied} & {*UNREFINED}) if all(each.refine for each in settings) else []:
        raise DetectError(
            f"--vary {' '.join(idle)}: without effect on discs that are found by their rims: "
            "expected refine=false beside it"
        )

    demand_recording(options.run)
    run = open_run(options.run, options.camera, options.source)
    output = run.output("tune") if options.output is None else options.output
    frames = SomeFrames(run.frames, every=options.every)
    if options.serve:
        # Nothing else needs a server.
        from detect.tuning_page import LABELS_NAME, SETTINGS_NAME, TuningSession, serve

        demand_free([output / SETTINGS_NAME, output / LABELS_NAME], overwrite=options.force)
        return serve(TuningSession(run, list(frames), base, output, options.force), options.port)

    names = "table.json", "curve.png"
    demand_free([output / name for name in names], overwrite=options.force)
    path = options.reference or run.folder / "map.circles"
    pairs = _with_reference(frames, path)
    compare = partial(
        compare_frames,
        [rows for _, rows in pairs],
        options=options.matching,
        projection=DiscProjection(run.camera, base, read_head(path).level),
        unlisted=rows_beside(path, "unlisted"),
    )
    count = len(grid) * len(pairs)
    workers = local_workers(default_jobs(count) if options.jobs is None else options.jobs)
    with progress_bar("trials", count) as advance:
        chosen = [frame for frame, _ in pairs]
        trials = list(tune_run(run, chosen, settings, compare, workers, advance))
    records = marked([{**c, **figures_of(found)} for c, (found, _) in zip(grid, trials)])
    head = {
        "version": __version__,
        "run": run.name,
        "reference": path.name,
        "frames": [frame.step.prefix for frame, _ in pairs],
        "gate": options.matching,
        "camera": run.camera.content_hash,
        "settings": base,
        "varied": varied,
    }
    table = f"{json_text({**head, 'trials': records})}\n".encode()
    title = f"{len(grid)} settings on {len(pairs)} frames of {run.name}"
    output.mkdir(parents=True, exist_ok=True)
    for name, content in zip(names, (table, curve_picture(records, varied, title))):
        write_bytes(output / name, content, overwrite=options.force)
    print(f"{output}: {title}: {', '.join(names)}")
    for record in records:
        if record["knee"]:
            values = " ".join(f"{name}={record[name]}" for name in varied)
            rates = f"recall {record['recall']:.3f}, precision {record['precision']:.3f}"
            print(f"knee: {values}: {rates}")
    failures = sorted({failure for _, failed in trials for failure in failed})
    return report_failures(len(failures), failures)


def _with_reference(frames: Iterable[RunFrame], path: Path) -> list[tuple[RunFrame, Frame]]:
    """The frames that have an image and reference rows, with these."""
    if not path.is_file():
        raise LandmarkFileError(path, None, "no such reference rows: give some with --reference")
    reference = FramesByImage(path)
    chosen = [each for each in frames if each.image is not None or each.content is not None]
    wanted = [(frame, reference.get(frame.step.prefix)) for frame in chosen]
    pairs = [(frame, rows) for frame, rows in wanted if rows is not None]
    if not pairs:
        raise DetectError(f"{path}: none of the {len(chosen)} chosen frames: expected some of them")
    return pairs


def parameter_values(name: str, text: str) -> tuple[Any, ...]:
    """The values of a parameter to try, each once; errors as those of `word_value`.

    `text` is FROM:TO:STEP, both ends included, or comma-separated values.
    """
    words = text.split(",")
    if ":" in text:
        expected = f"{name} is {text!r}: expected FROM:TO:STEP with a step above 0, TO not below"
        try:
            # Decimal numbers, so that 0.3 plus twice 0.1 is 0.5, with the digits of a file.
            first, last, step = (Decimal(part.strip()) for part in text.split(":"))
            if not (last - first).is_finite() or step <= 0 or not 0 <= (last - first) / step <= 1e5:
                raise ValueError
            words = [str(first + k * step) for k in range(int((last - first) / step) + 1)]
        except (ArithmeticError, ValueError):  # not numbers, or a quotient out of range
            raise DetectError(expected) from None
    return tuple(dict.fromkeys(word_value(CircleSettings, name, word.strip()) for word in words))


def combinations(varied: Mapping[str, str]) -> tuple[dict[str, Any], ...]:
    """All combinations of the values of parameters, written as for `parameter_values`.

    Each has the names and values in the order of `varied`; the last varies fastest. Raises
    DetectError if nothing is varied, or there are too many, and as `parameter_values` does.
    """
    if not varied:
        raise DetectError(
            "nothing is varied: expected a parameter and values, as --vary evidence=-1:3:0.5"
        )
    values = {name: parameter_values(name, text) for name, text in varied.items()}
    count = math.prod(map(len, values.values()))
    if count > _MOST_TRIALS:
        raise DetectError(f"{count} combinations of values: expected at most {_MOST_TRIALS}")
    return tuple(dict(zip(values, chosen)) for chosen in itertools.product(*values.values()))


def tune_run(
    run: Run,
    frames: Sequence[RunFrame],
    settings: Sequence[CircleSettings],
    compare: Callable[[list[Frame]], DiscComparison],
    workers: Workers,
    on_progress: Callable[[], None] = lambda: None,
) -> Iterator[tuple[DiscComparison, list[str]]]:
    """Detect discs in frames of a run with each setting, and compare them with the reference.

    `on_progress` is called after every frame of every setting. Yields the comparison of each, and
    why frames could not be processed: these count as frames without detections.
    """
    tasks = [FrameTask(frame) for frame in frames]
    with closing(WorkerPool(workers)) as pool:
        # Each setting as if it was alone: what some frames show of the tilt depends on it.
        plans = [
            with_initial_tilt(run, FramePlan(run.camera, circles=each), pool) for each in settings
        ]
        work = (task._replace(plan=plan) for plan in plans for task in tasks)
        done = chain.from_iterable(pool.detect_chunks(work, plans[0]))
        for _ in plans:
            found: list[Frame] = []
            failures: list[str] = []
            for _, each in islice(done, len(tasks)):
                found += frames_of_rows(
                    parse_rows(io.BytesIO(each.rows["circles"].encode("utf-8", "surrogateescape")))
                )
                failures += [] if each.error is None else [each.error]
                on_progress()
            yield compare(found), failures


def figures_of(result: DiscComparison) -> dict[str, Any]:
    """A comparison's figures for the table; `matched` are the reference rows that were found."""
    figures = {
        "reference": result.reference,
        "detected": result.detected,
        "matched": result.found,
        "recall": result.recall,
        "precision": result.precision,
        "error_median_m": result.error_median_m,
        "normalised_error": result.normalised_error.per_dof,
    }
    # Six significant digits, as in the files of rows.
    return {
        name: float(f"{value:.6g}") if isinstance(value, float) else value
        for name, value in figures.items()
    }


def marked(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of trials, with whether each is on the front, and the knee."""
    rates = _rates(records)
    front, best = pareto_front(*rates), knee(*rates)
    return [{**each, "front": k in front, "knee": k == best} for k, each in enumerate(records)]


def pareto_front(recall: ArrayLike, precision: ArrayLike) -> NDArray[np.intp]:
    """(M,) indices of the settings on the Pareto front of recall and precision.

    By increasing recall; of equals the first. Recalls and precisions (N,) are NaN if undefined.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    known = np.flatnonzero(np.isfinite(r) & np.isfinite(p))
    # By decreasing recall, then precision: points no better than those before are dominated.
    order = known[np.lexsort((known, -p[known], -r[known]))]
    before = np.maximum.accumulate(np.concatenate([[-np.inf], p[order]]))[:-1]
    return order[p[order] > before][::-1]


def knee(recall: ArrayLike, precision: ArrayLike) -> int | None:
    """The setting at the knee of the curve of precision over recall; None without any.

    That is the point of the front farthest beyond the chord between the front's ends, both axes
    scaled to the front's extent (Satopää, Albrecht, Irwin, Raghavan: Finding a "Kneedle" in a
    Haystack, 2011). If no point is beyond the chord, there is no knee, and the point with the
    largest harmonic mean of recall and precision is used instead.
    """
    r, p = np.asarray(recall, np.float64), np.asarray(precision, np.float64)
    front = pareto_front(r, p)
    if not len(front):
        return None
    if len(front) > 2:
        x = (r[front] - r[front[0]]) / (r[front[-1]] - r[front[0]])
        y = (p[front] - p[front[-1]]) / (p[front[0]] - p[front[-1]])
        beyond = x + y - 1.0
        if beyond.max() > 1e-9:
            return int(front[np.argmax(beyond)])
    return int(front[np.argmax(r[front] * p[front] / np.maximum(r[front] + p[front], 1e-12))])


def curve_picture(records: Sequence[dict[str, Any]], varied: Iterable[str], title: str) -> bytes:
    """Precision over recall as a PNG file: all trials, their front, and the knee."""
    recall, precision = _rates(records)
    names = [", ".join(f"{name} {each[name]}" for name in varied) for each in records]
    front, best = pareto_front(recall, precision), knee(recall, precision)
    with figure_file((6.4, 6.2), "png") as (figure, content):
        axes = figure.subplots()
        axes.plot(recall, precision, "o", color=DATA, ms=4, label="tried")
        label = "none is better in both"
        axes.plot(recall[front], precision[front], "--", color=DATA, lw=1.2, label=label)
        if best is not None:
            at = (recall[best], precision[best])
            axes.plot(*at, "o", mfc="none", mec=MARK, mew=2.0, ms=12, label=f"knee: {names[best]}")
        for k in front[:: max(1, -(-(len(front) - 1) // (_MOST_NAMED - 1)))]:
            at = (recall[k], precision[k])
            axes.annotate(
                names[k], at, (-7, -9), textcoords="offset points", ha="right", fontsize=7
            )
        axes.set(xlabel="recall", ylabel="precision", title=title)
        axes.grid(alpha=0.25, lw=0.6)
        axes.margins(0.15)
        figure.legend(loc="outside lower center", fontsize=8, ncols=1)
    return content.getvalue()


def _rates(records: Sequence[dict[str, Any]]) -> tuple[FloatArray, FloatArray]:
    """(N,) recall and precision, NaN if undefined."""
    rates = [(each["recall"], each["precision"]) for each in records]
    recall, precision = np.array(rates, np.float64).reshape(-1, 2).T
    return recall, precision
