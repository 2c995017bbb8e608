"""Compiled: one axis of the tilt of a run's frames, filtered forward and smoothed backward."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def smooth_axis(
    deviation: NDArray[np.float64], sigma: NDArray[np.float64], model: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """True deviations of one angle from the run's constant lean, by all frames.

    The state is the deviation x and the error u of the verticals in units of their standard
    deviation; both are first-order autoregressions: what is wrong with verticals (a tree, a
    curtain) stays in view. A measurement is x + scale sigma u + white noise, or a stray. The two
    filtered densities are merged into the normal one of the same moments before the next frame.

    Parameters
    ----------
    deviation : (N,) float64
        Measured angles less the constant lean (rad); NaN where there is none.
    sigma : (N,) float64
        Their standard deviations as measured (rad).
    model : (7,) float64
        Standard deviation of x (rad), its correlation from frame to frame, scale and correlation of
        the verticals' lasting error, standard deviation of white noise beyond `sigma` (rad), share
        of strays, their standard deviation (rad).

    Returns
    -------
    log_likelihood : float
        Of the measurements.
    smoothed, variance : (N,) float64
        x (rad) given all frames, and its variance (rad^2).
    """
    spread, memory, scale, lasting, noise, stray_share, stray = model
    count = len(deviation)
    # Filtered and predicted: means of x and u, variances of both and their covariance.
    after, before = np.empty((count, 5)), np.empty((count, 5))
    log_likelihood = 0.0
    x, u, xx, xu, uu = 0.0, 0.0, spread * spread, 0.0, 1.0
    for k in range(count):
        if k > 0:
            x, u = memory * x, lasting * u
            xx = memory * memory * xx + (1.0 - memory * memory) * spread * spread
            xu = memory * lasting * xu
            uu = lasting * lasting * uu + 1.0 - lasting * lasting
        before[k, 0], before[k, 1], before[k, 2], before[k, 3], before[k, 4] = x, u, xx, xu, uu
        if not math.isnan(deviation[k]):
            load = scale * sigma[k]
            off = deviation[k] - x - load * u
            to_x, to_u = xx + load * xu, xu + load * uu
            good = to_x + load * to_u + sigma[k] ** 2 + noise * noise
            bad = good + stray * stray
            log_good = math.log((1.0 - stray_share) / math.sqrt(good)) - 0.5 * off * off / good
            log_bad = math.log(stray_share / math.sqrt(bad)) - 0.5 * off * off / bad
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
            cxx, cxu, cux, cuu = memory * fxx, lasting * fxu, memory * fxu, lasting * fuu
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
    return log_likelihood, smoothed, variance
