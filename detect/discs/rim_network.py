"""Log-odds that a rim is a disc's, from the grey values around it: a small convolutional network.

A distant disc is some ten pixels wide and three to six rows high. A person recognises it by the
picture as a whole: the floor continues behind a cable, glare fades. The network's input are grey
values sampled at several directions and distances from the centre, so that perspective and the size
of the disc in the image are removed already. It applies two convolutions over three neighbours
around the circle of directions (the first of which sees whole profiles), pools the mean, maximum
and minimum of each channel, and weighs these together with some features of the rim:

    a = relu(W1 * x + b1), b = relu(W2 * a + b2), c = relu(W3 [mean b, max b, min b, scale] + b3)
    log-odds = w4 [c, features] + b4

A rotation of the disc rotates a and b and changes nothing else. Networks trained from several seeds
are averaged until their mean is certain. There are two kinds: one prescreens all candidates,
several of them at once, the other decides about those whose rim was traced.
`python -m tools.evaluation train-rim-network` trains both.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from redetect.array_types import Float32Array, FloatArray
from redetect.compiled import kernel

WEIGHTS_FILE = Path(__file__).with_name("rim_network.npz")
#: Besides grey values, inputs are each direction's size in the image and its share outside it
#: (`OTHERS`), and size and contrast over all directions (`SCALES`).
OTHERS, SCALES = 2, 2
#: Added to the variance of the grey values, grey levels squared: less contrast than this is noise.
_NOISE = 9.0
#: Mean log-odds between which further networks are asked: in the prescreening, whose networks all
#: pass nearly all discs, and about rims.
DOUBTFUL_CANDIDATE, DOUBTFUL_RIM = (-0.6, 0.6), (-3.0, 3.0)

_Weights = Float32Array


class RimNetwork(NamedTuple):
    """Weights of N networks of I inputs for each direction, C channels and D dense units."""

    around: _Weights  # (N, 3, I, C) first convolution: the direction before, the same, the next one
    around_bias: _Weights  # (N, C)
    again: _Weights  # (N, 3, C, C) second convolution
    again_bias: _Weights  # (N, C)
    dense: _Weights  # (N, 3 C + SCALES, D) of channels' means, maxima and minima, and scales
    dense_bias: _Weights  # (N, D)
    out: _Weights  # (N, D + F) of the dense units and F features of the rim
    out_bias: _Weights  # (N,)


class Networks(NamedTuple):
    """One decides whether the rim of a candidate is traced, the other whether it is a disc's."""

    prescreening: RimNetwork
    classifier: RimNetwork


@cache
def trained_networks() -> Networks:
    """The networks that the detector uses."""
    with np.load(WEIGHTS_FILE, allow_pickle=False) as weights:
        prescreening, classifier = (
            RimNetwork(
                *(np.ascontiguousarray(weights[f"{sort}_{name}"]) for name in RimNetwork._fields)
            )
            for sort in Networks._fields
        )
    return Networks(prescreening, classifier)


@kernel()
def network_inputs(
    grey: Float32Array, pixels_per_radius: FloatArray, sign: FloatArray
) -> tuple[_Weights, _Weights]:
    """The input of a network for N samples: (N, K, M) grey values in K directions at M distances.

    Grey values are NaN outside the image. `sign` (N,) is -1 for dark discs, which are seen as light
    ones. The inputs (M + OTHERS, (K + 2) N) are deviations from the mean relative to their root
    mean square, 0 outside the image; the logarithm of the pixels per radius; the share outside.
    Samples follow each other in each direction; the last direction is repeated in front, the first
    at the end. The scales (N, SCALES) are logarithms of the pixels per radius and of the root mean
    square, relative to usual ones.
    """
    samples, directions, distances = grey.shape
    inputs = np.zeros((distances + OTHERS, (directions + 2) * samples), np.float32)
    scales = np.empty((samples, SCALES), np.float32)
    for sample in range(samples):
        total = squares = size = 0.0
        n = 0
        for k in range(directions):
            sum_k = squares_k = 0.0  # sums by direction do not wait for each other
            for m in range(distances):
                value = np.float64(grey[sample, k, m])
                if value == value:
                    sum_k += value
                    squares_k += value * value
                    n += 1
            total += sum_k
            squares += squares_k
        mean = total / max(n, 1)
        deviation = math.sqrt(squares / max(n, 1) - mean * mean + _NOISE)
        scale = sign[sample] / deviation
        for k in range(directions):
            column, outside = (k + 1) * samples + sample, 0
            for m in range(distances):
                value = np.float64(grey[sample, k, m])
                if value == value:
                    inputs[m, column] = scale * (value - mean)
                else:
                    outside += 1
            log_size = math.log(np.float32(pixels_per_radius[sample, k])) - 1.5
            size += log_size
            inputs[distances, column] = log_size
            inputs[distances + 1, column] = outside / distances
        scales[sample, 0] = size / directions
        scales[sample, 1] = math.log(deviation) - 2.5
    _pad(inputs, samples)
    return inputs, scales


