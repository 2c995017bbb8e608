"""Tilt from verticals: known tilts back, honest covariances, outliers left out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detect.verticals.tilt import ConsensusSettings, TiltEstimate, consensus, lean, level_rotation

SETTINGS = ConsensusSettings()


def seen_normals(
    rng: np.random.Generator,
    count: int,
    tilt_rad: tuple[float, float],
    deviation_rad: np.ndarray,
) -> np.ndarray:
    """Normals of verticals over a view of +-40 deg, as a tilted camera measures them."""
    bearing = rng.uniform(-0.7, 0.7, count)
    level = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(count)], axis=-1)
    real = level + rng.normal(0.0, 1.0, (count, 1)) * deviation_rad[:, None] * [0.0, 0.0, 1.0]
    measured = real @ level_rotation(*tilt_rad)
    return np.asarray(measured / np.linalg.norm(measured, axis=1, keepdims=True))


@given(
    pitch=st.floats(-4.9, 4.9),
    roll=st.floats(-4.9, 4.9),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=40, deadline=None)
def test_exact_verticals_give_the_tilt_back(pitch: float, roll: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = np.radians(pitch), np.radians(roll)
    normal = seen_normals(rng, 20, true, np.zeros(20))
    tilt, consistent = consensus(
        normal, np.full(20, 1e-10), np.full(20, 0.01), np.full(20, 3.0), SETTINGS
    )
    assert tilt is not None
    assert consistent.all()
    np.testing.assert_allclose([tilt.pitch_rad, tilt.roll_rad], true, atol=1e-4)


@pytest.mark.parametrize("true_deg", [(0.0, 0.0), (2.3, 0.0), (-2.1, 1.0), (4.0, -3.0)])
def test_normalised_error_is_one_among_outliers(true_deg: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    true = np.radians(true_deg)
    squared, raw = [], []
    for _ in range(300):
        deviation = rng.uniform(0.05, 0.2, 12)
        normal = seen_normals(rng, 12, (true[0], true[1]), np.radians(np.hypot(deviation, 0.03)))
        furniture = rng.normal(size=(4, 3)) * [1.0, 1.0, 0.15]
        furniture /= np.linalg.norm(furniture, axis=1, keepdims=True)
        tilt, consistent = consensus(
            np.concatenate([normal, furniture]),
            np.radians(np.concatenate([deviation, np.full(4, 0.1)])) ** 2,
            np.full(16, np.radians(0.9)),
            np.full(16, 2.0),
            SETTINGS,
        )
        assert tilt is not None
        assert tilt.lines == consistent.sum()
        error = np.array([tilt.pitch_rad, tilt.roll_rad]) - true
        squared.append(error @ np.linalg.solve(tilt.covariance, error) / 2.0)
        raw.append(np.degrees(error))
    assert 0.7 < np.mean(squared) < 1.4
    assert np.all(np.sqrt(np.mean(np.square(raw), axis=0)) < 0.15)


def test_largest_set_wins_over_the_smallest_tilt() -> None:
    rng = np.random.default_rng(1)
    tilted = seen_normals(rng, 8, (0.05, -0.04), np.zeros(8))
    upright = seen_normals(rng, 4, (0.0, 0.0), np.zeros(4))
    tilt, consistent = consensus(
        np.concatenate([upright, tilted]),
        np.full(12, 1e-8),
        np.full(12, 0.01),
        np.full(12, 3.0),
        SETTINGS,
    )
    assert tilt is not None
    assert (tilt.pitch_rad, tilt.roll_rad) == pytest.approx((0.05, -0.04), abs=5e-4)
    assert consistent[4:].all()
    assert consistent[:4].sum() < 4


def test_order_of_lines_does_not_matter() -> None:
    rng = np.random.default_rng(2)
    normal = seen_normals(rng, 15, (0.02, 0.03), np.full(15, 2e-3))
    variance, weight = np.full(15, 4e-6), rng.uniform(1.0, 3.0, 15)
    tolerance = np.full(15, 0.015)
    order = rng.permutation(15)
    first, _ = consensus(normal, variance, tolerance, weight, SETTINGS)
    second, _ = consensus(normal[order], variance, tolerance, weight[order], SETTINGS)
    assert isinstance(first, TiltEstimate)
    assert isinstance(second, TiltEstimate)
    assert second.pitch_rad == pytest.approx(first.pitch_rad, abs=1e-12)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_lines_give_no_estimate(count: int) -> None:
    normal = seen_normals(np.random.default_rng(3), count, (0.0, 0.0), np.zeros(count))
    tilt, consistent = consensus(
        normal, np.full(count, 1e-6), np.full(count, 0.01), np.ones(count), SETTINGS
    )
    assert tilt is None
    assert consistent.all()
    assert len(consistent) == count


def test_lines_that_no_small_tilt_explains_give_none() -> None:
    normal = seen_normals(np.random.default_rng(4), 10, (0.3, 0.0), np.zeros(10))
    normal = normal[np.abs(normal[:, 1]) > 0.2]
    tilt, consistent = consensus(
        normal,
        np.full(len(normal), 1e-8),
        np.full(len(normal), 0.01),
        np.ones(len(normal)),
        SETTINGS,
    )
    assert tilt is None or tilt.lines < len(normal)
    assert not consistent.all()


def test_lean_is_what_a_tilted_camera_sees() -> None:
    bearing, pitch, roll = 0.4, 0.01, -0.02
    level = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    measured = level @ level_rotation(pitch, roll)
    # In the chart X = a + b Z the plane's normal is (left - a ahead, -b).
    assert -measured[2] == pytest.approx(float(lean(bearing, pitch, roll)), abs=3e-4)
