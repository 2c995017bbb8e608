"""Kernels that count no references: the arrays that they are given outlive them all the same."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numpy.typing import NDArray

from detect.uncounted import uncounted


class Pair(NamedTuple):
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def _dot(pair: Pair) -> float:
    total = 0.0
    for i in range(len(pair.first)):
        if pair.first[i] < 0.0:
            return -1.0
        total += pair.first[i] * pair.second[i:][0]
    return total


def _sum_of_new(pair: Pair) -> float:
    return float(np.zeros(len(pair.first)).sum())


def test_no_array_is_given_back_too_often() -> None:
    kernel: Any = uncounted(_dot)
    counted: Any = njit(_dot)

    def often(values: NDArray[np.float64], times: int) -> float:
        total = 0.0
        for k in range(times):
            mine = values + k  # freed in every turn, and not before its last use
            total += kernel(Pair(mine, mine)) - counted(Pair(mine, mine))
        return total

    compiled: Any = njit(often)
    values = np.linspace(0.0, 1.0, 100)
    pair = Pair(values, values[::-1].copy())
    before = sys.getrefcount(pair.first), sys.getrefcount(pair.second)
    for _ in range(100):
        assert kernel(pair) == pytest.approx(pair.first @ pair.second)
    assert (sys.getrefcount(pair.first), sys.getrefcount(pair.second)) == before
    assert compiled(values, 1000) == 0.0


def test_a_kernel_that_allocates_is_refused() -> None:
    kernel: Any = uncounted(_sum_of_new)
    values = np.zeros(3)
    with pytest.raises(TypingError, match="Only accept returning of array passed"):
        kernel(Pair(values, values))
