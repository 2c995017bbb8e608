"""A second look at what the quality, or the fit of a whole disc, speaks against.

Glare or a sun patch beside a disc raises the total variance of its outlines, a cable across it
leaves much that the fit of a disc does not explain, and far away a disc has few pixels. A person
sees the disc all the same. Here the candidates are those centres round which the grey value steps
in most directions (`detect.discs.quality`). What the two outlines say about the disturbed
directions is enough to drop most of the clutter among them; round the others the rim is followed,
and a small network (`detect.discs.rim_network`) decides by the grey values about it and by the rim.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.candidates import strong_and_alone, suppress_neighbours
from detect.discs.patch import floor_steps
from detect.discs.quality import Centres, chosen
from detect.discs.rim import Rim, follow_rim, median, profiles
from detect.discs.rim_network import RimNetwork, network_inputs, network_log_odds
from detect.discs.search import DiscSearch, Scene

FloatArray = NDArray[np.float64]

_DIRECTIONS = 16
_ANGLES = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
#: A direction counts with this share of the median step.
_LEAST_STEP = 0.4
#: Weights of the outlines' directions, deviations inside and outside, and flatness towards the
#: rim; and the least sum that is worth following the rim.
_OUTLINE_WEIGHTS = (0.51, -4.74, -7.14, -3.68)
_LEAST_OUTLINE = 0.3
#: Share of the rim that is worth the network.
_LEAST_RIM = 0.4
#: Nearer to a disc already found than this share of the separation nothing is looked for.
_WITHIN = 0.75
#: A rim followed from its own middle may lose this share and is still the better one.
_RIM_SLACK = 0.07
#: Radius of a rim that fits best, relative to the nominal one.
_RIM_RADIUS = 0.98
#: Log-odds by the network that make a disc: its training sees discs and others as they were
#: gathered, not as often as they occur.
_TAKEN = -0.04
#: Features of the rim, in the order of the network's weights.
FEATURES = ("rim", "runs", "scatter", "radius", "radius_2", "size", "score")


@njit(cache=True, error_model="numpy", nogil=True)
def outline_steps(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    search: DiscSearch,
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
    search : DiscSearch
        Radii of the disc and the outlines.
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
    radius = search.radius
    at = (search.inner, 0.5 * (search.inner + radius) + 0.05 * radius, search.outer)
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
    usual = median(difference[votes])
    spread = median(np.abs(inside - median(inside.copy())))
    slope = median(np.abs(near_rim - inside))
    weights = _OUTLINE_WEIGHTS
    weight = (
        weights[0] * np.sum(difference > _LEAST_STEP * usual)
        + weights[1] * min(spread / usual, 1.2)
        + weights[2] * min(_about_plane(outside, votes, _COS, _SIN) / usual, 1.2)
        + weights[3] * min(slope / usual, 1.2)
    )
    return float(weight), usual


@njit(cache=True, error_model="numpy", nogil=True)
def _note_rim(rim: Rim, radius: float, score: float, out: NDArray[np.float64]) -> None:
    """The features of the rim, each bounded, for a single one is never to decide."""
    off = abs(math.log(min(max(rim.radius / radius, 0.3), 3.0) / _RIM_RADIUS))
    out[0] = rim.agreeing
    out[1] = min(rim.runs, 4)
    out[2] = rim.scatter
    out[3] = off
    out[4] = 10.0 * off * off
    out[5] = math.log(min(max(rim.radius_px, 3.0), 30.0) / 6.0)
    out[6] = score


class SecondLooks(NamedTuple):
    """Candidates that were followed to the end: of those at one place the best.

    Attributes
    ----------
    centre : (L,) int64
        Their indices.
    features : (L, len(FEATURES)) float64
        Of their rims.
    place, covariance : (L, 2), (L, 2, 2) float64
        Metres, square metres.
    evidence : (L,) float64
        Log-odds, on the scale of `DiscSearch.least_evidence`.
    """

    centre: NDArray[np.int64]
    features: FloatArray
    place: FloatArray
    covariance: FloatArray
    evidence: FloatArray


def second_looks(
    scene: Scene, centres: Centres, found_xy: FloatArray, step: float, network: RimNetwork
) -> SecondLooks:
    """Look a second time at candidates that are not at discs already found.

    Parameters
    ----------
    scene : Scene
    centres : Centres
        Candidates; the contrast's sign says which discs are looked for.
    found_xy : (M, 2) float64
        Places of discs already found, metres.
    step : float
        Directions with a larger step are compared first, grey levels.
    network : RimNetwork
    """
    separation = scene.search.separation
    index = strong_and_alone(centres, centres.score, scene.floor_xy, 0.0, 0.5 * separation)
    looks = _look_at_all(
        scene, chosen(centres, index), np.ascontiguousarray(found_xy), step, network
    )
    best = np.flatnonzero(suppress_neighbours(looks.place, looks.evidence, separation))
    return SecondLooks(
        index[looks.centre[best]], looks.features[best], looks.place[best], looks.covariance[best],
        looks.evidence[best],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _look_at_all(
    scene: Scene, centres: Centres, found_xy: FloatArray, step: float, network: RimNetwork
) -> SecondLooks:
    image, camera_numbers, search = scene.image, scene.camera_numbers, scene.search
    n = len(centres.score)
    index, features = np.empty(n, np.int64), np.empty((n, len(FEATURES)))
    place, covariance, evidence = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n)
    count = 0
    for i in range(n):
        u, v = centres.pixels[i, 0], centres.pixels[i, 1]
        x, y = np.float64(scene.floor_xy[v, u, 0]), np.float64(scene.floor_xy[v, u, 1])
        if _near_any(found_xy, x, y, _WITHIN * search.separation):
            continue
        sign = 1.0 if centres.contrast[i] > 0.0 else -1.0
        weight, median = outline_steps(image, scene.floor_xy, u, v, search, sign, step)
        if weight < _LEAST_OUTLINE:
            continue
        rim = follow_rim(image, camera_numbers, x, y, search.radius, sign * median)
        if rim.agreeing < _LEAST_RIM:
            continue
        again = follow_rim(image, camera_numbers, rim.x, rim.y, search.radius, rim.step)
        if again.agreeing >= rim.agreeing - _RIM_SLACK:
            rim = again
        if _near_any(found_xy, rim.x, rim.y, search.separation):
            continue
        _note_rim(rim, search.radius, centres.score[i], features[count])
        grey, scale = profiles(image, camera_numbers, rim.x, rim.y, search.radius)
        inputs, scales = network_inputs(grey, scale, sign)
        log_odds = network_log_odds(inputs, scales, features[count], network)
        index[count] = i
        place[count, 0], place[count, 1] = rim.x, rim.y
        covariance[count, 0, 0], covariance[count, 1, 1] = rim.cov_xx, rim.cov_yy
        covariance[count, 0, 1] = covariance[count, 1, 0] = rim.cov_xy
        evidence[count] = search.least_evidence + log_odds - _TAKEN
        count += 1
    return SecondLooks(
        index[:count], features[:count], place[:count], covariance[:count], evidence[:count]
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _near_any(places: FloatArray, x: float, y: float, distance: float) -> bool:
    for k in range(len(places)):
        if (places[k, 0] - x) ** 2 + (places[k, 1] - y) ** 2 < distance * distance:
            return True
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _about_plane(
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
