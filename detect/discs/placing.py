"""Where discs are: the fit of the whole disc, the fit by parts, or the points of its rim.

A disc that is wholly in view is fitted as a whole. One that something hides, stains or lights in
part is fitted by its edge, sector by sector (`detect.discs.fit`), as is a whole one that the fit
does not explain well: the more certain place counts. Where too few sectors agree on one disc, the
points of the rim give the place (`detect.discs.rim`). A rim in part may be that of more than one
circle: the squared distance of another one that is nearly as likely is in the covariance. Of a
part, radius and place trade off: what the other discs of the image say of the radius is used.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from detect.discs.fit import Fit, FitSettings, Scene, Start, fit_disc
from detect.discs.patch import Reach
from detect.discs.rim import Rim, follow_rim, median, profiles
from redetect.array_types import FloatArray
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.judgement import Judgement

#: Pixels of a whole disc, and of its edge.
WHOLE = Reach(radii=1.45, px=3.0, blurs=2.0, nearest=0.0, farthest=math.inf)
EDGE_ALONE = Reach(radii=0.0, px=3.0, blurs=2.5, nearest=0.5, farthest=1.5)
#: Standard deviation of a radius, relative: of a disc whose place does not depend on it; of all
#: discs, about the nominal one; of one about the others, usually and at most.
RADIUS_SIGMA, _CALIBRATED_SIGMA = 0.08, 0.02
_USUAL_SCATTER, _MOST_SCATTER = 0.01, 0.03
#: Steps of the robust mean of radii; it starts at their median if there are so many.
_SIZE_STEPS, _LEAST_OTHERS = 4, 3
#: Share of the variance that a fit explains where nothing but a disc and noise is there.
_WELL_EXPLAINED = 0.97
#: From this share of the variance on that it explains, the fit of the whole disc gives the place:
#: where this share of the rim is in view, and where less is.
_WHOLE_RIM, _EXPLAINS_WHOLE, _EXPLAINS_PART = 0.8, 0.9, 0.97
#: A whole disc's fit is final if it explains this much of the variance.
_EXPLAINS_ALL = 0.99
#: A blur that reached this share of the most that a patch allows is fitted again in a wider one.
_AT_BOUND, _MOST_REFITS = 0.98, 2
#: Blur where nothing is known of it, pixels.
_BLUR_PX = 1.0
#: Share of two rims' squared difference that is added to the covariance.
_DISAGREEMENT = 0.5


class Place(NamedTuple):
    """Where a disc is, metres, and the covariance of that."""

    x: float
    y: float
    cov_xx: float
    cov_xy: float
    cov_yy: float


class Size(NamedTuple):
    """What is known of a disc's radius, metres."""

    radius: float
    sigma: float


@kernel()
def place_discs(scene: Scene, discs: Judgement, work: Any) -> tuple[FloatArray, FloatArray]:
    """Place N discs by fits: those that are wholly in view, then the others, of about their size.

    Parameters
    ----------
    scene : Scene
    discs : Judgement
        Of N discs.
    work : WORK
        Working space (`detect.discs.fit`).

    Returns
    -------
    floor_xy : (N, 2) float64
        Centres, metres.
    covariance : (N, 2, 2) float64
        Square metres.
    """
    count = len(discs.step)
    floor_xy, covariance = np.empty((count, 2)), np.empty((count, 2, 2))
    whole = [_fit_whole(scene, discs, k, work) for k in range(count)]
    radii = np.zeros((count, 2))
    for k, fit in enumerate(whole):
        if _explains(fit, discs, k) and fit.explained >= _WELL_EXPLAINED:
            radii[k] = _radius_seen(fit, Size(scene.radius, RADIUS_SIGMA * scene.radius))
    # Those that are hidden in part say something of the size too, and are then fitted once more.
    parts, radii_of_whole = list(whole), radii.copy()
    for k, fit in enumerate(whole):
        if not _explains(fit, discs, k):
            size = size_of_disc(scene.radius, radii_of_whole, k)
            rim = _rim_of(scene, discs, k, size.radius)
            start = Start(rim.x, rim.y, rim.radius, _BLUR_PX)
            parts[k] = fit_disc(scene, start, _by_parts(size), work)
            radii[k] = _radius_seen(parts[k], size)
    for k, fit in enumerate(whole):
        size = size_of_disc(scene.radius, radii, k)
        if not _explains(fit, discs, k):
            place = _place_by_rim(scene, discs, k, parts[k], size, work)
        else:
            place = _place_of(fit)
            if fit.explained < _EXPLAINS_ALL:
                again = fit_disc(scene, _start_at(fit), _by_parts(size), work)
                place = _more_certain(_place_of(again), place)
        floor_xy[k, 0], floor_xy[k, 1] = place.x, place.y
        covariance[k, 0, 0], covariance[k, 1, 1] = place.cov_xx, place.cov_yy
        covariance[k, 0, 1] = covariance[k, 1, 0] = place.cov_xy
    return floor_xy, covariance


