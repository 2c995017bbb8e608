"""The normal equations of the disc fit, and what its residuals say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.discs import fit
from detect.discs.patch import SECTORS
from redetect.array_types import FloatArray

TERMS = 12


def rows_of(seed: int, n: int) -> tuple[NDArray[Any], NDArray[np.int64], FloatArray]:
    """Working space, ends of sectors of some whole numbers of pixels, and its (n, 12) columns."""
    rng = np.random.default_rng(seed)
    work = np.zeros(1, fit.WORK)
    work["rows"][0, :, :n] = rng.normal(0.0, 1.0, (TERMS, n))
    work["rows"][0, -1, :n] *= 80.0
    # Beyond the pixels there is rubbish that must not count.
    work["rows"][0, :, n:] = 1e6
    ends = np.append(0, np.sort(rng.integers(0, n // 8 + 1, SECTORS - 1)) * 8)
    return work, np.append(ends, n), work["rows"][0, :, :n].T.astype(float)


@pytest.mark.parametrize("first", [0, 3])
def test_products_are_those_of_each_sector(first: int) -> None:
    work, ends, columns = rows_of(1, 400)
    products = np.zeros((TERMS, TERMS, SECTORS))
    fit._multiply(work["rows"][0], ends, first, products)
    for s in range(SECTORS):
        some = columns[ends[s] : ends[s + 1], first:]
        found = np.tril(products[first:, first:, s])
        np.testing.assert_allclose(found, np.tril(some.T @ some), atol=0.5)
    whole = np.zeros((TERMS, TERMS, 1))
    fit._multiply(work["rows"][0], ends[::SECTORS].copy(), first, whole)
    found, some = np.tril(whole[first:, first:, 0]), columns[:, first:]
    np.testing.assert_allclose(found, np.tril(some.T @ some), atol=2.0)


def test_solutions_are_least_squares() -> None:
    _, _, columns = rows_of(2, 400)
    unknowns = np.zeros(TERMS - 1)
    fit.solve((columns.T @ columns)[..., None].copy(), unknowns)
    expected = np.linalg.lstsq(columns[:, :-1], columns[:, -1], rcond=None)[0]
    np.testing.assert_allclose(unknowns, expected, rtol=1e-8)


def test_a_term_that_nothing_depends_on_is_left_out() -> None:
    _, _, columns = rows_of(3, 200)
    columns[:, 8] = 0.0
    unknowns = np.zeros(TERMS - 1)
    fit.solve((columns.T @ columns)[..., None].copy(), unknowns)
    expected = np.linalg.lstsq(np.delete(columns, 8, 1)[:, :-1], columns[:, -1], rcond=None)[0]
    np.testing.assert_allclose(np.delete(unknowns, 8), expected, rtol=1e-8)
    assert unknowns[8] == 0.0


def area_of(residual: FloatArray) -> float:
    """The correlated area of residuals of a model whose terms are all zero."""
    work = np.zeros(1, fit.WORK)
    n = len(residual)
    work["rows"][0, -1, :n] = residual
    work["patch"]["pixel"][0, :n] = np.arange(n)
    return float(fit._correlated_area(work["patch"][0], work["rows"][0], n, np.zeros(TERMS)))


def test_correlated_residuals_say_less() -> None:
    """White noise counts in full; a process of correlation c as (1 + c)^2 / (1 - c)^2.

    Of the correlation, 1.5 standard deviations of its estimate are taken off.
    """
    rng, n = np.random.default_rng(2), 3400
    assert area_of(rng.normal(0.0, 3.0, n)) == pytest.approx(1.0, abs=0.1)
    walk = rng.normal(0.0, 1.0, n)
    for k in range(1, n):
        walk[k] = 0.5 * walk[k - 1] + np.sqrt(0.75) * walk[k]
    c = 0.5 - 1.5 / np.sqrt(n)
    assert area_of(walk) == pytest.approx(((1.0 + c) / (1.0 - c)) ** 2, rel=0.2)
    assert area_of(np.zeros(n)) == 1.0
