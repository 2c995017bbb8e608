"""Compiled search for discs among the maxima of the quality: looks, fits, and one row per disc."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import fit
from detect.discs.candidates import Centres, middles, strong_and_alone, suppress_neighbours
from detect.discs.descent import PATIENT, Hope
from detect.discs.evidence_kernels import (
    CLEAR_EVIDENCE,
    LEAST_MIDDLE_STEP,
    LEAST_RIM,
    LEAST_RIM_PX,
    RADIUS_RANGE,
    evidence_of,
    evidence_with_rim,
)
from detect.discs.fit import RESULT, fit_disc
from detect.discs.model import Disc
from detect.discs.patch import Candidate, FitSettings, floor_steps
from detect.discs.positions import refined_covariances
from detect.discs.rim import follow_rim

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


@njit(cache=True, error_model="numpy", nogil=True)
def search_discs(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    centres: Centres,
    weakest: float,
    search: DiscSearch,
    settings: FitSettings,
    camera: tuple[NDArray[np.float64], NDArray[np.float64]],
    work: NDArray[Any],
) -> tuple[
    NDArray[np.int64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
]:
    """Fit discs at the best centres, weigh the evidence, and keep the best of those that are one.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    centres : Centres
    weakest : float
        Least contrast, grey levels.
    search : DiscSearch
    settings : FitSettings
    camera : (K,) float64, (3,) float64
        `camera_numbers` and `centre` of `detect.discs.positions.refined_covariances`.
    work : (1,) WORK
        See `detect.discs.fit.working_space`.

    Returns
    -------
    own_pixels, own_quality : (M, 2) int64, (M,) float64
        Those of the best centres that are discs, in their order.
    found_xy : (M, 2) float64
        Their fitted places, metres.
    covariance : (M, 2, 2) float64
        Square metres.
    evidence : (M,) float64
    """
    pixels, quality, contrast = centres.pixels, centres.quality, centres.contrast
    camera_numbers, centre = camera
    # Each disc has several best centres: of those in the middle of it one is enough.
    near = 0.5 * search.separation
    keep = strong_and_alone(pixels, quality, contrast, floor_xy, weakest, near)
    starts = middles(pixels, quality, contrast, floor_xy, weakest, near, keep)
    results, evidence, found = _fit_all(
        image, floor_xy, starts, quality[keep], contrast[keep], search, settings,
        work[0], camera_numbers,
    )  # fmt: skip
    if search.verify:
        found = _of_likely_sign(results, evidence, found, search.least_evidence)
    own_pixels = np.empty((len(found), 2), np.int64)
    own_quality = np.empty(len(found))
    found_xy = np.empty((len(found), 2))
    covariance = np.empty((len(found), 2, 2))
    log_odds = np.empty(len(found))
    for k in range(len(found)):
        result = results[found[k]]
        i = keep[found[k]]
        own_pixels[k, 0] = pixels[i, 0]
        own_pixels[k, 1] = pixels[i, 1]
        own_quality[k] = quality[i]
        found_xy[k, 0] = result[fit.X]
        found_xy[k, 1] = result[fit.Y]
        covariance[k, 0, 0] = result[fit.COV_XX]
        covariance[k, 0, 1] = covariance[k, 1, 0] = result[fit.COV_XY]
        covariance[k, 1, 1] = result[fit.COV_YY]
        log_odds[k] = evidence[found[k]]
    covariance = refined_covariances(
        camera_numbers, centre, found_xy, covariance, search.pixel_variance, search.tilt_variance
    )
    return own_pixels, own_quality, found_xy, covariance, log_odds


@njit(cache=True, error_model="numpy", nogil=True)
def _of_likely_sign(
    results: NDArray[Any],
    evidence: NDArray[np.float64],
    found: NDArray[np.int64],
    least_evidence: float,
) -> NDArray[np.int64]:
    """Which discs are not both doubtful and the only dark ones among light ones, or vice versa.

    Discs of one place are mostly alike. With m of n clear discs of a sign, the odds of that sign
    are (m + 1) : (n - m + 1) by Laplace's rule of succession; where they speak against a doubtful
    disc, they are weighed with its evidence. Few clear discs say too little.
    """
    light = dark = 0
    for i in found:
        if evidence[i] >= least_evidence + CLEAR_EVIDENCE:
            if results[i][fit.CONTRAST] > 0.0:
                light += 1
            else:
                dark += 1
    if light + dark < _LEAST_CLEAR:
        return found
    log_odds = math.log((light + 1.0) / (dark + 1.0))
    likely = np.ones(len(found), np.bool_)
    for k in range(len(found)):
        i = found[k]
        sign = 1.0 if results[i][fit.CONTRAST] > 0.0 else -1.0
        likely[k] = evidence[i] + min(sign * log_odds, 0.0) >= least_evidence
    return found[likely]


@njit(cache=True, error_model="numpy", forceinline=True)
def _evidence(result: Any, radius: float, optics_px: float) -> float:
    return evidence_of(
        result[fit.EXPLAINED],
        result[fit.RADIUS] / radius,
        result[fit.OUTLINE_DEVIATION],
        result[fit.SECTORS_GOOD],
        result[fit.MIDDLE_STEP],
        result[fit.RELATIVE_BLUR],
        optics_px,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def _slack(quality: float) -> float:
    """How much less than the required evidence a first look may promise."""
    return _FIRST_LOOK_SLACK + _SLACK_PER_QUALITY * max(quality - _ORDINARY_QUALITY, 0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def _shows_rim(
    image: NDArray[np.uint8],
    camera_numbers: NDArray[np.float64],
    search: DiscSearch,
    result: Any,
) -> bool:
    """Whether enough of a rim is in view round a poor first look to be worth a fit."""
    rim = follow_rim(
        image, camera_numbers, result[fit.X], result[fit.Y], search.radius, result[fit.CONTRAST]
    )
    return bool(rim.agreeing >= LEAST_RIM or rim.radius_px < LEAST_RIM_PX)


@njit(cache=True, error_model="numpy", nogil=True)
def _with_rim(
    image: NDArray[np.uint8],
    camera_numbers: NDArray[np.float64],
    search: DiscSearch,
    quality: float,
    log_odds: float,
    result: Any,
) -> float:
    """The evidence of a doubtful fit with its rim, which also places a partly hidden disc."""
    relative = result[fit.RADIUS] / search.radius
    possible = (
        RADIUS_RANGE[0] < relative < RADIUS_RANGE[1] and result[fit.MIDDLE_STEP] > LEAST_MIDDLE_STEP
    )
    if not possible:
        return log_odds
    rim = follow_rim(
        image, camera_numbers, result[fit.X], result[fit.Y], search.radius, result[fit.CONTRAST]
    )
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
    if rim.agreeing < _WHOLE_RIM:
        result[fit.X], result[fit.Y] = rim.x, rim.y
        result[fit.COV_XX], result[fit.COV_XY], result[fit.COV_YY] = (
            rim.cov_xx,
            rim.cov_xy,
            rim.cov_yy,
        )
    return by_rim


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
def _next_to_look_at(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    search: DiscSearch,
    order: NDArray[np.int64],
    begin: int,
    clear: NDArray[np.float64],
) -> int:
    """The place in the order, from `begin` on, of the next candidate worth a look; or the end.

    What lies within a disc that showed clearly need not be fitted.
    """
    within_2 = (_WITHIN * search.separation) ** 2
    for at in range(begin, len(order)):
        i = order[at]
        u, v = pixels[i, 0], pixels[i, 1]
        seen = False
        for k in range(len(clear)):
            dx = clear[k, 0] - floor_xy[v, u, 0]
            dy = clear[k, 1] - floor_xy[v, u, 1]
            if dx * dx + dy * dy < within_2:
                seen = True
                break
        if not seen and (
            not search.verify
            or worth_a_look(
                image, floor_xy, u, v, quality[i], float(contrast[i]), search.inner, search.outer
            )
        ):
            return at
    return len(order)


@njit(cache=True, error_model="numpy", inline="always")
def _fit_all(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    search: DiscSearch,
    settings: FitSettings,
    work: Any,
    camera_numbers: NDArray[np.float64],
) -> tuple[Any, NDArray[np.float64], NDArray[np.int64]]:
    """Look at the candidates, then fit what the looks left: the results, the evidence, the discs.

    Both are fits, and one call: it is inlined, and machine code of it twice takes twice as long to
    compile.
    """
    n = len(pixels)
    radius = search.radius
    looks = np.zeros(n, RESULT)
    results = np.zeros(n, RESULT)
    place = np.zeros((n, 2))
    promise = np.full(n, -np.inf)
    evidence = np.full(n, -np.inf)
    score = np.full(n, -np.inf)
    start = Disc(0.0, 0.0, 1.0, 0.0)
    blur_start = max(settings.blur_px, 0.6 * search.optics_px)
    hope = PATIENT
    clear = np.empty((n, 2))
    clear_count = 0
    # The best first.
    order = np.argsort(-quality, kind="mergesort")
    looking = True
    at = -1
    refits = 0
    i = 0
    u = v = 0
    blur = at_x = at_y = 0.0
    while True:
        if looking:
            at = _next_to_look_at(
                image, floor_xy, pixels, quality, contrast, search, order, at + 1,
                clear[:clear_count],
            )  # fmt: skip
            if at == len(order):
                looking = False
                order = np.flatnonzero(promise > -np.inf)
                if search.separation > 0.0:
                    order = order[
                        suppress_neighbours(
                            place[order], promise[order], _SAME_DISC * search.separation
                        )
                    ]
                at = -1
        if not looking and refits == 0:
            at += 1
            if at == len(order):
                break
        i = order[at]
        result = looks[i] if looking else results[i]
        if looking:
            u, v = int(pixels[i, 0]), int(pixels[i, 1])
            blur = blur_start
            start = Disc(0.0, 0.0, 1.0, math.log(blur_start))
        else:
            before = looks[i] if refits == 0 else results[i]
            at_x, at_y = before[fit.X], before[fit.Y]
            if refits == 0:
                u, v = nearest_pixel(floor_xy, pixels[i, 0], pixels[i, 1], at_x, at_y)
                # A look gives the blur but roughly: too small a patch would be gathered again.
                blur = max(before[fit.BLUR], blur_start)
            else:
                # Too blurred for its patch: once more, in a wider one.
                blur = before[fit.BLUR_BOUND]
            start = Disc(
                (at_x - floor_xy[v, u, 0]) / radius, (at_y - floor_xy[v, u, 1]) / radius,
                before[fit.RADIUS] / radius, math.log(before[fit.BLUR]),
            )  # fmt: skip
        if search.verify:
            hope = Hope(_LEAST_SHARE, search.least_evidence - _slack(quality[i]), search.optics_px)
        fitted = fit_disc(
            image, floor_xy, Candidate(u, v, radius, blur), settings, start, looking, hope, work,
            result,
        )  # fmt: skip
        log_odds = -math.inf
        if fitted:
            log_odds = _evidence(result, radius, search.optics_px)
        if looking:
            place[i, 0] = result[fit.X]
            place[i, 1] = result[fit.Y]
            if not search.verify:
                if fitted:
                    promise[i] = log_odds if log_odds > -math.inf else -1e9
            elif log_odds >= search.least_evidence - _FIRST_LOOK_SLACK or (
                log_odds >= search.least_evidence - _slack(quality[i])
                and _shows_rim(image, camera_numbers, search, result)
            ):
                promise[i] = log_odds
                if log_odds >= search.least_evidence + _CLEAR:
                    clear[clear_count, 0] = result[fit.X]
                    clear[clear_count, 1] = result[fit.Y]
                    clear_count += 1
            continue
        if search.verify and fitted and log_odds < search.least_evidence + CLEAR_EVIDENCE:
            log_odds = _with_rim(image, camera_numbers, search, quality[i], log_odds, result)
        evidence[i] = log_odds
        enough = fitted and (not search.verify or log_odds >= search.least_evidence)
        again = result[fit.BLUR] > _AT_BOUND * result[fit.BLUR_BOUND]
        if enough and again and refits < _MOST_REFITS:
            refits += 1
            continue
        refits = 0
        candidate = floor_xy[pixels[i, 1], pixels[i, 0]]
        place[i, 0] = result[fit.X] if search.refine else candidate[0]
        place[i, 1] = result[fit.Y] if search.refine else candidate[1]
        # A fit that wandered off, or turned the disc's contrast round, is about something else.
        stayed = math.hypot(result[fit.X] - candidate[0], result[fit.Y] - candidate[1]) < radius
        same_sign = result[fit.CONTRAST] * contrast[i] > 0.0
        if enough and stayed and same_sign:
            score[i] = log_odds if log_odds > -math.inf else -1e9 + quality[i]
    sound = np.flatnonzero(score > -np.inf)
    if search.separation > 0.0:
        sound = sound[suppress_neighbours(place[sound], score[sound], search.separation)]
    return results, evidence, sound
