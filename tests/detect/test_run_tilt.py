"""The tilt of a run: simulated sequences, whose true tilt is known, come back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.run_tilt import COMMON_RAD, LEAST_FRAMES, tilt_of_run

FloatArray = NDArray[np.float64]
FRAMES = 600
LEAN = np.radians([-2.4, 0.7])


def sequence(seed: int, scale: float, strays: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """True tilts, measured ones and their stated variances.

    Errors are `scale` times what is stated, and last from frame to frame as scenes do.
    """
    rng = np.random.default_rng(seed)
    sigma = np.radians(rng.uniform(0.03, 0.3, (FRAMES, 2)))
    true, lasting = np.empty((2, FRAMES, 2))
    x, u = np.zeros(2), np.zeros(2)
    for k in range(FRAMES):
        x = 0.7 * x + math.sqrt(1 - 0.7**2) * np.radians(0.3) * rng.standard_normal(2)
        u = 0.6 * u + math.sqrt(1 - 0.6**2) * rng.standard_normal(2)
        true[k], lasting[k] = LEAN + x, u
    measured = true + scale * sigma * lasting + sigma * rng.standard_normal((FRAMES, 2))
    stray = rng.random(FRAMES) < strays
    measured[stray] += np.radians(2.0) * rng.standard_normal((int(stray.sum()), 2))
    measured[rng.random(FRAMES) < 0.05] = np.nan
    return true, measured, sigma**2


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("scale", "strays"), [(0.2, 0.0), (4.0, 0.1)])
def test_errors_are_as_large_as_stated(seed: int, scale: float, strays: float) -> None:
    true, measured, variance = sequence(seed, scale, strays)

    run = tilt_of_run(measured, variance)

    assert run is not None
    # The simulated lens has no error that all verticals share.
    normalised = np.mean((run.tilt - true) ** 2 / (run.variance - COMMON_RAD**2), axis=0)
    assert np.all((normalised > 0.5) & (normalised < 1.5)), normalised
    for axis, lean in zip(run.axes, LEAN):
        assert abs(axis.lean - lean) < 3.0 * axis.lean_sigma


def test_is_nearer_than_the_frames_and_than_the_constant() -> None:
    true, measured, variance = sequence(3, 4.0, 0.1)

    run = tilt_of_run(measured, variance)

    assert run is not None
    error = np.sqrt(np.mean((run.tilt - true) ** 2))
    assert error < 0.5 * np.sqrt(np.nanmean((measured - true) ** 2))
    assert error < np.sqrt(np.mean((np.array([a.lean for a in run.axes]) - true) ** 2))


def test_verticals_that_lean_together_are_not_believed() -> None:
    """Trunks in view for twenty frames, by three degrees, and sure of it."""
    true, measured, variance = sequence(4, 0.2, 0.0)
    measured[300:320, 0] += np.radians(3.0)
    variance[300:320] = np.radians(0.3) ** 2

    run = tilt_of_run(measured, variance)

    assert run is not None
    assert np.degrees(np.abs(run.tilt - true)[300:320, 0]).max() < 2.0


def test_too_few_frames_have_no_run() -> None:
    measured = np.full((50, 2), np.nan)
    measured[: LEAST_FRAMES - 1] = 0.01

    assert tilt_of_run(measured, np.full((50, 2), 1e-6)) is None
