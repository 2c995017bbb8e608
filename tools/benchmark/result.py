"""What a benchmark found: plain values, and their JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tools.benchmark.functions import DECODING, Measured
from tools.benchmark.machine import Machine
from tools.benchmark.timing import FloatArray, Spread, paired_ratios, spread_of


@dataclass(frozen=True)
class FunctionTimes:
    """Times of one function on some pictures.

    Attributes
    ----------
    name, group : str
        As in `Measured`.
    ms : Spread
        Milliseconds per image.
    decodings : Spread
        The same, in times that decoding the same image took in the same round.
    """

    name: str
    group: str
    ms: Spread
    decodings: Spread


@dataclass(frozen=True)
class Comparison:
    """How many times as long as one function another takes on the same image.

    Attributes
    ----------
    slower, faster : str
        Names; `slower` is expected to be, the ratio tells.
    ratio : Spread
        Time of `slower` / time of `faster`.
    """

    slower: str
    faster: str
    ratio: Spread


@dataclass(frozen=True)
class KindTimes:
    """Times on one kind of pictures.

    Attributes
    ----------
    kind : str
        "demo", "noise" or "photographs".
    description : str
        What the pictures are.
    pictures : int
        How many there were.
    functions : tuple of FunctionTimes
    comparisons : tuple of Comparison
        Peers against what does their work here.
    """

    kind: str
    description: str
    pictures: int
    functions: tuple[FunctionTimes, ...]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True)
class RunTimes:
    """Passes over a whole run, files in and files out.

    Attributes
    ----------
    command : str
        What was carried out.
    frames, jobs : int
        Frames of the run, processes or threads at work.
    images_per_s : Spread
        Images per second, by all jobs together.
    decoding_images_per_s, reading_images_per_s : Spread
        Images per second when one core decodes the same files from memory and does nothing else,
        and when it reads each file before.
    share_of_decoding : Spread
        Images per second and job / those of decoding from memory.
    share_of_reading : Spread
        Images per second and job / those of reading and decoding.
    times_one_job : Spread or None
        Images per second / those of one job; None where one job was not measured.
    """

    command: str
    frames: int
    jobs: int
    images_per_s: Spread
    decoding_images_per_s: Spread
    reading_images_per_s: Spread
    share_of_decoding: Spread
    share_of_reading: Spread
    times_one_job: Spread | None = None


@dataclass(frozen=True)
class GrowthPoint:
    """Times at one point of a growth curve: how much there was, and what that took."""

    amount: float
    functions: tuple[FunctionTimes, ...]


@dataclass(frozen=True)
class Result:
    """All that a benchmark found.

    Attributes
    ----------
    machine : Machine
    settings : mapping
        What decided how it was measured.
    absent : tuple of str
        Peers that are not installed.
    skipped : tuple of str
        A sentence for each thing that was not measured.
    kinds : tuple of KindTimes
    runs : tuple of RunTimes
        A run of the demo's images, all commands.
    by_megapixels, by_discs, by_verticals : tuple of GrowthPoint
        Growth curves.
    by_frames : tuple of RunTimes
        `detect all` on runs of growing length.
    """

    machine: Machine
    settings: Mapping[str, Any]
    absent: tuple[str, ...]
    skipped: tuple[str, ...]
    kinds: tuple[KindTimes, ...]
    runs: tuple[RunTimes, ...]
    by_megapixels: tuple[GrowthPoint, ...]
    by_discs: tuple[GrowthPoint, ...]
    by_verticals: tuple[GrowthPoint, ...]
    by_frames: tuple[RunTimes, ...]


def function_times(
    measured: Sequence[Measured], seconds: Mapping[str, FloatArray]
) -> tuple[FunctionTimes, ...]:
    """Sum up the times of functions that were measured in turn with decoding.

    Parameters
    ----------
    measured : sequence of Measured
    seconds : mapping
        As from `measure_in_turn`; decoding must be among them.
    """
    reference = seconds[DECODING]
    return tuple(
        FunctionTimes(
            function.name,
            function.group,
            spread_of(1e3 * seconds[function.name]),
            spread_of(paired_ratios(seconds[function.name], reference)),
        )
        for function in measured
    )


def comparisons(
    pairs: Sequence[tuple[str, str]], seconds: Mapping[str, FloatArray]
) -> tuple[Comparison, ...]:
    """Ratios of (slower, faster) pairs of functions; pairs that were not measured are left out."""
    return tuple(
        Comparison(slower, faster, spread_of(paired_ratios(seconds[slower], seconds[faster])))
        for slower, faster in pairs
        if slower in seconds and faster in seconds
    )


def run_times(
    command: str,
    frames: int,
    jobs: int,
    seconds: FloatArray,
    decoding: FloatArray,
    reading: FloatArray,
    one_job: FloatArray | None = None,
) -> RunTimes:
    """Sum up passes over a run.

    Parameters
    ----------
    command : str
    frames, jobs : int
    seconds, decoding, reading : (rounds,) float64
        Of the command, of decoding the same files from memory, and of reading and decoding them, in
        the same round; NaN where left out.
    one_job : (rounds,) float64, optional
        Of the same command with one job.
    """
    return RunTimes(
        command,
        frames,
        jobs,
        spread_of(frames / seconds),
        spread_of(frames / decoding),
        spread_of(frames / reading),
        spread_of(paired_ratios(decoding, seconds) / jobs),
        spread_of(paired_ratios(reading, seconds) / jobs),
        None if one_job is None else spread_of(paired_ratios(one_job, seconds)),
    )


def times_one_job_beyond(runs: Sequence[RunTimes], jobs: int) -> tuple[int, float] | None:
    """How many times as many images as one job some do, once they have begun.

    Parameters
    ----------
    runs : sequence of RunTimes
        Of one command, on runs of growing length.
    jobs : int

    Returns
    -------
    frames : int
        Length of the longest run but one.
    times : float
        Ratio of what the frames beyond that took in the longest run, by the medians. None where
        there are not two lengths that both were measured on, or some took no time.
    """
    seconds = {(t.frames, t.jobs): t.frames / t.images_per_s.median for t in runs}
    lengths = sorted(
        {frames for frames, _ in seconds if {(frames, 1), (frames, jobs)} <= set(seconds)}
    )
    if len(lengths) < 2:
        return None
    first, last = lengths[-2:]
    one, several = (seconds[last, count] - seconds[first, count] for count in (1, jobs))
    return (first, one / several) if min(one, several) > 0.0 else None


def growth_powers(points: Sequence[GrowthPoint]) -> dict[str, float]:
    """The power of the amount that each function's median time grows as (least squares of logs)."""
    amounts = np.log([point.amount for point in points])
    return {
        times.name: _line(amounts, np.log([p.functions[i].ms.median for p in points]))[1]
        for i, times in enumerate(points[0].functions)
    }


def costs_per_landmark(points: Sequence[GrowthPoint]) -> dict[str, tuple[float, float]]:
    """Each function's median time without landmarks, and for each of them (least squares; ms)."""
    amounts = np.array([point.amount for point in points])
    return {
        times.name: _line(amounts, np.array([p.functions[i].ms.median for p in points]))
        for i, times in enumerate(points[0].functions)
    }


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Where a line of least squares begins, and its slope."""
    # `Polynomial.fit` would leave out a slope of exactly 0.
    slope, begin = np.polyfit(x, y, 1)
    return float(begin), float(slope)


def format_json(result: Result) -> str:
    """The result as JSON, ending with a line end."""
    return json.dumps(dataclasses.asdict(result), indent=1) + "\n"
