"""Blur of what pixels see of a flat disc, across the steep image axis."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model_kernels import BY_BLUR, CAPACITY, F32, FASTMATH, FIELDS

_0, _2 = F32(0.0), F32(2.0)
#: A sampled Gaussian is narrower than the continuous one where it is below this (pixels).
_WELL_SAMPLED_PX = 0.8
#: Weights of the blur reach this many deviations, and a pixel more.
_REACH = 3.0


@njit(cache=True, error_model="numpy", forceinline=True)
def blur_weights(blur: float, weights: NDArray[np.float32]) -> int:
    """Gaussian weights 0 ... k of a blur on a grid of pixels, and k, its reach (see `weights`).

    Their sum (both sides) is 1 and their variance blur^2, exactly so also where the blur is well
    below a pixel: there the sampled Gaussian is one of a different width, found by Newton's method.
    """
    variance = blur * blur
    if blur < _WELL_SAMPLED_PX:
        # With q = exp(-1 / (2 s^2)) the weight n is q^(n^2).
        q = min(0.5 * variance, 0.25)
        for _ in range(6):
            q4 = q * q * q * q
            q9 = q4 * q4 * q
            value = 2.0 * (q + 4.0 * q4 + 9.0 * q9) - variance * (1.0 + 2.0 * (q + q4 + q9))
            slope = 2.0 + 32.0 * q4 / q + 162.0 * q9 / q
            slope -= variance * (2.0 + 8.0 * q4 / q + 18.0 * q9 / q)
            q -= value / slope
    else:
        q = math.exp(-0.5 / variance)
    reach = min(int(_REACH * blur) + 1, len(weights) - 1)
    total = 1.0
    weight = 1.0
    ratio = q
    weights[0] = 1.0
    for k in range(1, reach + 1):
        # q^(k^2) = q^((k - 1)^2) q^(2 k - 1)
        weight *= ratio
        ratio *= q * q
        weights[k] = weight
        total += 2.0 * weight
    for k in range(reach + 1):
        weights[k] /= total
    return reach


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _sum_of_three(
    middle: NDArray[np.float32],
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    weight: float,
    weight_aside: float,
    result: NDArray[np.float32],
) -> None:
    for i in range(len(result)):
        result[i] = weight * middle[i] + weight_aside * (left[i] + right[i])


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _add_four(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    next_left: NDArray[np.float32],
    next_right: NDArray[np.float32],
    weight: float,
    next_weight: float,
    result: NDArray[np.float32],
) -> None:
    for i in range(len(result)):
        result[i] += weight * (left[i] + right[i]) + next_weight * (next_left[i] + next_right[i])


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def _add_second_difference(
    values: NDArray[np.float32], scale: float, result: NDArray[np.float32]
) -> None:
    for i in range(len(result)):
        result[i] += scale * (values[i] - _2 * values[i + 1] + values[i + 2])


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def blur_across(
    shares: NDArray[np.float32],
    n: int,
    margin: int,
    first: int,
    last: int,
    blur: float,
    weights: NDArray[np.float32],
    fields: NDArray[np.float32],
) -> tuple[int, int]:
    """Blur `chord_shares` across the steep axis.

    Parameters
    ----------
    shares : (5 * CAPACITY,) float32
        The shares of n pixels, line after line. Each line has a margin at both of its ends that
        is longer than the blur reaches: blurred across the lines' ends, it gets wrong values.
    n, margin : int
        Pixels altogether, and of a margin.
    first, last : int
        Before the first and from the last on all shares are 0.
    blur : float
        Standard deviation, pixels.
    weights : (K,) float32
        Working space; K - 1 is the longest reach.
    fields : (5 * CAPACITY,) float32
        Result, in the same layout.

    Returns
    -------
    int, int
        The same for the result.
    """
    reach = min(blur_weights(blur, weights), margin - 2)
    # One pixel more on either side, for the second derivative.
    begin = min(max(margin - 1, first - reach - 2), n - margin - 1)
    end = max(min(n - margin + 1, last + reach + 2), begin + 2)
    length = end - begin
    for field in range(FIELDS):
        at = field * CAPACITY + begin
        result = fields[at : at + length]
        _sum_of_three(
            shares[at:], shares[at - 1 :], shares[at + 1 :], weights[0], weights[1], result
        )
        for k in range(2, reach + 1, 2):
            next_weight = weights[k + 1] if k < reach else _0
            _add_four(
                shares[at - k :], shares[at + k :], shares[at - k - 1 :], shares[at + k + 1 :],
                weights[k], next_weight, result,
            )  # fmt: skip
        fields[field * CAPACITY : at] = _0
        fields[at + length : field * CAPACITY + n] = _0
    # d/dlog(blur) of a Gaussian blur of variance t is t times the second derivative.
    _add_second_difference(
        fields[begin:end],
        F32(blur * blur),
        fields[BY_BLUR * CAPACITY + begin + 1 : BY_BLUR * CAPACITY + end - 1],
    )
    return begin, end