@kernel()
def _pad(values: _Weights, samples: int) -> None:
    """Put the last direction of the samples before their first, and the first behind the last."""
    for row in values:
        for first in range(samples):
            last = len(row) - 1 - first
            row[first], row[last] = row[first - 2 * samples], row[2 * samples - 1 - first]


@kernel(fastmath={"contract"})
def _convolve(values: _Weights, weights: _Weights, bias: _Weights, samples: int) -> _Weights:
    """Convolution over three neighbours on a circle, and relu, as (C, (K + 2) N) float32."""
    result = np.zeros((len(bias), values.shape[1]), np.float32)
    # Over directions and samples at once, so that loops are long and what they load is aligned.
    step, inner = np.uint64(samples), np.uint64(values.shape[1] - 2 * samples)
    for c in range(len(bias)):
        row = result[c, samples:]
        for k in range(inner):
            row[k] = bias[c]
        for i in range(len(values)):
            seen = values[i]
            before, same, after = weights[0, i, c], weights[1, i, c], weights[2, i, c]
            for k in range(inner):
                row[k] += before * seen[k] + same * seen[k + step] + after * seen[k + step + step]
        for k in range(inner):
            row[k] = max(row[k], np.float32(0.0))
    _pad(result, samples)
    return result


@kernel()
def _pool(values: _Weights, scales: _Weights) -> _Weights:
    """(N, 3 C + SCALES) mean, maximum and minimum of channels of N samples, and their scales."""
    channels, samples = len(values), len(scales)
    pooled = np.empty((samples, 3 * channels + scales.shape[1]), np.float32)
    for sample in range(samples):
        for c in range(channels):
            row = values[c, samples + sample : -samples : samples]
            total, most, least = np.float32(0.0), row[0], row[0]
            for k in range(len(row)):
                total += row[k]
                most, least = max(most, row[k]), min(least, row[k])
            pooled[sample, c] = total / np.float32(len(row))
            pooled[sample, channels + c], pooled[sample, 2 * channels + c] = most, least
        for i in range(scales.shape[1]):
            pooled[sample, 3 * channels + i] = scales[sample, i]
    return pooled


@kernel()
def network_log_odds(
    inputs: _Weights, scales: _Weights, features: FloatArray, network: RimNetwork,
    doubtful: tuple[float, float],
) -> FloatArray:  # fmt: skip
    """(N,) log-odds that rims with (N, F) features are discs', the mean of the networks.

    Further networks see only those whose mean so far is within `doubtful`.
    """
    samples, (members, units) = len(scales), network.dense_bias.shape
    odds = np.zeros(samples)
    left = np.arange(samples)
    for n in range(members):
        if n > 0:
            again = np.flatnonzero((odds[left] >= doubtful[0]) & (odds[left] <= doubtful[1]))
            some = inputs.reshape(len(inputs), -1, len(left))[:, :, again]
            inputs, left = some.reshape(len(inputs), -1), left[again]
        if len(left) == 0:
            break
        around = _convolve(inputs, network.around[n], network.around_bias[n], len(left))
        around = _convolve(around, network.again[n], network.again_bias[n], len(left))
        pooled = _pool(around, scales[left])
        for j in range(len(left)):
            sample = left[j]
            dense = network.dense_bias[n].copy()
            for i in range(pooled.shape[1]):
                for d in range(units):
                    dense[d] += pooled[j, i] * network.dense[n, i, d]
            value = np.float64(network.out_bias[n])
            for d in range(units):
                value += max(dense[d], np.float32(0.0)) * network.out[n, d]
            for f in range(features.shape[1]):
                value += features[sample, f] * network.out[n, units + f]
            # The mean so far.
            odds[sample] += (value - odds[sample]) / (n + 1)
    return odds
