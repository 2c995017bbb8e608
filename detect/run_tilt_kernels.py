"""Compiled: one axis of the tilt of a run's frames, filtered forward and smoothed backward."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
