"""The network of rims against its equation, and its laws."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.discs.judgement import FEATURES
from detect.discs.rim import DIRECTIONS, STEPS
from detect.discs.rim_network import network_inputs, network_log_odds, trained_networks
from tests.reference import rim_network as reference

Floats = NDArray[np.float64]
Profiles = tuple[Floats, Floats, Floats]


def some_profiles(seed: int) -> Profiles:
    """Grey values, pixels per radius and features; of every other seed with a part unseen."""
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.0, 255.0, (DIRECTIONS, STEPS // 2))
    if seed % 2:
        grey[5:9, STEPS // 4 :] = np.nan
    return grey, rng.uniform(3.0, 30.0, DIRECTIONS), rng.uniform(0.0, 1.0, len(FEATURES))


def test_the_compiled_network_is_its_equation() -> None:
    grey, scale, features = (np.stack(values) for values in zip(*map(some_profiles, range(12))))
    sign = np.where(np.arange(12) % 3, 1.0, -1.0)
    network = trained_networks().look
    inputs, scales = network_inputs(grey, scale, sign)
    found = network_log_odds(inputs, scales, features, network)
    for k in range(12):
        expected, expected_scales = reference.inputs_of(grey[k], scale[k], sign[k])
        np.testing.assert_allclose(inputs[:, k, 1:-1].T, expected, atol=2e-6)
        np.testing.assert_allclose(scales[k], expected_scales, atol=2e-6)
        odds = reference.log_odds_of(expected, expected_scales, features[k], network)
        assert found[k] == pytest.approx(odds, abs=1e-4)


def log_odds_of_one(grey: Floats, scale: Floats, sign: float, features: Floats) -> float:
    inputs, scales = network_inputs(grey[None], scale[None], np.array([sign]))
    return float(network_log_odds(inputs, scales, features[None], trained_networks().look)[0])


def test_turned_directions_and_a_dark_disc_are_the_same() -> None:
    grey, scale, features = some_profiles(3)
    odds = log_odds_of_one(grey, scale, 1.0, features)
    turned = log_odds_of_one(np.roll(grey, 7, axis=0), np.roll(scale, 7), 1.0, features)
    assert turned == pytest.approx(odds, abs=1e-4)
    assert log_odds_of_one(255.0 - grey, scale, -1.0, features) == pytest.approx(odds, abs=1e-4)


def test_a_clear_disc_is_likelier_than_a_flat_floor() -> None:
    at = np.linspace(0.37, 1.63, STEPS // 2)
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 2.0, (DIRECTIONS, STEPS // 2))
    scale = np.full(DIRECTIONS, 8.0)
    disc = 90.0 + 60.0 / (1.0 + np.exp((at - 1.0) / 0.08)) + noise
    whole = np.array([1.0, 0.0, 0.3, 0.02, 0.004, 0.3, 0.15])
    none = np.array([0.4, 4.0, 0.8, 0.2, 0.4, 0.3, 0.13])
    clear = log_odds_of_one(disc, scale, 1.0, whole)
    assert clear > log_odds_of_one(90.0 + noise, scale, 1.0, none) + 2.0
