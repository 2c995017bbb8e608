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
are averaged; if the first is certain, the others are skipped. There are two kinds: one glances at
every candidate, the other decides about those whose rim was traced.
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
#: Log-odds of the first network below and above which the others are skipped.
HOPELESS, CERTAIN = -4.0, 5.0

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

    glance: RimNetwork
    look: RimNetwork


@cache
def trained_networks() -> Networks:
    """The networks that the detector uses."""
    with np.load(WEIGHTS_FILE, allow_pickle=False) as weights:
        glance, look = (
            RimNetwork(
                *(np.ascontiguousarray(weights[f"{sort}_{name}"]) for name in RimNetwork._fields)
            )
            for sort in Networks._fields
        )
    return Networks(glance, look)


@kernel()
def network_inputs(
    grey: FloatArray, pixels_per_radius: FloatArray, sign: FloatArray
) -> tuple[_Weights, _Weights]:
    """The input of a network for (N, K, M) grey values of N rims in K directions at M distances.

    Grey values are NaN outside the image. `sign` (N,) is -1 for a dark disc, which is seen as a
    light one. The inputs (M + OTHERS, N, K + 2) are deviations from the mean relative to their root
    mean square, 0 outside the image; the logarithm of the pixels per radius; the share outside.
    They are padded by the last direction in front and the first at the end. The scales (N, SCALES)
    are logarithms of the pixels per radius and of the root mean square, relative to usual ones.
    """
    rims, directions, distances = grey.shape
    inputs = np.zeros((distances + OTHERS, rims, directions + 2), np.float32)
    scales = np.empty((rims, SCALES), np.float32)
    for r in range(rims):
        total = squares = size = 0.0
        n = 0
        for k in range(directions):
            for m in range(distances):
                value = grey[r, k, m]
                if value == value:
                    total += value
                    squares += value * value
                    n += 1
        mean = total / max(n, 1)
        deviation = math.sqrt(squares / max(n, 1) - mean * mean + _NOISE)
        for k in range(directions):
            outside = 0
            for m in range(distances):
                value = grey[r, k, m]
                if value == value:
                    inputs[m, r, k + 1] = sign[r] * (value - mean) / deviation
                else:
                    outside += 1
            log_size = math.log(pixels_per_radius[r, k]) - 1.5
            size += log_size
            inputs[distances, r, k + 1] = log_size
            inputs[distances + 1, r, k + 1] = outside / distances
        for i in range(distances + OTHERS):
            inputs[i, r, 0] = inputs[i, r, directions]
            inputs[i, r, directions + 1] = inputs[i, r, 1]
        scales[r, 0] = size / directions
        scales[r, 1] = math.log(deviation) - 2.5
    return inputs, scales


@kernel(fastmath={"contract"})
def _convolve(values: _Weights, weights: _Weights, bias: _Weights) -> _Weights:
    """Convolution over three neighbours on N circles, and relu, as (C, N, K + 2) float32.

    The circles are one row: the two values between circles, which are wrong, are overwritten.
    """
    channels, rims, padded = len(bias), values.shape[1], values.shape[2]
    seen = values.reshape(len(values), rims * padded)
    result = np.empty((channels, rims * padded), np.float32)
    inner = rims * padded - 2
    for c in range(channels):
        row = result[c, 1:]
        for k in range(inner):
            row[k] = bias[c]
        for i in range(len(seen)):
            of = seen[i]
            before, same, after = weights[0, i, c], weights[1, i, c], weights[2, i, c]
            for k in range(inner):
                row[k] += before * of[k] + same * of[k + 1] + after * of[k + 2]
        for k in range(inner):
            row[k] = max(row[k], np.float32(0.0))
        for first in range(0, rims * padded, padded):
            result[c, first] = result[c, first + padded - 2]
            result[c, first + padded - 1] = result[c, first + 1]
    return result.reshape(channels, rims, padded)


@kernel()
def _member_log_odds(
    inputs: _Weights, scales: _Weights, features: FloatArray, network: RimNetwork, n: int
) -> FloatArray:
    """(N,) log-odds by the n-th network."""
    channels, units = network.around_bias.shape[1], network.dense_bias.shape[1]
    rims, directions = inputs.shape[1], inputs.shape[2] - 2
    around = _convolve(inputs, network.around[n], network.around_bias[n])
    again = _convolve(around, network.again[n], network.again_bias[n])
    pooled = np.empty(3 * channels + SCALES, np.float32)
    odds = np.full(rims, np.float64(network.out_bias[n]))
    for r in range(rims):
        for c in range(channels):
            total = most = least = again[c, r, 1]
            for k in range(2, directions + 1):
                total += again[c, r, k]
                most = max(most, again[c, r, k])
                least = min(least, again[c, r, k])
            pooled[c] = total / np.float32(directions)
            pooled[channels + c], pooled[2 * channels + c] = most, least
        for i in range(SCALES):
            pooled[3 * channels + i] = scales[r, i]
        for d in range(units):
            unit = network.dense_bias[n, d]
            for i in range(len(pooled)):
                unit += pooled[i] * network.dense[n, i, d]
            odds[r] += max(unit, np.float32(0.0)) * network.out[n, d]
        for f in range(features.shape[1]):
            odds[r] += features[r, f] * network.out[n, units + f]
    return odds


@kernel()
def network_log_odds(
    inputs: _Weights, scales: _Weights, features: FloatArray, network: RimNetwork
) -> FloatArray:
    """(N,) log-odds that rims with (N, F) features are those of discs, the mean of the networks."""
    odds = _member_log_odds(inputs, scales, features, network, 0)
    unsure = (odds >= HOPELESS) & (odds <= CERTAIN)
    members = len(network.out_bias)
    if members > 1 and unsure.any():
        for n in range(1, members):
            odds += unsure * _member_log_odds(inputs, scales, features, network, n)
        odds /= np.where(unsure, members, 1)
    return odds
