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
from detect.discs.candidates import suppress_close
from detect.discs.hough import HoughCandidates
from detect.discs.rim import (
    COS,
    DIRECTIONS,
    FARTHEST,
    NEAREST,
    SIN,
    STEPS,
    Profiles,
    follow_rims,
    profiles,
)
from detect.discs.rim_network import (
    HOPELESS,
    Networks,
    RimNetwork,
    network_inputs,
    network_log_odds,
)
from redetect.array_types import BoolArray, Float32Array, FloatArray, GreyImage
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

    def profiles_at(floor_xy: FloatArray) -> Profiles:
        return profiles(image, camera_numbers, floor_xy, np.full(len(floor_xy), nominal))

    count, sign = len(candidates.score), candidates.sign
    outcome, value = np.full(count, Outcome.FEW_STEPS, np.int8), np.zeros(count)
    grey, scale = sparse_profiles(image, camera_numbers, candidates.floor_xy, nominal)
    contrast = _contrast(grey, sign, least_step)
    seen, score = network_inputs(grey, scale, sign), candidates.score[:, None]
    odds = network_log_odds(*seen, score, networks.prescreening)
    k = np.flatnonzero(contrast > 0.0)
    outcome[k], value[k] = Outcome.PRESCREENING, odds[k]

    k = k[odds[k] >= _LEAST_PRESCREENING]
    from_xy = candidates.floor_xy[k]
    rims = follow_rims(image, camera_numbers, profiles_at(from_xy), sign[k] * contrast[k])
    outcome[k], value[k] = Outcome.NO_RIM, rims["agreeing"]
    found = rims["agreeing"] >= LEAST_RIM
    outcome[k[found]] = Outcome.SAME_RIM
    found[found] = _first_of_each(rims["floor_xy"][found], sign[k[found]], _SAME * nominal)
    k, from_xy, rims = k[found], from_xy[found], rims[found]

    radial, score = profiles_at(rims["floor_xy"]), candidates.score[k]
    features = _features(rims, nominal, score)
    odds = _rim_odds(radial, features, sign[k], networks.classifier)
    # A rim is seen best from its own centre, but that may lead to another circle.
    doubtful, doubt = np.flatnonzero((odds >= HOPELESS) & (odds < _CERTAIN)), np.zeros((len(k), 2))
    step = rims["step"][doubtful]
    again = follow_rims(image, camera_numbers, radial.where(doubtful), step)
    kept = again["agreeing"] >= rims["agreeing"][doubtful] - _SLACK
    doubtful, again = doubtful[kept], again[kept]
    doubt[doubtful] = again["floor_xy"] - rims["floor_xy"][doubtful]
    radial_again = profiles_at(again["floor_xy"])
    features_again = _features(again, nominal, score[doubtful])
    odds_again = _rim_odds(radial_again, features_again, sign[k[doubtful]], networks.classifier)
    better = odds_again > odds[doubtful]
    changed = doubtful[better]
    from_xy[changed] = rims["floor_xy"][changed]
    rims[changed], odds[changed] = again[better], odds_again[better]
    features[changed], radial.grey[changed] = features_again[better], radial_again.grey[better]

    outcome[k], value[k] = Outcome.JUDGED, odds
    quality, floor_grey = _quality(radial.grey)

    def of_all(judged: NDArray[Any], others: NDArray[Any] | float = 0.0) -> FloatArray:
        values = np.zeros((count, *judged.shape[1:])) + others
        values[k] = judged
        return values

    place = of_all(rims["floor_xy"], candidates.floor_xy)
    return JudgedCandidates(
        outcome, value, sign, of_all(features), of_all(rims["agreeing"]), of_all(rims["radius"]),
        place, of_all(from_xy, candidates.floor_xy), of_all(doubt), of_all(rims["step"]),
        of_all(floor_grey), of_all(quality), of_all(odds),
    )  # fmt: skip


def _first_of_each(floor_xy: FloatArray, sign: FloatArray, apart: float) -> BoolArray:
    """(N,) mask of positions that are not the same as one before, of the same sign."""
    first = np.zeros(len(sign), np.bool_)
    for own in (1.0, -1.0):
        first[suppress_close(floor_xy, np.flatnonzero(sign == own), apart)] = True
    return first


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


def pairs_of_steps(grey: Float32Array) -> Float32Array:
    """Profiles as the network sees them: means of pairs of steps, (..., STEPS / 2)."""
    return np.asarray(np.float32(0.5) * (grey[..., ::2] + grey[..., 1::2]))


def _contrast(grey: Float32Array, sign: FloatArray, least_step: float) -> FloatArray:
    """(N,) median steps over the directions with a sufficient step; 0 if these are too few."""
    contrast, rows = np.zeros(len(grey)), np.arange(len(grey))
    half, none = np.float32(0.5) * sign.astype(np.float32), np.float32(np.inf)
    for inner in reversed(_INNER):
        inside, outside = (grey[..., i] + grey[..., i + 1] for i in (inner, _OUTER))
        step = half[:, None] * (inside - outside)
        steps = np.sort(np.where(step > least_step, step, none), axis=1)
        count = (steps < none).sum(axis=1)
        median = 0.5 * (steps[rows, (count - 1) // 2] + steps[rows, count // 2])
        contrast = np.where(count >= _LEAST_STEPS * SPARSE_DIRECTIONS, median, contrast)
    return contrast


def _quality(grey: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Between-class over total variance of the grey values inside and outside; mean outside."""
    at = np.linspace(NEAREST, FARTHEST, STEPS)
    inside, outside = (
        grey[..., np.abs(at - low).argmin() : np.abs(at - high).argmin() + 1].mean(
            axis=2, dtype=float
        )
        for low, high in (_INSIDE, _OUTSIDE)
    )
    seen = np.isfinite(inside) & np.isfinite(outside)
    count = np.maximum(seen.sum(axis=1), 1)
    means, variance = [], 0.0
    for values in (inside, outside):
        mean = np.where(seen, values, 0.0).sum(axis=1) / count
        off = np.where(seen, values - mean[:, None], 0.0)
        variance = variance + (off * off).sum(axis=1) / count
        means.append(mean)
    between = 0.25 * (means[0] - means[1]) ** 2
    total = between + 0.5 * variance
    return between / np.where(total > 0.0, total, 1.0), means[1]


def _features(rims: Any, nominal: float, score: FloatArray) -> FloatArray:
    """(N, len(FEATURES)) features of rims, each bounded, so that no single one decides."""
    off = np.abs(np.log(np.clip(rims["radius"] / nominal, 0.3, 3.0) / RIM_RADIUS))
    size = np.log(np.clip(rims["radius_px"], 3.0, 30.0) / 6.0)
    runs, score = np.minimum(rims["runs"], 4.0), np.minimum(score, 12.0)
    columns = [rims["agreeing"], runs, rims["scatter"], off, 10.0 * off * off, size, score]
    return np.stack(columns, axis=1)


def _rim_odds(
    radial: Profiles, features: FloatArray, sign: FloatArray, network: RimNetwork
) -> FloatArray:
    """(N,) log-odds that rims, seen from their centres, are those of discs."""
    seen = network_inputs(pairs_of_steps(radial.grey), radial.pixels_per_radius, sign)
    return network_log_odds(*seen, features, network)
