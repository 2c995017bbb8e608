"""The network of rims against its equation, and its laws."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.discs.judgement import FEATURES
from detect.discs.rim import DIRECTIONS, STEPS
from detect.discs.rim_network import (
    DOUBTFUL_RIM,
    RimNetwork,
    network_inputs,
    network_log_odds,
    trained_networks,
)
from tests.reference import rim_network as reference

FloatArray = NDArray[np.float64]
Profiles = tuple[FloatArray, FloatArray, FloatArray]


def some_profiles(seed: int) -> Profiles:
    """Grey values, pixels per radius and features; of every other seed with a part unseen."""
    rng = np.random.default_rng(seed)
    grey = rng.uniform(0.0, 255.0, (DIRECTIONS, STEPS // 2))
    if seed % 2:
        grey[5:9, STEPS // 4 :] = np.nan
    return grey, rng.uniform(3.0, 30.0, DIRECTIONS), rng.uniform(0.0, 1.0, len(FEATURES))


def odds_of(profiles: list[Profiles], signs: list[float], network: RimNetwork) -> FloatArray:
    grey, scale, features = (np.array(each) for each in zip(*profiles, strict=True))
    inputs = network_inputs(grey.astype(np.float32), scale, np.array(signs))
    return network_log_odds(*inputs, features, network, DOUBTFUL_RIM)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("doubtful", [DOUBTFUL_RIM, (0.0, 0.0), (-100.0, 100.0)])
def test_the_compiled_network_is_its_equation(
    seed: int, sign: float, doubtful: tuple[float, float]
) -> None:
    grey, scale, features = some_profiles(seed)
    inputs, scales = network_inputs(grey[None].astype(np.float32), scale[None], np.array([sign]))
    expected, expected_scales = reference.inputs_of(grey, scale, sign)
    np.testing.assert_allclose(inputs[:, 1:-1].T, expected, atol=2e-6)
    np.testing.assert_allclose(scales[0], expected_scales, atol=2e-6)
    network = trained_networks().classifier
    [found] = network_log_odds(inputs, scales, features[None], network, doubtful)
    odds = reference.log_odds_of(expected, expected_scales, features, network, doubtful)
    assert found == pytest.approx(odds, abs=1e-4)


def test_several_samples_at_once_are_each_judged_as_alone() -> None:
    profiles, signs = [some_profiles(seed) for seed in range(5)], [1.0, -1.0, 1.0, 1.0, -1.0]
    network = trained_networks().classifier
    alone = [odds_of(profiles[k : k + 1], signs[k : k + 1], network)[0] for k in range(5)]
    np.testing.assert_allclose(odds_of(profiles, signs, network), alone, atol=1e-5)


def test_turned_directions_and_a_dark_disc_are_the_same() -> None:
    grey, scale, features = some_profiles(3)
    turned = np.roll(grey, 7, axis=0), np.roll(scale, 7), features
    samples = [(grey, scale, features), turned, (255.0 - grey, scale, features)]
    odds, odds_turned, odds_dark = odds_of(samples, [1.0, 1.0, -1.0], trained_networks().classifier)
    assert odds_turned == pytest.approx(odds, abs=1e-4)
    assert odds_dark == pytest.approx(odds, abs=1e-4)


def test_a_clear_disc_is_likelier_than_a_flat_floor() -> None:
    at = np.linspace(0.37, 1.63, STEPS // 2)
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 2.0, (DIRECTIONS, STEPS // 2))
    scale = np.full(DIRECTIONS, 8.0)
    disc = 90.0 + 60.0 / (1.0 + np.exp((at - 1.0) / 0.08)) + noise
    whole = np.array([1.0, 0.0, 0.3, 0.02, 0.004, 0.3, 0.15])
    none = np.array([0.4, 4.0, 0.8, 0.2, 0.4, 0.3, 0.13])
    samples = [(disc, scale, whole), (90.0 + noise, scale, none)]
    clear, flat = odds_of(samples, [1.0, 1.0], trained_networks().classifier)
    assert clear > flat + 2.0
