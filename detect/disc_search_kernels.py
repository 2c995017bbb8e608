"""Compiled search for discs among the maxima of the quality: looks, fits, and one row per disc."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect import disc_fit_kernels as fit
from detect.circle_kernels import suppress_neighbours
from detect.disc_descent_kernels import PATIENT, Hope, new_work
from detect.disc_evidence_kernels import evidence_of
from detect.disc_fit_kernels import fit_disc
from detect.disc_list_kernels import floor_steps
from detect.disc_patch_kernels import FitSettings

#: Candidates whose first look is this much below the required evidence are not fitted in full.
_FIRST_LOOK_SLACK = 2.0
#: Candidates of a lower quality than this are looked at only if the grey value steps in this share
#: of the directions, by this share of the contrast.
_CLEAR_QUALITY = 0.55
_LEAST_STEPS = 0.85
_LEAST_STEP = 0.25
_DIRECTIONS = np.array([[math.cos(k * math.pi / 8), math.sin(k * math.pi / 8)] for k in range(16)])
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


@njit(cache=True, error_model="numpy", nogil=True)
def strong_and_alone(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
) -> NDArray[np.int64]:
    """Which of the best centres have at least the contrast `weakest`, and no better one nearby.

    Parameters
    ----------
    pixels, quality, contrast : (N, 2) int64, (N,) float64, (N,) float32
        See `detect.centres.best_centres`.
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    weakest : float
        Grey levels.
    separation : float
        Of centres closer than this on the floor the one of the highest quality stays, metres.

    Returns
    -------
    (M,) int64
        Indices, ascending.
    """
    index = np.flatnonzero(np.abs(contrast) >= weakest)
    place = np.empty((len(index), 2))
    for k in range(len(index)):
        u, v = pixels[index[k]]
        place[k, 0] = floor_xy[v, u, 0]
        place[k, 1] = floor_xy[v, u, 1]
    return index[suppress_neighbours(place, quality[index], separation)]


@njit(cache=True, error_model="numpy", nogil=True)
def middles(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
    keep: NDArray[np.int64],
) -> NDArray[np.int64]:
    """In the middle of which pixels of the same disc each best centre lies.

    A large disc has many best centres, and which of them is the very best is up to the noise: a fit
    that starts beside the disc's middle may be given up.

    Parameters
    ----------
    pixels, quality, contrast, floor_xy, weakest, separation
        As in `strong_and_alone`.
    keep : (M,) int64
        What that returned.

    Returns
    -------
    (M, 2) int64
        Pixels (u, v): the means of the centres of at least the contrast `weakest`, and of the same
        sign, within the separation, weighed by quality squared and contrast.
    """
    middle = np.empty((len(keep), 2), np.int64)
    for k in range(len(keep)):
        u0, v0 = pixels[keep[k]]
        total = 0.0
        sum_u = 0.0
        sum_v = 0.0
        for i in range(len(pixels)):
            if abs(contrast[i]) < weakest or contrast[i] * contrast[keep[k]] < 0.0:
                continue
            u, v = pixels[i]
            dx = floor_xy[v, u, 0] - floor_xy[v0, u0, 0]
            dy = floor_xy[v, u, 1] - floor_xy[v0, u0, 1]
            if dx * dx + dy * dy < separation * separation or i == keep[k]:
                weight = quality[i] * quality[i] * abs(contrast[i])
                total += weight
                sum_u += weight * (u - u0)
                sum_v += weight * (v - v0)
        middle[k, 0] = u0 + round(sum_u / total)
        middle[k, 1] = v0 + round(sum_v / total)
    return middle


@njit(cache=True, error_model="numpy", forceinline=True)
def _nearest_pixel(
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
        x, y = _DIRECTIONS[k]
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


@njit(cache=True, error_model="numpy", forceinline=True)
def _evidence(result: NDArray[np.float64], radius: float, optics_px: float) -> float:
    return evidence_of(
        result[fit.EXPLAINED],
        result[fit.RADIUS] / radius,
        result[fit.OUTLINE_DEVIATION],
        result[fit.SECTORS_GOOD],
        result[fit.MIDDLE_STEP],
        result[fit.RELATIVE_BLUR],
        optics_px,
    )


@njit(cache=True, error_model="numpy", nogil=True)
def search_discs(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    radius: float,
    inner: float,
    outer: float,
    settings: FitSettings,
    verify: bool,
    refine: bool,
    least_evidence: float,
    optics_px: float,
    separation: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Fit discs at candidates, weigh the evidence, and keep the best of those that are one.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    pixels, quality, contrast : (N, 2) int64, (N,) float64, (N,) float32
        The candidates (see `detect.centres.best_centres`).
    radius, inner, outer : float
        Nominal radius, and those of the outlines, metres.
    settings : FitSettings
    verify : bool
        Drop candidates without `least_evidence`.
    refine : bool
        Neighbours are suppressed at the fitted positions; else at the candidates'.
    least_evidence, optics_px, separation : float
        `CircleSettings.evidence`, `blur_px` and `separation_m`.

    Returns
    -------
    results : (M, RESULT_SIZE) float64
        Fits of the discs found (columns: `detect.disc_fit_kernels`).
    evidence : (M,) float64
    index : (M,) int64
        Which of the candidates they are, ascending.
    """
    n = len(pixels)
    work = new_work()
    looks = np.zeros((n, fit.RESULT_SIZE))
    place = np.zeros((n, 2))
    promise = np.full(n, -np.inf)
    start = np.zeros(4)
    blur_start = max(settings.blur_px, 0.6 * optics_px)
    hope = PATIENT
    if verify:
        hope = Hope(_LEAST_SHARE, least_evidence - _FIRST_LOOK_SLACK, optics_px)
    # The best first: what lies within a disc that shows clearly need not be looked at.
    clear = np.empty((n, 2))
    clear_count = 0
    within_2 = (_WITHIN * separation) ** 2
    for i in np.argsort(-quality, kind="mergesort"):
        u, v = pixels[i]
        seen = False
        for k in range(clear_count):
            dx = clear[k, 0] - floor_xy[v, u, 0]
            dy = clear[k, 1] - floor_xy[v, u, 1]
            if dx * dx + dy * dy < within_2:
                seen = True
                break
        if seen:
            continue
        if verify and quality[i] < _CLEAR_QUALITY:
            steps = share_of_steps(image, floor_xy, u, v, inner, outer, float(contrast[i]))
            if steps < _LEAST_STEPS:
                continue
        start[0] = 0.0
        start[1] = 0.0
        start[2] = 1.0
        start[3] = math.log(blur_start)
        look = looks[i]
        if not fit_disc(
            image, floor_xy, pixels[i, 0], pixels[i, 1], radius, settings, start, blur_start,
            fit.LOOK, hope, work, look,
        ):  # fmt: skip
            continue
        place[i, 0] = look[fit.X]
        place[i, 1] = look[fit.Y]
        told = _evidence(look, radius, optics_px)
        if not verify:
            promise[i] = told if told > -math.inf else -1e9
        elif told >= least_evidence - _FIRST_LOOK_SLACK:
            promise[i] = told
            if told >= least_evidence + _CLEAR:
                clear[clear_count, 0] = look[fit.X]
                clear[clear_count, 1] = look[fit.Y]
                clear_count += 1
    likely = np.flatnonzero(promise > -np.inf)
    if separation > 0.0:
        likely = likely[
            suppress_neighbours(place[likely], promise[likely], _SAME_DISC * separation)
        ]

    results = np.zeros((len(likely), fit.RESULT_SIZE))
    evidence = np.full(len(likely), -np.inf)
    score = np.full(len(likely), -np.inf)
    found = np.empty((len(likely), 2))
    for k in range(len(likely)):
        i = likely[k]
        look = looks[i]
        result = results[k]
        u, v = _nearest_pixel(floor_xy, pixels[i, 0], pixels[i, 1], look[fit.X], look[fit.Y])
        # A look tells the blur but roughly; too small a patch would have to be gathered again.
        blur = max(look[fit.BLUR], blur_start)
        start[2] = look[fit.RADIUS] / radius
        # First with the pixels that tell most; a disc, or one too blurred for the patch, once more.
        detail = fit.EDGE
        at_x, at_y = look[fit.X], look[fit.Y]
        log_blur = math.log(look[fit.BLUR])
        fitted = False
        for _ in range(1 + _MOST_REFITS):
            start[0] = (at_x - floor_xy[v, u, 0]) / radius
            start[1] = (at_y - floor_xy[v, u, 1]) / radius
            start[3] = log_blur
            fitted = fit_disc(
                image, floor_xy, u, v, radius, settings, start, blur, detail, hope, work, result
            )
            if not fitted:
                break
            evidence[k] = _evidence(result, radius, optics_px)
            wider = result[fit.BLUR] > _AT_BOUND * result[fit.BLUR_BOUND]
            if (verify and evidence[k] < least_evidence) or (
                not wider and (detail == fit.ALL or result[fit.COMPLETE] > 0.0)
            ):
                break
            detail = fit.ALL
            at_x, at_y = result[fit.X], result[fit.Y]
            start[2] = result[fit.RADIUS] / radius
            log_blur = math.log(result[fit.BLUR])
            if wider:
                blur = result[fit.BLUR_BOUND]
        candidate = floor_xy[pixels[i, 1], pixels[i, 0]]
        found[k, 0] = result[fit.X] if refine else candidate[0]
        found[k, 1] = result[fit.Y] if refine else candidate[1]
        # A fit that wandered off, or turned the disc's contrast round, is about something else.
        stayed = math.hypot(result[fit.X] - candidate[0], result[fit.Y] - candidate[1]) < radius
        same_sign = result[fit.CONTRAST] * contrast[i] > 0.0
        if not (fitted and stayed and same_sign):
            continue
        if evidence[k] > -math.inf:
            score[k] = evidence[k]
        else:
            score[k] = -1e9 + quality[i]
        if verify and evidence[k] < least_evidence:
            score[k] = -math.inf
    sound = np.flatnonzero(score > -np.inf)
    if separation > 0.0:
        sound = sound[suppress_neighbours(found[sound], score[sound], separation)]
    return results[sound], evidence[sound], likely[sound]
