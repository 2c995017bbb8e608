"""Finds the pictures that one camera explains, and those that contradict them.

A board that was found a square off, or another board, must neither abort a calibration nor bias it:
such pictures are excluded from the fit, and included again if they agree with the others after all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from camera.calibration.adjustment import Adjusted, Estimate, Points, fit_points, residuals_of
from camera.calibration.model import CalibrationSettings, FreeLens
from camera.calibration.start import best_poses, initial_estimate, normals_spread_deg, view_errors
from camera.errors import CalibrationError
from redetect.array_types import BoolArray, FloatArray

# A view contradicts the others above this multiple of their median residual: with one coefficient
# of the lens, which leaves systematic residuals in the image's corners, and with all of them.
_FAR_AT_FIRST, _FAR = 10.0, 3.0
# Never below this: good photographs have up to some 0.3 px (the medians of four cameras are 0.02 to
# 0.23 px), and the noise-free ones of a nearly perfect set differ by large factors.
_LEAST_FAR_PX = 0.3
# A view's farthest points are ignored for that, since single outliers are excluded separately.
_COUNTED_SHARE = 0.95
_ROUNDS = 3
ALL_THE_SAME = (
    "are --columns, --rows and the kind of --board right, and do all pictures show the same board "
    "by the same camera at the same zoom?"
)
# Below this the focal length hangs on the perspective of single views alone.
_SMALLEST_SPREAD_DEG = 3.0
_LARGEST_SCALE_SIGMA = 0.03
# Such boards do not have almost the same orientation.
_WIDE_SPREAD_DEG = 20.0


@dataclass(frozen=True, eq=False)
class Consensus:
    """A camera that was fitted to some views, and its residuals in each."""

    fit: Adjusted  #: to those views
    estimate: Estimate  #: With the poses of all views
    #: (V,) RMS residual of each view; infinite where the camera sees its board in no pose
    rms_px: FloatArray
    #: (V,) whether the residuals of a view, all but those of single points, are not far above those
    #: of the views that it was fitted to
    agree: BoolArray


def find_consensus(
    points: Points, names: Sequence[str], settings: CalibrationSettings, radius_m: float
) -> Consensus:
    """The camera that most views agree on, with all allowed coefficients free.

    Takes the views' names, and the radius of circles (m), 0 for points.

    Raises
    ------
    CalibrationError
        If no camera explains most of the views, or they are too much alike.
    StartError
        If none explains any.
    """
    fitted = partial(_fitted, points, settings, radius_m)
    estimate = initial_estimate(points, settings.aspect)
    errors = view_errors(estimate, points)
    used = np.isfinite(errors)
    if used.any():
        used &= errors <= max(_FAR_AT_FIRST * np.median(errors[used]), _LEAST_FAR_PX)
    _demand_most(used, names)
    few = min(2, settings.most)
    for count in (1, few):
        estimate = best_poses(fitted(estimate, used, settings.lens(count)).estimate, points)
    for count in range(few, settings.most + 1):
        found = fitted(estimate, used, settings.lens(count))
        estimate = found.estimate
    # Checked before terms are fitted that such views do not determine.
    demand_different_views(found.fit)
    lens = settings.lens(settings.most, tangential=settings.tangential is not False)
    if lens.tangential:
        found = fitted(estimate, used, lens)
    for _ in range(_ROUNDS):
        if np.array_equal(found.agree, used):
            break
        used = found.agree
        found = fitted(found.estimate, used, lens)
    if not settings.keep_outliers:
        _demand_most(found.agree, names)
    return found


def _demand_most(agree: BoolArray, names: Sequence[str]) -> None:
    """Raise an error if at most half of the views agree."""
    if 2 * agree.sum() <= len(agree):
        raise CalibrationError(
            f"no camera explains most of the pictures: {listed(names, ~agree)} contradict "
            f"{listed(names, agree) or 'each other'}; {ALL_THE_SAME}"
        )


def listed(names: Sequence[str], chosen: BoolArray) -> str:
    """Names of some views."""
    return ", ".join(name for name, is_chosen in zip(names, chosen) if is_chosen)


def _fitted(
    points: Points,
    settings: CalibrationSettings,
    radius_m: float,
    estimate: Estimate,
    used: BoolArray,
    lens: FreeLens,
) -> Consensus:
    """Fit to the views that are used; for the others, fit only the poses."""
    views, others = np.flatnonzero(used), np.flatnonzero(~used)
    fit, _ = fit_points(estimate.of_views(views), points.of_views(views), settings, lens, radius_m)
    found = replace(estimate, intrinsics=fit.estimate.intrinsics).with_poses(views, fit.estimate)
    residuals = np.empty_like(points.pixels)
    residuals[used[points.views]] = fit.residuals
    if len(others):
        rest = points.of_views(others)
        posed = best_poses(found.of_views(others), rest)
        found = found.with_poses(others, posed)
        residuals[~used[points.views]] = residuals_of(posed, rest)
    typical, rms = (view_rms(residuals, points, share) for share in (_COUNTED_SHARE, 1.0))
    far = max(_FAR * np.median(typical[used]), _LEAST_FAR_PX)
    return Consensus(fit=fit, estimate=found, rms_px=rms, agree=(typical <= far) & np.isfinite(rms))


def view_rms(residuals: FloatArray, points: Points, share: float = 1.0) -> FloatArray:
    """(V,) root of the mean squared distance of each view's points, the nearest share of them.

    Infinite where one of these is NaN.
    """
    squares = np.nan_to_num(np.sum(residuals**2, axis=1), nan=np.inf)
    of_views = np.split(squares[np.lexsort((squares, points.views))], np.cumsum(points.counts)[:-1])
    return np.sqrt([np.mean(some[: int(np.ceil(share * len(some)))]) for some in of_views])


def demand_different_views(fit: Adjusted) -> None:
    """Raise an error for views that do not separate focal length and distance."""
    spread_deg = normals_spread_deg(fit.estimate.rotations)
    variance = float(fit.covariance[0, 0])
    # In a singular problem rounding can make the variance zero or negative.
    sigma = np.sqrt(variance) if variance > 0.0 else np.inf
    relative = float(sigma / fit.estimate.intrinsics[0])
    if spread_deg >= _SMALLEST_SPREAD_DEG and relative < _LARGEST_SCALE_SIGMA:
        return
    uncertain = f"the focal length {100.0 * relative:.2g} % uncertain"
    tilt = "tilt the board by 20 to 45 deg in different directions between pictures"
    if spread_deg < _WIDE_SPREAD_DEG:
        raise CalibrationError(
            f"the boards have almost the same orientation: their normals differ by at most "
            f"{spread_deg:.1f} deg and leave {uncertain}, because it is not separable from the "
            f"distance; {tilt}"
        )
    u, v = fit.estimate.intrinsics[2:4].tolist()
    raise CalibrationError(
        f"the pictures do not determine the lens: they leave {uncertain}, with the principal point "
        f"at {u:.0f}, {v:.0f}; {tilt}, hold it nearer, and measure it: it may be longer than "
        "--square-m one way only"
    )
