"""Trains the network of the second look (`detect.discs.rim_network`) on looks of known truth.

Plain NumPy: some 6,000 looks and 2,000 weights take seconds. Forward and backward pass are written
out; the steps are Adam's with decoupled weight decay (I. Loshchilov and F. Hutter, Decoupled Weight
Decay Regularization, ICLR 2019), their length rises and falls once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from detect.discs.rim_network import DISTANCES, INPUTS, SCALES, RimNetwork
from tools.evaluation.second_look_data import Looks

FloatArray = NDArray[np.floating]

CHANNELS, UNITS, MEMBERS = 12, 16, 4
_EPOCHS, _BATCH = 60, 256
#: Share of the discs that the features of the rim alone may lose.
_QUICKLY_LOST = 0.01
_LONGEST_STEP, _RISING, _DECAY = 6e-3, 0.3, 0.02
_MOMENTUM, _SQUARES = 0.9, 0.99
#: A look is never taken for certain.
_SMOOTHING = 0.01
#: Grey values are multiplied by exp(N(0, _GAIN)), noise of up to _NOISE grey levels is added.
_GAIN, _NOISE = 0.3, 4.0


class Batch(NamedTuple):
    """What the network sees of N looks.

    Attributes
    ----------
    inputs : (N, DIRECTIONS, INPUTS) float32
    scales : (N, SCALES) float32
    features : (N, F) float32
    """

    inputs: FloatArray
    scales: FloatArray
    features: FloatArray


def batch_of(grey: FloatArray, pixels_per_radius: FloatArray, features: FloatArray) -> Batch:
    """`detect.discs.rim_network.network_inputs` of N looks at light discs."""
    values = grey.reshape(*grey.shape[:-1], DISTANCES, 2).mean(axis=-1)
    outside = np.isnan(values)
    count = np.maximum((~outside).sum(axis=(1, 2), keepdims=True), 1)
    mean = np.where(outside, 0.0, values).sum(axis=(1, 2), keepdims=True) / count
    off = np.where(outside, 0.0, values - mean)
    deviation = np.sqrt((off**2).sum(axis=(1, 2), keepdims=True) / count + 9.0)
    size = np.log(pixels_per_radius) - 1.5
    inputs = np.concatenate(
        [off / deviation, size[..., None], outside.mean(axis=-1, keepdims=True)], axis=-1
    )
    scales = np.stack([size.mean(axis=-1), np.log(deviation[:, 0, 0]) - 2.5], axis=-1)
    return Batch(inputs.astype(np.float32), scales.astype(np.float32), features)


class _Member:
    """One network: its weights, in the order of `RimNetwork`, and the values of a pass."""

    def __init__(self, features: int, rng: np.random.Generator) -> None:
        def layer(inputs: int, outputs: int) -> FloatArray:
            deviations = rng.normal(size=(inputs, outputs)) * np.sqrt(2.0 / inputs)
            return np.asarray(deviations, np.float32)

        self.weights = [
            layer(3 * INPUTS, CHANNELS), np.zeros(CHANNELS, np.float32),
            layer(3 * CHANNELS, CHANNELS), np.zeros(CHANNELS, np.float32),
            layer(3 * CHANNELS + SCALES, UNITS), np.zeros(UNITS, np.float32),
            0.3 * layer(UNITS + features, 1), np.zeros(1, np.float32),
        ]  # fmt: skip

    def log_odds(self, batch: Batch) -> FloatArray:
        w_around, b_around, w_again, b_again, w_dense, b_dense, w_out, b_out = self.weights
        self._seen = _neighbours(batch.inputs)
        self._around = np.maximum(self._seen @ w_around + b_around, 0.0)
        self._around_seen = _neighbours(self._around)
        self._again = again = np.maximum(self._around_seen @ w_again + b_again, 0.0)
        self._most, self._least = again.argmax(axis=1), again.argmin(axis=1)
        pooled = [again.mean(axis=1), again.max(axis=1), again.min(axis=1), batch.scales]
        self._pooled = np.concatenate(pooled, axis=-1)
        self._dense = np.maximum(self._pooled @ w_dense + b_dense, 0.0)
        self._all = np.concatenate([self._dense, batch.features], axis=-1)
        return np.asarray((self._all @ w_out + b_out)[:, 0])

    def gradient(self, d_odds: FloatArray) -> list[FloatArray]:
        """Of a cost with these derivatives by the log-odds of the latest pass."""
        _, _, w_again, _, w_dense, _, w_out, _ = self.weights
        d_out = d_odds[:, None]
        d_dense = (d_out @ w_out.T)[:, :UNITS] * (self._dense > 0.0)
        mean, most, least = np.split((d_dense @ w_dense.T)[:, : 3 * CHANNELS], 3, axis=-1)
        directions = self._again.shape[1]
        d_again = np.repeat((mean / directions)[:, None], directions, axis=1)
        look, channel = np.ogrid[: len(d_odds), :CHANNELS]
        d_again[look, self._most, channel] += most
        d_again[look, self._least, channel] += least
        d_again = (d_again * (self._again > 0.0)).reshape(-1, CHANNELS)
        before, same, after = np.split((d_again @ w_again.T).reshape(self._around_seen.shape), 3, 2)
        d_around = np.roll(before, -1, axis=1) + same + np.roll(after, 1, axis=1)
        d_around = (d_around * (self._around > 0.0)).reshape(-1, CHANNELS)
        return [
            self._seen.reshape(-1, 3 * INPUTS).T @ d_around, d_around.sum(axis=0),
            self._around_seen.reshape(-1, 3 * CHANNELS).T @ d_again, d_again.sum(axis=0),
            self._pooled.T @ d_dense, d_dense.sum(axis=0),
            self._all.T @ d_out, d_out.sum(axis=0),
        ]  # fmt: skip


def _neighbours(values: FloatArray) -> FloatArray:
    """Values of the direction before, the same and the next one, side by side."""
    return np.concatenate([np.roll(values, 1, 1), values, np.roll(values, -1, 1)], axis=-1)


def _varied(looks: Looks, chosen: NDArray[np.int64], rng: np.random.Generator) -> Batch:
    """Looks as they could have been: from a place nearby, mirrored, in other light, noisier."""
    n = len(chosen)
    view = rng.integers(looks.grey.shape[1], size=n)
    grey, scale = looks.grey[chosen, view], looks.pixels_per_radius[chosen, view]
    mirrored = rng.random(n) < 0.5
    grey[mirrored], scale[mirrored] = grey[mirrored, ::-1], scale[mirrored, ::-1]
    noise = rng.normal(size=grey.shape) * rng.uniform(0.0, _NOISE, (n, 1, 1))
    lit = grey * np.exp(rng.normal(0.0, _GAIN, (n, 1, 1))) + noise
    return batch_of(lit.astype(np.float32), scale, looks.features[chosen].astype(np.float32))


def _train_member(looks: Looks, used: NDArray[np.int64], seed: int) -> _Member:
    rng = np.random.default_rng(seed)
    member = _Member(looks.features.shape[1], rng)
    target = looks.is_disc * (1.0 - 2.0 * _SMOOTHING) + _SMOOTHING
    weight = looks.weight / looks.weight[used].mean()
    first = [np.zeros_like(w) for w in member.weights]
    second = [np.zeros_like(w) for w in member.weights]
    steps = _EPOCHS * -(-len(used) // _BATCH)
    orders = (rng.permutation(used) for _ in range(_EPOCHS))
    batches = (order[k : k + _BATCH] for order in orders for k in range(0, len(order), _BATCH))
    for t, chosen in enumerate(batches, 1):
        odds = member.log_odds(_varied(looks, chosen, rng))
        d_odds = (1.0 / (1.0 + np.exp(-odds)) - target[chosen]) * weight[chosen] / len(chosen)
        gradient = member.gradient(d_odds.astype(np.float32))
        done = t / steps
        rate = done / _RISING
        if done >= _RISING:
            rate = 0.5 + 0.5 * np.cos(np.pi * (done - _RISING) / (1.0 - _RISING))
        for k, slope in enumerate(gradient):
            first[k] = _MOMENTUM * first[k] + (1.0 - _MOMENTUM) * slope
            second[k] = _SQUARES * second[k] + (1.0 - _SQUARES) * slope**2
            mean = first[k] / (1.0 - _MOMENTUM**t)
            deviation = np.sqrt(second[k] / (1.0 - _SQUARES**t)) + 1e-8
            decay = _DECAY * member.weights[k] if k % 2 == 0 else 0.0
            step = _LONGEST_STEP * rate * (mean / deviation + decay)
            member.weights[k] = np.asarray(member.weights[k] - step, np.float32)
    return member


def quick_weights(looks: Looks, used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """`RimNetwork.quick`: a logistic regression that keeps all but a few of the discs."""
    chosen = looks.features[used]
    mean, deviation = chosen.mean(axis=0), chosen.std(axis=0) + 1e-6
    scaled = (chosen - mean) / deviation
    design = np.concatenate([scaled, scaled**2, np.ones((len(chosen), 1))], axis=1)
    target, weight = looks.is_disc[used], looks.weight[used]

    def cost(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        odds = design @ weights
        value = weight @ (np.logaddexp(0.0, odds) - target * odds) + 0.5 * weights @ weights
        return float(value), design.T @ (weight * (expit(odds) - target)) + weights

    linear, square, _ = np.split(
        minimize(cost, np.zeros(design.shape[1]), jac=True).x, [len(mean), 2 * len(mean)]
    )
    # The same in the features as they are.
    square = square / deviation**2
    linear = linear / deviation - 2.0 * square * mean
    odds = chosen @ linear + chosen**2 @ square
    limit = np.quantile(odds[target], _QUICKLY_LOST)
    return np.concatenate([linear, square, [-limit]])


def worth_the_network(looks: Looks, quick: NDArray[np.float64]) -> NDArray[np.bool_]:
    """`detect.discs.rim_network.worth_the_network` of all looks."""
    n = looks.features.shape[1]
    odds = looks.features @ quick[:n] + looks.features**2 @ quick[n : 2 * n] + quick[-1]
    return np.asarray(odds >= 0.0)


def train(looks: Looks, used: NDArray[np.bool_], seed: int) -> RimNetwork:
    """Train networks on some of the looks.

    Parameters
    ----------
    looks : Looks
    used : (N,) bool
    seed : int
        Of the first network; each has its own.

    Returns
    -------
    RimNetwork
        Its features are those of the looks as they are.
    """
    quick = quick_weights(looks, used)
    used = used & worth_the_network(looks, quick)
    index = np.flatnonzero(used)
    mean, deviation = looks.features[used].mean(axis=0), looks.features[used].std(axis=0) + 1e-6
    alike = looks._replace(features=(looks.features - mean) / deviation)
    members = [_train_member(alike, index, seed + k).weights for k in range(MEMBERS)]
    around, around_bias, again, again_bias, dense, dense_bias, out, out_bias = (
        np.stack(layer) for layer in zip(*members, strict=True)
    )
    by_unit, by_feature = out[:, :UNITS, 0], out[:, UNITS:, 0] / deviation
    return RimNetwork(
        around.reshape(MEMBERS, 3, INPUTS, CHANNELS), around_bias,
        again.reshape(MEMBERS, 3, CHANNELS, CHANNELS), again_bias, dense, dense_bias,
        np.c_[by_unit, by_feature].astype(np.float32),
        (out_bias[:, 0] - by_feature @ mean).astype(np.float32),
        quick,
    )  # fmt: skip


def log_odds(network: RimNetwork, batch: Batch) -> NDArray[np.float64]:
    """(N,) log-odds of looks by a network: `detect.discs.rim_network.network_log_odds` in NumPy."""
    members = []
    for layers in zip(*network[:-1], strict=True):
        w = RimNetwork._make([*layers, network.quick])
        member = _Member(0, np.random.default_rng(0))
        member.weights = [
            w.around.reshape(-1, w.around.shape[-1]), w.around_bias,
            w.again.reshape(-1, w.again.shape[-1]), w.again_bias,
            w.dense, w.dense_bias, w.out[:, None], np.atleast_1d(w.out_bias),
        ]  # fmt: skip
        members.append(member.log_odds(batch))
    return np.asarray(np.mean(members, axis=0), np.float64)


def cross_validation(looks: Looks, seed: int) -> Iterable[str]:
    """What networks find in each building that was left out of training them, line by line."""
    buildings = np.array([source.split()[0] for source in looks.source])
    for left_out in np.unique(buildings[looks.source == buildings]):
        own = looks.source == left_out
        if not looks.is_disc[own].any():
            continue
        network = train(looks, buildings != left_out, seed)
        batch = batch_of(looks.grey[own, 0], looks.pixels_per_radius[own, 0], looks.features[own])
        odds = np.where(
            worth_the_network(looks, network.quick)[own], log_odds(network, batch), -np.inf
        )
        discs, others = odds[looks.is_disc[own]], odds[~looks.is_disc[own]]
        text = ", ".join(
            f">= {t:g}: {(discs >= t).sum()}/{len(discs)} discs, {(others >= t).sum()} others"
            for t in np.arange(-1.0, 2.01, 0.5)
        )
        yield f"left out {left_out}: {text}"
