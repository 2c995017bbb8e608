"""Training of the network of rims: its gradient, and that it learns what is there."""

from __future__ import annotations

import numpy as np
import pytest

from detect.discs.judgement import DENSE_RADII
from detect.discs.rim import DIRECTIONS, STEPS
from detect.discs.rim_network import (
    DOUBTFUL_RIM,
    OTHERS,
    RimNetwork,
    network_inputs,
    network_log_odds,
)
from redetect.array_types import FloatArray
from tests.reference import rim_network as reference
from tools.evaluation import rim_network_training as training
from tools.evaluation.rim_data import Samples


def samples_of(count: int, seed: int) -> Samples:
    """Half of them discs, whose outer steps are darker; their features say nothing."""
    rng = np.random.default_rng(seed)
    is_disc = np.arange(count) % 2 == 0
    grey = 120.0 + rng.normal(0.0, 8.0, (count, 2, DIRECTIONS, len(DENSE_RADII)))
    grey[is_disc, :, :, STEPS // 4 :] -= 40.0
    return Samples(
        rng.normal(size=(count, 3)), grey.astype(np.float32),
        rng.uniform(4.0, 9.0, (count, 2, DIRECTIONS)).astype(np.float32),
        is_disc, np.ones(count),
    )  # fmt: skip


def log_odds(network: RimNetwork, samples: Samples) -> FloatArray:
    """What the detector says of samples."""
    sign = np.ones(len(samples.is_disc))
    scale = samples.pixels_per_radius[:, 0].astype(float)
    inputs = network_inputs(samples.grey[:, 0], scale, sign)
    return network_log_odds(*inputs, samples.features, network, DOUBTFUL_RIM)


def test_what_is_trained_on_is_what_the_network_sees() -> None:
    samples = samples_of(4, 10)
    samples.grey[1, 0, 3:5, 2:] = np.nan
    batch = training.batch_of(samples.grey[:, 0], samples.pixels_per_radius[:, 0], samples.features)
    for k in range(4):
        inputs, scales = reference.inputs_of(
            samples.grey[k, 0], samples.pixels_per_radius[k, 0], 1.0
        )
        np.testing.assert_allclose(batch.inputs[k], inputs, atol=2e-6)
        np.testing.assert_allclose(batch.scales[k], scales, atol=2e-6)


def test_the_gradient_is_that_of_finite_differences() -> None:
    samples = samples_of(6, 1)
    batch = training.batch_of(
        samples.grey[:, 0], samples.pixels_per_radius[:, 0], samples.features.astype(np.float32)
    )
    rng = np.random.default_rng(2)
    shape = training.Shape(5, 4, 1, 1)
    first = training._first_weights(len(DENSE_RADII) + OTHERS, 3, shape, rng)
    member = training._Member([w + 0.05 * rng.normal(size=w.shape) for w in first])
    d_odds = rng.normal(size=6)
    member.log_odds(batch)
    gradient = member.gradient(d_odds)
    for layer, slopes in zip(member.weights, gradient, strict=True):
        assert slopes.shape == layer.shape
        for _ in range(5):
            at = tuple(rng.integers(n) for n in layer.shape)
            before, sums = layer[at], []
            for step in (-1e-6, 1e-6):
                layer[at] = before + step
                sums.append(d_odds @ member.log_odds(batch))
            layer[at] = before
            assert (sums[1] - sums[0]) / 2e-6 == pytest.approx(slopes[at], rel=1e-4, abs=1e-6)


def test_training_learns_what_the_detector_computes() -> None:
    samples, unseen = samples_of(400, 3), samples_of(40, 4)
    every = np.ones(400, np.bool_)
    network = training.train(samples, every, training.Shape(6, 5, 2, 60), 1)
    assert ((log_odds(network, unseen) > 0.0) == unseen.is_disc).all()


def test_the_prescreening_loses_few_discs() -> None:
    samples = samples_of(400, 5)
    every = np.ones(400, np.bool_)
    passed = log_odds(training.train_prescreening(samples, every, 1), samples) >= 0.0
    assert passed[samples.is_disc].mean() >= 0.97
    assert not passed[~samples.is_disc].any()


def test_variations_of_looks_change_what_they_say() -> None:
    rng, samples = np.random.default_rng(7), samples_of(60, 6)
    grey, other = samples.grey[:30, 0], samples.grey[30:, 0] + 1000.0
    covered = training._covered(grey, other, rng)
    changed = np.abs(covered - grey) > 1.0
    assert (changed.mean(axis=(1, 2)) < 0.8).all()
    # Beside what is covered or in other light, most directions are as before.
    assert 0.2 < changed.any(axis=2).mean() < 0.7
    nowhere = np.full_like(other, np.nan)
    assert np.isfinite(training._covered(grey, nowhere, rng)).all()
    cut = training._cut(grey, other, rng)
    outside = np.isnan(cut)
    assert (cut[~outside] == grey[~outside]).all()
    # A straight border: no more than half of the directions, and nothing behind it.
    assert (outside.any(axis=2).sum(axis=1) <= DIRECTIONS // 2).all()
    assert (outside[:, :, 1:] >= outside[:, :, :-1]).all()
    textured = training._textured(grey, other, rng) - grey
    inside = np.abs(textured[:, :, : STEPS // 8]).max(axis=(1, 2))
    assert 0.4 < np.mean(inside < 0.1) < 0.95
    assert (np.abs(textured[:, :, -2:]).max(axis=(1, 2)) > 0.5).all()
    soft = training._softened(grey, other, rng)
    assert (np.diff(soft, axis=2).std(axis=(1, 2)) < np.diff(grey, axis=2).std(axis=(1, 2))).all()


def test_looks_at_discs_remain_so_in_other_light() -> None:
    samples, rng = samples_of(60, 8), np.random.default_rng(9)
    grey = training._relit(samples.grey[:, 0], samples.grey[:, 1], rng)
    assert ((grey >= 0.0) & (grey <= 255.0)).all()
    step = grey[:, :, : STEPS // 4].mean(axis=(1, 2)) - grey[:, :, STEPS // 4 :].mean(axis=(1, 2))
    assert ((step > 15.0) == samples.is_disc).all()
