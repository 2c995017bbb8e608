"""Positions of discs: from a fit of the whole disc, a fit by parts, or the points of the rim.

A fully visible disc is fitted as a whole. A disc that is partly occluded, stained or unevenly lit
is fitted by its edge, sector by sector (`detect.discs.fit`). So is a fully visible one that the
first fit does not explain well; the more certain position is kept. If too few sectors agree, the
points of the rim give the position (`detect.discs.rim`). A partial rim may belong to more than one
circle: the squared distance to another plausible one is added to the covariance. Since a part of a
disc hardly separates radius from position, the other discs of the image provide the radius.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from detect.discs.fit import NO_FIT, Fit, FitSettings, Scene, Start, fit_disc
from detect.discs.patch import Reach
from detect.discs.rim import Rim, follow_rim, median, profiles
from redetect.array_types import FloatArray
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.judgement import JudgedCandidates

#: Pixels that the fit of a whole disc uses, and those of the fit by parts.
WHOLE = Reach(radii=1.45, px=3.0, blurs=2.0, nearest=0.0, farthest=math.inf)
EDGE_ALONE = Reach(radii=0.0, px=3.0, blurs=2.5, nearest=0.5, farthest=1.5)
#: Relative standard deviations of radii:
RADIUS_SIGMA = 0.08  #: Prior of a whole disc's fit.
_CALIBRATED_SIGMA = 0.02  #: Mean radius of all discs against the nominal one.
_USUAL_SCATTER, _MOST_SCATTER = 0.01, 0.03  #: One disc against the mean: prior and maximum.
_SIZE_STEPS = 4  #: Of the robust mean of radii.
_LEAST_OTHERS = 3  #: Number of radii from which it starts at their median.
#: Share of the variance that a fit explains if there is nothing but a disc and noise.
_WELL_EXPLAINED = 0.97
_WHOLE_RIM = 0.8  #: Share of the rim from which it is complete.
#: Share of the variance that a whole disc's fit has to explain with a complete rim, and with less.
_EXPLAINS_WHOLE, _EXPLAINS_PART = 0.9, 0.97
#: The fit of a whole disc is final if it explains this share of the variance.
_EXPLAINS_ALL = 0.99
_AT_BOUND = 0.98  #: If the blur reaches this share of a patch's bound, the fit is repeated.
_MOST_REFITS = 2  #: Largest number of repetitions, each in a wider patch.
#: Stages of fits: whole discs, up to as often; then parts of discs; then again with a better size.
_PARTS, _LAST = _MOST_REFITS + 1, _MOST_REFITS + 2
_BLUR_PX = 1.0  #: Initial blur, pixels.
#: Share of two rims' squared difference that is added to the covariance.
_DISAGREEMENT = 0.5


class Place(NamedTuple):
    """Position of a disc, metres, and its covariance."""

    x: float
    y: float
    cov_xx: float
    cov_xy: float
    cov_yy: float


class Size(NamedTuple):
    """Prior of a disc's radius, metres."""

    radius: float
    sigma: float


