"""A second look for discs of one polarity: candidates by edges, followed round their rims.

Glare or a sun patch beside a disc raises the total variance of its outlines, a cable across it
leaves much that the fit of a whole disc does not explain, and far away a disc has few pixels. A
person sees the disc all the same. Here the candidates are those of the Hough transform
(`detect.discs.hough`). Round each the rim is followed (`detect.discs.rim`), and where enough of it
lies on a circle of the right size, a small network (`detect.discs.rim_network`) decides by the grey
values about it and by the rim.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.candidates import suppress_neighbours
from detect.discs.hough import HoughCandidates
from detect.discs.rim import (
    COS,
    DIRECTIONS,
    FARTHEST,
    NEAREST,
    SIN,
    STEPS,
    Rim,
    follow_again,
    follow_rim,
    median,
    profiles,
)
from detect.discs.rim_network import Networks, RimNetwork, network_inputs, network_log_odds
from redetect.compiled import kernel

FloatArray = NDArray[np.float64]

#: Where grey values count as of the disc and of the floor, nominal radii.
_INSIDE, _OUTSIDE = (0.4, 0.75), (1.25, 1.6)
#: Directions of a glance (a part of the rim's), where its samples are, and which are inside and
#: outside; the least share of directions in which the disc differs from the floor.
GLANCED = DIRECTIONS // 2
GLANCED_AT = np.linspace(0.3, 1.7, 8)
_INNER, _OUTER = (slice(1, 3), slice(2, 4)), slice(5, 7)
_LEAST_STEPS = 0.24
#: Least log-odds of a glance; those of candidates with at least this score.
_LEAST_GLANCE, _LEAST_IF_VOTED, _VOTED = 0.3, -0.7, 3.0
#: Least share of the rim that is on a circle.
_LEAST_RIM = 0.3
#: Nearer to a disc already found than this share of the separation nothing is looked for.
_WITHIN = 0.75
#: Radius of a rim that fits best, relative to the nominal one.
_RIM_RADIUS = 0.98
#: Log-odds by the network that make a disc.
_TAKEN = 0.8
#: A rim that looks worse than this by the log-odds is not followed from its own middle.
_HOPELESS = -4.0
#: Nearer to another rim than this share of the radius it is the same.
_SAME = 0.1
#: Features of the rim, in the order of the network's weights.
FEATURES = ("rim", "runs", "scatter", "radius", "radius_2", "size", "score")


class Sought(NamedTuple):
    """Which discs are looked for."""

    radius: float
    """Nominal, metres."""
    separation: float
    """Least distance of two discs, metres."""
    sign: float
    """1 for light discs, -1 for dark ones."""
    least_step: float
    """Least step of the grey value at a rim, grey levels."""
    needed: float
    """Log-odds that a disc needs more than usual."""


class SecondLooks(NamedTuple):
    """Candidates that were followed to the end, at most one in each place.

    Attributes
    ----------
    features : (N, len(FEATURES)) float64
    floor_xy : (N, 2) float64
        Metres.
    seen_from, doubt : (N, 2) float64
        Where the rim was followed from, and the difference to the centre of the rim that is found
        from the other start, metres.
    step : (N,) float64
        Of the grey value at the rim, inside minus outside.
    floor_grey : (N,) float64
        Mean grey value of the floor round it.
    quality : (N,) float64
        Otsu's, of the disc and that floor.
    log_odds : (N,) float64
        That it is a disc; above 0 it is taken for one.
    """

    features: FloatArray
    floor_xy: FloatArray
    seen_from: FloatArray
    doubt: FloatArray
    step: FloatArray
    floor_grey: FloatArray
    quality: FloatArray
    log_odds: FloatArray


NO_LOOKS = SecondLooks(np.empty((0, len(FEATURES))), *np.empty((3, 0, 2)), *np.empty((4, 0)))


def second_looks(
    image: NDArray[np.uint8],
    candidates: HoughCandidates,
    found_xy: FloatArray,
    sought: Sought,
    camera_numbers: FloatArray,
    networks: Networks,
) -> SecondLooks:
    """Look a second time at candidates that are not at discs already found.

    Parameters
    ----------
    image : (H, W) uint8
    candidates : HoughCandidates
    found_xy : (M, 2) float64
        Places of discs already found, metres.
    sought : Sought
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    networks : Networks
    """
    looks = _look_at_all(image, candidates, found_xy, sought, camera_numbers, networks)
    best = suppress_neighbours(looks.floor_xy, looks.log_odds, sought.separation)
    return SecondLooks(*(values[best] for values in looks))


@kernel()
def _look_at_all(
    image: NDArray[np.uint8],
    candidates: HoughCandidates,
    found_xy: FloatArray,
    sought: Sought,
    camera_numbers: FloatArray,
    networks: Networks,
) -> SecondLooks:
    n = len(candidates.score)
    features, place = np.empty((n, len(FEATURES))), np.empty((n, 2))
    seen_from, doubt = np.empty((n, 2)), np.empty((n, 2))
    step, floor_grey, quality, log_odds = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    count = 0
    for i in range(n):
        x, y = candidates.floor_xy[i, 0], candidates.floor_xy[i, 1]
        if _near_any(found_xy, x, y, _WITHIN * sought.separation):
            continue
        grey, scale = glance(image, camera_numbers, x, y, sought.radius)
        contrast = _contrast(grey, sought)
        if contrast == 0.0:
            continue
        inputs, scales = network_inputs(grey, scale, sought.sign)
        score = candidates.score[i : i + 1]
        least = _LEAST_IF_VOTED if score[0] >= _VOTED else _LEAST_GLANCE
        if network_log_odds(inputs, scales, score, networks.glance) < least + sought.needed:
            continue
        rim = follow_rim(image, camera_numbers, x, y, sought.radius, sought.sign * contrast)
        is_known = _near_any(found_xy, rim.x, rim.y, sought.separation) or _near_any(
            place[:count], rim.x, rim.y, _SAME * sought.radius
        )
        if rim.agreeing < _LEAST_RIM or is_known:
            continue
        odds, noted, grey = _look(image, camera_numbers, rim, score[0], sought, networks.look)
        if odds < _HOPELESS:
            continue
        # From its own middle a rim is seen best, but that may lead to another circle.
        again = follow_again(image, camera_numbers, sought.radius, rim)
        if _near_any(found_xy, again.x, again.y, sought.separation):
            continue
        doubt[count, 0], doubt[count, 1] = again.x - rim.x, again.y - rim.y
        more, noted_again, grey_again = _look(
            image, camera_numbers, again, score[0], sought, networks.look
        )
        if more > odds and not _near_any(place[:count], again.x, again.y, _SAME * sought.radius):
            x, y = rim.x, rim.y
            rim, odds, noted, grey = again, more, noted_again, grey_again
        for k in range(len(FEATURES)):  # assigning the row takes seconds to compile
            features[count, k] = noted[k]
        log_odds[count], step[count] = odds, rim.step
        quality[count], floor_grey[count] = _quality(grey)
        place[count, 0], place[count, 1] = rim.x, rim.y
        seen_from[count, 0], seen_from[count, 1] = x, y
        count += 1
    return SecondLooks(
        features[:count], place[:count], seen_from[:count], doubt[:count], step[:count],
        floor_grey[:count], quality[:count], log_odds[:count],
    )  # fmt: skip


@kernel()
def _near_any(places: FloatArray, x: float, y: float, distance: float) -> bool:
    for k in range(len(places)):
        if (places[k, 0] - x) ** 2 + (places[k, 1] - y) ** 2 < distance * distance:
            return True
    return False


@kernel()
def _between(grey: FloatArray, bounds: tuple[float, float]) -> FloatArray:
    """Mean grey value of each direction between two distances, nominal radii."""
    per_step = (FARTHEST - NEAREST) / (STEPS - 1)
    first = round((bounds[0] - NEAREST) / per_step)
    last = round((bounds[1] - NEAREST) / per_step)
    mean = np.empty(DIRECTIONS)
    for k in range(DIRECTIONS):
        mean[k] = np.mean(grey[k, first : last + 1])
    return mean


@kernel()
def glance(
    image: NDArray[np.uint8], camera_numbers: FloatArray, x: float, y: float, radius: float
) -> tuple[FloatArray, FloatArray]:
    """The nearest grey values along some directions, without perspective within the disc.

    Parameters and results are as of `detect.discs.rim.profiles`, with fewer directions and steps.
    """
    grey, scale = np.empty((GLANCED, len(GLANCED_AT))), np.empty(GLANCED)
    u0, v0 = project_floor_point(camera_numbers, x, y)
    ux, vx = project_floor_point(camera_numbers, x + radius, y)
    uy, vy = project_floor_point(camera_numbers, x, y + radius)
    height, width = image.shape
    for k in range(GLANCED):
        cos, sin = COS[k * (DIRECTIONS // GLANCED)], SIN[k * (DIRECTIONS // GLANCED)]
        du, dv = cos * (ux - u0) + sin * (uy - u0), cos * (vx - v0) + sin * (vy - v0)
        scale[k] = math.sqrt(du * du + dv * dv)
        for m in range(len(GLANCED_AT)):
            u, v = (
                math.floor(u0 + GLANCED_AT[m] * du + 0.5),
                math.floor(v0 + GLANCED_AT[m] * dv + 0.5),
            )
            inside = 0 <= u < width and 0 <= v < height
            grey[k, m] = image[v, u] if inside else math.nan
    return grey, scale


@kernel()
def pairs_of_steps(grey: FloatArray) -> FloatArray:
    """Profiles as the network sees them: means of two steps each."""
    return 0.5 * (grey[:, ::2] + grey[:, 1::2])


@kernel()
def _contrast(grey: FloatArray, sought: Sought) -> float:
    """Median step over those directions that step enough; 0 where these are too few."""
    steps = np.empty(GLANCED)
    for inner in _INNER:
        count = 0
        for k in range(GLANCED):
            step = sought.sign * (np.mean(grey[k, inner]) - np.mean(grey[k, _OUTER]))
            if step > sought.least_step:
                steps[count] = step
                count += 1
        if count >= _LEAST_STEPS * GLANCED:
            return median(steps[:count])
    return 0.0


@kernel()
def _quality(grey: FloatArray) -> tuple[float, float]:
    """Between-class over total variance of the grey values inside and outside; mean outside."""
    inside, outside = _between(grey, _INSIDE), _between(grey, _OUTSIDE)
    seen = np.isfinite(inside) & np.isfinite(outside)
    inside, outside = inside[seen], outside[seen]
    if len(inside) == 0:
        return 0.0, 0.0
    floor_grey = np.mean(outside)
    between = 0.25 * (np.mean(inside) - floor_grey) ** 2
    total = between + 0.5 * (np.var(inside) + np.var(outside))
    return (float(between / total) if total > 0.0 else 0.0), float(floor_grey)


@kernel()
def _look(
    image: NDArray[np.uint8],
    camera_numbers: FloatArray,
    rim: Rim,
    score: float,
    sought: Sought,
    network: RimNetwork,
) -> tuple[float, FloatArray, FloatArray]:
    """Log-odds that a rim is a disc's; its features, and the grey values about it.

    Each feature is bounded, for a single one is never to decide.
    """
    noted = np.empty(len(FEATURES))
    off = abs(math.log(min(max(rim.radius / sought.radius, 0.3), 3.0) / _RIM_RADIUS))
    noted[0] = rim.agreeing
    noted[1] = min(rim.runs, 4)
    noted[2] = rim.scatter
    noted[3] = off
    noted[4] = 10.0 * off * off
    noted[5] = math.log(min(max(rim.radius_px, 3.0), 30.0) / 6.0)
    noted[6] = min(score, 12.0)
    grey, scale = profiles(image, camera_numbers, rim.x, rim.y, sought.radius)
    inputs, scales = network_inputs(pairs_of_steps(grey), scale, sought.sign)
    return network_log_odds(inputs, scales, noted, network) - _TAKEN - sought.needed, noted, grey
