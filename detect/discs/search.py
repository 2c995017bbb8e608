"""Compiled search for discs among the maxima of the quality: looks, fits, and one row per disc."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import fit
from detect.discs.candidates import middles, strong_and_alone, suppress_neighbours
from detect.discs.descent import Hope
from detect.discs.evidence_kernels import (
    CLEAR_EVIDENCE,
    LEAST_MIDDLE_STEP,
    LEAST_RIM,
    LEAST_RIM_PX,
    RADIUS_RANGE,
    evidence_of,
    evidence_with_rim,
)
from detect.discs.fit import RESULT, X, Y, fit_disc, fitted_positions, working_space
from detect.discs.model import Disc
from detect.discs.patch import FULL, LOOK, Candidate, FitSettings, floor_steps
from detect.discs.quality import Centres
from detect.discs.rim import Rim, follow_rim

#: Candidates whose first look is this much below the required evidence are not fitted in full; more
#: is allowed where the quality is high, for what hides part of a disc hardly lowers that.
_FIRST_LOOK_SLACK = 2.0
_SLACK_PER_QUALITY, _ORDINARY_QUALITY = 15.0, 0.7
#: A look must promise to explain this share of the variance.
_LEAST_SHARE = 0.1
#: A look this much above the required evidence shows a disc clearly; within this share of the
#: separation from it nothing else is looked for.
_CLEAR = 6.0
_WITHIN = 0.75
#: Looks that came to places nearer than this share of the separation are at the same disc.
_SAME_DISC = 0.3
#: In place of an evidence of minus infinity, where nothing is verified.
_NO_EVIDENCE = -1e9
#: A blur that reached this share of the most that a patch allows is fitted again in a wider one.
_AT_BOUND = 0.98
_MOST_REFITS = 2
#: From this number of clear discs on, their sign counts against doubtful ones of the other.
_LEAST_CLEAR = 20
#: By fit and rim together, a candidate that the fit speaks against needs these log-odds, and one
#: that it speaks for is dropped below those.
_RESCUED, _REFUTED = 0.93, 0.0
#: Where the edge is farther than this from a circle (radii), the rim is a coincidence.
_MOST_UNEVEN = 0.14
#: A disc whose evidence exceeds the least by this much is placed by the fit.
_BY_FIT = 0.5
#: From this share of the rim on, the fit of the whole disc gives the place better.
_WHOLE_RIM = 0.9
#: A rim whose step varies by less than this over the directions, relative to its mean, is even.
_EVEN = 0.18
#: A fit that explains less of the variance than this may place the disc worse than half of its rim.
_WELL_EXPLAINED, _HALF_RIM = 0.97, 0.5


#: Candidates of a lower quality than this are kept only if the grey value steps in this share
#: of the directions, by this share of the contrast.
CLEAR_QUALITY = 0.55
_LEAST_STEPS = 0.9
_LEAST_STEP = 0.25
_DIRECTIONS = np.array([[math.cos(k * math.pi / 8), math.sin(k * math.pi / 8)] for k in range(16)])


class DiscSearch(NamedTuple):
    """What is searched for: see `detect.settings.CircleSettings`."""

    radius: float
    """Nominal radius, and those of the outlines, metres."""
    inner: float
    outer: float
    separation: float
    """Metres."""
    verify: bool
    """Drop candidates without evidence of a disc."""
    refine: bool
    """Neighbours are suppressed at the fitted positions; else at the candidates'."""
    least_evidence: float
    optics_px: float
    pixel_variance: float
    """Of the systematic error, pixels squared."""
    tilt_variance: float
    """Of pitch and of roll, radians squared."""


class Scene(NamedTuple):
    """An image, and how it is searched."""

    image: NDArray[np.uint8]
    floor_xy: NDArray[np.float32]
    search: DiscSearch
    settings: FitSettings
    camera_numbers: NDArray[np.float64]


class FoundDiscs(NamedTuple):
    """Discs that were found.

    Attributes
    ----------
    centre : (M,) int64
        Indices of the candidates.
    floor_xy, covariance : (M, 2), (M, 2, 2) float64
        Fitted places and their covariances by the fits alone, metres, square metres.
    evidence : (M,) float64
    """

    centre: NDArray[np.int64]
    floor_xy: NDArray[np.float64]
    covariance: NDArray[np.float64]
    evidence: NDArray[np.float64]


