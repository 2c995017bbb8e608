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
    median,
    profiles,
)
from detect.discs.rim_network import (
    DOUBTFUL_CANDIDATE,
    DOUBTFUL_RIM,
    Networks,
    network_inputs,
    network_log_odds,
)
from redetect.array_types import BoolArray, Float32Array, FloatArray, GreyImage, IntArray, Records
from redetect.compiled import kernel

#: Steps of the rim's profiles within the disc, about 0.4 to 0.75 nominal radii, and on the floor
#: around it, about 1.25 to 1.6.
_INSIDE, _OUTSIDE = slice(1, 11), slice(21, 31)
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
        at = np.ascontiguousarray(floor_xy)
        return profiles(image, camera_numbers, at, np.full(len(at), nominal))

    def classified(rims: Records, of: IntArray) -> tuple[Profiles, FloatArray, FloatArray]:
        """Profiles, features and log-odds of the rims of some candidates."""
        radial, features = profiles_at(rims["floor_xy"]), _features(rims, nominal, score[of])
        seen = network_inputs(pairs_of_steps(radial.grey), radial.pixels_per_radius, sign[of])
        odds = network_log_odds(*seen, features, networks.classifier, DOUBTFUL_RIM)
        return radial, features, odds

    # Prescreening, of all candidates.
    count, sign, score = len(candidates.score), candidates.sign, candidates.score
    outcome, value = np.full(count, Outcome.FEW_STEPS, np.int8), np.zeros(count)
    grey, scale = sparse_profiles(image, camera_numbers, candidates.floor_xy, nominal)
    contrast = _contrast(grey, sign, least_step)
    seen = network_inputs(grey, scale, sign)
    odds = network_log_odds(*seen, score[:, None], networks.prescreening, DOUBTFUL_CANDIDATE)
    left = np.flatnonzero(contrast > 0.0)
    outcome[left], value[left] = Outcome.PRESCREENING, odds[left]
    left = left[odds[left] >= _LEAST_PRESCREENING]

    # Rims of those left.
    from_xy, step = candidates.floor_xy[left], sign[left] * contrast[left]
    rims = follow_rims(image, camera_numbers, profiles_at(from_xy), step)
    outcome[left], value[left] = Outcome.NO_RIM, rims["agreeing"]
    found = rims["agreeing"] >= LEAST_RIM
    outcome[left[found]] = Outcome.SAME_RIM
    found[found] = _first_of_each(rims["floor_xy"][found], sign[left[found]], _SAME * nominal)
    left, from_xy, rims = left[found], from_xy[found], rims[found]

    radial, features, odds = classified(rims, left)
    # A rim is seen best from its own centre, but that may lead to another circle.
    doubtful = np.flatnonzero((odds >= DOUBTFUL_RIM[0]) & (odds < _CERTAIN))
    step = rims["step"][doubtful]
    again = follow_rims(image, camera_numbers, radial.where(doubtful), step)
    found = again["agreeing"] >= rims["agreeing"][doubtful] - _SLACK
    doubtful, again, doubt = doubtful[found], again[found], np.zeros((len(left), 2))
    doubt[doubtful] = again["floor_xy"] - rims["floor_xy"][doubtful]
    radial_again, features_again, odds_again = classified(again, left[doubtful])
    better = odds_again > odds[doubtful]
    changed = doubtful[better]
    from_xy[changed] = rims["floor_xy"][changed]
    rims[changed], odds[changed] = again[better], odds_again[better]
    features[changed], radial.grey[changed] = features_again[better], radial_again.grey[better]

    # Some may have moved to the rim of another one.
    first = _first_of_each(rims["floor_xy"], sign[left], _SAME * nominal)
    odds = np.where(first, odds, 0.0)
    outcome[left[first]], value[left[first]] = Outcome.JUDGED, odds[first]
    quality, floor_grey = _quality(radial.grey)

    def of_all(judged: NDArray[Any], others: NDArray[Any] | float = 0.0) -> FloatArray:
        values = np.zeros((count, *judged.shape[1:])) + others
        values[left] = judged
        return values

    place = of_all(rims["floor_xy"], candidates.floor_xy)
    return JudgedCandidates(
        outcome, value, sign, of_all(features), of_all(rims["agreeing"]), of_all(rims["radius"]),
        place, of_all(from_xy, candidates.floor_xy), of_all(doubt), of_all(rims["step"]),
        of_all(floor_grey), of_all(quality), of_all(odds),
    )  # fmt: skip


def _first_of_each(floor_xy: FloatArray, sign: FloatArray, apart: float) -> BoolArray:
    """(N,) mask of positions that are not the same as one before, of the same sign."""
    first, at = np.zeros(len(sign), np.bool_), np.ascontiguousarray(floor_xy)
    for own in (1.0, -1.0):
        first[suppress_close(at, np.flatnonzero(sign == own), apart)] = True
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


@kernel()
def _contrast(grey: Float32Array, sign: FloatArray, least_step: float) -> FloatArray:
    """(N,) median steps over the directions with a sufficient step; 0 if these are too few."""
    contrast, steps = np.zeros(len(grey)), np.empty(SPARSE_DIRECTIONS)
    for i in range(len(grey)):
        for inner in _INNER:
            count = 0
            for k in range(SPARSE_DIRECTIONS):
                inside = grey[i, k, inner] + grey[i, k, inner + 1]
                outside = grey[i, k, _OUTER] + grey[i, k, _OUTER + 1]
                step = 0.5 * sign[i] * (inside - outside)
                if step > least_step:
                    steps[count] = step
                    count += 1
            if count >= _LEAST_STEPS * SPARSE_DIRECTIONS:
                contrast[i] = median(steps[:count])
                break
    return contrast


def _quality(grey: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Between-class over total variance of the grey values inside and outside; mean outside."""
    both = np.stack([grey[..., steps].mean(axis=2, dtype=float) for steps in (_INSIDE, _OUTSIDE)])
    seen = np.isfinite(both).all(axis=0)
    count = np.maximum(seen.sum(axis=1), 1)
    mean = np.where(seen, both, 0.0).sum(axis=2) / count
    off = np.where(seen, both - mean[..., None], 0.0)
    between = 0.25 * (mean[0] - mean[1]) ** 2
    total = between + 0.5 * (off * off).sum(axis=(0, 2)) / count
    return between / np.where(total > 0.0, total, 1.0), mean[1]


def _features(rims: Records, nominal: float, score: FloatArray) -> FloatArray:
    """(N, len(FEATURES)) features of rims, each bounded, so that no single one decides."""
    off = np.abs(np.log(np.clip(rims["radius"] / nominal, 0.3, 3.0) / RIM_RADIUS))
    size = np.log(np.clip(rims["radius_px"], 3.0, 30.0) / 6.0)
    runs, score = np.minimum(rims["runs"], 4.0), np.minimum(score, 12.0)
    columns = [rims["agreeing"], runs, rims["scatter"], off, 10.0 * off * off, size, score]
    return np.stack(columns, axis=1)
