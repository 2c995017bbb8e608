"""Trains the networks that judge candidates (`detect.discs.rim_network`) on known truth.

Plain NumPy: 310,000 candidates, 210,000 rims and 15,000 weights take an hour on two busy cores.
Forward and backward pass are written out; the steps are Adam's with decoupled weight decay
(I. Loshchilov and F. Hutter, Decoupled Weight Decay Regularization, ICLR 2019), their length rises
and falls once.

There are few buildings of known truth. So that the networks do not learn these by heart, each
sample is varied whenever it is used: mirrored, on another floor, in other light, partly hidden or
stained, cut off, less sharp, or noisier.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from tyro.conf import Positional

from detect.discs.judgement import DENSE_RADII, SPARSE_RADII
from detect.discs.rim_network import (
    OTHERS,
    SCALES,
    Networks,
    RimNetwork,
    network_inputs,
    network_log_odds,
)
from redetect.array_types import Float32Array
from redetect.storage import write_whole
from tools.evaluation.figures import Figures, Study
from tools.evaluation.rim_data import Samples, gather

FloatArray = NDArray[np.floating]

_BATCH = 256
#: Share of the discs that the prescreening may lose.
_LOST_BY_PRESCREENING = 0.01
_LONGEST_STEP, _RISING, _DECAY = 6e-3, 0.3, 0.02
_MOMENTUM, _SQUARES = 0.9, 0.99
#: A sample is never taken for certain.
_SMOOTHING = 0.01
#: Shares of samples that are varied in each way, and how much. Of another sample's deviations from
#: its mean a part is added, mostly to the floor alone: from this distance on, with a transition of
#: this width (nominal radii).
_TEXTURED, _TEXTURE, _ONLY_FLOOR, _FLOOR_FROM = 0.35, (0.1, 0.7), 0.7, (1.08, 0.04)
#: A gradient of N(0, x) grey levels per radius is added; grey values have the power exp(N(0, x)).
_RELIT, _SIDE_LIGHT, _POWER = 0.5, 12.0, 0.35
#: Each grey value is averaged with its neighbours along the radius, which have up to this weight.
_SOFT, _NEIGHBOUR = 0.3, 0.33
#: A half-plane, a strip, a blot or a sector, with an edge of this width (nominal radii), shows
#: another sample, one grey value, or the same under light of the factor exp(N(0, x)).
_COVERED, _EDGE, _SHADE = 0.3, (0.02, 0.15), 0.7
#: The image ends at up to this distance from the centre, nominal radii.
_CUT, _CUT_AT = 0.1, 1.2
#: All grey values are multiplied by exp(N(0, x)), and have noise of up to so many levels; this
#: share has three times the noise.
_GAIN, _NOISE, _NOISY = 0.3, 4.0, 0.3


class Shape(NamedTuple):
    """How large networks are, how many are averaged, and how often each sees every sample."""

    channels: int
    units: int
    members: int
    epochs: int


SHAPES = {"prescreening": Shape(12, 8, 3, 30), "classifier": Shape(16, 24, 4, 40)}


class Batch(NamedTuple):
    """What the network sees of N samples."""

    inputs: FloatArray  # (N, K, I)
    scales: FloatArray  # (N, SCALES)
    features: FloatArray  # (N, F)


def _distances(grey: FloatArray) -> Float32Array:
    """Distances (M,) of (..., M) sparse or dense profiles, nominal radii."""
    [at] = [at for at in (SPARSE_RADII, DENSE_RADII) if len(at) == grey.shape[-1]]
    return at.astype(np.float32)


def _seen(grey: Float32Array, pixels_per_radius: FloatArray) -> tuple[Float32Array, Float32Array]:
    """`network_inputs` of light discs."""
    return network_inputs(grey, pixels_per_radius.astype(np.float64), np.ones(len(grey)))


def batch_of(grey: Float32Array, pixels_per_radius: FloatArray, features: FloatArray) -> Batch:
    """What the network sees of N samples of light discs, arranged for training."""
    samples, directions, _ = grey.shape
    inputs, scales = _seen(grey, pixels_per_radius)
    # The first and the last direction are repeated at the ends.
    circle = inputs.reshape(-1, directions + 2, samples)[:, 1:-1]
    return Batch(np.ascontiguousarray(circle.transpose(2, 1, 0)), scales, features)


def _first_weights(
    inputs: int, features: int, shape: Shape, rng: np.random.Generator
) -> list[FloatArray]:
    channels, units = shape.channels, shape.units
    sizes = [
        (3 * inputs, channels), (3 * channels, channels), (3 * channels + SCALES, units),
        (units + features, 1),
    ]  # fmt: skip
    weights: list[FloatArray] = []
    for n, m in sizes:
        first = np.sqrt(2.0 / n) * rng.normal(size=(n, m))
        weights += [first.astype(np.float32), np.zeros(m, np.float32)]
    weights[-2] *= 0.3
    return weights


class _Member:
    """One network: its weights, in the order of `RimNetwork`, and the values of a pass."""

    def __init__(self, weights: list[FloatArray]) -> None:
        self.weights = weights

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
        d_dense = (d_out @ w_out.T)[:, : w_dense.shape[1]] * (self._dense > 0.0)
        mean, most, least = np.split((d_dense @ w_dense.T)[:, :-SCALES], 3, axis=-1)
        directions, channels = self._again.shape[1:]
        d_again = np.repeat((mean / directions)[:, None], directions, axis=1)
        sample, channel = np.ogrid[: len(d_odds), :channels]
        d_again[sample, self._most, channel] += most
        d_again[sample, self._least, channel] += least
        d_again = (d_again * (self._again > 0.0)).reshape(-1, channels)
        before, same, after = np.split((d_again @ w_again.T).reshape(self._around_seen.shape), 3, 2)
        d_around = np.roll(before, -1, axis=1) + same + np.roll(after, 1, axis=1)
        d_around = (d_around * (self._around > 0.0)).reshape(-1, channels)
        return [
            self._seen.reshape(len(d_around), -1).T @ d_around, d_around.sum(axis=0),
            self._around_seen.reshape(len(d_again), -1).T @ d_again, d_again.sum(axis=0),
            self._pooled.T @ d_dense, d_dense.sum(axis=0),
            self._all.T @ d_out, d_out.sum(axis=0),
        ]  # fmt: skip


def _neighbours(values: FloatArray) -> FloatArray:
    """Values of the direction before, the same and the next one, side by side."""
    return np.concatenate([np.roll(values, 1, 1), values, np.roll(values, -1, 1)], axis=-1)


def _varied(
    samples: Samples, chosen: NDArray[np.int64], others: NDArray[np.int64], rng: np.random.Generator
) -> Batch:
    """Samples as they could have been; `others` are of what is no disc."""
    n = len(chosen)
    view = rng.integers(samples.grey.shape[1], size=n)
    grey, scale = samples.grey[chosen, view], samples.pixels_per_radius[chosen, view]
    mirrored = rng.random(n) < 0.5
    grey[mirrored], scale[mirrored] = grey[mirrored, ::-1], scale[mirrored, ::-1]
    for share, vary in _VARIATIONS:
        some = np.flatnonzero(rng.random(n) < share)
        other = samples.grey[rng.choice(others, len(some)), 0]
        grey[some] = vary(grey[some], other, rng)
    gain = np.exp(rng.normal(0.0, _GAIN, (n, 1, 1))).astype(np.float32)
    noise = rng.uniform(0.0, _NOISE, (n, 1, 1)) * np.where(rng.random((n, 1, 1)) < _NOISY, 3.0, 1.0)
    lit = gain * grey + noise.astype(np.float32) * rng.standard_normal(grey.shape, np.float32)
    return batch_of(lit, scale, samples.features[chosen].astype(np.float32))


def _positions(grey: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Angles (N, K, 1) from a random direction, and distances (M,) in nominal radii, of samples."""
    samples, directions, _ = grey.shape
    angle = np.linspace(0.0, 2.0 * np.pi, directions, endpoint=False, dtype=np.float32)[:, None]
    first = rng.uniform(0.0, 2.0 * np.pi, (samples, 1, 1)).astype(np.float32)
    return angle - first, _distances(grey)


