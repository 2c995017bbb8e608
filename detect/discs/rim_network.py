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
    grey: FloatArray, pixels_per_radius: FloatArray, sign: float
) -> tuple[_Weights, _Weights]:
    """The input of a network for (K, M) grey values in K directions at M distances.

    Grey values are NaN outside the image. `sign` is -1 for a dark disc, which is seen as a light
    one. The inputs (M + OTHERS, K + 2) are deviations from the mean relative to their root mean
    square, 0 outside the image; the logarithm of the pixels per radius; the share outside. They are
    padded by the last direction in front and the first at the end. The scales are logarithms of the
    pixels per radius and of the root mean square, relative to usual ones.
    """
    directions, distances = grey.shape
    inputs = np.zeros((distances + OTHERS, directions + 2), np.float32)
    total = squares = size = 0.0
    n = 0
    for k in range(directions):
        for m in range(distances):
            value = grey[k, m]
            if value == value:
                total += value
                squares += value * value
                n += 1
    mean = total / max(n, 1)
    deviation = math.sqrt(squares / max(n, 1) - mean * mean + _NOISE)
    for k in range(directions):
        outside = 0
        for m in range(distances):
            value = grey[k, m]
            if value == value:
                inputs[m, k + 1] = sign * (value - mean) / deviation
            else:
                outside += 1
        log_size = math.log(pixels_per_radius[k]) - 1.5
        size += log_size
        inputs[distances, k + 1] = log_size
        inputs[distances + 1, k + 1] = outside / distances
    for i in range(distances + OTHERS):
        inputs[i, 0], inputs[i, directions + 1] = inputs[i, directions], inputs[i, 1]
    scales = np.empty(SCALES, np.float32)
    scales[0] = size / directions
    scales[1] = math.log(deviation) - 2.5
    return inputs, scales


@kernel(fastmath={"contract"})
def _convolve(values: _Weights, weights: _Weights, bias: _Weights) -> _Weights:
    """Convolution over three neighbours on a circle, and relu, as (C, K + 2) float32."""
    result = np.empty((len(bias), values.shape[1]), np.float32)
    directions = values.shape[1] - 2
    for c in range(len(bias)):
        row = result[c, 1:]
        for k in range(directions):
            row[k] = bias[c]
        for i in range(len(values)):
            seen = values[i]
            before, same, after = weights[0, i, c], weights[1, i, c], weights[2, i, c]
            for k in range(directions):
                row[k] += before * seen[k] + same * seen[k + 1] + after * seen[k + 2]
        for k in range(directions):
            row[k] = max(row[k], np.float32(0.0))
        result[c, 0], row[directions] = row[directions - 1], row[0]
    return result


@kernel()
def network_log_odds(
    inputs: _Weights, scales: _Weights, features: FloatArray, network: RimNetwork
) -> float:
    """Log-odds that a rim with (F,) features is a disc's, the mean of the networks."""
    members, channels = network.around_bias.shape
    units = network.dense_bias.shape[1]
    directions = inputs.shape[1] - 2
    odds = np.float64(0.0)
    pooled = np.empty(3 * channels + len(scales), np.float32)
    for i in range(len(scales)):
        pooled[3 * channels + i] = scales[i]
    for n in range(members):
        around = _convolve(inputs, network.around[n], network.around_bias[n])
        again = _convolve(around, network.again[n], network.again_bias[n])
        for c in range(channels):
            total = most = least = again[c, 1]
            for k in range(2, directions + 1):
                total += again[c, k]
                most = max(most, again[c, k])
                least = min(least, again[c, k])
            pooled[c] = total / np.float32(directions)
            pooled[channels + c], pooled[2 * channels + c] = most, least
        odds += network.out_bias[n]
        for d in range(units):
            unit = network.dense_bias[n, d]
            for i in range(len(pooled)):
                unit += pooled[i] * network.dense[n, i, d]
            odds += max(unit, np.float32(0.0)) * network.out[n, d]
        for f in range(len(features)):
            odds += features[f] * network.out[n, units + f]
        if n == 0 and not HOPELESS <= odds <= CERTAIN:
            return float(odds)
    return float(odds / members)
