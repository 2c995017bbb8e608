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
from typing import TYPE_CHECKING, Any

import numpy as np

from detect.discs.fit import START, FitSettings, Scene, fit_discs
from detect.discs.patch import Reach
from detect.discs.rim import follow_rims, median, profiles
from redetect.array_types import BoolArray, FloatArray, IntArray, Records
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.judgement import JudgedCandidates

#: The fit of a whole disc, and that of its edge alone, by parts.
WHOLE = FitSettings(
    by_parts=False, reach=Reach(radii=1.45, px=3.0, blurs=2.0, nearest=0.0, farthest=math.inf)
)
BY_PARTS = FitSettings(
    by_parts=True, reach=Reach(radii=0.0, px=3.0, blurs=2.5, nearest=0.5, farthest=1.5)
)
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
_BLUR_PX = 1.0  #: Initial blur, pixels.
#: Share of two rims' squared difference that is added to the covariance.
_DISAGREEMENT = 0.5


def place_discs(scene: Scene, discs: JudgedCandidates, work: Any) -> tuple[FloatArray, FloatArray]:
    """Locate N discs by fits: fully visible ones first, then the others, given the size of those.

    `work` is a working space (`detect.discs.fit`). Returns (N, 2) centres, metres, and their
    (N, 2, 2) covariances, square metres.
    """
    start, nominal = np.zeros(len(discs.step), START), scene.radius
    start["floor_xy"], start["radius"], start["blur"] = discs.floor_xy, discs.radius, _BLUR_PX
    start["size"], start["size_sigma"] = nominal, RADIUS_SIGMA * nominal
    whole = fit_discs(scene, start, WHOLE, work)
    for _ in range(_MOST_REFITS):  # of discs too blurred for their patch, in a wider one
        blurred = whole["converged"] & (whole["blur"] > _AT_BOUND * whole["blur_bound"])
        if not blurred.any():
            break
        wider = _continued(start, whole)[blurred]
        wider["blur"] = whole["blur_bound"][blurred]
        whole[blurred] = fit_discs(scene, wider, WHOLE, work)
    explained, radii = _explained(whole, discs), np.zeros((len(whole), 2))
    well = explained & (whole["explained"] >= _WELL_EXPLAINED)
    radii[well] = _radii_without_prior(whole, start)[well]

    hidden, by_parts = np.flatnonzero(~explained), whole.copy()
    _state_sizes(start, hidden, nominal, radii)
    rims = _rims_of(scene, discs, hidden, start["size"][hidden])
    start["floor_xy"][hidden], start["radius"][hidden] = rims["floor_xy"], rims["radius"]
    by_parts[hidden] = fit_discs(scene, start[hidden], BY_PARTS, work)
    radii[hidden] = _radii_without_prior(by_parts, start)[hidden]

    # Once more, given the sizes of partly hidden discs, too.
    again = np.flatnonzero(~explained | (whole["explained"] < _EXPLAINS_ALL))
    _state_sizes(start, again, nominal, radii)
    start["floor_xy"], start["radius"] = discs.floor_xy, start["size"]
    last, best = fit_discs(scene, _continued(start, by_parts)[again], BY_PARTS, work), by_parts
    surer = np.linalg.det(last["covariance"]) < np.linalg.det(whole["covariance"][again])
    better = last["converged"] & (surer | ~explained[again])
    best[again[better]] = last[better]

    floor_xy, covariance = best["floor_xy"].copy(), best["covariance"].copy()
    rims = _rims_of(scene, discs, hidden, start["size"][hidden])
    lost = ~best["converged"][hidden]  # sectors disagree
    by_rim = hidden[lost]
    floor_xy[by_rim] = rims["floor_xy"][lost]
    covariance[by_rim] = rims["covariance"][lost] + _DISAGREEMENT * _squares(discs.doubt[by_rim])
    covariance[hidden] += _squares(rims["doubt"])
    return floor_xy, covariance


def _continued(start: Records, fits: Records) -> Records:
    """(N,) `START` at the results of fits, or, where they have not converged, as they were."""
    start, found = start.copy(), fits["converged"]
    for name in ("floor_xy", "radius", "blur"):
        start[name][found] = fits[name][found]
    return start


def _explained(fits: Records, discs: JudgedCandidates) -> BoolArray:
    """(N,) mask of the discs whose fit as a whole explains the image."""
    least = np.where(discs.agreeing >= _WHOLE_RIM, _EXPLAINS_WHOLE, _EXPLAINS_PART)
    same_sign = fits["contrast"] * discs.step > 0.0
    return np.asarray(fits["converged"] & (fits["explained"] >= least) & same_sign)


def _radii_without_prior(fits: Records, start: Records) -> FloatArray:
    """(N, 2) radii of fits, metres, without the prior, and their inverse variances; or 0, 0."""
    information = np.where(fits["radius_information"] > 0.0, fits["radius_information"], np.inf)
    pull = 1.0 / (start["size_sigma"] ** 2 * information)
    radius = fits["radius"] + pull * (fits["radius"] - start["size"])
    return np.where(np.isfinite(information), [radius, information], 0.0).T


def _state_sizes(start: Records, chosen: IntArray, nominal: float, radii: FloatArray) -> None:
    """Set the prior of some discs' fits to the size that the other discs suggest."""
    for k in chosen.tolist():
        start["size"][k], start["size_sigma"][k] = size_of_disc(nominal, radii, k)


def _rims_of(
    scene: Scene, discs: JudgedCandidates, chosen: IntArray, radius: FloatArray
) -> Records:
    """Rims of some discs (`RIM`), traced for a radius of each, metres."""
    near_xy, numbers = discs.traced_from[chosen], scene.camera_numbers
    radial = profiles(scene.image, numbers, near_xy, radius)
    return follow_rims(scene.image, numbers, radial, discs.step[chosen])


def _squares(vectors: FloatArray) -> FloatArray:
    """(N, 2, 2) products of (N, 2) vectors with themselves."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])


@kernel()
def size_of_disc(nominal: float, radii: FloatArray, k: int) -> tuple[float, float]:
    """Radius of disc k by the other discs of its image, and its standard deviation, metres.

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
    return nominal * mean, nominal * math.sqrt(1.0 / certainty + scatter)
