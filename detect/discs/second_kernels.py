"""Compiled: a second look at what the quality, or the fit of a whole disc, speaks against.

Glare or a sun patch beside a disc raises the total variance of its outlines, a cable across it
leaves much that the fit of a disc does not explain. A person sees the disc all the same. Here the
candidates are those centres round which the grey value steps in most directions
(`detect.discs.quality`). What the two outlines say about the disturbed directions is
enough to drop most of the clutter among them; round the others the rim is followed, the levels in
and outside it are compared direction by direction, and a disc is fitted. All of it together is
weighed by a logistic regression. Its weights are printed by `python -m tools.evaluation
evidence-weights`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import fit
from detect.discs.candidates import strong_and_alone, suppress_neighbours
from detect.discs.evidence_kernels import evidence_of
from detect.discs.fit import fit_all
from detect.discs.patch import FitSettings, floor_steps
from detect.discs.rim import Rim, follow_rim
from detect.discs.search import DiscSearch, nearest_pixel
from detect.discs.sectors import Sectors, about_plane, sector_levels

_DIRECTIONS = 16
_ANGLES = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
#: A direction counts with this share of the median step.
_LEAST_STEP = 0.4
#: Weights of the outlines' directions, deviations inside and outside, and flatness towards the
#: rim; and the least sum that is worth following the rim.
_OUTLINE_WEIGHTS = (0.51, -4.74, -7.14, -3.68)
_LEAST_OUTLINE = 1.6
#: Shares of the rim and of the sectors that are worth a fit.
_LEAST_RIM = 0.53
_LEAST_GOOD = 0.56
#: Nearer to a disc already found than this share of the separation nothing is looked for.
_WITHIN = 0.75
#: A rim followed from its own middle may lose this share and is still the better one.
_RIM_SLACK = 0.07

#: Radius of a rim that fits best, relative to the nominal one.
_RIM_RADIUS = 0.98
#: Features of a second look, in the order of the weights.
FEATURES = (
    "rim", "rim_runs", "scatter", "rim_radius", "rim_radius_2", "size", "good", "good_runs",
    "step", "within", "slope_inside", "slope_outside", "other_inside", "spread_inside",
    "spread_outside", "middle", "score", "explained", "uneven", "fitted",
)  # fmt: skip
COUNT = len(FEATURES)
#: Constant and weights of the rim's features, which come first, and of all of them.
_RIM_WEIGHTS = (
    -1.01, 2.71, -0.83, -0.66, -1.21, -3.12, 0.02, 0.12, -0.17, 0.49, -0.91, -0.35, -1.39, -0.00,
    -1.16, -1.15, -0.86, 0.20,
)  # fmt: skip
WEIGHTS = (
    1.08, 2.37, -0.86, -0.69, -0.87, -1.91, -0.73, 0.13, -0.01, 0.61, -0.80, -0.24, -0.99, 0.55,
    -1.00, -1.33, -0.68, 0.23, -0.44, -0.48, 0.38,
)  # fmt: skip
#: What is worth a fit by the rim, and what is a disc by all features: log-odds.
_LEAST_BY_RIM = -2.8
_TAKEN = -0.75


@njit(cache=True, error_model="numpy", nogil=True)
def outline_steps(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    inner: float,
    outer: float,
    sign: float,
    step: float,
) -> tuple[float, float]:
    """How much the outlines look like a disc's but for some directions, and the median step there.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    u0, v0 : int
        Centre.
    radius, inner, outer : float
        Of the disc and the outlines, metres.
    sign : float
        1 for a light disc, -1 for a dark one.
    step : float
        Directions with a larger step are compared, grey levels.

    Returns
    -------
    weight, median_step : float
        Minus infinity and 0 where too few directions step so, or some are outside the image.
    """
    height, width = image.shape
    xu, yu, xv, yv = floor_steps(floor_xy, u0, v0)
    area = xu * yv - xv * yu
    inside = np.empty(_DIRECTIONS)
    near_rim = np.empty(_DIRECTIONS)
    outside = np.empty(_DIRECTIONS)
    if not abs(area) > 0.0:
        return -math.inf, 0.0
    at = (inner, 0.5 * (inner + radius) + 0.05 * radius, outer)
    for k in range(_DIRECTIONS):
        du = (yv * _COS[k] - xv * _SIN[k]) / area
        dv = (xu * _SIN[k] - yu * _COS[k]) / area
        for m in range(3):
            u = math.floor(u0 + at[m] * du + 0.5)
            v = math.floor(v0 + at[m] * dv + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height:
                return -math.inf, 0.0
            value = sign * image[v, u]
            if m == 0:
                inside[k] = value
            elif m == 1:
                near_rim[k] = value
            else:
                outside[k] = value
    difference = inside - outside
    votes = difference > step
    if np.sum(votes) < 5:
        return -math.inf, 0.0
    work = np.empty(_DIRECTIONS)
    count = 0
    for k in range(_DIRECTIONS):
        if votes[k]:
            work[count] = difference[k]
            count += 1
    median = _median(work, count)
    work[:] = inside
    level = _median(work, _DIRECTIONS)
    work[:] = np.abs(inside - level)
    spread = _median(work, _DIRECTIONS)
    work[:] = np.abs(near_rim - inside)
    slope = _median(work, _DIRECTIONS)
    weights = _OUTLINE_WEIGHTS
    weight = (
        weights[0] * np.sum(difference > _LEAST_STEP * median)
        + weights[1] * min(spread / median, 1.2)
        + weights[2] * min(about_plane(outside, votes, _COS, _SIN) / median, 1.2)
        + weights[3] * min(slope / median, 1.2)
    )
    return float(weight), median


@njit(cache=True, error_model="numpy", nogil=True)
def _median(values: NDArray[np.float64], count: int) -> float:
    """Median of the first few of some values, which are sorted."""
    for i in range(1, count):
        value = values[i]
        k = i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return float(0.5 * (values[(count - 1) // 2] + values[count // 2]))


@njit(cache=True, error_model="numpy", nogil=True)
def _note_rim(
    rim: Rim, sectors: Sectors, radius: float, score: float, out: NDArray[np.float64]
) -> None:
    """The features that need no fit, each bounded, for a single one is never to decide."""
    off = abs(math.log(min(max(rim.radius / radius, 0.3), 3.0) / _RIM_RADIUS))
    out[0] = rim.agreeing
    out[1] = min(rim.runs, 4)
    out[2] = rim.scatter
    out[3] = off
    out[4] = 10.0 * off * off
    out[5] = math.log(min(max(rim.radius_px, 3.0), 30.0) / 6.0)
    out[6] = sectors.good
    out[7] = min(sectors.runs, 4)
    out[8] = math.log(min(max(sectors.step, 5.0), 80.0) / 40.0)
    out[9] = min(sectors.within, 0.6)
    out[10] = min(sectors.slope_inside, 0.5)
    out[11] = min(sectors.slope_outside, 0.8)
    out[12] = sectors.other_inside
    out[13] = min(sectors.spread_inside, 0.8)
    out[14] = min(sectors.spread_outside, 1.0)
    out[15] = min(sectors.middle, 0.6)
    out[16] = score


@njit(cache=True, error_model="numpy", nogil=True)
def _note_fit(result: Any, radius: float, optics_px: float, out: NDArray[np.float64]) -> None:
    """The features of the fit."""
    fitted = evidence_of(
        result[fit.EXPLAINED], result[fit.RADIUS] / radius, result[fit.OUTLINE_DEVIATION],
        result[fit.SECTORS_GOOD], result[fit.MIDDLE_STEP], result[fit.RELATIVE_BLUR], optics_px,
    )  # fmt: skip
    share = min(max(result[fit.EXPLAINED], 0.01), 0.99)
    out[17] = math.log(share / (1.0 - share))
    out[18] = min(result[fit.OUTLINE_DEVIATION], 0.35)
    out[19] = min(max(fitted, -8.0), 4.0)


@njit(cache=True, error_model="numpy", nogil=True)
def second_looks(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    contrast: NDArray[np.float32],
    score: NDArray[np.float64],
    found_xy: NDArray[np.float64],
    search: DiscSearch,
    step: float,
    settings: FitSettings,
    camera_numbers: NDArray[np.float64],
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """Look a second time at candidates that are not at discs already found.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    pixels, contrast, score : (N, 2) int64, (N,) float32, (N,) float64
        See `detect.discs.candidates.Centres`; the contrast's sign says which discs are looked for.
    found_xy : (M, 2) float64
        Places of discs already found, metres.
    search : DiscSearch
    step : float
        Directions with a larger step are compared first, grey levels.
    settings : FitSettings
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.

    Returns
    -------
    index : (L,) int64
        Which candidates were followed to the end: of those at one place the best.
    features : (L, COUNT) float64
    place : (L, 2) float64
        Metres.
    covariance : (L, 2, 2) float64
        Of the place, square metres.
    evidence : (L,) float64
        Log-odds, on the scale of `DiscSearch.least_evidence`.
    """
    radius = search.radius
    index = strong_and_alone(pixels, score, contrast, floor_xy, 0.0, 0.5 * search.separation)
    n = len(index)
    features = np.empty((n, COUNT))
    place = np.empty((n, 2))
    covariance = np.empty((n, 2, 2))
    nearest = np.empty((n, 2), np.int64)
    count = 0
    for i in index:
        u, v = pixels[i, 0], pixels[i, 1]
        x, y = np.float64(floor_xy[v, u, 0]), np.float64(floor_xy[v, u, 1])
        if _near_any(found_xy, x, y, _WITHIN * search.separation):
            continue
        sign = 1.0 if contrast[i] > 0.0 else -1.0
        weight, median = outline_steps(
            image, floor_xy, u, v, radius, search.inner, search.outer, sign, step
        )
        if weight < _LEAST_OUTLINE:
            continue
        rim = follow_rim(image, camera_numbers, x, y, radius, sign * median)
        if rim.agreeing < _LEAST_RIM:
            continue
        again = follow_rim(image, camera_numbers, rim.x, rim.y, radius, rim.step)
        if again.agreeing >= rim.agreeing - _RIM_SLACK:
            rim = again
        if _near_any(found_xy, rim.x, rim.y, search.separation):
            continue
        sectors = sector_levels(image, camera_numbers, rim, sign)
        if sectors.good < _LEAST_GOOD:
            continue
        _note_rim(rim, sectors, radius, score[i], features[count])
        if _weighed(features[count], _RIM_WEIGHTS) < _LEAST_BY_RIM:
            continue
        index[count] = i
        nearest[count, 0], nearest[count, 1] = nearest_pixel(floor_xy, u, v, rim.x, rim.y)
        place[count, 0], place[count, 1] = rim.x, rim.y
        covariance[count, 0, 0], covariance[count, 1, 1] = rim.cov_xx, rim.cov_yy
        covariance[count, 0, 1] = covariance[count, 1, 0] = rim.cov_xy
        count += 1
    evidence = np.full(count, -np.inf)
    if count > 0:
        blur = np.full(count, settings.blur_px)
        results, fitted = fit_all(image, floor_xy, nearest[:count], radius, blur, settings, False)
        for k in range(count):
            if fitted[k]:
                _note_fit(results[k], radius, search.optics_px, features[k])
                evidence[k] = search.least_evidence + _weighed(features[k], WEIGHTS) - _TAKEN
    best = np.flatnonzero(evidence > -np.inf)
    best = best[suppress_neighbours(place[best], evidence[best], search.separation)]
    return index[best], features[best], place[best], covariance[best], evidence[best]


@njit(cache=True, error_model="numpy", nogil=True)
def _near_any(places: NDArray[np.float64], x: float, y: float, distance: float) -> bool:
    for k in range(len(places)):
        if (places[k, 0] - x) ** 2 + (places[k, 1] - y) ** 2 < distance * distance:
            return True
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _weighed(features: NDArray[np.float64], weights: tuple[float, ...]) -> float:
    total = weights[0]
    for k in range(len(weights) - 1):
        total += weights[k + 1] * features[k]
    return total
