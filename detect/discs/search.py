"""The search for discs among the maxima of the quality: looks, fits, and one row per disc."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.candidates import best_apart, middles, strong_and_alone
from detect.discs.descent import Hope
from detect.discs.evidence import (
    CLEAR_EVIDENCE,
    LEAST_MIDDLE_STEP,
    LEAST_RIM_PX,
    RADIUS_RANGE,
    evidence_of,
    evidence_with_rim,
    lost_by_paleness,
)
from detect.discs.fit import RESULT, fit_disc, fitted_positions, working_space
from detect.discs.model import Disc
from detect.discs.patch import FULL, LOOK, Candidate, FitSettings, floor_steps
from detect.discs.placing import WELL_EXPLAINED, apparent_radius, place_by_rim, place_fitted
from detect.discs.quality import Centres, contrast_and_floor
from detect.discs.rim import follow_rim
from redetect.compiled import kernel

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
#: Discs of this evidence are sure: others are compared with them.
SURE_EVIDENCE = 4.0
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
#: A fit that explains less of the variance than this may place the disc worse than half of its rim.
_IN_PART, _HALF_RIM = 0.94, 0.5


#: Candidates of a lower quality than this are kept only if the grey value steps in this share
#: of the directions, by this share of the contrast.
CLEAR_QUALITY = 0.55
LEAST_STEPS = 0.9
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


class Scene(NamedTuple):
    """An image, and how it is searched."""

    image: NDArray[np.uint8]
    floor_xy: NDArray[np.float32]
    search: DiscSearch
    settings: FitSettings
    camera_numbers: NDArray[np.float64]


#: What became of a candidate, in the order of the stages.
FATES = (
    "disc",
    "in a clear disc",
    "few steps",
    "first look",
    "same disc",
    "evidence",
    "elsewhere",
    "beside a better disc",
    "of the rarer sign",
    "pale",
)
_DISC, _IN_CLEAR, _FEW_STEPS, _LOOK, _SAME, _EVIDENCE, _ELSEWHERE, _BESIDE, _RARE, _PALE = range(
    len(FATES)
)


class Looks(NamedTuple):
    """All candidates that were examined, and what became of them.

    Attributes
    ----------
    pixels : (K, 2) int64
        Where they started.
    fate : (K,) int8
        Indices of `FATES`.
    log_odds : (K,) float64
        By the last fit that was made; minus infinity where there is none, or it is impossible.
    results : (K,) RESULT
        That fit.
    """

    pixels: NDArray[np.int64]
    fate: NDArray[np.int8]
    log_odds: NDArray[np.float64]
    results: NDArray[Any]


class FoundDiscs(NamedTuple):
    """Discs that were found.

    Attributes
    ----------
    centre : (M,) int64
        Indices of the candidates.
    floor_xy, covariance : (M, 2), (M, 2, 2) float64
        Fitted places and their covariances by the fits alone, metres, square metres.
    evidence : (M,) float64
    radius : float
        That the discs seem to have, metres.
    looks : Looks
    """

    centre: NDArray[np.int64]
    floor_xy: NDArray[np.float64]
    covariance: NDArray[np.float64]
    evidence: NDArray[np.float64]
    radius: float
    looks: Looks


class Fits(NamedTuple):
    """Candidates, and what their fits say."""

    centre: NDArray[np.int64]
    """(K,) indices of the centres."""
    starts: NDArray[np.int64]
    """(K, 2) pixels."""
    results: NDArray[Any]
    """(K,) `RESULT`."""
    place: NDArray[np.float64]
    """(K, 2) metres."""
    evidence: NDArray[np.float64]
    """(K,); minus infinity where there is no disc, as is the score."""
    score: NDArray[np.float64]
    """(K,) what neighbours are suppressed by."""
    rim_xy: NDArray[np.float64]
    """(K, 2) of the rim that is to place the disc, metres."""
    rim_step: NDArray[np.float64]
    """(K,) grey levels across that rim; 0 where the fit places the disc."""
    fate: NDArray[np.int8]
    """(K,) and the next: as of `Looks`."""
    log_odds: NDArray[np.float64]
    """(K,)"""


def search_discs(scene: Scene, centres: Centres, weakest: float) -> FoundDiscs:
    """Fit discs at the best centres, weigh the evidence, and keep the best of those that are one.

    Parameters
    ----------
    scene : Scene
    centres : Centres
    weakest : float
        Least contrast, grey levels.
    """
    fits, radius = _search(scene, centres, weakest, working_space())
    best = _best(scene, centres, fits)
    positions, covariance = fitted_positions(fits.results[best])
    return FoundDiscs(
        fits.centre[best], positions, covariance, fits.evidence[best], radius,
        Looks(fits.starts, fits.fate, fits.log_odds, fits.results),
    )  # fmt: skip


@kernel()
def _search(
    scene: Scene, centres: Centres, weakest: float, space: NDArray[Any]
) -> tuple[Fits, float]:
    """Fits of all candidates, discs placed by their edges; the radius that discs seem to have."""
    search, work = scene.search, space[0]
    fits = candidates_of(scene, centres, weakest)
    _fit(scene, centres, fits, work)
    radii, count = np.empty(len(fits.results)), 0
    for k in range(len(fits.results)):
        clear = fits.evidence[k] >= search.least_evidence + CLEAR_EVIDENCE
        if clear and fits.results[k].explained >= WELL_EXPLAINED:
            radii[count] = fits.results[k].radius
            count += 1
    radius = apparent_radius(search.radius, radii[:count])
    if search.verify and search.refine:
        place_found(scene, radius, fits, work)
    return fits, radius


@kernel()
def candidates_of(scene: Scene, centres: Centres, weakest: float) -> Fits:
    """The centres to fit discs at: of those in the middle of a disc one is enough."""
    near = 0.5 * scene.search.separation
    keep = strong_and_alone(centres, scene.floor_xy, weakest, near)
    starts = middles(centres, keep, scene.floor_xy, weakest, near)
    count = len(keep)
    results: Any = np.zeros(count, RESULT)
    return Fits(
        keep, starts, results, np.zeros((count, 2)), np.full(count, -np.inf),
        np.full(count, -np.inf), np.zeros((count, 2)), np.zeros(count),
        np.full(count, _LOOK, np.int8), np.full(count, -np.inf),
    )  # fmt: skip


@kernel()
def _fit(scene: Scene, centres: Centres, fits: Fits, work: Any) -> None:
    """Look at each candidate with a short fit; fit a disc in full where that promises one."""
    image, floor_xy, search, settings = scene.image, scene.floor_xy, scene.search, scene.settings
    results, place, evidence, fate = fits.results, fits.place, fits.evidence, fits.fate
    first_blur = max(settings.blur_px, 0.6 * search.optics_px)
    for k in range(len(results)):
        result, u, v = results[k], fits.starts[k, 0], fits.starts[k, 1]
        quality, contrast = centres.quality[fits.centre[k]], centres.contrast[fits.centre[k]]
        if _at_clear_disc(search, place[:k], evidence, floor_xy[v, u]):
            fate[k] = _IN_CLEAR
            continue
        if search.verify and not worth_a_look(scene, u, v, quality, contrast):
            fate[k] = _FEW_STEPS
            continue
        candidate = Candidate(u, v, search.radius, first_blur)
        start = Disc(0.0, 0.0, 1.0, math.log(first_blur))
        hope = _hope(search, quality)
        if fit_disc(image, floor_xy, candidate, settings, start, LOOK, hope, work, result):
            place[k, 0], place[k, 1] = result.x, result.y
            promise = _evidence(result, search)
            fits.log_odds[k] = promise
            if not search.verify:
                evidence[k] = max(promise, _NO_EVIDENCE)
            elif promise >= hope.least_evidence:
                evidence[k] = promise
            if evidence[k] > -np.inf:
                fate[k] = _SAME
    for k in best_apart(place, evidence, _SAME_DISC * search.separation):
        result, u, v = results[k], fits.starts[k, 0], fits.starts[k, 1]
        quality, contrast = centres.quality[fits.centre[k]], centres.contrast[fits.centre[k]]
        x, y = floor_xy[v, u, 0], floor_xy[v, u, 1]
        u, v = nearest_pixel(floor_xy, u, v, result.x, result.y)
        # A look gives the blur but roughly: too small a patch would be gathered again.
        blur = max(result.blur, first_blur)
        is_disc = False
        for _ in range(1 + _MOST_REFITS):
            candidate = Candidate(u, v, search.radius, blur)
            start = Disc(
                (result.x - floor_xy[v, u, 0]) / search.radius,
                (result.y - floor_xy[v, u, 1]) / search.radius,
                result.radius / search.radius,
                math.log(result.blur),
            )
            hope = _hope(search, quality)
            is_disc = fit_disc(
                image, floor_xy, candidate, settings, start, FULL, hope, work, result
            )
            evidence[k] = _evidence(result, search) if is_disc else -np.inf
            if is_disc and search.verify:
                verdict = _with_rim(scene, quality, evidence[k], result)
                evidence[k], fits.rim_step[k] = verdict.log_odds, verdict.rim_step
                fits.rim_xy[k, 0], fits.rim_xy[k, 1] = verdict.rim_x, verdict.rim_y
                is_disc = evidence[k] >= search.least_evidence
            if not is_disc or result.blur <= _AT_BOUND * result.blur_bound:
                break
            # Too blurred for its patch: once more, in a wider one.
            blur = result.blur_bound
        # A fit that wandered off, or turned the disc's contrast round, is about something else.
        off = math.hypot(result.x - x, result.y - y)
        fate[k], fits.log_odds[k] = _EVIDENCE, evidence[k]
        if is_disc and off < search.radius and result.contrast * contrast > 0.0:
            fits.score[k] = max(evidence[k], _NO_EVIDENCE + quality)
            fate[k] = _BESIDE
        elif is_disc:
            fate[k] = _ELSEWHERE
        place[k, 0], place[k, 1] = (result.x, result.y) if search.refine else (x, y)


@kernel()
def place_found(scene: Scene, radius: float, fits: Fits, work: Any) -> None:
    """Place the discs by their sectors (`detect.discs.placing`)."""
    for k in range(len(fits.results)):
        if fits.fate[k] != _BESIDE:
            continue
        result = fits.results[k]
        if fits.rim_step[k] != 0.0:
            x, y = fits.rim_xy[k, 0], fits.rim_xy[k, 1]
            rim = follow_rim(scene.image, scene.camera_numbers, x, y, radius, fits.rim_step[k])
            place_by_rim(scene, radius, rim, work, result)
        else:
            place_fitted(scene, radius, work, result)
        fits.place[k, 0], fits.place[k, 1] = result.x, result.y


def _best(scene: Scene, centres: Centres, fits: Fits) -> NDArray[np.int64]:
    """The fits that are discs, in scan order, as the centres are; the fate of all others."""
    search, evidence = scene.search, fits.evidence
    best = best_apart(fits.place, fits.score, search.separation)
    if search.verify:
        fits.fate[best] = _RARE
        best = of_likely_sign(best, fits.results["contrast"], evidence, search.least_evidence)
        fits.fate[best] = _PALE
        contrast, floor_grey = contrast_and_floor(scene.image, centres, fits.centre[best])
        sure = evidence[best] >= SURE_EVIDENCE
        lost = lost_by_paleness(contrast, floor_grey, sure)
        best = best[evidence[best] - lost >= search.least_evidence]
    fits.fate[best] = _DISC
    return np.asarray(best[np.argsort(fits.centre[best])])


@kernel()
def _at_clear_disc(
    search: DiscSearch, looked_at: NDArray[np.float64], evidence: NDArray[np.float64],
    place: NDArray[np.float32],
) -> bool:  # fmt: skip
    """Whether a place is within a disc that a look showed clearly."""
    near = _WITHIN * search.separation
    for k in range(len(looked_at)):
        if search.verify and evidence[k] >= search.least_evidence + _CLEAR:
            dx, dy = looked_at[k, 0] - place[0], looked_at[k, 1] - place[1]
            if dx * dx + dy * dy < near * near:
                return True
    return False


@kernel()
def of_likely_sign(
    found: NDArray[np.int64], contrast: NDArray[np.float64], evidence: NDArray[np.float64],
    least_evidence: float,
) -> NDArray[np.int64]:  # fmt: skip
    """Those discs that are not both doubtful and of a sign that hardly any others have.

    Discs of one place are mostly alike. With m of n clear discs of a sign, the odds of that sign
    are (m + 1) : (n - m + 1) by Laplace's rule of succession; where they speak against a doubtful
    disc, they are weighed with its evidence. Few clear discs say too little.
    """
    light = dark = 0
    for k in found:
        if evidence[k] >= least_evidence + CLEAR_EVIDENCE:
            light += contrast[k] > 0.0
            dark += contrast[k] < 0.0
    if light + dark < _LEAST_CLEAR:
        return found
    log_odds = math.log((light + 1.0) / (dark + 1.0))
    kept, count = np.empty(len(found), np.int64), 0
    for k in found:
        for_it = log_odds if contrast[k] > 0.0 else -log_odds
        if evidence[k] + min(for_it, 0.0) >= least_evidence:
            kept[count] = k
            count += 1
    return kept[:count]


@kernel(forceinline=True)
def _evidence(result: Any, search: DiscSearch) -> float:
    return evidence_of(
        result.explained,
        result.radius / search.radius,
        result.outline_deviation,
        result.sectors_good,
        result.middle_step,
        result.relative_blur,
        search.optics_px,
    )


@kernel(forceinline=True)
def _hope(search: DiscSearch, quality: float) -> Hope:
    """When a fit is given up: it may promise less where the quality is high."""
    if not search.verify:
        return Hope(-math.inf, -math.inf, search.optics_px)
    slack = _FIRST_LOOK_SLACK + _SLACK_PER_QUALITY * max(quality - _ORDINARY_QUALITY, 0.0)
    return Hope(_LEAST_SHARE, search.least_evidence - slack, search.optics_px)


class _Verdict(NamedTuple):
    """The evidence of a fit with its rim; where the rim is, if it is to place the disc."""

    log_odds: float
    rim_x: float
    rim_y: float
    rim_step: float
    """0 where the fit places the disc."""


@kernel(inline="always")
def _with_rim(scene: Scene, quality: float, log_odds: float, result: Any) -> _Verdict:
    """The evidence of a fit with its rim, where it is doubtful; the rim may place the disc.

    It places a partly hidden disc, and one that the fit explains in part: a shadow's edge, a sun
    patch or a sheet of paper pull at the fit of a whole disc (`detect.discs.placing`).
    """
    search = scene.search
    is_clear = log_odds >= search.least_evidence + CLEAR_EVIDENCE
    relative = result.radius / search.radius
    possible = (
        RADIUS_RANGE[0] < relative < RADIUS_RANGE[1] and result.middle_step > LEAST_MIDDLE_STEP
    )
    if (is_clear and result.explained >= WELL_EXPLAINED) or not possible:
        return _Verdict(log_odds, 0.0, 0.0, 0.0)
    if _radius_px(scene, result.x, result.y) < LEAST_RIM_PX:
        return _Verdict(log_odds, 0.0, 0.0, 0.0)
    rim = follow_rim(
        scene.image, scene.camera_numbers, result.x, result.y, search.radius, result.contrast
    )
    together = evidence_with_rim(
        log_odds, result.explained, result.contrast, quality, rim, search.radius
    )
    by_fit, by_rim = log_odds, search.least_evidence + together - _RESCUED
    if not is_clear and log_odds >= search.least_evidence and together < _REFUTED:
        by_fit = -math.inf
    step = rim.step if rim.agreeing < _WHOLE_RIM else 0.0
    if (
        log_odds >= search.least_evidence + _BY_FIT
        or result.outline_deviation > _MOST_UNEVEN
        or by_rim < search.least_evidence <= log_odds
    ):
        partly = result.explained < _IN_PART and rim.agreeing >= _HALF_RIM
        return _Verdict(by_fit, rim.x, rim.y, step if partly else 0.0)
    return _Verdict(by_rim, rim.x, rim.y, step)


@kernel()
def _radius_px(scene: Scene, x: float, y: float) -> float:
    """The geometric mean of a disc's radius over all directions: (a + b) / 2 of an ellipse."""
    radius = scene.search.radius
    u, v = project_floor_point(scene.camera_numbers, x, y)
    u1, v1 = project_floor_point(scene.camera_numbers, x + radius, y)
    u2, v2 = project_floor_point(scene.camera_numbers, x, y + radius)
    u1, v1, u2, v2 = u1 - u, v1 - v, u2 - u, v2 - v
    squares = u1 * u1 + v1 * v1 + u2 * u2 + v2 * v2
    return 0.5 * math.sqrt(squares + 2.0 * abs(u1 * v2 - u2 * v1))


@kernel(forceinline=True)
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


@kernel()
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


@kernel()
def worth_a_look(scene: Scene, u: int, v: int, quality: float, contrast: float) -> bool:
    """Whether a candidate's quality is clear, or the grey value steps on most sides."""
    if quality >= CLEAR_QUALITY:
        return True
    steps = share_of_steps(
        scene.image, scene.floor_xy, u, v, scene.search.inner, scene.search.outer, contrast
    )
    return bool(steps >= LEAST_STEPS)