def search_discs(scene: Scene, centres: Centres, weakest: float) -> FoundDiscs:
    """Fit discs at the best centres, weigh the evidence, and keep the best of those that are one.

    Parameters
    ----------
    scene : Scene
    centres : Centres
    weakest : float
        Least contrast, grey levels.
    """
    search = scene.search
    # Each disc has several best centres: of those in the middle of it one is enough.
    near = 0.5 * search.separation
    keep = strong_and_alone(centres, scene.floor_xy, weakest, near)
    starts = middles(centres, keep, scene.floor_xy, weakest, near)
    quality, contrast, work = centres.quality[keep], centres.contrast[keep], working_space()[0]
    order = np.argsort(-quality, kind="stable")
    looks, promise = _look_at_all(scene, starts, quality, contrast, order, work)
    order = np.flatnonzero(promise > -np.inf)
    looked_xy = np.column_stack([looks[X], looks[Y]])
    order = _apart(order, looked_xy, promise, _SAME_DISC * search.separation)
    results, evidence, score = _fit_all(scene, starts, quality, contrast, looks, order, work)
    found = np.flatnonzero(score > -np.inf)
    places = np.column_stack([results[X], results[Y]])
    if not search.refine:
        places = scene.floor_xy[starts[:, 1], starts[:, 0]].astype(np.float64)
    found = _apart(found, places, score, search.separation)
    if search.verify:
        found = found[_likely_sign(contrast[found] > 0.0, evidence[found], search.least_evidence)]
    return FoundDiscs(keep[found], *fitted_positions(results[found]), evidence[found])


def _apart(
    index: NDArray[np.int64], place: NDArray[np.float64], score: NDArray[np.float64], near: float
) -> NDArray[np.int64]:
    """Those of some discs that have no better one nearby; all of them if nothing is near."""
    if near > 0.0:
        index = index[suppress_neighbours(place[index], score[index], near)]
    return index


def _likely_sign(
    light: NDArray[np.bool_], evidence: NDArray[np.float64], least_evidence: float
) -> NDArray[np.bool_]:
    """Which discs are not both doubtful and the only dark ones among light ones, or vice versa.

    Discs of one place are mostly alike. With m of n clear discs of a sign, the odds of that sign
    are (m + 1) : (n - m + 1) by Laplace's rule of succession; where they speak against a doubtful
    disc, they are weighed with its evidence. Few clear discs say too little.
    """
    clear = evidence >= least_evidence + CLEAR_EVIDENCE
    if np.count_nonzero(clear) < _LEAST_CLEAR:
        return np.ones(len(light), np.bool_)
    odds = (np.count_nonzero(light & clear) + 1) / (np.count_nonzero(~light & clear) + 1)
    log_odds = np.where(light, 1.0, -1.0) * math.log(odds)
    return np.asarray(evidence + np.minimum(log_odds, 0.0) >= least_evidence)


