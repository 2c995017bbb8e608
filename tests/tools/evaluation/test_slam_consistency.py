"""Normalised estimation error squared of both filters over 50 seeded runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from redetect.slam.filters.frames import FilterRun
from tools.evaluation.consistency import (
    CAMERA_XY,
    Scenario,
    SimulatedRun,
    assess,
    band,
    localized,
    mapped,
    simulate,
)

RUNS, SEED = 50, 1
#: Enough for what is far outside the band.
FEW_RUNS = 20
SMALL_NOISE = Scenario(steps=120, steps_per_round=50, turn_sigma_rad=0.005, discs=30)


def test_band_is_that_of_chi_squared() -> None:
    # 150 degrees of freedom: 117.98 and 185.80 (tables of chi squared).
    assert band(50) == pytest.approx((117.985 / 50, 185.800 / 50), abs=1e-4)


def test_rows_have_the_errors_that_they_state() -> None:
    from redetect.plane import between
    from redetect.slam.models import bearing_of_vertical, disc_in_robot

    run = simulate(Scenario(steps=400, lines=20), 3)
    rows = run.recording.circles
    seen = disc_in_robot(run.poses[rows.frame + 1], run.discs_xy[rows.ids])
    error = rows.xy - seen
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows.covariance), error)
    assert np.mean(squared) == pytest.approx(2.0, rel=4 / np.sqrt(len(squared)))
    step_error = run.recording.steps - between(run.poses[:-1], run.poses[1:])
    weight = np.linalg.inv(run.recording.step_covariance)
    squared = np.einsum("ni,nij,nj->n", step_error, weight, step_error)
    assert np.mean(squared) == pytest.approx(3.0, rel=4 * np.sqrt(2 / 3 / len(squared)))
    lines = run.recording.lines
    numbers = np.array([ids[0] for ids in lines.ids])
    bearing = bearing_of_vertical(run.poses[lines.frame + 1], run.lines_xy[numbers], CAMERA_XY)
    scaled = (lines.bearing_rad - bearing) / lines.sigma_rad
    assert np.mean(scaled**2) == pytest.approx(1.0, rel=6 / np.sqrt(len(scaled)))


def test_the_same_seed_gives_the_same_run() -> None:
    one, two, other = (simulate(SMALL_NOISE, seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one.recording.circles.xy, two.recording.circles.xy)
    assert not np.array_equal(one.recording.steps, other.recording.steps)


@pytest.mark.long
@pytest.mark.parametrize(
    "estimate",
    [localized(0.0, "considered"), localized(0.05, "considered"), mapped("first")],
    ids=["localizer, exact map", "localizer, map of 5 cm", "EKF-SLAM"],
)
@pytest.mark.parametrize("lines", [0, 10])
def test_errors_are_as_large_as_covariances_say(
    estimate: Callable[[SimulatedRun, int], FilterRun], lines: int
) -> None:
    found = assess(replace(SMALL_NOISE, lines=lines), estimate, RUNS, SEED)
    # Means of successive steps are correlated: so many of them leave the band together.
    assert found.inside > 0.85
    assert 2.5 < found.overall < 3.5
    assert found.band[0] < found.mean[-1] < found.band[1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimate", "scenario"),
    [
        (localized(0.05, "ignored"), SMALL_NOISE),
        (localized(0.05, "white"), SMALL_NOISE),
        (localized(0.0, "considered"), replace(SMALL_NOISE, overconfidence=1.44)),
        (mapped("first"), replace(SMALL_NOISE, overconfidence=1.44)),
        (mapped("latest"), replace(SMALL_NOISE, turn_sigma_rad=0.1)),
    ],
    ids=["map errors ignored", "map errors white", "localizer", "EKF-SLAM", "heading error"],
)
def test_what_is_wrong_shows(
    estimate: Callable[[SimulatedRun, int], FilterRun], scenario: Scenario
) -> None:
    found = assess(scenario, estimate, FEW_RUNS, SEED)
    assert found.inside < 0.5
    assert found.overall > found.band[1]
