"""What is inside and outside the rim of a candidate, direction by direction.

A disc beside glare, across a shadow's edge or under a cable still has one grey value inside, and
steps by about the same to whatever is outside, in all directions but the disturbed ones. Clutter
whose rim happens to lie on a circle does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.rim import DIRECTIONS, FARTHEST, NEAREST, STEPS, Rim, profiles

#: Grey values up to here are inside, and between the other two outside, in radii of the rim.
_INSIDE, _OUTSIDE_FROM, _OUTSIDE_TO = 0.78, 1.22, 1.6
#: Directions with this share of the rim's step are good ones.
_LEAST_STEP = 0.4
_LEAST_GOOD = 5
_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
_AT = np.linspace(NEAREST, FARTHEST, STEPS)
_IS_INSIDE = _AT < _INSIDE
_IS_OUTSIDE = (_AT > _OUTSIDE_FROM) & (_AT < _OUTSIDE_TO)


class Sectors(NamedTuple):
    """Levels in the directions from the middle of a rim; grey levels relative to the step."""

    good: float
    """Share of all directions that step as the rim does."""
    runs: int
    """Stretches of other directions."""
    step: float
    """Median step of the good directions, grey levels."""
    within: float
    """Mean deviation from the levels along the good directions."""
    slope_inside: float
    """Root mean square of the inner levels of the good directions about a plane,"""
    slope_outside: float
    """and of the outer ones."""
    other_inside: float
    """Share of all directions whose inner level is not the good ones'."""
    spread_inside: float
    """Median deviation of the inner levels of all directions from the good ones'."""
    spread_outside: float
    """The same of the outer levels."""
    middle: float
    """Deviation of the nearest grey values in all directions from the good ones' inner level."""


NOTHING = Sectors(0.0, 0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)


@njit(cache=True, error_model="numpy", nogil=True)
def sector_levels(
    image: NDArray[np.uint8], camera_numbers: NDArray[np.float64], rim: Rim, sign: float
) -> Sectors:
    """Levels inside and outside a rim.

    Parameters
    ----------
    image : (H, W) uint8
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    rim : Rim
        Where `detect.discs.rim.follow_rim` found it.
    sign : float
        1 for a light disc, -1 for a dark one.

    Returns
    -------
    Sectors
        `NOTHING` where hardly any direction steps.
    """
    grey, _ = profiles(image, camera_numbers, rim.x, rim.y, rim.radius)
    inside = np.zeros(DIRECTIONS)
    outside = np.zeros(DIRECTIONS)
    within = np.zeros(DIRECTIONS)
    nearest = np.zeros(DIRECTIONS)
    seen = np.zeros(DIRECTIONS, np.bool_)
    for k in range(DIRECTIONS):
        inside[k], n, inner_off = _level(grey, k, _IS_INSIDE)
        outside[k], m, outer_off = _level(grey, k, _IS_OUTSIDE)
        seen[k] = n > 0 and m > 0
        within[k] = inner_off + outer_off
        nearest[k] = grey[k, 0]
    good = seen & (sign * (inside - outside) > _LEAST_STEP * abs(rim.step))
    count = np.sum(good)
    if count < _LEAST_GOOD:
        return NOTHING
    step = float(np.median(sign * (inside[good] - outside[good])))
    level, around = np.median(inside[good]), np.median(outside[good])
    runs = 0
    for k in range(DIRECTIONS):
        runs += 1 if seen[k] and not good[k] and good[(k - 1) % DIRECTIONS] else 0
    return Sectors(
        count / DIRECTIONS,
        runs,
        step,
        float(np.mean(within[good])) / step,
        about_plane(inside, good, _COS, _SIN) / step,
        about_plane(outside, good, _COS, _SIN) / step,
        np.sum(seen & (np.abs(inside - level) > _LEAST_STEP * step)) / DIRECTIONS,
        float(np.median(np.abs(inside[seen] - level))) / step,
        float(np.median(np.abs(outside[seen] - around))) / step,
        float(np.median(np.abs(nearest[seen] - level))) / step,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _level(
    grey: NDArray[np.float64], k: int, counts: NDArray[np.bool_]
) -> tuple[float, int, float]:
    """Mean of some grey values along a direction, their number, their mean deviation from it."""
    total = 0.0
    n = 0
    for m in range(STEPS):
        if counts[m]:
            value = grey[k, m]
            if value != value:
                return 0.0, 0, 0.0
            total += value
            n += 1
    mean = total / n
    off = 0.0
    for m in range(STEPS):
        if counts[m]:
            off += abs(grey[k, m] - mean)
    return mean, n, off / n


@njit(cache=True, error_model="numpy", nogil=True)
def about_plane(
    level: NDArray[np.float64],
    counted: NDArray[np.bool_],
    cos: NDArray[np.float64],
    sin: NDArray[np.float64],
) -> float:
    """Root mean square of some levels about a + b cos + c sin of their directions.

    Solved by elimination: NumPy's own would have Numba look LAPACK up at the first call, which an
    interrupt must not meet.
    """
    products = np.zeros((3, 3))
    sums = np.zeros(3)
    squares = 0.0
    n = 0
    for k in range(len(level)):
        if counted[k]:
            term = (1.0, cos[k], sin[k])
            n += 1
            squares += level[k] * level[k]
            for i in range(3):
                sums[i] += term[i] * level[k]
                for j in range(3):
                    products[i, j] += term[i] * term[j]
    for i in range(3):
        products[i, i] += 1e-6
    explained = 0.0
    for i in range(3):
        explained += sums[i] * sums[i] / products[i, i]
        for j in range(i + 1, 3):
            share = products[j, i] / products[i, i]
            sums[j] -= share * sums[i]
            for k in range(i, 3):
                products[j, k] -= share * products[i, k]
    return math.sqrt(max(squares - explained, 0.0) / n)