@kernel(inline="always")
def _by_parts(size: Size) -> FitSettings:
    return FitSettings(True, size.radius, size.sigma / size.radius, EDGE_ALONE)


@kernel(inline="always")
def _start_at(fit: Fit) -> Start:
    return Start(fit.x, fit.y, fit.radius, fit.blur)


@kernel(inline="always")
def _radius_seen(fit: Fit, expected: Size) -> tuple[float, float]:
    """Radius of a fitted disc, metres, and one over its variance, less what was expected of it."""
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
    return Place(
        place.x,
        place.y,
        place.cov_xx + share * x * x,
        place.cov_xy + share * x * y,
        place.cov_yy + share * y * y,
    )


@kernel(inline="always")
def _fit_whole(scene: Scene, discs: Judgement, k: int, work: Any) -> Fit:
    """Fit the whole disc of a rim."""
    settings = FitSettings(False, scene.radius, RADIUS_SIGMA, WHOLE)
    start = Start(discs.floor_xy[k, 0], discs.floor_xy[k, 1], discs.radius[k], _BLUR_PX)
    fit = fit_disc(scene, start, settings, work)
    for _ in range(_MOST_REFITS):
        if not fit.arrived or fit.blur <= _AT_BOUND * fit.blur_bound:
            break
        # Too blurred for its patch: once more, in a wider one.
        start = Start(fit.x, fit.y, fit.radius, fit.blur_bound)
        fit = fit_disc(scene, start, settings, work)
    return fit


@kernel(inline="always")
def _explains(fit: Fit, discs: Judgement, k: int) -> bool:
    """Whether the fit of a whole disc explains what is seen."""
    least = _EXPLAINS_WHOLE if discs.agreeing[k] >= _WHOLE_RIM else _EXPLAINS_PART
    same_sign = fit.contrast * discs.step[k] > 0.0
    return bool(fit.arrived and fit.explained >= least and same_sign)


@kernel(inline="always")
def _place_by_rim(
    scene: Scene, discs: Judgement, k: int, before: Fit, size: Size, work: Any
) -> Place:
    """Place a disc by its sectors, or where they differ by the points of its rim."""
    start = Start(discs.floor_xy[k, 0], discs.floor_xy[k, 1], size.radius, _BLUR_PX)
    if before.arrived:
        start = _start_at(before)
    fit = fit_disc(scene, start, _by_parts(size), work)
    if not fit.arrived:
        fit = before
    rim = _rim_of(scene, discs, k, size.radius)
    if fit.arrived:
        place = _place_of(fit)
    else:
        place = Place(rim.x, rim.y, rim.cov_xx, rim.cov_xy, rim.cov_yy)
        place = _plus_square(place, _DISAGREEMENT, discs.doubt[k, 0], discs.doubt[k, 1])
    return _plus_square(place, 1.0, rim.doubt_x, rim.doubt_y)


@kernel(inline="always")
def _rim_of(scene: Scene, discs: Judgement, k: int, radius: float) -> Rim:
    x, y = discs.seen_from[k, 0], discs.seen_from[k, 1]
    seen = profiles(scene.image, scene.camera_numbers, x, y, radius)
    return follow_rim(scene.image, scene.camera_numbers, seen, discs.step[k])


@kernel()
def size_of_disc(nominal: float, radii: FloatArray, k: int) -> Size:
    """How large a disc is, by what is seen of the others of its image.

    All seem larger or smaller where the camera hangs lower or higher than calibrated, and each by
    itself does a little. The radius of a part of a disc trades with its place, so it has to be
    known otherwise: as the robust mean of the others, with the scatter about that.

    `radii` (N, 2) are those of each disc, metres, and one over their variance, 0 where nothing is
    known; k is the disc.
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
        # The nominal radius counts as a disc, and the usual scatter as that of two.
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