@kernel()
def place_discs(scene: Scene, discs: JudgedCandidates, work: Any) -> tuple[FloatArray, FloatArray]:
    """Locate N discs by fits: fully visible ones first, then the others, given the size of those.

    `work` is a working space (`detect.discs.fit`). Returns (N, 2) centres, metres, and their
    (N, 2, 2) covariances, square metres.
    """
    count = len(discs.step)
    whole = [NO_FIT for _ in range(count)]
    parts, last = whole.copy(), whole.copy()
    # Of each disc: its radius, and one over the variance of that.
    radii = np.zeros((count, 2))
    known = radii
    # All stages share one call of the fit, whose code is inlined there: only then a kernel that has
    # just been compiled and one loaded from the cache agree to the last digit.
    for stage in range(_LAST + 1):
        if stage == _PARTS:
            for k, fit in enumerate(whole):
                if _explains(fit, discs, k) and fit.explained >= _WELL_EXPLAINED:
                    nominal = Size(scene.radius, RADIUS_SIGMA * scene.radius)
                    # Assigning the row takes two seconds to compile.
                    radii[k, 0], radii[k, 1] = _radius_without_prior(fit, nominal)
            parts, known = whole.copy(), radii.copy()
        elif stage == _LAST:
            known = radii  # those of partly hidden discs included
        for k in range(count):
            wanted, start, size = _start_of(scene, discs, k, stage, (whole[k], parts[k]), known)
            if not wanted:
                continue
            reach = WHOLE if stage < _PARTS else EDGE_ALONE
            settings = FitSettings(stage >= _PARTS, size.radius, size.sigma / size.radius, reach)
            fit = fit_disc(scene, start, settings, work)
            if stage < _PARTS:
                whole[k] = fit
            elif stage == _PARTS:
                parts[k] = fit
                radii[k, 0], radii[k, 1] = _radius_without_prior(fit, size)
            else:
                last[k] = fit
    floor_xy, covariance = np.empty((count, 2)), np.empty((count, 2, 2))
    for k, fit in enumerate(whole):
        if not _explains(fit, discs, k):
            size = size_of_disc(scene.radius, radii, k)
            place = _place_by_rim(scene, discs, k, last[k] if last[k].converged else parts[k], size)
        else:
            place = _place_of(fit)
            if fit.explained < _EXPLAINS_ALL:
                place = _more_certain(_place_of(last[k]), place)
        floor_xy[k, 0], floor_xy[k, 1] = place.x, place.y
        covariance[k, 0, 0], covariance[k, 1, 1] = place.cov_xx, place.cov_yy
        covariance[k, 0, 1] = covariance[k, 1, 0] = place.cov_xy
    return floor_xy, covariance


@kernel(inline="always")
def _start_of(
    scene: Scene,
    discs: JudgedCandidates,
    k: int,
    stage: int,
    fits: tuple[Fit, Fit],
    radii: FloatArray,
) -> tuple[bool, Start, Size]:
    """Whether a disc is fitted in a stage, from where, and its size; by its fits so far."""
    fit, by_parts = fits
    x, y, radius, blur_px = discs.floor_xy[k, 0], discs.floor_xy[k, 1], discs.radius[k], _BLUR_PX
    size, wanted = Size(scene.radius, RADIUS_SIGMA * scene.radius), True
    if stage < _PARTS:
        if stage > 0:  # too blurred for its patch: once more, in a wider one
            wanted = fit.converged and fit.blur > _AT_BOUND * fit.blur_bound
            x, y, radius, blur_px = fit.x, fit.y, fit.radius, fit.blur_bound
    elif stage == _PARTS:
        wanted = not _explains(fit, discs, k)
        if wanted:
            size = size_of_disc(scene.radius, radii, k)
            rim = _rim_of(scene, discs, k, size.radius)
            x, y, radius = rim.x, rim.y, rim.radius
    else:
        explained = _explains(fit, discs, k)
        wanted = not explained or fit.explained < _EXPLAINS_ALL
        if wanted:
            size = size_of_disc(scene.radius, radii, k)
            before, radius = fit if explained else by_parts, size.radius
            if before.converged:
                x, y, radius, blur_px = before.x, before.y, before.radius, before.blur
    return wanted, Start(x, y, radius, blur_px), size


@kernel(inline="always")
def _radius_without_prior(fit: Fit, expected: Size) -> tuple[float, float]:
    """Radius of a fitted disc, metres, and its inverse variance, both with the prior removed."""
    information = fit.radius_information
    if not information > 0.0:
        return 0.0, 0.0
    pull = 1.0 / (expected.sigma**2 * information)
    return fit.radius + pull * (fit.radius - expected.radius), information


