"""The network of rims as its equation is written."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detect.discs.rim_network import RimNetwork

FloatArray = NDArray[np.floating]


def inputs_of(
    grey: FloatArray, pixels_per_radius: FloatArray, sign: float
) -> tuple[FloatArray, FloatArray]:
    """See `detect.discs.rim_network.network_inputs`; the inputs as (K, I)."""
    values = sign * grey
    outside = np.isnan(values)
    off = values - np.nanmean(values)
    deviation = np.sqrt(np.nanmean(off**2) + 9.0)
    size = np.log(pixels_per_radius) - 1.5
    inputs = np.column_stack([np.nan_to_num(off / deviation), size, outside.mean(axis=1)])
    return inputs, np.array([size.mean(), np.log(deviation) - 2.5])


def log_odds_of(
    inputs: FloatArray, scales: FloatArray, features: FloatArray, network: RimNetwork,
    doubtful: tuple[float, float],
) -> float:  # fmt: skip
    """See `detect.discs.rim_network.network_log_odds`."""
    odds: list[float] = []
    for member in range(len(network.out)):
        if odds and not doubtful[0] <= np.mean(odds) <= doubtful[1]:
            break
        w = RimNetwork(*(array[member] for array in network))
        a = _relu(_convolved(inputs, w.around) + w.around_bias)
        b = _relu(_convolved(a, w.again) + w.again_bias)
        pooled = np.concatenate([b.mean(axis=0), b.max(axis=0), b.min(axis=0), scales])
        c = _relu(pooled @ w.dense + w.dense_bias)
        odds.append(w.out @ np.concatenate([c, features]) + w.out_bias)
    return float(np.mean(odds))


def _convolved(values: FloatArray, weights: FloatArray) -> FloatArray:
    before, same, after = weights
    after_it, before_it = np.roll(values, -1, axis=0), np.roll(values, 1, axis=0)
    return np.asarray(before_it @ before + values @ same + after_it @ after)


def _relu(values: FloatArray) -> FloatArray:
    return np.maximum(values, 0.0)
