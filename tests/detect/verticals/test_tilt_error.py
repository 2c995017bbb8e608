"""How far a tilt may be wrong: against sums over a dense grid, and against simulated buildings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detect.line_settings import DEFAULT, numbers_of
from detect.verticals.tilt import (
    SCATTER_RAD,
    SCATTER_SHARE,
    STRAY_RAD,
    TOGETHER_RAD,
    TiltEstimate,
    group_around_strongest,
    merge_lines,
    with_error,
)
from tests.detect.verticals.stages import consensus, verticals
from tests.reference.verticals import tilt_error

SETTINGS = replace(DEFAULT, largest_tilt_deg=5.0)


def normals(bearing: np.ndarray, inclination: np.ndarray) -> np.ndarray:
    normal = np.stack([np.cos(bearing), np.sin(bearing), inclination], axis=-1)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def stated_error(
    normal: np.ndarray, variance: np.ndarray, weight: np.ndarray, edge: np.ndarray,
    tilt: tuple[float, float], share: float,
) -> np.ndarray:  # fmt: skip
    """The covariance of a tilt that has a prior of 0.035 rad."""
    settings = replace(DEFAULT, tilt_prior_deg=float(np.degrees(0.035)), stray_share=share)
    lines = verticals(normal, variance, 1.0, weight)
    estimate = TiltEstimate(*tilt, np.eye(2), len(weight))
    return with_error(estimate, lines, edge, numbers_of(settings)).covariance


def building(
    rng: np.random.Generator, groups: int, tilt: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Normals of lines, and their variances, in a building as the model has it."""
    scatter = rng.choice(SCATTER_RAD, p=SCATTER_SHARE)
    stray = rng.random(groups) < SETTINGS.stray_share
    lean = np.where(
        stray, STRAY_RAD * rng.standard_cauchy(groups), scatter * rng.standard_t(3, groups)
    )
    place = np.linspace(-0.6, 0.6, groups) + rng.uniform(-0.02, 0.02, groups)
    lines = rng.integers(1, 4, groups)
    bearing = np.repeat(place, lines) + rng.uniform(-0.03, 0.03, lines.sum())
    sigma = np.radians(rng.uniform(0.03, 0.12, len(bearing)))
    seen = np.repeat(lean, lines) + sigma * rng.standard_normal(len(bearing))
    seen -= tilt[0] * np.sin(bearing) - tilt[1] * np.cos(bearing)
    return normals(bearing, seen), sigma**2


def test_errors_are_as_large_as_stated() -> None:
    """Where lines of a board lean together, carpentry is crooked, and some are no verticals."""
    rng = np.random.default_rng(3)
    squared: list[float] = []
    one_by_one: list[float] = []
    for _ in range(800):
        true = np.radians(rng.normal(0.0, 1.0, 2))
        normal, variance = building(rng, int(rng.integers(4, 8)), (true[0], true[1]))
        given_ = verticals(normal, variance, np.radians(0.9), 1.0)
        for chosen, into in ((SETTINGS, squared), (replace(SETTINGS, stray_share=0.0), one_by_one)):
            tilt, _ = consensus(given_, chosen)
            if tilt is not None and tilt.lines >= 5:
                error = np.array([tilt.pitch_rad, tilt.roll_rad]) - true
                into.append(float(error @ np.linalg.solve(tilt.covariance, error)) / 2.0)
    assert len(squared) > 500
    # The median is that of chi-squared; tails are groups of lines that lean alike by chance.
    assert 0.55 < np.median(squared) < 0.9
    assert np.mean(squared) < 2.5
    assert np.quantile(squared, 0.95) < 10.0
    # What lines that err one by one would say.
    assert np.mean(one_by_one) > 10.0


def test_is_the_mean_square_over_the_posterior() -> None:
    ratios = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        share = rng.uniform(0.02, 0.4)
        true = np.radians(rng.normal(0.0, 1.0, 2))
        normal, variance = building(rng, 6, (true[0], true[1]))
        weight = rng.uniform(1.0, 3.0, len(variance))
        edge = np.arange(len(variance))
        edge[1] = 0
        tilt = (float(true[0]) + 1e-3, float(true[1]) - 1e-3)

        error = stated_error(normal, variance, weight, edge, tilt, share)

        expected = tilt_error(normal, variance, weight, edge, tilt, 0.035, share)
        ratios.append(np.sort(np.linalg.eigvals(np.linalg.solve(expected, error)).real))
    # The compiled grid is coarse: good to some ten percent of a standard deviation, seldom worse.
    smaller, larger = np.transpose(ratios)
    assert smaller.min() > 0.2
    assert larger.max() < 5.0
    np.testing.assert_allclose(np.exp(np.mean(np.log(ratios))), 1.0, rtol=0.1)
    assert np.quantile(smaller, 0.25) > 0.6
    assert np.quantile(larger, 0.75) < 1.7


def test_one_wall_tells_one_angle() -> None:
    """Lines that stand close together cannot tell a lean in the direction of the view."""
    rng = np.random.default_rng(5)
    bearing = np.linspace(-0.07, 0.07, 12)
    normal = normals(bearing, np.radians(0.05) * rng.standard_normal(12))

    tilt, _ = consensus(verticals(normal, np.radians(0.05) ** 2, 0.015), SETTINGS)

    assert tilt is not None
    pitch, roll = np.degrees(np.sqrt(np.diag(tilt.covariance)))
    assert pitch > 1.0
    assert roll < 0.5


def test_clutter_is_believed_less_than_carpentry() -> None:
    bearing = np.linspace(-0.6, 0.6, 12)
    off = np.radians(0.5) * np.array([1.0, -1.0, 0.6, -0.8] * 3)
    stated = []
    for scale in (0.05, 1.0):
        lines = verticals(normals(bearing, scale * off), np.radians(0.03) ** 2, 0.02)
        tilt, _ = consensus(lines, SETTINGS)
        assert tilt is not None
        stated.append(np.sqrt(np.diag(tilt.covariance)))
    assert np.all(stated[1] > 2.5 * stated[0])


def test_lines_are_gathered_round_the_strongest() -> None:
    bearing = np.array([0.0, 0.5, 0.1, 0.2, 0.9]) * TOGETHER_RAD * 2.0
    weight = np.array([1.0, 4.0, 3.0, 2.0, 5.0])

    group = group_around_strongest(bearing, np.full(5, TOGETHER_RAD), weight, np.zeros(5))

    np.testing.assert_array_equal(group, [0, 1, 0, 0, 1])


def test_merged_lines_have_mean_normals() -> None:
    normal = normals(np.array([0.1, 0.2, 0.5]), np.array([0.01, 0.03, 0.0]))

    lines = verticals(normal, 1e-6)
    merged = merge_lines(lines, np.array([0, 0, 2]))

    np.testing.assert_allclose(merged[:, :3], [normal[:2].mean(axis=0), normal[2]])
    np.testing.assert_allclose(merged[:, 3], [0.5e-6, 1e-6])


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_a_tilt_that_rivals_contradict_is_in_doubt(share: float) -> None:
    """Half of the lines agree on another tilt: the error reaches about as far as that is."""
    bearing = np.linspace(-0.6, 0.6, 16)
    rival = np.radians(1.5)
    lean = np.where(np.arange(16) % 2 == 0, 0.0, rival) * np.cos(bearing)
    variance = np.full(16, np.radians(0.03) ** 2)
    error = stated_error(
        normals(bearing, lean), variance, np.ones(16), np.arange(16), (0.0, 0.0), share
    )
    assert np.sqrt(error[1, 1]) > 0.3 * rival
