"""Compiled Gauss-Newton steps of the disc fit, with what is known beforehand of radius and blur."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import normal_kernels as normal
from detect.discs.normal_kernels import factor_rows, solution
from detect.discs.patch_kernels import FitSettings

_LEAST_RADIUS, _MOST_RADIUS = 0.4, 2.0
#: Longest step of the position, in nominal radii.
_LONGEST_STEP = 0.3


@njit(cache=True, error_model="numpy", forceinline=True)
def gauss_newton_step(
    products: NDArray[np.float64],
    damping: float,
    p: NDArray[np.float64],
    contrast: float,
    variance: float,
    settings: FitSettings,
    log_most: float,
    damped: NDArray[np.float64],
    factor: NDArray[np.float64],
    values: NDArray[np.float64],
) -> bool:
    """Solve for the four nonlinear parameters' steps, times contrast, into `values`.

    The first six rows of the factor are those of the products; the prior knowledge of radius and
    blur and the damping come in only then.
    """
    n = normal.ROWS
    for i in range(normal.LOG_BLUR, n):
        for j in range(i + 1):
            damped[i, j] = products[i, j]
    for j in range(n):
        damped[normal.GREYS, j] = products[normal.GREYS, j]
    prior_blur = variance / (settings.blur_sigma * settings.blur_sigma)
    prior_radius = variance / (settings.radius_sigma * settings.radius_sigma)
    c_2 = contrast * contrast
    damped[normal.LOG_BLUR, normal.LOG_BLUR] += prior_blur / c_2
    damped[normal.RADIUS, normal.RADIUS] += prior_radius / c_2
    off_blur = p[3] - math.log(settings.blur_px)
    off_radius = p[2] - 1.0
    damped[normal.GREYS, normal.LOG_BLUR] -= prior_blur * off_blur / contrast
    damped[normal.GREYS, normal.RADIUS] -= prior_radius * off_radius / contrast
    for i in range(normal.LOG_BLUR, normal.UNKNOWNS):
        damped[i, i] *= 1.0 + damping
    if not factor_rows(damped, normal.LOG_BLUR, normal.UNKNOWNS, factor):
        return False
    solution(factor, normal.LOG_BLUR, normal.UNKNOWNS, values)
    if p[3] >= log_most and values[normal.LOG_BLUR] / contrast > 0.0:
        # The blur stays at its bound.
        damped[normal.LOG_BLUR, normal.LOG_BLUR] *= 1e9
        damped[normal.GREYS, normal.LOG_BLUR] = 0.0
        if not factor_rows(damped, normal.LOG_BLUR, normal.UNKNOWNS, factor):
            return False
        solution(factor, normal.LOG_BLUR, normal.UNKNOWNS, values)
    return True


@njit(cache=True, error_model="numpy", forceinline=True)
def move(
    best: NDArray[np.float64],
    values: NDArray[np.float64],
    contrast: float,
    log_least: float,
    log_most: float,
    p: NDArray[np.float64],
) -> None:
    """Take a step from the best parameters, within limits."""
    d_x = values[normal.X] / contrast
    d_y = values[normal.Y] / contrast
    length = math.hypot(d_x, d_y)
    shorten = min(1.0, _LONGEST_STEP / length) / contrast if length > 0.0 else 1.0 / contrast
    p[0] = best[0] + shorten * values[normal.X]
    p[1] = best[1] + shorten * values[normal.Y]
    radius = best[2] + shorten * values[normal.RADIUS]
    p[2] = min(max(radius, _LEAST_RADIUS), _MOST_RADIUS)
    p[3] = min(max(best[3] + shorten * values[normal.LOG_BLUR], log_least), log_most)