@njit(cache=True, error_model="numpy", forceinline=True)
def _evidence(result: Any, search: DiscSearch) -> float:
    return evidence_of(
        result[fit.EXPLAINED],
        result[fit.RADIUS] / search.radius,
        result[fit.OUTLINE_DEVIATION],
        result[fit.SECTORS_GOOD],
        result[fit.MIDDLE_STEP],
        result[fit.RELATIVE_BLUR],
        search.optics_px,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _slack(quality: float) -> float:
    """How much less than the required evidence a first look may promise."""
    return _FIRST_LOOK_SLACK + _SLACK_PER_QUALITY * max(quality - _ORDINARY_QUALITY, 0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def _rim_of(scene: Scene, result: Any) -> Rim:
    return follow_rim(
        scene.image, scene.camera_numbers, result[fit.X], result[fit.Y], scene.search.radius,
        result[fit.CONTRAST],
    )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True)
def _with_rim(scene: Scene, quality: float, log_odds: float, result: Any) -> float:
    """The evidence of a doubtful fit with its rim, which also places a partly hidden disc."""
    search = scene.search
    relative = result[fit.RADIUS] / search.radius
    possible = (
        RADIUS_RANGE[0] < relative < RADIUS_RANGE[1] and result[fit.MIDDLE_STEP] > LEAST_MIDDLE_STEP
    )
    if not possible:
        return log_odds
    rim = _rim_of(scene, result)
    if rim.radius_px < LEAST_RIM_PX:
        return log_odds
    together = evidence_with_rim(
        log_odds, result[fit.EXPLAINED], result[fit.CONTRAST], quality, rim, search.radius
    )
    by_fit = log_odds
    if log_odds >= search.least_evidence and together < _REFUTED:
        by_fit = -math.inf
    by_rim = search.least_evidence + together - _RESCUED
    if log_odds >= search.least_evidence + _BY_FIT or result[fit.OUTLINE_DEVIATION] > _MOST_UNEVEN:
        return by_fit
    if by_rim < search.least_evidence and log_odds >= search.least_evidence:
        return by_fit
    if _places_well(rim):
        _place_by_rim(result, rim)
    return by_rim


@njit(cache=True, error_model="numpy", nogil=True)
def _places_well(rim: Rim) -> bool:
    """Whether a rim is hidden in part, and steps by as much all round where it is not.

    Where movement blurs it, it steps less on two sides, and is found beside its place.
    """
    return rim.agreeing < _WHOLE_RIM and rim.unevenness < _EVEN


@njit(cache=True, error_model="numpy", nogil=True)
def _place_by_rim(result: Any, rim: Rim) -> None:
    result[fit.X], result[fit.Y] = rim.x, rim.y
    result[fit.COV_XX], result[fit.COV_XY] = rim.cov_xx, rim.cov_xy
    result[fit.COV_YY] = rim.cov_yy


@njit(cache=True, error_model="numpy", nogil=True)
def _place_by_the_surer(scene: Scene, result: Any) -> None:
    """Place a disc that the fit explains in part by its rim, if that states the smaller covariance.

    A shadow's edge, a sun patch or a sheet of paper pull at the fit of a whole disc, and much less
    at the points of the rim beside them.
    """
    if result[fit.EXPLAINED] >= _WELL_EXPLAINED:
        return
    rim = _rim_of(scene, result)
    by_fit = result[fit.COV_XX] + result[fit.COV_YY]
    enough = rim.agreeing >= _HALF_RIM and rim.radius_px >= LEAST_RIM_PX
    if enough and _places_well(rim) and rim.cov_xx + rim.cov_yy < by_fit:
        _place_by_rim(result, rim)


@njit(cache=True, error_model="numpy", forceinline=True)
def nearest_pixel(
    floor_xy: NDArray[np.float32], u: int, v: int, x: float, y: float
) -> tuple[int, int]:
    """The pixel that sees the floor nearest to (x, y), starting from one nearby."""
    height, width = floor_xy.shape[:2]
    for _ in range(3):
        u = min(max(u, 1), width - 2)
        v = min(max(v, 1), height - 2)
        xu = 0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0])
        yu = 0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1])
        xv = 0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0])
        yv = 0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1])
        area = xu * yv - xv * yu
        dx = x - floor_xy[v, u, 0]
        dy = y - floor_xy[v, u, 1]
        du = (yv * dx - xv * dy) / area
        dv = (xu * dy - yu * dx) / area
        if not (abs(du) < width and abs(dv) < height):
            return u, v
        if abs(du) <= 0.5 and abs(dv) <= 0.5:
            return u, v
        u += round(du)
        v += round(dv)
    return min(max(u, 1), width - 2), min(max(v, 1), height - 2)


