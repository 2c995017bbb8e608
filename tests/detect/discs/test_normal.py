"""The normal equations of the disc fit against dense linear algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from detect.discs import least_squares as normal
from detect.discs.model import ROWS
from detect.discs.patch import PATCH

FloatArray = NDArray[np.float64]


def patch(n: int, seed: int) -> tuple[NDArray[Any], FloatArray]:
    """A patch, and the (n, 11) columns of its least-squares problem."""
    rng = np.random.default_rng(seed)
    found = np.zeros(1, PATCH)
    design = found["design"][0]
    x, y = rng.uniform(-1.7, 1.7, (2, n))
    design[:5, :n] = np.ones(n), x, y, x * x - y * y, x * y
    design[5:10, :n] = rng.normal(0.0, 1.0, (5, n))
    design[10, :n] = rng.normal(0.0, 80.0, n)
    # Beyond the patch there is rubbish that must not count.
    design[:, n:] = 1e6
    return found, design[:, :n].T.astype(float)


def test_sums_of_products() -> None:
    found, columns = patch(333, 1)
    products = np.zeros((ROWS, ROWS))
    normal.background_products(found[0], 333, products)
    normal.disc_products(found[0], 333, products)
    expected = np.tril(columns.T @ columns)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(np.tril(products) / scale, expected / scale, atol=1e-5)


def test_factor_tells_solutions_and_what_is_left() -> None:
    """In two goes, as the fit does it: without the disc's steps, and with them."""
    _, columns = patch(200, 2)
    products = columns.T @ columns
    factor = np.zeros_like(products)
    values = np.zeros(ROWS)
    assert normal.factor_rows(products, 0, 6, factor)
    assert normal.factor_rows(products, 6, 10, factor)
    for count in (5, 6, 10):
        solution, residual, *_ = np.linalg.lstsq(columns[:, :count], columns[:, 10], rcond=None)
        normal.solution(factor, 0, count, values)
        np.testing.assert_allclose(values[:count], solution, rtol=1e-8)
        assert abs(normal.left_over(products, factor, count) / residual[0] - 1.0) < 1e-9
    # x and y come last, so their covariance can be read off the last two rows.
    inverse = np.linalg.inv(products[:10, :10])[8:, 8:]
    last = np.array([[1.0 / factor[8, 8], 0.0], [factor[9, 8], 1.0 / factor[9, 9]]])
    np.testing.assert_allclose(np.linalg.inv(last @ last.T), inverse, rtol=1e-8)


def test_dependent_columns_are_refused() -> None:
    _, columns = patch(100, 3)
    columns[:, 7] = columns[:, 6]
    products = columns.T @ columns
    factor = np.zeros_like(products)
    assert normal.factor_rows(products, 0, 7, factor)
    assert not normal.factor_rows(products, 7, 10, factor)
