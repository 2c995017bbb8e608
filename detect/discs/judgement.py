"""Decides which candidates are discs: prescreening, then the rim, by networks trained on truth.

The candidates come from the Hough transform (`detect.discs.hough`). Most are rejected by a
prescreening of a few grey values. For the others the rim is traced (`detect.discs.rim`): with glare
beside a disc or a cable across it, the rest still is on a circle of the right size. A small network
(`detect.discs.rim_network`) then decides from the grey values around the candidate and the rim.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import distance_of_floor_point, project_floor_point
from detect.discs.hough import HoughCandidates
from detect.discs.rim import (
    COS,
    DIRECTIONS,
    FARTHEST,
    NEAREST,
    SIN,
    STEPS,
    Profiles,
    Rim,
    follow_rim,
    median,
    profiles,
)
from detect.discs.rim_network import (
    HOPELESS,
    Networks,
    RimNetwork,
    network_inputs,
    network_log_odds,
)
from redetect.array_types import Float32Array, FloatArray, GreyImage
from redetect.compiled import kernel

#: Distances at which grey values are taken for the disc and for the floor, nominal radii.
_INSIDE, _OUTSIDE = (0.4, 0.75), (1.25, 1.6)
#: Directions of sparse profiles (some of the rim's), distances of their samples, which of these are
#: inside and outside, and the least share of directions in which the disc differs from the floor.
_EVERY = 2
SPARSE_DIRECTIONS = DIRECTIONS // _EVERY
SPARSE_RADII = np.linspace(0.3, 1.7, 8)
_INNER, _OUTER = (1, 2), 5  #: The first of two neighbouring samples.
_LEAST_STEPS = 0.3
#: Distances of what the network sees about a rim, nominal radii: means of pairs of steps.
DENSE_RADII = np.linspace(NEAREST, FARTHEST, STEPS).reshape(-1, 2).mean(axis=1)
_AT_ONCE = 16  #: Candidates that are prescreened at a time.
_LEAST_PRESCREENING = 0.0  #: Threshold of the prescreening.
LEAST_RIM = 0.3  #: Least share of the rim that has to be on a circle.
RIM_RADIUS = 0.98  #: Most likely radius of a rim, relative to the nominal one.
#: A rim is traced again, from its own centre, unless it is hopeless or its log-odds exceed this.
_CERTAIN = 2.5
_SLACK = 0.07  #: The second trace may lose this share of the rim and still be preferred.
_SAME = 0.1  #: Two rims closer than this share of the radius are the same.
#: Features of the rim, in the order of the network's weights.
FEATURES = ("rim", "runs", "scatter", "radius", "radius_2", "size", "score")


class Outcome(IntEnum):
    """The stage that rejected a candidate, in order; or it was judged by its rim."""

    FEW_STEPS = 0
    PRESCREENING = 1
    NO_RIM = 2
    SAME_RIM = 3
    JUDGED = 4


class JudgedCandidates(NamedTuple):
    """N candidates and their outcomes; `step` and later fields are valid for judged rims only."""

    outcome: NDArray[np.int8]  #: (N,) of `Outcome`
    value: FloatArray  #: (N,) the number that decided: log-odds, or a share of the rim
    sign: FloatArray  #: (N,) 1 for light discs, -1 for dark ones
    features: FloatArray  #: (N, len(FEATURES))
    agreeing: FloatArray  #: (N,) share of the rim that is on a circle
    radius: FloatArray  #: (N,) radius of that circle, metres
    #: (N, 2) centre of the rim, metres; of the candidate if the rim was not traced
    floor_xy: FloatArray
    traced_from: FloatArray  #: (N, 2) point from which the rim was traced, metres
    #: (N, 2) difference between the centres found from the two starts, metres
    doubt: FloatArray
    step: FloatArray  #: (N,) of the grey value at the rim, inside minus outside
    floor_grey: FloatArray  #: (N,) mean grey value of the floor around it
    quality: FloatArray  #: (N,) Otsu's quality of the disc against that floor
    log_odds: FloatArray  #: (N,) that the candidate is a disc

    def where(self, chosen: NDArray[Any]) -> JudgedCandidates:
        """The candidates that indices or a mask select."""
        return JudgedCandidates(*(values[chosen] for values in self))


@kernel()
def judge(
    image: GreyImage,
    candidates: HoughCandidates,
    nominal: float,
    least_step: float,
    camera_numbers: FloatArray,
    networks: Networks,
) -> JudgedCandidates:
    """Judge candidates, the best first, in an image (H, W).

    Discs have a `nominal` radius, metres, and at least `least_step` grey levels at their rims;
    `camera_numbers` are those of `camera.kernels.camera_numbers`.
    """
    n = len(candidates.score)
    features, place = np.zeros((n, len(FEATURES))), candidates.floor_xy.copy()
    traced_from, doubt = candidates.floor_xy.copy(), np.zeros((n, 2))
    step, floor_grey, quality, log_odds = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    outcome, value = np.full(n, Outcome.FEW_STEPS, np.int8), np.zeros(n)
    agreeing, radius = np.zeros(n), np.zeros(n)
    judged = np.empty((n, 3))  # places and signs of rims
    count = 0
    contrast, prescreened = _prescreening_odds(
        image, candidates, nominal, least_step, camera_numbers, networks.prescreening
    )
    for i in range(n):
        if contrast[i] == 0.0:
            continue
        outcome[i], value[i] = Outcome.PRESCREENING, prescreened[i]
        if prescreened[i] < _LEAST_PRESCREENING:
            continue
        x, y, sign = candidates.floor_xy[i, 0], candidates.floor_xy[i, 1], candidates.sign[i]
        score = candidates.score[i]
        radial = profiles(image, camera_numbers, x, y, nominal)
        rim = follow_rim(image, camera_numbers, radial, sign * contrast[i])
        outcome[i], value[i] = Outcome.NO_RIM, rim.agreeing
        if rim.agreeing < LEAST_RIM:
            continue
        outcome[i] = Outcome.SAME_RIM
        if _is_known(judged[:count], rim, sign, nominal):
            continue
        radial = profiles(image, camera_numbers, rim.x, rim.y, nominal)
        odds, rim_features = _rim_odds(radial, rim, score, sign, networks.classifier)
        if HOPELESS <= odds < _CERTAIN:
            # A rim is seen best from its own centre, but that may lead to another circle.
            again = follow_rim(image, camera_numbers, radial, rim.step)
            if again.agreeing >= rim.agreeing - _SLACK:
                radial_again = profiles(image, camera_numbers, again.x, again.y, nominal)
                more, features_again = _rim_odds(
                    radial_again, again, score, sign, networks.classifier
                )
                doubt[i, 0], doubt[i, 1] = again.x - rim.x, again.y - rim.y
                if more > odds and not _is_known(judged[:count], again, sign, nominal):
                    x, y = rim.x, rim.y
                    rim, odds, rim_features, radial = again, more, features_again, radial_again
        outcome[i], value[i], log_odds[i], step[i] = Outcome.JUDGED, odds, odds, rim.step
        agreeing[i], radius[i] = rim.agreeing, rim.radius
        for k in range(len(FEATURES)):  # assigning the row takes seconds to compile
            features[i, k] = rim_features[k]
        quality[i], floor_grey[i] = _quality(radial.grey)
        place[i, 0], place[i, 1] = rim.x, rim.y
        traced_from[i, 0], traced_from[i, 1] = x, y
        judged[count, 0], judged[count, 1], judged[count, 2] = rim.x, rim.y, sign
        count += 1
    return JudgedCandidates(
        outcome, value, candidates.sign, features, agreeing, radius, place, traced_from, doubt,
        step, floor_grey, quality, log_odds,
    )  # fmt: skip


@kernel()
def _is_known(judged: FloatArray, rim: Rim, sign: float, radius: float) -> bool:
    """Whether a rim is one of `judged`, rows (x, y, sign)."""
    near = _SAME * radius
    for k in range(len(judged)):
        off_x, off_y = judged[k, 0] - rim.x, judged[k, 1] - rim.y
        if off_x * off_x + off_y * off_y < near * near and judged[k, 2] == sign:
            return True
    return False


@kernel()
def _between(grey: Float32Array, bounds: tuple[float, float]) -> FloatArray:
    """Mean grey value of each direction between two distances, nominal radii."""
    per_step = (FARTHEST - NEAREST) / (STEPS - 1)
    first = round((bounds[0] - NEAREST) / per_step)
    last = round((bounds[1] - NEAREST) / per_step)
    mean = np.empty(DIRECTIONS)
    for k in range(DIRECTIONS):
        mean[k] = np.mean(grey[k, first : last + 1])
    return mean


@kernel()
def _prescreening_odds(
    image: GreyImage, candidates: HoughCandidates, nominal: float, least_step: float,
    camera_numbers: FloatArray, network: RimNetwork,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """(N,) contrasts of candidates, 0 if too few directions have any, and their log-odds."""
    n = len(candidates.score)
    contrast, odds = np.empty(n), np.empty(n)
    for first in range(0, n, _AT_ONCE):
        end = min(first + _AT_ONCE, n)
        sign, score = candidates.sign[first:end], candidates.score[first:end]
        floor_xy = candidates.floor_xy[first:end]
        grey, scale = sparse_profiles(image, camera_numbers, floor_xy, nominal)
        inputs, scales = network_inputs(grey, scale, sign)
        log_odds = network_log_odds(inputs, scales, score.reshape(-1, 1), network)
        for k in range(end - first):
            contrast[first + k] = _contrast(grey[k], sign[k], least_step)
            odds[first + k] = log_odds[k]
    return contrast, odds


@kernel()
def sparse_profiles(
    image: GreyImage, camera_numbers: FloatArray, floor_xy: FloatArray, radius: float
) -> tuple[Float32Array, FloatArray]:
    """Nearest-pixel grey values along some directions from N points on the floor.

    Perspective within a disc is ignored if it shifts the rim by less than a step. Returns (N, K, M)
    grey values, NaN outside the image, and (N, K) pixels per radius; parameters otherwise as for
    `detect.discs.rim.profiles`.
    """
    count = len(floor_xy)
    grey = np.empty((count, SPARSE_DIRECTIONS, len(SPARSE_RADII)), np.float32)
    scale = np.empty((count, SPARSE_DIRECTIONS))
    height, width = image.shape
    step = SPARSE_RADII[1] - SPARSE_RADII[0]
    for i in range(count):
        x, y = floor_xy[i]
        u0, v0 = project_floor_point(camera_numbers, x, y)
        ux, vx = project_floor_point(camera_numbers, x + radius, y)
        uy, vy = project_floor_point(camera_numbers, x, y + radius)
        # The scale changes from the centre to the rim by up to radius over distance.
        flat = 2.0 * radius < step * distance_of_floor_point(camera_numbers, x, y)
        for k in range(SPARSE_DIRECTIONS):
            cos, sin = COS[_EVERY * k], SIN[_EVERY * k]
            du, dv = cos * (ux - u0) + sin * (uy - u0), cos * (vx - v0) + sin * (vy - v0)
            scale[i, k] = math.sqrt(du * du + dv * dv)
            for m in range(len(SPARSE_RADII)):
                u, v = u0 + SPARSE_RADII[m] * du, v0 + SPARSE_RADII[m] * dv
                if not flat:
                    off = radius * SPARSE_RADII[m]
                    u, v = project_floor_point(camera_numbers, x + off * cos, y + off * sin)
                u, v = u + 0.5, v + 0.5
                inside = 0.0 <= u < width and 0.0 <= v < height  # not if NaN
                grey[i, k, m] = image[np.uint64(v), np.uint64(u)] if inside else math.nan
    return grey, scale


@kernel()
def pairs_of_steps(grey: Float32Array) -> Float32Array:
    """Profiles as the network sees them: means of pairs of steps."""
    # Loops, here and below: expressions of arrays take several times as long to compile.
    pairs = np.empty((len(grey), grey.shape[1] // 2), np.float32)
    for k in range(len(grey)):
        for m in range(grey.shape[1] // 2):
            pairs[k, m] = np.float32(0.5) * (grey[k, 2 * m] + grey[k, 2 * m + 1])
    return pairs


@kernel()
def _contrast(grey: Float32Array, sign: float, least_step: float) -> float:
    """Median step over the directions with a sufficient step; 0 if these are too few."""
    steps = np.empty(SPARSE_DIRECTIONS)
    for inner in _INNER:
        count = 0
        for k in range(SPARSE_DIRECTIONS):
            inside = grey[k, inner] + grey[k, inner + 1]
            step = 0.5 * sign * (inside - (grey[k, _OUTER] + grey[k, _OUTER + 1]))
            if step > least_step:
                steps[count] = step
                count += 1
        if count >= _LEAST_STEPS * SPARSE_DIRECTIONS:
            return median(steps[:count])
    return 0.0


@kernel()
def _quality(grey: Float32Array) -> tuple[float, float]:
    """Between-class over total variance of the grey values inside and outside; mean outside."""
    inside, outside = _between(grey, _INSIDE), _between(grey, _OUTSIDE)
    count = 0
    for k in range(DIRECTIONS):
        if math.isfinite(inside[k]) and math.isfinite(outside[k]):
            inside[count], outside[count] = inside[k], outside[k]
            count += 1
    if count == 0:
        return 0.0, 0.0
    inside, outside = inside[:count], outside[:count]
    floor_grey = np.mean(outside)
    between = 0.25 * (np.mean(inside) - floor_grey) ** 2
    total = between + 0.5 * (np.var(inside) + np.var(outside))
    return (float(between / total) if total > 0.0 else 0.0), float(floor_grey)


@kernel()
def _rim_odds(
    radial: Profiles, rim: Rim, score: float, sign: float, network: RimNetwork
) -> tuple[float, FloatArray]:
    """Log-odds that a rim, seen from its centre, is a disc's; and its features.

    Each feature is bounded, so that no single one decides.
    """
    features = np.empty(len(FEATURES))
    off = abs(math.log(min(max(rim.radius / radial.radius, 0.3), 3.0) / RIM_RADIUS))
    features[0] = rim.agreeing
    features[1] = min(rim.runs, 4)
    features[2] = rim.scatter
    features[3] = off
    features[4] = 10.0 * off * off
    features[5] = math.log(min(max(rim.radius_px, 3.0), 30.0) / 6.0)
    features[6] = min(score, 12.0)
    grey, scale = pairs_of_steps(radial.grey), radial.pixels_per_radius
    signs = np.full(1, sign)
    inputs, scales = network_inputs(grey.reshape(1, DIRECTIONS, -1), scale.reshape(1, -1), signs)
    return network_log_odds(inputs, scales, features.reshape(1, -1), network)[0], features