@njit(cache=True, error_model="numpy", nogil=True)
def share_of_steps(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    inner: float,
    outer: float,
    contrast: float,
) -> float:
    """In what share of directions the grey value steps from a small circle to a large one.

    Clutter (an edge, a corner, texture) can part the grey values of the two circles nearly as well
    as a disc does, but it does so on some sides only.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    u0, v0 : int
        The circles' centre.
    inner, outer : float
        Radii, metres: on the floor, which is taken to be seen as a plane by parallel rays.
    contrast : float
        Grey levels inside minus outside; a step of the same sign and a quarter of that counts.

    Returns
    -------
    float
        Of the directions in which both circles are in the image; 1 if there are none.
    """
    height, width = image.shape
    xu, yu, xv, yv = floor_steps(floor_xy, u0, v0)
    area = xu * yv - xv * yu
    if not abs(area) > 0.0:
        return 1.0
    per_area = 1.0 / area
    seen = 0
    steps = 0
    for k in range(len(_DIRECTIONS)):
        x, y = _DIRECTIONS[k, 0], _DIRECTIONS[k, 1]
        du = (yv * x - xv * y) * per_area
        dv = (xu * y - yu * x) * per_area
        # Half a pixel up, and rounded down: nearest pixels.
        u1 = math.floor(u0 + inner * du + 0.5)
        v1 = math.floor(v0 + inner * dv + 0.5)
        u2 = math.floor(u0 + outer * du + 0.5)
        v2 = math.floor(v0 + outer * dv + 0.5)
        if min(u1, u2, v1, v2) < 0 or max(u1, u2) >= width or max(v1, v2) >= height:
            continue
        seen += 1
        difference = float(image[v1, u1]) - float(image[v2, u2])
        steps += 1 if difference * contrast > _LEAST_STEP * contrast * contrast else 0
    return steps / seen if seen > 0 else 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def worth_a_look(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u: int,
    v: int,
    quality: float,
    contrast: float,
    inner: float,
    outer: float,
) -> bool:
    """Whether a candidate's quality is clear, or the grey value steps on most sides.

    Parameters are those of `share_of_steps`.
    """
    if quality >= CLEAR_QUALITY:
        return True
    steps = share_of_steps(image, floor_xy, u, v, inner, outer, contrast)
    return bool(steps >= _LEAST_STEPS)


@njit(cache=True, error_model="numpy", nogil=True)
def _near_clear(clear: NDArray[np.float64], count: int, x: float, y: float, near: float) -> bool:
    """Whether a place is nearer than this to one of the first discs that showed clearly."""
    for k in range(count):
        dx, dy = clear[k, 0] - x, clear[k, 1] - y
        if dx * dx + dy * dy < near * near:
            return True
    return False


@njit(cache=True, error_model="numpy", forceinline=True)
def _hope(search: DiscSearch, quality: float) -> Hope:
    """When a fit is given up."""
    if search.verify:
        return Hope(_LEAST_SHARE, search.least_evidence - _slack(quality), search.optics_px)
    return Hope(-math.inf, -math.inf, search.optics_px)


@njit(cache=True, error_model="numpy", nogil=True)
def _promising(scene: Scene, quality: float, log_odds: float, result: Any) -> bool:
    """Whether a look is worth a fit."""
    search = scene.search
    if log_odds >= search.least_evidence - _FIRST_LOOK_SLACK:
        return True
    if log_odds < search.least_evidence - _slack(quality):
        return False
    # Whether enough of a rim is in view round a poor first look to be worth a fit.
    rim = _rim_of(scene, result)
    return bool(rim.agreeing >= LEAST_RIM or rim.radius_px < LEAST_RIM_PX)


@njit(cache=True, error_model="numpy", nogil=True)
def _look_at_all(
    scene: Scene, pixels: NDArray[np.int64], quality: NDArray[np.float64],
    contrast: NDArray[np.float32], order: NDArray[np.int64], work: Any,
) -> tuple[Any, NDArray[np.float64]]:  # fmt: skip
    """Look at the candidates in some order: (N,) RESULT, and what they promise.

    What lies within a disc that showed clearly is left out. The promise is the evidence;
    minus infinity for what is not worth a fit.
    """
    search, floor_xy = scene.search, scene.floor_xy
    looks = np.zeros(len(pixels), RESULT)
    promise = np.full(len(pixels), -np.inf)
    clear = np.empty((len(pixels), 2))
    clear_count = 0
    blur = _first_blur(scene)
    for i in order:
        u, v = pixels[i, 0], pixels[i, 1]
        x, y = float(floor_xy[v, u, 0]), float(floor_xy[v, u, 1])
        if _near_clear(clear, clear_count, x, y, _WITHIN * search.separation):
            continue
        if search.verify and not worth_a_look(
            scene.image, floor_xy, u, v, quality[i], float(contrast[i]), search.inner, search.outer
        ):
            continue
        candidate = Candidate(u, v, search.radius, blur)
        start = Disc(0.0, 0.0, 1.0, math.log(blur))
        fitted = fit_disc(
            scene.image, scene.floor_xy, candidate, scene.settings, start, LOOK,
            _hope(search, quality[i]), work, looks[i],
        )  # fmt: skip
        log_odds = _evidence(looks[i], search) if fitted else -math.inf
        if not search.verify:
            if fitted:
                promise[i] = max(log_odds, _NO_EVIDENCE)
        elif _promising(scene, quality[i], log_odds, looks[i]):
            promise[i] = log_odds
            if log_odds >= search.least_evidence + _CLEAR:
                clear[clear_count, 0], clear[clear_count, 1] = looks[i][fit.X], looks[i][fit.Y]
                clear_count += 1
    return looks, promise


