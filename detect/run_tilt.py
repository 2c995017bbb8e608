"""The tilt of the frames of a run: a constant lean, and each frame's deviation from it.

The verticals of one frame often have a common error: trunks, folds of a curtain, a leaning board.
Those of a run determine the lean of the camera relative to its calibration, and the robot's tilt
about that. The outlines of discs (`detect.discs.outline_tilt`) measure a frame's deviation, too.
The two constants differ if the calibration is not exact: that of the verticals depends on errors of
the lens, that of the outlines on errors of height and radius. The truth is assumed to be anywhere
between them, and the mean is used. Each axis is an autoregressive process about a constant,
measured with errors that last as long as their scene is visible (`smooth_axis`). The constants, the
spread, and the factors between true and stated errors, which a single frame cannot determine, are
estimated by maximum likelihood: in some buildings all verticals are true, in others few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from camera import Camera
from detect.settings import LEAST_FRAMES
from redetect.array_types import BoolArray, FloatArray
from redetect.compiled import kernel
from redetect.landmarks import FrameTilt

#: Priors of the estimated parameters, and the standard deviations of their logarithms: the spread
#: of the true tilt about its constant, for an even floor (rad); the duration of a deviation, for a
#: robot on springs (frames); the factors on the stated deviations of verticals and of outlines,
#: which a run of few frames cannot determine well.
_SPREAD_RAD, _LOG_SPREAD_SIGMA = math.radians(0.3), 0.3
_FRAMES, _LOG_FRAMES_SIGMA = 2.3, 0.3
_LOG_FACTOR_SIGMA = 0.5
#: Unit of the constants in the optimisation (rad).
_UNIT_RAD = math.radians(0.1)
_SEARCH = {"gtol": 1e-2}
#: Systematic error common to all verticals: that of the lens towards the image border (rad). It is
#: not estimated, since a run determines only its sum with the true lean.
COMMON_RAD = math.radians(0.15)
#: The same if the calibration is exact in lens and height; standard deviation of the difference
#: between the constants of outlines and verticals then, and otherwise (rad; `_share_exact`).
_EXACT_RAD, _EXACT_OFFSET_RAD, _OFFSET_RAD = (math.radians(x) for x in (0.01, 0.1, 1.0))
#: Derivative of the outlines' pitch (rad) by the camera's height, relative to that height.
OUTLINE_PITCH_PER_HEIGHT = 0.45
#: Where hardly any verticals are visible: standard deviation of the lean, and of the error common
#: to the pitch of all outlines (mainly the height's), with and without a calibration's covariance.
_UNSURE_STATED_RAD, _UNSURE_RAD = math.radians(0.5), _OFFSET_RAD
#: Correlated share of the variance of a frame's error (a scene stays visible), and its correlation.
LASTING_SHARE, LASTING = 0.5, 0.9
#: Share of frames with an outlier, a consensus of wrong lines, and its standard deviation (rad).
OUTLIER_SHARE, OUTLIER_RAD = 0.02, math.radians(2.0)
#: Share of frames with a momentary tilt (a wheel on a sill or a cable), and its size (rad).
JUMP_SHARE, JUMP_RAD = 0.03, math.radians(2.0)
#: A lean is certain beyond this number of standard deviations; displacement of discs that matters.
_CERTAIN_SIGMAS, _LEAST_OFF_M = 3.0, 0.02
_LEAST_RAD = math.radians(0.02)  #: Least standard deviation of a frame's tilt (rad).


class FrameTilts(NamedTuple):
    """Pitch and roll of frames (rad), NaN if missing, and their variances (rad^2)."""

    tilt: FloatArray  # (N, 2)
    variance: FloatArray  # (N, 2)

    @property
    def known(self) -> BoolArray:
        """(N,) which frames have a tilt."""
        return np.isfinite(self.tilt[:, 0])


def frame_tilts(tilts: Sequence[FrameTilt | None]) -> FrameTilts:
    """Pitch and roll of frames with their variances, NaN for frames without a tilt."""
    unknown = (math.nan,) * 4
    rows = [(t.pitch, t.roll, t.cpp, t.crr) if t else unknown for t in tilts]
    numbers = np.array(rows).reshape(-1, 4)
    return FrameTilts(numbers[:, :2], numbers[:, 2:])


@dataclass(frozen=True, eq=False)
class RunTilt:
    """The tilt of all frames of a run: pitch and roll (rad)."""

    lean: FloatArray  # (2,) the constants
    lean_sigma: FloatArray  # (2,) their standard deviations
    tilt: FloatArray  # (N, 2) of each frame
    #: (N, 2) of them (rad^2), including the constant's; the axes are assumed to be independent
    variance: FloatArray
    #: Relative standard deviation of the camera's height, if the calibration has no covariance.
    height_sigma: float = 0.0
    by_verticals: bool = True  #: Otherwise mainly from the outlines of discs.

    @property
    def usual_rad(self) -> float:
        """Root mean square of pitch and roll: the standard deviation of an unknown tilt."""
        return math.sqrt(np.mean(self.tilt**2 + self.variance))

    def sentence(self, height_m: float) -> str:
        """A sentence on the constant lean, and what it may mean for discs of a camera this high."""
        pitch, roll = (
            f"{math.degrees(lean):.2f} +- {math.degrees(sigma):.2f}"
            for lean, sigma in zip(self.lean, self.lean_sigma)
        )
        by = "" if self.by_verticals else ", by the outlines of discs"
        # Levelling turns about the robot's origin on the floor.
        off_m = height_m * math.hypot(*self.lean)
        certain = math.hypot(*self.lean) > _CERTAIN_SIGMAS * math.hypot(*self.lean_sigma)
        if_alone = (
            f" (if the camera alone leans, not the robot, discs are {100.0 * off_m:.0f} cm off)"
        )
        return (
            f"the camera leans {pitch} (pitch) and {roll} degrees (roll) from its calibration{by}: "
            f"levelled by it{if_alone if certain and off_m > _LEAST_OFF_M else ''}"
        )


def camera_pitch_weights(camera: Camera) -> tuple[float, float]:
    """Weights of pitch and roll in the pitch of a camera, by its bearing in eighths of a turn."""
    x, y = camera.rotation[:2, 2]
    bearing_rad = 0.25 * math.pi * round(math.atan2(x, -y) / (0.25 * math.pi))
    return math.cos(bearing_rad), math.sin(bearing_rad)


def tilt_of_run(
    verticals: FrameTilts,
    outlines: FrameTilts | None = None,
    common_variance: FloatArray | None = None,
    pitch_weights: tuple[float, float] = (1.0, 0.0),
) -> RunTilt | None:
    """Estimate the tilt of a run from the tilts of its frames, in their order.

    The tilts are those from the verticals of each frame and, optionally, from the outlines of its
    discs; None if fewer than `LEAST_FRAMES` frames have one. `common_variance`,
    (2,) rad^2, is that of the error of pitch and roll common to all frames, if the calibration
    states it: then the lean is that of the verticals, otherwise it depends on the outlines, too.
    Errors of the camera's height change its own pitch in outlines (`camera_pitch_weights`).
    """
    if np.count_nonzero(verticals.known) < LEAST_FRAMES:
        if outlines is None:
            return None
        unsure = _UNSURE_RAD if common_variance is None else _UNSURE_STATED_RAD
        return _tilt_by_outlines(verticals, outlines, unsure, pitch_weights)
    if outlines is None or np.count_nonzero(outlines.known & verticals.known) < LEAST_FRAMES:
        nothing = np.full_like(verticals.tilt, np.nan)
        outlines = FrameTilts(nothing, nothing)
    series = [_Series(*axis) for axis in zip(*map(np.transpose, (*verticals, *outlines)))]
    found = _estimated(series)
    offsets = [one.offset for one in found]
    exact = _share_exact(offsets)
    # If the calibration has a covariance, that covers the verticals and the height.
    between = np.nan_to_num(offsets) if common_variance is None else np.zeros(2)
    lean, lean_variance = np.array([(one.lean, one.lean_variance) for one in found]).T
    tilt, of_deviation = _tilts(series, found)
    # Weight of the constant in a frame's tilt: zero for a well measured frame.
    shifted, _ = _tilts(series, [one._replace(lean=one.lean + _UNIT_RAD) for one in found])
    share = np.clip((shifted - tilt) / _UNIT_RAD, 0.0, 1.0)
    if common_variance is None:
        common_variance = COMMON_RAD**2 + between**2 / 12.0  # the latter: uniform between them
        common_variance = exact * _EXACT_RAD**2 + (1.0 - exact) * common_variance
    pitch_sigma = math.sqrt((1.0 - exact) * np.dot(pitch_weights, between) ** 2 / 12.0)
    return RunTilt(
        lean + 0.5 * between,
        np.sqrt(lean_variance + common_variance),
        tilt + 0.5 * between,
        of_deviation + share**2 * lean_variance + common_variance,
        pitch_sigma / OUTLINE_PITCH_PER_HEIGHT,
    )


def usual_tilt(verticals: FrameTilts, outlines: FrameTilts) -> float:
    """Standard deviation of unknown tilts (rad) in a run of which few frames have a tilt.

    By the median square of those from verticals, or else from outlines, without the variance of
    their errors; the prior counts like as many frames as would determine it as well.
    """
    tilt, variance = (np.where(verticals.known[:, None], *of) for of in zip(verticals, outlines))
    # Half of two normal errors have a sum of squares below ln 4 times their variance.
    squares = np.sum(tilt**2, axis=1) / math.log(4.0) - np.mean(variance, axis=1)
    prior = np.full(round(0.25 / _LOG_SPREAD_SIGMA**2), _SPREAD_RAD**2)
    usual = np.median(np.concatenate([prior, squares[np.isfinite(squares)]]))
    return max(_SPREAD_RAD, math.sqrt(max(usual, 0.0)))


def _tilt_by_outlines(
    verticals: FrameTilts, outlines: FrameTilts, unsure: float, pitch_weights: tuple[float, float]
) -> RunTilt | None:
    """The tilt of a run of which few frames show verticals, mainly from the outlines of discs.

    What all outlines show may be the camera's lean or an error of the calibration: `unsure` is the
    standard deviation of either (rad).
    """
    both = verticals, outlines
    information = np.stack([np.where(of.known[:, None], 1.0 / of.variance, 0.0) for of in both])
    total = information.sum(axis=0)
    weighted = (information * np.nan_to_num([verticals.tilt, outlines.tilt])).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = FrameTilts(weighted / total, 1.0 / total)
        by_outlines = np.where(total > 0.0, information[1] / total, 1.0)
    if np.count_nonzero(mean.known) < LEAST_FRAMES:
        return None
    run = tilt_of_run(mean, None, np.zeros(2))
    assert run is not None
    error = np.hypot(COMMON_RAD, unsure * np.array(pitch_weights))
    believed = unsure**2 / (unsure**2 + error**2 + run.lean_sigma**2)
    lean_variance = (1.0 - believed) * unsure**2
    common = by_outlines**2 * lean_variance + (1.0 - by_outlines) ** 2 * COMMON_RAD**2
    return RunTilt(
        believed * run.lean,
        np.sqrt(lean_variance),
        run.tilt - by_outlines * (1.0 - believed) * run.lean,
        run.variance + common,
        by_verticals=False,
    )


def _tilts(series: Sequence[_Series], found: Sequence[_Axis]) -> tuple[FloatArray, FloatArray]:
    """(N, 2) tilts of the frames, and their variances if the constants are right."""
    smoothed = [axis.smoothed(one) for axis, one in zip(series, found)]
    tilt = np.stack([one.lean + each[1] for one, each in zip(found, smoothed)], axis=-1)
    return tilt, np.stack([each[2] for each in smoothed], axis=-1)


class _Axis(NamedTuple):
    """Estimated parameters of an axis: constants, spread (rad), factors of stated deviations."""

    lean: float
    spread: float
    correlation: float  # of deviations from frame to frame
    verticals_scale: float
    outlines_scale: float
    offset: float = math.nan  # the outlines' constant minus the verticals'
    lean_variance: float = math.nan


class _Series(NamedTuple):
    """The measurements of an axis in all frames (rad, rad^2); NaN if missing."""

    verticals: FloatArray
    verticals_variance: FloatArray
    outlines: FloatArray
    outlines_variance: FloatArray

    def smoothed(self, axis: _Axis) -> tuple[float, FloatArray, FloatArray]:
        """The log-likelihood of the parameters; deviations from the constant, their variances.

        Their weighted means, which are smoothed, and differences together contain all information.
        """
        of_verticals = axis.verticals_scale**2 * self.verticals_variance
        of_outlines = axis.outlines_scale**2 * self.outlines_variance
        variance = np.stack([of_verticals, of_outlines])
        values = np.stack([self.verticals, self.outlines - axis.offset])
        information = np.where(np.isfinite(values), 1.0 / variance, 0.0)
        total = information.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (information * np.nan_to_num(values)).sum(axis=0) / total
            likelihood, deviation, of_deviation = smooth_axis(
                mean - axis.lean, 1.0 / np.sqrt(total), axis.spread, axis.correlation
            )
        difference, of_difference = values[1] - values[0], variance.sum(axis=0)
        both = np.isfinite(difference)
        likelihood += _log_density(difference[both], of_difference[both])
        return likelihood, deviation, of_deviation


def _log_density(difference: FloatArray, variance: FloatArray) -> float:
    """Log density of differences of two measurements, either of which may be an outlier."""
    log_good, log_bad = (
        math.log(share) - 0.5 * (np.log(spread) + difference**2 / spread)
        for share, spread in (
            (1.0 - 2.0 * OUTLIER_SHARE, variance),
            (2.0 * OUTLIER_SHARE, variance + OUTLIER_RAD**2),
        )
    )
    return float(np.logaddexp(log_good, log_bad).sum())


def _estimated(series: Sequence[_Series]) -> list[_Axis]:
    """Maximum likelihood estimates of the axes' parameters.

    The factors are determined by the differences of verticals and outlines; without these they are
    1. That of verticals is common to all axes, since lines lean in any direction.
    """
    from scipy.optimize import minimize  # importing takes as long as a hundred frames

    has_outlines = any(np.isfinite(axis.outlines).any() for axis in series)
    middle = [
        (
            float(np.nanmedian(axis.verticals)),
            float(np.nanmedian(axis.outlines - axis.verticals)) if has_outlines else math.nan,
        )
        for axis in series
    ]
    # The logarithm of the verticals' factor, then each axis's parameters in the order of `axes_of`.
    of_axis = [math.inf, _LOG_SPREAD_SIGMA, _LOG_FRAMES_SIGMA, _LOG_FACTOR_SIGMA, math.inf]
    prior_sigma = np.array([_LOG_FACTOR_SIGMA] + of_axis * len(series))
    is_free = np.array([has_outlines] + ([True] * 3 + [has_outlines] * 2) * len(series))

    def axes_of(unknowns: FloatArray) -> list[_Axis]:
        return [
            _Axis(
                lean + _UNIT_RAD * to_lean,
                _SPREAD_RAD * math.exp(spread),
                math.exp(-math.exp(-frames) / _FRAMES),
                math.exp(unknowns[0]),
                math.exp(outlines),
                # NaN is equal only to itself, the same object: any other is not in the cache.
                offset + _UNIT_RAD * to_offset if has_outlines else math.nan,
            )
            for (lean, offset), (to_lean, spread, frames, outlines, to_offset) in zip(
                middle, unknowns[1:].reshape(len(series), -1), strict=True
            )
        ]

    @cache  # most unknowns affect one axis only
    def log_likelihood(number: int, axis: _Axis) -> float:
        return series[number].smoothed(axis)[0]

    def cost(unknowns: FloatArray) -> float:
        likelihood = sum(log_likelihood(*each) for each in enumerate(axes_of(unknowns)))
        return float(0.5 * np.sum((unknowns / prior_sigma) ** 2) - likelihood)

    def cost_of_free(values: FloatArray) -> float:
        unknowns = np.zeros(len(is_free))
        unknowns[is_free] = values
        return cost(unknowns)

    found = np.zeros(len(is_free))
    found[is_free] = minimize(cost_of_free, found[is_free], method="BFGS", options=_SEARCH).x
    estimated = []
    for k, axis in enumerate(axes_of(found)):
        step = np.zeros(len(found))
        step[1 + 5 * k] = 0.2
        curvature = (cost(found + step) - 2.0 * cost(found) + cost(found - step)) / 0.2**2
        estimated.append(axis._replace(lean_variance=_UNIT_RAD**2 / max(curvature, 1e-4)))
    return estimated


def _share_exact(offsets: Sequence[float]) -> float:
    """Probability that the calibration is exact, given the differences of the constants.

    A wrong lens or height moves the constant of the outlines away from that of the verticals. If
    they agree, the calibration is most likely exact, but they may also agree by chance.
    """
    if not np.isfinite(offsets).all():
        return 0.0
    log_odds = sum(
        math.log(_OFFSET_RAD / _EXACT_OFFSET_RAD)
        - 0.5 * (x / _EXACT_OFFSET_RAD) ** 2
        + 0.5 * (x / _OFFSET_RAD) ** 2
        for x in offsets
    )
    return 1.0 / (1.0 + math.exp(min(-log_odds, 700.0)))


@kernel()
def _weighted_density(share: float, off: float, variance: float) -> float:
    """A normal density, times a share."""
    return share * math.exp(-0.5 * min(off * off / variance, 1000.0)) / math.sqrt(variance)


@kernel()
def smooth_axis(
    deviation: FloatArray, sigma: FloatArray, spread: float, correlation: float
) -> tuple[float, FloatArray, FloatArray]:
    """Smooth the deviations of one angle from the run's constant lean over all frames.

    The state is the deviation x and the correlated error u of the verticals in units of its
    standard deviation; both are first-order autoregressive, since wrong verticals (a tree, a
    curtain) stay visible. A measurement is x + a u + white noise, or an outlier. The two filtered
    densities are merged into a Gaussian with the same moments before the next frame. The smoothed
    residual may be an outlier or a jump of the robot: mean and variance are the mixture's.

    From (N,) measured angles minus the lean (rad; NaN if missing), their standard deviations and
    that of x, and the correlation of x from frame to frame, returns the log-likelihood of the
    measurements, and the (N,) means and variances of the deviations given all frames (rad, rad^2).
    """
    count = len(deviation)
    # Filtered and predicted: means of x and u, variances of both and their covariance.
    after, before = np.empty((count, 5)), np.empty((count, 5))
    log_likelihood = 0.0
    x, u, xx, xu, uu = 0.0, 0.0, spread * spread, 0.0, 1.0
    for k in range(count):
        if k > 0:
            x, u = correlation * x, LASTING * u
            xx = spread * spread + correlation * correlation * (xx - spread * spread)
            xu = correlation * LASTING * xu
            uu = LASTING * LASTING * uu + 1.0 - LASTING * LASTING
        before[k, 0], before[k, 1], before[k, 2], before[k, 3], before[k, 4] = x, u, xx, xu, uu
        if not math.isnan(deviation[k]):
            load = math.sqrt(LASTING_SHARE) * sigma[k]
            off = deviation[k] - x - load * u
            to_x, to_u = xx + load * xu, xu + load * uu
            white = (1.0 - LASTING_SHARE) * sigma[k] ** 2 + _LEAST_RAD**2
            good = to_x + load * to_u + white
            bad = good + OUTLIER_RAD**2
            log_good = math.log((1.0 - OUTLIER_SHARE) / math.sqrt(good)) - 0.5 * off * off / good
            log_bad = math.log(OUTLIER_SHARE / math.sqrt(bad)) - 0.5 * off * off / bad
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
            cxx, cxu, cux, cuu = correlation * fxx, LASTING * fxu, correlation * fxu, LASTING * fuu
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
        jumped = _weighted_density(JUMP_SHARE, left, good + JUMP_RAD**2)
        others = _weighted_density(1.0 - JUMP_SHARE - OUTLIER_SHARE, left, good)
        others += _weighted_density(OUTLIER_SHARE, left, good + OUTLIER_RAD**2)
        share = jumped / (jumped + others)
        believed = JUMP_RAD**2 / (good + JUMP_RAD**2)
        smoothed[k] += share * believed * left
        variance[k] += share * (1.0 - believed) * JUMP_RAD**2
        variance[k] += share * (1.0 - share) * (believed * left) ** 2
    return log_likelihood, smoothed, variance
