"""Compiled: the tilt from the band round the horizon alone, where it tells it beyond doubt.

An edge that crosses the band has a maximum of the response on each of its rows. Such maxima, one
below the other, are a *chain*: a short track that costs nothing to follow.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.verticals.fit_kernels import fit_eigenlines
from detect.verticals.judgement_kernels import ACCEPTED, NOT_STRAIGHT, weigh_verticals
from detect.verticals.pass_kernels import agreed_tilt, regression_covariance

#: Maxima on neighbouring rows of the band that belong together are not as far apart, columns.
_APART = 1.5
#: Least number of maxima of a chain, of which noise alone has few so long.
_LEAST = 6
#: Largest root-mean-square distance of them from a straight line, pixels.
_SCATTER_PX = 0.3
#: How far a chain may lean from the vertical over its length, pixels (see
#: `detect.line_settings.LineSettings.largest_lean_px`).
_LEAN_PX = 0.5
#: Standard deviation of its lean over its length due to all but noise, pixels: more than that of
#: lines, which are refined on the grey values.
_BEND_PX = 0.125


@njit(cache=True, error_model="numpy")
def chain_maxima(
    response: NDArray[np.float32],
    level: NDArray[np.int32],
    column: NDArray[np.int32],
    sign: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Places of maxima between columns, and of each the one below that continues its edge.

    Parameters
    ----------
    response
        See `band_response`.
    level, column, sign
        Maxima as `find_maxima` tells them.

    Returns
    -------
    place : (N,) float64
        Top of the parabola through the maximum and its neighbours.
    below : (N,) int32
        Maximum of the same sign on the next row of the band; -1 for none. No two have the same.
    """
    count = len(level)
    place = np.empty(count)
    below = np.full(count, -1, np.int32)
    first = 0
    for i in range(count):
        k = level[i]
        c = column[i]
        left = float(response[k, c - 1])
        centre = float(response[k, c])
        right = float(response[k, c + 1])
        place[i] = c + 0.5 * (left - right) / (left - 2.0 * centre + right)
        while first < i and (
            level[first] < k - 1 or (level[first] < k and place[first] <= place[i] - 2.0 * _APART)
        ):
            first += 1
        nearest = _APART
        above = -1
        other = first
        while other < i and level[other] < k and place[other] < place[i] + _APART:
            apart = abs(place[other] - place[i])
            if sign[other] == sign[i] and below[other] < 0 and apart < nearest:
                nearest = apart
                above = other
            other += 1
        if above >= 0:
            below[above] = i
    return place, below


@njit(cache=True, error_model="numpy")
def tilt_of_chains(
    response: NDArray[np.float32],
    band_row: NDArray[np.int32],
    level: NDArray[np.int32],
    column: NDArray[np.int32],
    sign: NDArray[np.float32],
    bearing: NDArray[np.float64],
    elevation: NDArray[np.float32],
    limits: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The tilt that most chains agree with.

    Parameters
    ----------
    response, band_row
        See `find_starts`.
    level, column, sign
        Maxima as `find_maxima` tells them.
    bearing
        The table's.
    elevation
        See `detect.verticals.strip.Strip.rise`.
    limits
        See `detect.verticals.judgement.limits_of`.

    Returns
    -------
    (`TILT_NUMBERS`,) float64
        NaN where too few agree.
    """
    place, below = chain_maxima(response, level, column, sign)
    count = len(level)
    length = np.ones(count, np.int32)
    for i in range(count - 1, -1, -1):
        if below[i] >= 0:
            length[i] += length[below[i]]
    bounds = np.zeros(count + 1, np.int64)
    row_of = np.empty(count, np.int32)
    place_of = np.empty(count)
    score_of = np.empty(count, np.float32)
    chains = 0
    n = 0
    for i in range(count):
        if length[i] < _LEAST:
            continue
        at = i
        while at >= 0:
            # Not to begin with this one again.
            length[at] = 0
            row_of[n] = band_row[level[at], column[at]]
            place_of[n] = place[at]
            score_of[n] = abs(response[level[at], column[at]])
            n += 1
            at = below[at]
        chains += 1
        bounds[chains] = n
    bounds = bounds[: chains + 1]
    reference, pixel, line, scatter_px, middle, spread, _, _ = fit_eigenlines(
        bearing, elevation, bounds, row_of[:n], place_of[:n], score_of[:n], _LEAST, 0.0
    )
    covariance = np.empty((chains, 2, 2))
    regression_covariance(covariance, scatter_px, pixel, bounds, middle, spread)
    evidence = np.empty(chains)
    fate = np.empty(chains, np.int8)
    for t in range(chains):
        evidence[t] = limits[13] * 10.0
        fate[t] = ACCEPTED if scatter_px[t] <= _SCATTER_PX else NOT_STRAIGHT
    _, normal, inclination, tolerance, weight = weigh_verticals(
        reference, pixel, line, covariance, spread, evidence, fate, limits[14], _BEND_PX, 1.0,
        limits[10], limits[11], _LEAN_PX, limits[13],
    )  # fmt: skip
    edge = np.arange(len(weight))
    tilt, _ = agreed_tilt(bearing, normal, inclination, tolerance, weight, edge, 0.0, limits)
    return tilt
