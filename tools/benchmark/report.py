"""The measurements as rows, in JSON, as Markdown tables, and as a picture."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from detect import __version__
from tools.arrays import FloatArray
from tools.benchmark.timing import Spread, paired_ratios, spread_of
from tools.evaluation.tables import markdown_table, picture

_PACKAGES = ("numpy", "numba", "opencv-python-headless", "scikit-image")


@dataclass(frozen=True)
class Time:
    """Time of one function on the pictures of one case."""

    part: str  # Part of the benchmark: images, megapixels, discs, verticals.
    case: str  # What the pictures are, or how much of it there is.
    function: str
    ms: Spread  # Milliseconds per image.
    decodings: Spread  # The same, in decodings of the same image in the same round.


@dataclass(frozen=True)
class RunTime:
    """Passes over a whole run, files in and files out."""

    command: str
    frames: int
    jobs: int
    images_per_s: Spread  # By all jobs together.
    decoding_images_per_s: Spread  # Of one core that decodes the same files from memory.
    reading_images_per_s: Spread  # Of one core that reads and decodes them.
    share_of_decoding: Spread  # Images per second and job, over those of decoding.
    share_of_reading: Spread
    times_one_job: Spread | None = None  # None where one job was not measured.


@dataclass(frozen=True)
class Result:
    """All that was measured, where, and with which settings."""

    machine: str
    settings: dict[str, Any]
    times: tuple[Time, ...]
    runs: tuple[RunTime, ...]


def times_of(part: str, case: str, seconds: dict[str, FloatArray], reference: str) -> list[Time]:
    """Sum up functions that were measured in turn with a reference."""
    return [
        Time(part, case, name, spread_of(1e3 * taken),
             spread_of(paired_ratios(taken, seconds[reference])))
        for name, taken in seconds.items()
    ]  # fmt: skip


def run_time(
    command: str, frames: int, jobs: int, seconds: FloatArray, alone: Sequence[FloatArray],
    one_job: FloatArray | None = None,
) -> RunTime:  # fmt: skip
    """Sum up passes over a run; `alone` are seconds of decoding, and of reading and decoding."""
    rates = [spread_of(frames / taken) for taken in (seconds, *alone)]
    decoding, reading = (spread_of(paired_ratios(taken, seconds) / jobs) for taken in alone)
    ratio = None if one_job is None else spread_of(paired_ratios(one_job, seconds))
    return RunTime(command, frames, jobs, rates[0], rates[1], rates[2], decoding, reading, ratio)


def this_machine() -> str:
    """Processor, cores, system and versions, in a line."""
    file = Path("/proc/cpuinfo")
    model = cpu_model(file.read_text() if file.is_file() else "") or platform.processor()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = [f"{name} {version(name)}" for name in _PACKAGES]
    return ", ".join(
        [f"{model or 'unknown'}, {cores} cores, {platform.system()} {platform.machine()}",
         f"redetect {__version__}", f"python {platform.python_version()}", *versions]
    )  # fmt: skip


def cpu_model(cpuinfo: str) -> str:
    """The processor's name in the text of ``/proc/cpuinfo``; empty if it is not there."""
    rows = (line.partition(":") for line in cpuinfo.splitlines())
    return next((value.strip() for key, _, value in rows if key.strip() == "model name"), "")


_PARTS = {
    "images": "",
    "megapixels": "Over the size of the image, Mpixel:",
    "discs": "Over the discs in the image:",
    "verticals": "Over the vertical edges in the image:",
}