@njit(cache=True, error_model="numpy", forceinline=True)
def _first_blur(scene: Scene) -> float:
    return max(scene.settings.blur_px, 0.6 * scene.search.optics_px)


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_after_look(
    scene: Scene, pixel: NDArray[np.int64], quality: float, look: Any, work: Any, result: Any
) -> tuple[bool, float]:
    """Fit in full where a look came to: whether it is a disc, and the evidence."""
    search, floor_xy = scene.search, scene.floor_xy
    u, v = nearest_pixel(floor_xy, pixel[0], pixel[1], look[fit.X], look[fit.Y])
    # A look gives the blur but roughly: too small a patch would be gathered again.
    blur = max(look[fit.BLUR], _first_blur(scene))
    x, y, radius, log_blur = look[fit.X], look[fit.Y], look[fit.RADIUS], math.log(look[fit.BLUR])
    enough, log_odds = False, -math.inf
    for _ in range(1 + _MOST_REFITS):
        start = Disc(
            (x - floor_xy[v, u, 0]) / search.radius,
            (y - floor_xy[v, u, 1]) / search.radius,
            radius / search.radius,
            log_blur,
        )
        candidate = Candidate(u, v, search.radius, blur)
        fitted = fit_disc(
            scene.image, scene.floor_xy, candidate, scene.settings, start, FULL,
            _hope(search, quality), work, result,
        )  # fmt: skip
        log_odds = _evidence(result, search) if fitted else -math.inf
        if search.verify and fitted and log_odds < search.least_evidence + CLEAR_EVIDENCE:
            log_odds = _with_rim(scene, quality, log_odds, result)
        enough = fitted and (not search.verify or log_odds >= search.least_evidence)
        if not (enough and result[fit.BLUR] > _AT_BOUND * result[fit.BLUR_BOUND]):
            if enough and search.verify:
                _place_by_the_surer(scene, result)
            break
        # Too blurred for its patch: once more, in a wider one.
        blur = result[fit.BLUR_BOUND]
        x, y, radius = result[fit.X], result[fit.Y], result[fit.RADIUS]
        log_blur = math.log(result[fit.BLUR])
    return enough, log_odds


@njit(cache=True, error_model="numpy", nogil=True)
def _fit_all(
    scene: Scene, pixels: NDArray[np.int64], quality: NDArray[np.float64],
    contrast: NDArray[np.float32], looks: Any, order: NDArray[np.int64], work: Any,
) -> tuple[Any, NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Fit what the looks left: (N,) RESULT, the evidence, and a score for those that are discs."""
    search = scene.search
    results = np.zeros(len(pixels), RESULT)
    evidence, score = np.full(len(pixels), -np.inf), np.full(len(pixels), -np.inf)
    for i in order:
        result = results[i]
        enough, log_odds = _fit_after_look(scene, pixels[i], quality[i], looks[i], work, result)
        evidence[i] = log_odds
        candidate = scene.floor_xy[pixels[i, 1], pixels[i, 0]]
        # A fit that wandered off, or turned the disc's contrast round, is about something else.
        off = math.hypot(result[fit.X] - candidate[0], result[fit.Y] - candidate[1])
        same_sign = result[fit.CONTRAST] * contrast[i] > 0.0
        if enough and off < search.radius and same_sign:
            score[i] = log_odds if log_odds > -math.inf else _NO_EVIDENCE + quality[i]
    return results, evidence, score
