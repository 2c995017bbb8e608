"""Times of several functions on several images, measured in turn, and their summaries.

A machine's load changes within seconds. All functions are called in turn on the same image, round
after round, so that the load affects all of them alike; ratios are taken between calls of the same
round on the same image, and their median is reported.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from redetect.array_types import FloatArray

#: Even a slow function is called this many times (if there are as many images and rounds).
LEAST_CALLS = 3


def measure_in_turn(
    functions: Mapping[str, Callable[[int], object]],
    images: int,
    rounds: int,
    budget_s: float,
    clock: Callable[[], float] = time.process_time,
    *,
    warm_up: bool = True,
    least_calls: int = LEAST_CALLS,
) -> dict[str, FloatArray]:
    """Time functions in turn: round by round, image by image, one call of each.

    With `warm_up` every function is called once beforehand on the first image, so that compiling
    and first memory accesses are not measured. The first function changes from image to image.
    A function is left out once it has taken `budget_s`.

    Returns
    -------
    dict of (rounds, images) float64
        Seconds by function, NaN where it was left out.
    """
    if warm_up:
        for function in functions.values():
            function(0)
    seconds = {name: np.full((rounds, images), np.nan) for name in functions}
    names = list(functions)
    for turn, (round_, image) in enumerate(np.ndindex(rounds, images)):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            calls = np.count_nonzero(~np.isnan(seconds[name]))
            if calls >= least_calls and np.nansum(seconds[name]) >= budget_s:
                continue
            begin = clock()
            functions[name](image)
            seconds[name][round_, image] = clock() - begin
    return seconds


def decodings(seconds: Mapping[str, FloatArray], reference: str) -> dict[str, dict[str, float]]:
    """By function: its time over that of a reference on the same image in the same round.

    Quartiles of these ratios, and the median time in milliseconds (`ms`).
    """
    return {
        name: {**quartiles(taken / seconds[reference]), "ms": 1e3 * float(np.nanmedian(taken))}
        for name, taken in seconds.items()
    }


def quartiles(values: FloatArray) -> dict[str, float]:
    """The quartiles `lower`, `median` and `upper` of some values; NaN are ignored."""
    found = np.nanpercentile(values, [25.0, 50.0, 75.0]).tolist()
    return dict(zip(("lower", "median", "upper"), found))


def spread(found: Mapping[str, float]) -> str:
    """Quartiles as text: the median, and the others in brackets."""
    return f"{number(found['median'])} ({number(found['lower'])} - {number(found['upper'])})"


def number(value: float) -> str:
    """A positive number in two or three digits, without an exponent."""
    for least, digits in ((99.95, 0), (9.995, 1), (0.0995, 2), (0.00995, 3)):
        if value >= least:
            return f"{value:,.{digits}f}"
    return f"{value:.4f}"