@kernel(inline="always")
def _place_of(fit: Fit) -> Place:
    return Place(fit.x, fit.y, fit.cov_xx, fit.cov_xy, fit.cov_yy)


@kernel(inline="always")
def _more_certain(one: Place, other: Place) -> Place:
    area = one.cov_xx * one.cov_yy - one.cov_xy**2
    return one if area < other.cov_xx * other.cov_yy - other.cov_xy**2 else other


@kernel(inline="always")
def _plus_square(place: Place, share: float, x: float, y: float) -> Place:
    """Add a share of the square of (x, y), metres, to the covariance of a place."""
    xx, xy = place.cov_xx + share * x * x, place.cov_xy + share * x * y
    return Place(place.x, place.y, xx, xy, place.cov_yy + share * y * y)


@kernel(inline="always")
def _explains(fit: Fit, discs: JudgedCandidates, k: int) -> bool:
    """Whether the fit of a whole disc explains the image."""
    least = _EXPLAINS_WHOLE if discs.agreeing[k] >= _WHOLE_RIM else _EXPLAINS_PART
    same_sign = fit.contrast * discs.step[k] > 0.0
    return bool(fit.converged and fit.explained >= least and same_sign)


@kernel(inline="always")
def _place_by_rim(scene: Scene, discs: JudgedCandidates, k: int, fit: Fit, size: Size) -> Place:
    """Place a disc by its sectors, or where they differ by the points of its rim."""
    rim = _rim_of(scene, discs, k, size.radius)
    if fit.converged:
        place = _place_of(fit)
    else:
        place = Place(rim.x, rim.y, rim.cov_xx, rim.cov_xy, rim.cov_yy)
        place = _plus_square(place, _DISAGREEMENT, discs.doubt[k, 0], discs.doubt[k, 1])
    return _plus_square(place, 1.0, rim.doubt_x, rim.doubt_y)


@kernel(inline="always")
def _rim_of(scene: Scene, discs: JudgedCandidates, k: int, radius: float) -> Rim:
    x, y = discs.traced_from[k, 0], discs.traced_from[k, 1]
    radial = profiles(scene.image, scene.camera_numbers, x, y, radius)
    return follow_rim(scene.image, scene.camera_numbers, radial, discs.step[k])


@kernel()
def size_of_disc(nominal: float, radii: FloatArray, k: int) -> Size:
    """Estimate the radius of disc k from the other discs of its image.

    If the camera is lower or higher than calibrated, all discs appear larger or smaller; single
    discs vary a little. A part of a disc hardly separates radius from position, so the radius has
    to be known otherwise: as the robust mean of the others', with their scatter about it.

    `radii` (N, 2) are each disc's radius, metres, and its inverse variance, 0 if unknown.
    """
    radius, variance, count = np.empty(len(radii)), np.empty(len(radii)), 0
    for i in range(len(radii)):
        if i != k and radii[i, 1] > 0.0:
            radius[count] = radii[i, 0] / nominal
            variance[count] = 1.0 / (radii[i, 1] * nominal**2)
            count += 1
    mean = median(radius[:count].copy()) if count >= _LEAST_OTHERS else 1.0
    usual, scatter = _USUAL_SCATTER**2, _USUAL_SCATTER**2
    certainty = 0.0
    for _ in range(_SIZE_STEPS):
        # The nominal radius counts as one disc, the usual scatter as that of two.
        certainty = 1.0 / _CALIBRATED_SIGMA**2
        total, squares = certainty, 2.0 * usual
        for i in range(count):
            off = (radius[i] - mean) ** 2
            weight = 1.0 / (variance[i] + scatter)
            weight /= 1.0 + 0.25 * off * weight
            certainty += weight
            total += weight * radius[i]
            squares += min(max(off - variance[i], 0.0), _MOST_SCATTER**2)
        mean, scatter = total / certainty, squares / (2.0 + count)
    return Size(nominal * mean, nominal * math.sqrt(1.0 / certainty + scatter))
