"""The tilt of the frames of a run: a constant lean, and each frame's deviation from it.

The verticals of one frame often have a common error: trunks, folds of a curtain, a board that
leans. Those of a run determine how the camera leans relative to its calibration, and how far the
robot tilts about that. The outlines of discs (`detect.discs.outline_tilt`) show a frame's
deviation, too; their constant is taken from the verticals, since their own depends on the camera's
height. Each axis is an autoregression about a constant, measured with errors that last as long as
their scene is in view (`smooth_axis`). The constant and the spread about it maximise
the likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from redetect.landmarks import FrameTilt

FloatArray = NDArray[np.float64]

#: With fewer measured frames the errors cannot be separated from the tilt.
LEAST_FRAMES = 20
#: See `_joined`.
_OUTLIER_SIGMAS, _STATED_FRAMES = 3.0, 4.0
#: Prior of the spread of the true tilt about its constant, a robot on an even floor (rad), and the
#: standard deviation of its logarithm.
_SPREAD_RAD, _LOG_SPREAD_SIGMA = math.radians(0.3), 0.3
_SEARCH = {"fatol": 1e-4, "xatol": 1e-3}
#: Systematic error of any number of verticals: the lens's error common to all of them towards the
#: image's border (rad). It is given, not estimated: a run shows its sum with the true lean.
COMMON_RAD = math.radians(0.15)
#: Correlation of true deviations from frame to frame: a robot swings on its springs.
MEMORY = 0.65
#: Share of the variance of a frame's error that lasts, and its correlation: a scene stays in view.
LASTING_SHARE, LASTING = 0.5, 0.9
#: How often, and how far, a frame shows a wrong tilt (rad): a consensus of lines that are no
#: verticals.
STRAY_SHARE, STRAY_RAD = 0.02, math.radians(2.0)
#: How often, and how far, the robot tilts for a moment (rad): a wheel is on a sill or a cable.
JUMP_SHARE, JUMP_RAD = 0.03, math.radians(2.0)
#: Least standard deviation of a frame's tilt (rad).
_LEAST_RAD = math.radians(0.03)


class FrameTilts(NamedTuple):
    """Pitch and roll of frames (rad), NaN where there are none, and their variances (rad^2)."""

    tilt: FloatArray
    """(N, 2)"""
    variance: FloatArray
    """(N, 2)"""


def frame_tilts(tilts: Sequence[FrameTilt | None]) -> FrameTilts:
    """Pitch and roll of frames with their variances, NaN for frames without a tilt."""
    unknown = FrameTilt("", math.nan, math.nan, math.nan, 0.0, math.nan, 0)
    known = [tilt or unknown for tilt in tilts]
    return FrameTilts(
        np.array([(tilt.pitch, tilt.roll) for tilt in known]).reshape(-1, 2),
        np.array([(tilt.cpp, tilt.crr) for tilt in known]).reshape(-1, 2),
    )


@dataclass(frozen=True, eq=False)
class AxisModel:
    """Estimated model of one axis.

    Attributes
    ----------
    lean, lean_sigma : float
        The constant, and its standard deviation (rad).
    spread : float
        Standard deviation of true tilts about it (rad).
    """

    lean: float
    lean_sigma: float
    spread: float


@dataclass(frozen=True, eq=False)
class RunTilt:
    """The tilt of all frames of a run.

    Attributes
    ----------
    axes : (AxisModel, AxisModel)
        Pitch and roll.
    tilt : (N, 2) float64
        Pitch and roll of each frame (rad).
    variance : (N, 2) float64
        Of them (rad^2), the constant's included; the two axes are assumed to be independent.
    """

    axes: tuple[AxisModel, AxisModel]
    tilt: FloatArray
    variance: FloatArray

    def sentence(self) -> str:
        """The constant lean, and that it was used."""
        pitch, roll = (
            f"{math.degrees(axis.lean):.2f} +- {math.degrees(axis.lean_sigma):.2f}"
            for axis in self.axes
        )
        return (
            f"the camera leans {pitch} (pitch) and {roll} degrees (roll) from its calibration: "
            "levelled by it"
        )


def tilt_of_run(verticals: FrameTilts, outlines: FrameTilts | None = None) -> RunTilt | None:
    """The tilt of a run's frames from what each of them shows.

    Parameters
    ----------
    verticals : FrameTilts
        By the verticals of each frame, in the frames' order.
    outlines : FrameTilts, optional
        By the outlines of its discs.

    Returns
    -------
    RunTilt or None
        None if fewer than `LEAST_FRAMES` frames have a tilt by verticals.
    """
    if np.count_nonzero(np.isfinite(verticals.tilt[:, 0])) < LEAST_FRAMES:
        return None
    measured, variance = verticals if outlines is None else _joined(verticals, outlines)
    axes, tilts, variances = [], [], []
    for values, of_values in zip(measured.T, variance.T):
        sigma = np.sqrt(of_values)
        axis = _learned(values, sigma)
        _, deviation, of_deviation = smooth_axis(values - axis.lean, sigma, axis.spread)
        axes.append(axis)
        tilts.append(axis.lean + deviation)
        variances.append(of_deviation + axis.lean_sigma**2)
    return RunTilt((axes[0], axes[1]), np.stack(tilts, -1), np.stack(variances, -1))


def _joined(verticals: FrameTilts, outlines: FrameTilts) -> FrameTilts:
    """Means of both, weighed by their variances; outlines are moved onto the verticals' lean.

    Two independent measurements show how well their variances hold in this run:
    both are scaled by the mean squared difference in units of the stated variances. Frames beyond
    `_OUTLIER_SIGMAS` are outliers; the stated variances count as much as `_STATED_FRAMES` frames.
    """
    both = np.isfinite(verticals.tilt[:, 0]) & np.isfinite(outlines.tilt[:, 0])
    if np.count_nonzero(both) < LEAST_FRAMES:
        return verticals
    between = outlines.tilt - verticals.tilt
    apart = np.median(between[both], axis=0)
    squared = (between[both] - apart) ** 2 / (verticals.variance + outlines.variance)[both]
    found = np.minimum(squared, _OUTLIER_SIGMAS**2).mean(axis=1).sum()
    scale = (found + _STATED_FRAMES) / (np.count_nonzero(both) + _STATED_FRAMES)
    values = np.stack([verticals.tilt, outlines.tilt - apart])
    information = np.where(
        np.isfinite(values), 1.0 / np.stack([verticals.variance, outlines.variance]), 0.0
    )
    total = information.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (information * np.nan_to_num(values)).sum(axis=0) / total
        return FrameTilts(mean, scale / total)


def _learned(values: FloatArray, sigma: FloatArray) -> AxisModel:
    """The constants of the largest likelihood, and how well the lean among them is known."""
    from scipy.optimize import minimize  # takes as long as a hundred frames

    unit = math.radians(0.1)

    def cost(unknowns: FloatArray) -> float:
        lean, log_spread = unknowns.tolist()
        spread = _SPREAD_RAD * math.exp(log_spread)
        log_likelihood, _, _ = smooth_axis(values - unit * lean, sigma, spread)
        return float(0.5 * (log_spread / _LOG_SPREAD_SIGMA) ** 2 - log_likelihood)

    start = np.array([float(np.nanmedian(values)) / unit, 0.0])
    found = minimize(cost, start, method="Nelder-Mead", options=_SEARCH)
    step = np.array([0.2, 0.0])
    curvature = (cost(found.x + step) - 2.0 * found.fun + cost(found.x - step)) / (0.2 * unit) ** 2
    own = 1.0 / max(curvature, 1e-6)
    lean, log_spread = found.x.tolist()
    return AxisModel(
        unit * lean, math.sqrt(own + COMMON_RAD**2), _SPREAD_RAD * math.exp(log_spread)
    )


@njit(cache=True, error_model="numpy")
def _weighed(share: float, off: float, variance: float) -> float:
    """A share of a normal density."""
    return share * math.exp(-0.5 * min(off * off / variance, 1000.0)) / math.sqrt(variance)


@njit(cache=True, error_model="numpy")
def smooth_axis(
    deviation: NDArray[np.float64], sigma: NDArray[np.float64], spread: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """True deviations of one angle from the run's constant lean, by all frames.

    The state is the deviation x and the lasting error u of the verticals in units of its standard
    deviation; both are first-order autoregressions: wrong verticals (a tree, a curtain) stay in
    view. A measurement is x + a u + white noise, or an outlier. The two filtered densities are
    merged into the normal one of the same moments before the next frame. The final residual of a
    frame's measurement may be an outlier or a jump of the robot; the mean and the
    variance are those of the mixture.

    Parameters
    ----------
    deviation : (N,) float64
        Measured angles less the constant lean (rad); NaN where there is none.
    sigma : (N,) float64
        Their standard deviations (rad).
    spread : float
        Standard deviation of x (rad).

    Returns
    -------
    log_likelihood : float
        Of the measurements.
    mean, variance : (N,) float64
        Of the deviations given all frames (rad, rad^2).
    """
    count = len(deviation)
    # Filtered and predicted: means of x and u, variances of both and their covariance.
    after, before = np.empty((count, 5)), np.empty((count, 5))
    log_likelihood = 0.0
    x, u, xx, xu, uu = 0.0, 0.0, spread * spread, 0.0, 1.0
    for k in range(count):
        if k > 0:
            x, u = MEMORY * x, LASTING * u
            xx = MEMORY * MEMORY * xx + (1.0 - MEMORY * MEMORY) * spread * spread
            xu = MEMORY * LASTING * xu
            uu = LASTING * LASTING * uu + 1.0 - LASTING * LASTING
        before[k, 0], before[k, 1], before[k, 2], before[k, 3], before[k, 4] = x, u, xx, xu, uu
        if not math.isnan(deviation[k]):
            load = math.sqrt(LASTING_SHARE) * sigma[k]
            off = deviation[k] - x - load * u
            to_x, to_u = xx + load * xu, xu + load * uu
            white = (1.0 - LASTING_SHARE) * sigma[k] ** 2 + _LEAST_RAD**2
            good = to_x + load * to_u + white
            bad = good + STRAY_RAD**2
            log_good = math.log((1.0 - STRAY_SHARE) / math.sqrt(good)) - 0.5 * off * off / good
            log_bad = math.log(STRAY_SHARE / math.sqrt(bad)) - 0.5 * off * off / bad
            larger = max(log_good, log_bad)
            total = math.exp(log_good - larger) + math.exp(log_bad - larger)
            log_likelihood += larger + math.log(total)
            weight = math.exp(log_good - larger) / total
            gain = weight / good + (1.0 - weight) / bad
            between = weight * (1.0 - weight) * (off / good - off / bad) ** 2
            x, u = x + to_x * gain * off, u + to_u * gain * off
            xx += to_x * to_x * (between - gain)
            xu += to_x * to_u * (between - gain)
            uu += to_u * to_u * (between - gain)
        after[k, 0], after[k, 1], after[k, 2], after[k, 3], after[k, 4] = x, u, xx, xu, uu
    smoothed, variance = np.empty(count), np.empty(count)
    for k in range(count - 1, -1, -1):
        if k < count - 1:
            _, _, pxx, pxu, puu = before[k + 1]
            fx, fu, fxx, fxu, fuu = after[k]
            determinant = pxx * puu - pxu * pxu
            # Rows of the smoother's gain, for x and for u.
            cxx, cxu, cux, cuu = MEMORY * fxx, LASTING * fxu, MEMORY * fxu, LASTING * fuu
            gxx = (cxx * puu - cxu * pxu) / determinant
            gxu = (cxu * pxx - cxx * pxu) / determinant
            gux = (cux * puu - cuu * pxu) / determinant
            guu = (cuu * pxx - cux * pxu) / determinant
            dx, du = x - before[k + 1, 0], u - before[k + 1, 1]
            dxx, dxu, duu = xx - pxx, xu - pxu, uu - puu
            x, u = fx + gxx * dx + gxu * du, fu + gux * dx + guu * du
            xx = fxx + gxx * gxx * dxx + 2.0 * gxx * gxu * dxu + gxu * gxu * duu
            xu = fxu + gxx * gux * dxx + (gxx * guu + gxu * gux) * dxu + gxu * guu * duu
            uu = fuu + gux * gux * dxx + 2.0 * gux * guu * dxu + guu * guu * duu
        smoothed[k], variance[k] = x, xx
        if math.isnan(deviation[k]):
            variance[k] += JUMP_SHARE * JUMP_RAD**2
            continue
        # The residual of the measurement: noise, an outlier, or a jump.
        left = deviation[k] - x
        good = xx + sigma[k] ** 2
        jumped = _weighed(JUMP_SHARE, left, good + JUMP_RAD**2)
        others = _weighed(1.0 - JUMP_SHARE - STRAY_SHARE, left, good)
        others += _weighed(STRAY_SHARE, left, good + STRAY_RAD**2)
        share = jumped / (jumped + others)
        believed = JUMP_RAD**2 / (good + JUMP_RAD**2)
        smoothed[k] += share * believed * left
        variance[k] += share * (1.0 - believed) * JUMP_RAD**2
        variance[k] += share * (1.0 - share) * (believed * left) ** 2
    return log_likelihood, smoothed, variance
