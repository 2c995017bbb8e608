"""Where a disc is of which only a part is seen: by the part of its rim that is in view.

Something before a disc, or a stain on it, pulls at the fit of the whole disc. The rim
(`detect.discs.rim`) says in which directions the disc ends where it should. To the pixels about
the edge in these directions the same model is fitted again; where that explains them, it places the
disc, to a fraction of what single points of the rim do. Where it does not, as beside a shadow's
edge, which leaves the rim in its place and changes the grey values about it, the points place it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from camera.kernels import project_floor_point
from detect.discs.descent import Hope
from detect.discs.fit import RESULT, fit_disc
from detect.discs.model import Disc
from detect.discs.patch import FULL, Candidate, FitSettings
from detect.discs.rim import PLACING_SIGMA, Rim, follow_rim, median
from redetect.compiled import kernel

if TYPE_CHECKING:
    from detect.discs.search import Scene
    from detect.discs.second_look import SecondLooks

#: Share of the variance that a fit explains where nothing but a disc and noise is there.
WELL_EXPLAINED = 0.97
#: The fit to what is in view is at most this far from the rim, radii.
_MOST_OFF_RIM = 0.15
#: Share of the squared difference of fit and rim, or of two rims, that is added to the covariance.
_DISAGREEMENT = 0.5
#: Least number of whole discs that give the apparent radius.
_LEAST_WHOLE = 3
#: Blur from which fits start: that of a whole disc's fit is also of what hides a part, pixels.
_BLUR_PX = 1.0
#: A rim whose step varies by less than this over the directions, relative to its mean, is even.
_EVEN = 0.18
#: Nothing moves where the blur is less than this, pixels.
_SHARP_PX = 1.2
#: A fit that explains less of the variance than this is of a disc that something hides.
_LITTLE = 0.7


@kernel()
def place_by_part(scene: Scene, radius: float, rim: Rim, work: Any, result: Any) -> None:
    """Place a disc by the part of its rim that is in view.

    Parameters
    ----------
    scene : Scene
    radius : float
        That discs of the image seem to have (`apparent_radius`), metres.
    rim : Rim
        Followed from about its own middle.
    work : WORK
        Working space.
    result : RESULT
        The fit of the whole disc, or zeros: its centre and covariance are replaced.
    """
    of_part = np.zeros(1, RESULT)
    part = of_part[0]
    if (
        rim.hidden != 0
        and _fit_in_view(scene, radius, rim, work, part)
        and part.explained >= WELL_EXPLAINED
    ):
        result.x, result.y = part.x, part.y
        result.cov_xx, result.cov_xy, result.cov_yy = part.cov_xx, part.cov_xy, part.cov_yy
        # What fit and points of the rim disagree by is a sample of what either may be wrong by.
        _add_square(result, _DISAGREEMENT, part.x - rim.x, part.y - rim.y)
        _add_square(result, 1.0, rim.doubt_x, rim.doubt_y)
    elif _is_even(rim, result):
        result.x, result.y = rim.x, rim.y
        result.cov_xx, result.cov_xy, result.cov_yy = rim.cov_xx, rim.cov_xy, rim.cov_yy
        _add_square(result, 1.0, rim.doubt_x, rim.doubt_y)


@kernel()
def _is_even(rim: Rim, result: Any) -> bool:
    """Whether the points of a rim are found at its place all round where it is not hidden.

    Where movement blurs it, it steps less on two sides, and is found beside its place; then the fit
    explains most, though, and says that it is blurred.
    """
    return bool(rim.unevenness < _EVEN or result.explained < _LITTLE or result.blur < _SHARP_PX)


@kernel(forceinline=True)
def _add_square(result: Any, share: float, x: float, y: float) -> None:
    """Add a share of the square of (x, y), metres, to the covariance of a result."""
    result.cov_xx += share * x * x
    result.cov_xy += share * x * y
    result.cov_yy += share * y * y


@kernel()
def place_all_by_part(
    scene: Scene,
    radius: float,
    looks: SecondLooks,
    space: NDArray[Any],
) -> Any:
    """(N,) `RESULT` of the discs of N second looks."""
    results = np.zeros(len(looks.step), RESULT)
    for k in range(len(results)):
        x, y = looks.seen_from[k, 0], looks.seen_from[k, 1]
        rim = follow_rim(scene.image, scene.camera_numbers, x, y, radius, looks.step[k])
        place_by_part(scene, radius, rim, space[0], results[k])
        _add_square(results[k], _DISAGREEMENT, looks.doubt[k, 0], looks.doubt[k, 1])
    return results


@kernel()
def apparent_radius(nominal: float, radii: NDArray[np.float64]) -> float:
    """The radius that discs of an image seem to have, by those that are wholly in view.

    All are larger or smaller where the camera hangs lower or higher than calibrated. The radius of
    a part of a disc trades with its place, so it has to be known otherwise.
    """
    if len(radii) < _LEAST_WHOLE:
        return nominal
    return median(radii)


@kernel(inline="always")
def _fit_in_view(scene: Scene, radius: float, rim: Rim, work: Any, result: Any) -> bool:
    """Whether a fit to the pixels in view comes to a disc near the rim, of about its size."""
    floor_xy, given = scene.floor_xy, scene.settings
    pixel_u, pixel_v = project_floor_point(scene.camera_numbers, rim.x, rim.y)
    height, width = scene.image.shape
    u, v = min(max(round(pixel_u), 1), width - 2), min(max(round(pixel_v), 1), height - 2)
    start = Disc(
        (rim.x - floor_xy[v, u, 0]) / radius,
        (rim.y - floor_xy[v, u, 1]) / radius,
        rim.radius / radius,
        math.log(_BLUR_PX),
    )
    settings = FitSettings(
        given.noise, given.reach_radii, given.reach_px, given.reach_blurs, PLACING_SIGMA,
        given.blur_px, given.blur_sigma, given.blur_ratio,
    )  # fmt: skip
    hope = Hope(-math.inf, -math.inf, scene.search.optics_px)
    candidate = Candidate(u, v, radius, _BLUR_PX, rim.hidden)
    if not fit_disc(scene.image, floor_xy, candidate, settings, start, FULL, hope, work, result):
        return False
    off = math.hypot(result.x - rim.x, result.y - rim.y)
    most = _MOST_OFF_RIM * radius
    near = off < most and abs(result.radius - rim.radius) < most
    return bool(near and result.contrast * rim.step > 0.0)
