"""Outcomes by number and by name; filters that are tabulated against their formula."""

from __future__ import annotations

import numpy as np
import pytest

from detect.verticals.judgement import OUTCOMES, Outcome
from detect.verticals.refinement import SUBPIXELS, gaussian_steps


def test_fates_are_called_what_they_are_in_words() -> None:
    assert len(OUTCOMES) == len(Outcome)
    assert OUTCOMES[Outcome.ACCEPTED] == "accepted"
    assert OUTCOMES[Outcome.BESIDE_A_STRONGER_EDGE] == "beside a stronger edge"


@pytest.mark.parametrize("sigma", [0.8, 1.2, 1.8, 3.0])
def test_tabulated_filters_are_derivatives(sigma: float) -> None:
    half = 4 * int(np.ceil(1.1 * sigma))
    taps = np.arange(-half + 1, half + 1)
    height, first, second = gaussian_steps(sigma, half)
    position = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS
    # A parabola's first derivative is seen in proportion to the distance from its vertex, which a
    # sum over pixels reproduces as well as the integral does.
    vertex = 0.3
    signal = (taps - vertex) ** 2
    scale = height @ taps.astype(np.float64)
    expected = 2.0 * (position - vertex)
    np.testing.assert_allclose(height @ signal / scale, expected, atol=0.02)
    # Derivatives of the height by the position.
    change = np.gradient(height @ signal, position) * sigma**2
    np.testing.assert_allclose((first @ signal)[2:-2], change[2:-2], rtol=0.02, atol=0.02)
    change = np.gradient(first @ signal, position)
    np.testing.assert_allclose((second @ signal)[2:-2], change[2:-2], rtol=0.02, atol=0.1)
    for table in (height, first, second):
        np.testing.assert_allclose(table.sum(axis=1), 0.0, atol=1e-4)
