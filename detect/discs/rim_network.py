"""Log-odds that a rim is a disc's, by the grey values about it: a small convolutional network.

Far away a disc is some ten pixels wide and three to six rows high. Whether it is one, a person sees
by the picture as a whole: where the floor goes on behind a cable, how glare fades. The network sees
what `detect.discs.rim.profiles` samples, 32 directions times 16 distances, so that perspective and
the size of the disc in the image are taken out already. It goes round the circle of directions
twice (convolutions over three neighbours, the first of which sees whole profiles), keeps the mean,
the greatest and the least of each channel, and weighs these together with some features of the rim:

    a = relu(W1 * x + b1), b = relu(W2 * a + b2), c = relu(W3 [mean b, max b, min b, scale] + b3)
    log-odds = w4 [c, features] + b4

A turn of the disc turns a and b and changes nothing else. Networks that were trained from several
seeds are averaged. Their weights, some 2,000 each, are trained by `python -m tools.evaluation
train-rim-network`.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.rim import DIRECTIONS, STEPS

WEIGHTS_FILE = Path(__file__).with_name("rim_network.npz")
#: Of each direction the network sees grey values, the size in the image, and what is outside it.
DISTANCES = STEPS // 2
INPUTS = DISTANCES + 2
#: And of all directions together: size and contrast.
SCALES = 2
#: Of the grey values' deviations, grey levels squared: less contrast than this is noise.
_NOISE = 9.0

_Weights = NDArray[np.float32]


class RimNetwork(NamedTuple):
    """Weights of N networks of C channels and D dense units.

    Attributes
    ----------
    around : (N, 3, INPUTS, C) float32
        First convolution: of the direction before, the same and the next one.
    around_bias : (N, C) float32
    again : (N, 3, C, C) float32
        Second convolution.
    again_bias : (N, C) float32
    dense : (N, 3 C + SCALES, D) float32
        Of the means, greatest and least of the channels, and the scales.
    dense_bias : (N, D) float32
    out : (N, D + F) float32
        Of the dense units and F features of the rim.
    out_bias : (N,) float32
    quick : (2 F + 1,) float64
        Weights of the features, of their squares, and a constant: a rim below 0 is left out before
        any network sees it.
    """

    around: _Weights
    around_bias: _Weights
    again: _Weights
    again_bias: _Weights
    dense: _Weights
    dense_bias: _Weights
    out: _Weights
    out_bias: _Weights
    quick: NDArray[np.float64]


@cache
def rim_network() -> RimNetwork:
    """The trained network."""
    with np.load(WEIGHTS_FILE, allow_pickle=False) as weights:
        return RimNetwork(*(np.ascontiguousarray(weights[name]) for name in RimNetwork._fields))


@njit(cache=True, error_model="numpy", nogil=True)
def worth_the_network(features: NDArray[np.float64], network: RimNetwork) -> bool:
    """Whether the features of a rim alone leave it a chance to be a disc's."""
    n = len(features)
    odds = network.quick[2 * n]
    for f in range(n):
        odds += features[f] * (network.quick[f] + features[f] * network.quick[n + f])
    return bool(odds >= 0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def network_inputs(
    grey: NDArray[np.float64], pixels_per_radius: NDArray[np.float64], sign: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What the network sees of the profiles about a rim.

    Parameters
    ----------
    grey : (DIRECTIONS, STEPS) float64
    pixels_per_radius : (DIRECTIONS,) float64
        Of `detect.discs.rim.profiles`.
    sign : float
        1 for a light disc, -1 for a dark one, which is seen as a light one.

    Returns
    -------
    inputs : (DIRECTIONS, INPUTS) float32
        Deviations from the mean grey value relative to their root mean square, means of two steps
        each, 0 outside the image; logarithm of the pixels per radius; share outside the image.
    scales : (SCALES,) float32
        Logarithms of the pixels per radius and of the root mean square, less usual ones.
    """
    inputs = np.zeros((DIRECTIONS, INPUTS), np.float32)
    total = 0.0
    n = 0
    for k in range(DIRECTIONS):
        for m in range(DISTANCES):
            value = 0.5 * (grey[k, 2 * m] + grey[k, 2 * m + 1])
            if value == value:
                total += value
                n += 1
    mean = total / max(n, 1)
    squares = 0.0
    for k in range(DIRECTIONS):
        outside = 0
        for m in range(DISTANCES):
            value = 0.5 * (grey[k, 2 * m] + grey[k, 2 * m + 1])
            if value == value:
                inputs[k, m] = sign * (value - mean)
                squares += (value - mean) ** 2
            else:
                outside += 1
        inputs[k, DISTANCES] = math.log(pixels_per_radius[k]) - 1.5
        inputs[k, DISTANCES + 1] = outside / DISTANCES
    deviation = math.sqrt(squares / max(n, 1) + _NOISE)
    for k in range(DIRECTIONS):
        for m in range(DISTANCES):
            inputs[k, m] /= np.float32(deviation)
    scales = np.empty(SCALES, np.float32)
    scales[0] = np.mean(inputs[:, DISTANCES])
    scales[1] = math.log(deviation) - 2.5
    return inputs, scales


@njit(cache=True, error_model="numpy", nogil=True)
def _convolve(
    values: NDArray[np.float32], weights: NDArray[np.float32], bias: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Convolution over three neighbours on a circle, and relu: (DIRECTIONS, C) float32."""
    directions, inputs = values.shape
    result = np.empty((directions, len(bias)), np.float32)
    for k in range(directions):
        row = result[k]
        for c in range(len(bias)):
            row[c] = bias[c]
        for tap in range(3):
            seen = values[(k + tap - 1) % directions]
            for i in range(inputs):
                for c in range(len(bias)):
                    row[c] += seen[i] * weights[tap, i, c]
        for c in range(len(bias)):
            row[c] = max(row[c], np.float32(0.0))
    return result


@njit(cache=True, error_model="numpy", nogil=True)
def network_log_odds(
    inputs: NDArray[np.float32],
    scales: NDArray[np.float32],
    features: NDArray[np.float64],
    network: RimNetwork,
) -> float:
    """Log-odds that a rim is a disc's: the mean of the networks.

    Parameters
    ----------
    inputs, scales : (DIRECTIONS, INPUTS), (SCALES,) float32
        Of `network_inputs`.
    features : (F,) float64
        Of the rim.
    network : RimNetwork
    """
    members, channels = network.around_bias.shape
    units = network.dense_bias.shape[1]
    total = 0.0
    pooled = np.empty(3 * channels + len(scales), np.float32)
    for i in range(len(scales)):
        pooled[3 * channels + i] = scales[i]
    for n in range(members):
        around = _convolve(inputs, network.around[n], network.around_bias[n])
        again = _convolve(around, network.again[n], network.again_bias[n])
        for c in range(channels):
            pooled[c] = np.mean(again[:, c])
            pooled[channels + c] = np.max(again[:, c])
            pooled[2 * channels + c] = np.min(again[:, c])
        odds = np.float64(network.out_bias[n])
        for d in range(units):
            unit = network.dense_bias[n, d]
            for i in range(len(pooled)):
                unit += pooled[i] * network.dense[n, i, d]
            odds += max(unit, np.float32(0.0)) * network.out[n, d]
        for f in range(len(features)):
            odds += features[f] * network.out[n, units + f]
        total += odds
    return float(total / members)
