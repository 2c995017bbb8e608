"""Times of several functions on several images, taken in turn, and what sums them up.

A machine's load changes within seconds. All functions are called in turn on the same image, round
after round, so that load falls on all of them alike; ratios are taken between calls of the same
round on the same image, and the median of those is what counts.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tools.arrays import FloatArray

#: However slow a function is, it is called this often (as far as there are images and rounds).
LEAST_CALLS = 3


@dataclass(frozen=True)
class Spread:
    """What sums up repeated measurements."""

    median: float  # In the unit of the values.
    lower_quartile: float
    upper_quartile: float
    least: float
    count: int  # Number of values.


def spread_of(values: ArrayLike) -> Spread:
    """Median, quartiles, minimum and number of some values; NaN are none."""
    given = np.asarray(values, dtype=np.float64).ravel()
    given = given[~np.isnan(given)]
    if not given.size:
        raise ValueError("no measurements: expected at least one")
    lower, median, upper = np.percentile(given, [25.0, 50.0, 75.0])
    return Spread(float(median), float(lower), float(upper), float(given.min()), given.size)


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
    and first touches are not measured. Which function goes first changes from image to image.
    """
    if warm_up:
        for function in functions.values():
            function(0)
    seconds = {name: np.full((rounds, images), np.nan) for name in functions}
    spent = dict.fromkeys(functions, 0.0)
    calls = dict.fromkeys(functions, 0)
    names = list(functions)
    turn = 0
    for round_ in range(rounds):
        for image in range(images):
            first = turn % len(names)
            turn += 1
            for name in names[first:] + names[:first]:
                if spent[name] >= budget_s and calls[name] >= least_calls:
                    continue
                begin = clock()
                functions[name](image)
                took = clock() - begin
                seconds[name][round_, image] = took
                spent[name] += took
                calls[name] += 1
    return seconds


def paired_ratios(seconds: FloatArray, reference: FloatArray) -> FloatArray:
    """Ratios between measurements of the same round and image, NaN where one of them is missing.
    `seconds`, `reference` (rounds, images); returns (rounds, images).
    """
    return np.asarray(seconds / reference)
