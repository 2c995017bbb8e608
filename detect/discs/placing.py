"""Where discs are: the fit of the whole disc, the fit by parts, or the points of its rim.

A disc that is wholly in view is fitted as a whole. One that something hides, stains or lights in
part is fitted by its edge, sector by sector (`detect.discs.fit`), as is a whole one that the fit
does not explain well: the more certain place counts. Where too few sectors agree on one disc, the
points of the rim give the place (`detect.discs.rim`). A rim in part may be that of more than one
circle: the squared distance of another one that is nearly as likely is in the covariance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from detect.discs.fit import Fit, Manner, Scene, Start, fit_disc
from detect.discs.patch import Reach
from detect.discs.rim import Rim, follow_rim, median, profiles
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.judgement import Judgement

FloatArray = NDArray[np.float64]

#: Pixels of a whole disc, and of its edge.
_WHOLE = Reach(radii=1.7, px=3.0, blurs=2.0, nearest=0.0, farthest=math.inf)
_EDGE = Reach(radii=0.0, px=3.0, blurs=2.5, nearest=0.5, farthest=1.5)
#: Standard deviation of the radius, relative: about the nominal one, and about that which discs of
#: the image seem to have. Of a short arc, place and radius trade off.
_RADIUS_SIGMA, _APPARENT_SIGMA = 0.08, 0.02
#: Share of the variance that a fit explains where nothing but a disc and noise is there.
_WELL_EXPLAINED = 0.97
#: From this share of the variance on that it explains, the fit of the whole disc gives the place:
#: where this share of the rim is in view, and where less is.
_WHOLE_RIM, _EXPLAINS_WHOLE, _EXPLAINS_PART = 0.8, 0.9, 0.93
#: A whole disc's fit is final if it explains this much of the variance.
_EXPLAINS_ALL = 0.985
#: A blur that reached this share of the most that a patch allows is fitted again in a wider one.
_AT_BOUND, _MOST_REFITS = 0.98, 2
#: Blur where nothing is known of it, pixels.
_BLUR_PX = 1.0
#: Share of two rims' squared difference that is added to the covariance.
_DISAGREEMENT = 0.5
#: Least number of whole discs that give the apparent radius.
_LEAST_WHOLE = 3


@kernel()
def place_discs(scene: Scene, discs: Judgement, work: Any) -> tuple[FloatArray, FloatArray]:
    """Place discs by fits: those that are wholly in view, then the others, of the same size.

    Parameters
    ----------
    scene : Scene
    discs : Judgement
        Of N discs.
    work : WORK
        Working space.

    Returns
    -------
    floor_xy : (N, 2) float64
        Centres, metres.
    covariance : (N, 2, 2) float64
        Square metres.
    """
    count = len(discs.step)
    floor_xy, covariance = np.empty((count, 2)), np.empty((count, 2, 2))
    radii, clear = np.empty(count), 0
    whole = [_fit_whole(scene, discs, k, work) for k in range(count)]
    for k, fit in enumerate(whole):
        if _explains(fit, discs, k) and fit.explained >= _WELL_EXPLAINED:
            radii[clear] = fit.radius
            clear += 1
    by_parts = Manner(True, apparent_radius(scene.radius, radii[:clear]), _APPARENT_SIGMA, _EDGE)
    for k in range(count):
        fit = whole[k]
        if _explains(fit, discs, k):
            place = fit.x, fit.y, fit.cov_xx, fit.cov_xy, fit.cov_yy
            if fit.explained < _EXPLAINS_ALL:
                parts = fit_disc(
                    scene, Start(fit.x, fit.y, fit.radius, fit.blur), by_parts, work
                )
                if parts.arrived and _area(parts) < _area(fit):
                    place = parts.x, parts.y, parts.cov_xx, parts.cov_xy, parts.cov_yy
        else:
            place = _place_by_rim(scene, discs, k, by_parts, work)
        floor_xy[k, 0], floor_xy[k, 1] = place[0], place[1]
        covariance[k, 0, 0], covariance[k, 1, 1] = place[2], place[4]
        covariance[k, 0, 1] = covariance[k, 1, 0] = place[3]
    return floor_xy, covariance


@kernel()
def _area(fit: Fit) -> float:
    return fit.cov_xx * fit.cov_yy - fit.cov_xy**2


@kernel()
def _fit_whole(scene: Scene, discs: Judgement, k: int, work: Any) -> Fit:
    """Fit the whole disc of a rim."""
    manner = Manner(False, scene.radius, _RADIUS_SIGMA, _WHOLE)
    start = Start(discs.floor_xy[k, 0], discs.floor_xy[k, 1], discs.radius[k], _BLUR_PX)
    fit = fit_disc(scene, start, manner, work)
    for _ in range(_MOST_REFITS):
        if not fit.arrived or fit.blur <= _AT_BOUND * fit.blur_bound:
            break
        # Too blurred for its patch: once more, in a wider one.
        start = Start(fit.x, fit.y, fit.radius, fit.blur_bound)
        fit = fit_disc(scene, start, manner, work)
    return fit


@kernel()
def _explains(fit: Fit, discs: Judgement, k: int) -> bool:
    """Whether the fit of a whole disc explains what is seen."""
    least = _EXPLAINS_WHOLE if discs.agreeing[k] >= _WHOLE_RIM else _EXPLAINS_PART
    same_sign = fit.contrast * discs.step[k] > 0.0
    return bool(fit.arrived and fit.explained >= least and same_sign)


@kernel()
def _place_by_rim(
    scene: Scene, discs: Judgement, k: int, by_parts: Manner, work: Any
) -> tuple[float, float, float, float, float]:
    """Place and covariance of a disc by its sectors, or where they differ by its rim's points."""
    rim = _rim_of(scene, discs, k, by_parts.radius)
    fit = fit_disc(scene, Start(rim.x, rim.y, rim.radius, _BLUR_PX), by_parts, work)
    doubt_x, doubt_y = math.sqrt(_DISAGREEMENT) * discs.doubt[k, 0], math.sqrt(_DISAGREEMENT) * discs.doubt[k, 1]
    x, y, xx, xy, yy = rim.x, rim.y, rim.cov_xx, rim.cov_xy, rim.cov_yy
    xx, xy, yy = xx + doubt_x**2, xy + doubt_x * doubt_y, yy + doubt_y**2
    if fit.arrived:
        x, y, xx, xy, yy = fit.x, fit.y, fit.cov_xx, fit.cov_xy, fit.cov_yy
    xx, xy, yy = xx + rim.doubt_x**2, xy + rim.doubt_x * rim.doubt_y, yy + rim.doubt_y**2
    return x, y, xx, xy, yy


@kernel()
def _rim_of(scene: Scene, discs: Judgement, k: int, radius: float) -> Rim:
    x, y = discs.seen_from[k, 0], discs.seen_from[k, 1]
    seen = profiles(scene.image, scene.camera_numbers, x, y, radius)
    return follow_rim(scene.image, scene.camera_numbers, seen, discs.step[k])


@kernel()
def apparent_radius(nominal: float, radii: NDArray[np.float64]) -> float:
    """The radius that discs of an image seem to have, by those that are wholly in view.

    All are larger or smaller where the camera hangs lower or higher than calibrated. The radius of
    a part of a disc trades with its place, so it has to be known otherwise.
    """
    if len(radii) < _LEAST_WHOLE:
        return nominal
    return median(radii)