def format_markdown(result: Result) -> str:
    """Tables of all measurements: ratios to decoding first, since they hold on any machine."""
    settings = ", ".join(
        f"{key} {' '.join(map(str, value)) if isinstance(value, list | tuple) else value}"
        for key, value in result.settings.items()
    )
    lines = [f"- {result.machine}", f"- settings: {settings}", "",
             "Median processor time per image, in times that decoding the same image takes "
             "(quartiles; milliseconds):"]  # fmt: skip
    for part, title in _PARTS.items():
        times = [time for time in result.times if time.part == part]
        cases = list(dict.fromkeys(time.case for time in times))
        cells = {
            (t.function, t.case): f"{spread(t.decodings)}; {number(t.ms.median)} ms" for t in times
        }
        names = dict.fromkeys(time.function for time in times)
        lines += ["", title, ""] if title else [""]
        lines += markdown_table(
            ["", *cases], ([name, *(cells[name, case] for case in cases)] for name in names)
        )
    lines += ["", "Whole runs, files in, files out, by the clock on the wall; one core that only "
              "decodes the same files, or reads and decodes them, for comparison:", ""]  # fmt: skip
    head = ["command", "frames", "jobs", "images/s", "of decoding", "of reading and decoding",
            "times one job", "decoding alone", "with reading"]  # fmt: skip
    lines += markdown_table(
        head,
        (
            [f"`{t.command}`", f"{t.frames}", f"{t.jobs}", number(t.images_per_s.median),
             spread(t.share_of_decoding), spread(t.share_of_reading),
             "" if t.times_one_job is None else number(t.times_one_job.median),
             number(t.decoding_images_per_s.median), number(t.reading_images_per_s.median)]
            for t in result.runs
        ),
    )  # fmt: skip
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """A positive number in two or three digits, without an exponent."""
    for least, digits in ((99.95, 0), (9.995, 1), (0.0995, 2), (0.00995, 3)):
        if value >= least:
            return f"{value:,.{digits}f}"
    return f"{value:.4f}"


def spread(values: Spread) -> str:
    """Median and quartiles."""
    quartiles = f"{number(values.lower_quartile)} - {number(values.upper_quartile)}"
    return f"{number(values.median)} ({quartiles})"


def plot_png(result: Result) -> bytes:
    """Ratios on the first kind of images, times over growing amounts, and images per second."""
    return picture((13.0, 8.5), lambda figure: _plot(figure, result), dpi=100)


def _plot(figure: Any, result: Result) -> None:
    axes = figure.subplot_mosaic(
        [["ratios", "megapixels", "frames"], ["ratios", "discs", "verticals"]]
    )
    images = [time for time in result.times if time.part == "images"]
    first = [time for time in images if time.case == images[0].case]
    axes["ratios"].barh([t.function for t in first], [t.decodings.median for t in first])
    axes["ratios"].invert_yaxis()
    axes["ratios"].set(
        xscale="log", xlabel="time / time of decoding the same image", title=images[0].case
    )
    for part in ("megapixels", "discs", "verticals"):
        times = [time for time in result.times if time.part == part]
        for name in dict.fromkeys(time.function for time in times):
            own = [time for time in times if time.function == name]
            amounts = [float(time.case) for time in own]
            axes[part].plot(amounts, [time.ms.median for time in own], "o-", label=name)
            low, high = ([getattr(t.ms, f"{q}_quartile") for t in own] for q in ("lower", "upper"))
            axes[part].fill_between(amounts, low, high, alpha=0.2)
        scale = "log" if part == "megapixels" else "linear"
        axes[part].set(xscale=scale, yscale=scale, xlabel=part, ylabel="ms per image")
    for command, jobs in dict.fromkeys((run.command, run.jobs) for run in result.runs):
        passes = [r for r in result.runs if (r.command, r.jobs) == (command, jobs)]
        rates = [run.images_per_s.median for run in passes]
        label = f"{command}, jobs: {jobs}"
        axes["frames"].plot([run.frames for run in passes], rates, "o-", label=label)
    axes["frames"].set(xscale="log", xlabel="frames of the run", ylabel="images per second")
    for one in axes.values():
        one.grid(alpha=0.3)
        if one.get_legend_handles_labels()[0]:
            one.legend(fontsize=8)