def _each(values: FloatArray) -> FloatArray:
    """One value for each of N samples, as (N, 1, 1)."""
    return values.astype(np.float32)[:, None, None]


def _textured(grey: FloatArray, other: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples with the deviations of others added."""
    n, (at, width) = len(grey), _FLOOR_FROM
    _, distance = _positions(grey, rng)
    floor = np.where(_each(rng.random(n)) < _ONLY_FLOOR, expit((distance - at) / width), 1.0)
    deviation = np.nan_to_num(other - np.nanmean(other, axis=(1, 2), keepdims=True))
    return np.asarray(grey + _each(rng.uniform(*_TEXTURE, n)) * floor * deviation)


def _relit(grey: FloatArray, _: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples with light from one side, and brighter or darker."""
    n = len(grey)
    angle, distance = _positions(grey, rng)
    lit = grey + _each(rng.normal(0.0, _SIDE_LIGHT, n)) * distance * np.cos(angle)
    power = _each(np.exp(rng.normal(0.0, _POWER, n)))
    return np.asarray(255.0 * (np.clip(lit, 1.0, 255.0) / 255.0) ** power)


def _softened(grey: FloatArray, _: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples that are less sharp."""
    weight = _each(rng.uniform(0.0, _NEIGHBOUR, len(grey)))
    padded = np.pad(grey, ((0, 0), (0, 0), (1, 1)), mode="edge")
    return (1.0 - 2.0 * weight) * grey + weight * (padded[:, :, :-2] + padded[:, :, 2:])


def _covered(grey: FloatArray, other: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples of which a part is hidden, stained, or in another light."""
    n = len(grey)
    angle, distance = _positions(grey, rng)
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    at, size = _each(rng.uniform(0.1, 1.0, n)), _each(rng.uniform(0.05, 0.5, n))
    half_plane, strip, blot = x - at, 0.5 * size - np.abs(x - at), size - np.hypot(x - at, y)
    sector = 1.6 * size - np.abs((angle + np.pi) % (2.0 * np.pi) - np.pi)
    shape = rng.integers(4, size=(n, 1, 1))
    depth = np.choose(shape, np.broadcast_arrays(half_plane, strip, blot, sector))
    share = expit(depth / _each(rng.uniform(*_EDGE, n)))
    plain = np.broadcast_to(_each(rng.uniform(0.0, 255.0, n)), grey.shape)
    shaded = grey * _each(np.exp(rng.normal(0.0, _SHADE, n)))
    behind = np.where(np.isnan(other), plain, other)
    seen = np.choose(rng.integers(3, size=(n, 1, 1)), (behind, plain, shaded))
    return np.asarray(grey * (1.0 - share) + share * seen)


def _cut(grey: FloatArray, _: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples of which a part is outside the image."""
    angle, distance = _positions(grey, rng)
    farthest = _each(rng.uniform(0.0, _CUT_AT, len(grey)))
    return np.where(distance * np.cos(angle) > farthest, np.float32(np.nan), grey)


_VARIATIONS = (
    (_TEXTURED, _textured), (_RELIT, _relit), (_SOFT, _softened), (_COVERED, _covered),
    (_CUT, _cut),
)  # fmt: skip


def _train_member(samples: Samples, used: NDArray[np.int64], shape: Shape, seed: int) -> _Member:
    rng = np.random.default_rng(seed)
    inputs, features = samples.grey.shape[-1] + OTHERS, samples.features.shape[1]
    member = _Member(_first_weights(inputs, features, shape, rng))
    target = samples.is_disc * (1.0 - 2.0 * _SMOOTHING) + _SMOOTHING
    weight = samples.weight / samples.weight[used].mean()
    first = [np.zeros_like(w) for w in member.weights]
    second = [np.zeros_like(w) for w in member.weights]
    steps = shape.epochs * -(-len(used) // _BATCH)
    others = used[~samples.is_disc[used]]
    orders = (rng.permutation(used) for _ in range(shape.epochs))
    batches = (order[k : k + _BATCH] for order in orders for k in range(0, len(order), _BATCH))
    for t, chosen in enumerate(batches, 1):
        batch = _varied(samples, chosen, others, rng)
        odds = member.log_odds(batch)
        d_odds = (expit(odds) - target[chosen]) * weight[chosen] / len(chosen)
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


def train(samples: Samples, used: NDArray[np.bool_], shape: Shape, seed: int) -> RimNetwork:
    """Train networks on some of the samples. `used` (N,)."""
    index = np.flatnonzero(used)
    mean, deviation = samples.features[used].mean(axis=0), samples.features[used].std(axis=0) + 1e-6
    alike = samples._replace(features=(samples.features - mean) / deviation)
    with ThreadPoolExecutor() as pool:  # NumPy releases the interpreter lock most of the time
        seeds = range(seed, seed + shape.members)
        trained = pool.map(lambda own: _train_member(alike, index, shape, own).weights, seeds)
        members = list(trained)
    around, around_bias, again, again_bias, dense, dense_bias, out, out_bias = (
        np.stack(layer) for layer in zip(*members, strict=True)
    )
    by_unit, by_feature = out[:, : shape.units, 0], out[:, shape.units :, 0] / deviation
    return RimNetwork(
        around.reshape(shape.members, 3, -1, shape.channels), around_bias,
        again.reshape(shape.members, 3, -1, shape.channels), again_bias, dense, dense_bias,
        np.c_[by_unit, by_feature].astype(np.float32),
        (out_bias[:, 0] - by_feature @ mean).astype(np.float32),
    )  # fmt: skip


def train_prescreening(sparse: Samples, used: NDArray[np.bool_], seed: int) -> RimNetwork:
    """As `train`, for a network above 0 for all but a few of the discs."""
    network = train(sparse, used, SHAPES["prescreening"], seed)
    discs = used & sparse.is_disc
    seen = _seen(sparse.grey[discs, 0], sparse.pixels_per_radius[discs, 0])
    odds = network_log_odds(*seen, sparse.features[discs], network, (-np.inf, np.inf))
    least = np.quantile(odds, _LOST_BY_PRESCREENING).astype(np.float32)
    return network._replace(out_bias=network.out_bias - least)


def train_all(sparse: Samples, rims: Samples, members: int, seed: int) -> Networks:
    """The networks of the detector, by all sparse profiles and rims."""
    shape = SHAPES["classifier"]._replace(members=members)
    return Networks(
        train_prescreening(sparse, np.ones(len(sparse.is_disc), np.bool_), seed),
        train(rims, np.ones(len(rims.is_disc), np.bool_), shape, seed),
    )


@dataclass(frozen=True)
class TrainRimNetwork(Study):
    """Train the networks that judge candidates of discs."""

    data: Positional[Path] = Path("../shared/data")  # Folder with `rendered`, `york` and `dlr`.
    frames: int = 1000  # The first frames of the recorded run, of which some are used.
    every: int = 2  # Every n-th of them is used.
    members: int = SHAPES["classifier"].members  # Networks of which the classifier is the mean.
    scenes: int = 1500  # Rendered floors with disturbed discs.
    without: str = ""  # Folder of a rendered building that is not used.
    seed: int = 1  # Of the disturbances and the networks.
    output: Path = Path("build/rim_network.npz")
    """Where the weights go, which replace `detect/discs/rim_network.npz`."""
    force: bool = False  # Replace that file.

    def measure(self) -> Figures:
        sparse, rims = gather(
            self.data, slice(0, self.frames, self.every), self.scenes, self.seed, self.without
        )
        for kind, of in (("candidates", sparse), ("rims", rims)):
            print(f"{len(of.is_disc)} {kind}, {of.is_disc.sum()} at discs")
        networks = train_all(sparse, rims, self.members, self.seed)
        self.output.parent.mkdir(parents=True, exist_ok=True)
        weights: dict[str, Any] = {
            f"{sort}_{name}": values
            for sort, network in networks._asdict().items()
            for name, values in network._asdict().items()
        }
        with write_whole(self.output, overwrite=self.force) as stream:
            np.savez(stream, **weights)
        print(f"{self.output}: {sum(array.size for array in weights.values())} weights")
        return {}
