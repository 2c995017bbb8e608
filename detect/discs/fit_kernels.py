"""Compiled fit of a disc, seen through the camera, to the grey values around a candidate.

Model of a grey value:

    grey = background + contrast * W

W is the share of the disc that the pixel sees (see `detect.discs.model_kernels`). The background is
a plane plus the two saddle terms, which let light fall off across the disc without imitating one.
Parameters are x, y, radius (in units of the nominal radius, relative to the candidate) and log
blur; contrast and background are linear, and every Gauss-Newton step solves for them anew.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import normal_kernels as normal
from detect.discs.descent_kernels import (
    PATIENT,
    Descent,
    Hope,
    Work,
    blur_width,
    descend,
    new_work,
)
from detect.discs.gather_kernels import ALL as ALL
from detect.discs.gather_kernels import LEAST_BLUR, Gathered, gather
from detect.discs.gather_kernels import LOOK as LOOK
from detect.discs.normal_kernels import factor_rows, solution
from detect.discs.outline_kernels import correlated_area, outline_statistics, residuals
from detect.discs.patch_kernels import FitSettings
from detect.discs.step_kernels import gauss_newton_step, move
from detect.uncounted import uncounted

#: Columns of a result.
X, Y, RADIUS, BLUR, CONTRAST = range(5)
EXPLAINED, RESIDUAL_VARIANCE, PIXELS = range(5, 8)
COV_XX, COV_XY, COV_YY = range(8, 11)
SECTORS_STEP, SECTORS_GOOD, OUTLINE_DEVIATION, RELATIVE_BLUR = range(11, 15)
ITERATIONS, BLUR_BOUND, MIDDLE_STEP = range(15, 18)
RESULT_SIZE = 18

_MAX_EVALUATIONS = 15
_LOOK_EVALUATIONS = 3


@uncounted
def fit_disc(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    radius: float,
    settings: FitSettings,
    start: NDArray[np.float64],
    blur_guess: float,
    detail: int,
    hope: Hope,
    work: Work,
    out: NDArray[np.float64],
) -> bool:
    """Fit one candidate.

    Parameters
    ----------
    start : (4,) float64
        Where to start: x, y, radius (nominal radii, relative to the candidate), log blur.
    blur_guess : float
        About how blurred the candidate is (along u), pixels: how far out pixels are gathered.
    detail : int
        How many pixels: `LOOK`, about 160 and few steps, or `ALL`; of discs larger than a patch all
        that tell where the edge is, and as many others as there is room for.
    hope : Hope
        When to give up.
    out : (RESULT_SIZE,) float64
        The result.

    Returns
    -------
    bool
        Whether the fit came to a result.
    """
    out[:] = 0.0
    patch = gather(image, floor_xy, u0, v0, radius, settings, blur_guess, detail, work.patch)
    out[PIXELS] = patch.fitted
    out[BLUR_BOUND] = patch.most_blur
    if patch.fitted - normal.UNKNOWNS < 4:
        return False
    evaluations = _LOOK_EVALUATIONS if detail == LOOK else _MAX_EVALUATIONS
    descent = descend(patch, start, settings, evaluations, hope, work)
    if not descent.arrived or not _take_last_step(patch, descent, settings, work):
        return False
    out[ITERATIONS] = descent.evaluations
    _conclude(patch, radius, settings, detail, work, out)
    out[X] += floor_xy[v0, u0, 0]
    out[Y] += floor_xy[v0, u0, 1]
    return True


@uncounted
def _take_last_step(patch: Gathered, descent: Descent, settings: FitSettings, work: Work) -> bool:
    """The last step is taken as the linear model has it, and so are its residuals."""
    factor = work.factor
    if not factor_rows(work.kept, 0, normal.LOG_BLUR, factor):
        return False
    solution(factor, 0, normal.BACKGROUND, work.bare)
    log_most = math.log(patch.most_blur)
    if not gauss_newton_step(
        work.kept, 0.0, work.best, descent.contrast, descent.variance, settings, log_most,
        work.damped, factor, work.values,
    ):  # fmt: skip
        return False
    solution(factor, 0, normal.UNKNOWNS, work.values)
    move(work.best, work.values, descent.contrast, math.log(LEAST_BLUR), log_most, work.p)
    return True


@uncounted
def _conclude(
    patch: Gathered,
    radius: float,
    settings: FitSettings,
    detail: int,
    work: Work,
    out: NDArray[np.float64],
) -> None:
    """What the parameters, residuals and factor in the working space tell; x and y relative."""
    p, values, factor = work.p, work.values, work.factor
    terms = work.patch.terms
    errors = work.shares
    contrast = values[normal.CONTRAST]
    residual, near, near_total = residuals(terms, work.fields, patch.n, values, work.bare, errors)
    variance = residual / (patch.fitted - normal.UNKNOWNS)
    out[X] = p[0] * radius
    out[Y] = p[1] * radius
    out[RADIUS] = p[2] * radius
    out[BLUR] = math.exp(p[3])
    out[CONTRAST] = contrast
    out[EXPLAINED] = 1.0 - min(near / max(near_total, 1e-12), 1.0)
    out[RESIDUAL_VARIANCE] = variance
    out[RELATIVE_BLUR] = blur_width(patch, p, settings.blur_ratio, work) / p[2]
    if detail == LOOK:
        out[SECTORS_GOOD] = 1.0
        out[MIDDLE_STEP] = 1.0
        return
    variance = max(variance, settings.noise**2) * correlated_area(terms, errors, patch.n)
    # x and y come last: their covariance is the inverse of the last two rows' own products.
    per_xx = factor[normal.X, normal.X]
    per_yy = factor[normal.Y, normal.Y]
    xy = factor[normal.Y, normal.X]
    scale = variance * (radius / contrast) ** 2
    out[COV_XX] = scale * per_xx * per_xx * (1.0 + (xy * per_yy) ** 2)
    out[COV_XY] = -scale * per_xx * per_yy * per_yy * xy
    out[COV_YY] = scale * per_yy * per_yy
    step, good, deviation, middle = outline_statistics(
        terms, work.fields, errors, patch.n, p[0], p[1], p[2], contrast, work.patch.pixels,
        work.sums,
    )  # fmt: skip
    out[SECTORS_STEP] = step
    out[SECTORS_GOOD] = good
    out[OUTLINE_DEVIATION] = deviation
    out[MIDDLE_STEP] = middle


@njit(cache=True, error_model="numpy")
def fit_discs(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    radius: float,
    settings: FitSettings,
    blur_guess: NDArray[np.float64],
    detail: int,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fit a disc at each candidate.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    columns, rows : (N,) int64
        The candidates' pixels.
    radius : float
        Nominal radius, metres.
    settings : FitSettings
    blur_guess : (N,) float64
        About how blurred each candidate is (along u), pixels.
    detail : int
        See `fit_disc`.

    Returns
    -------
    results : (N, RESULT_SIZE) float64
        Columns as named at the top of this module.
    fitted : (N,) bool
        Where the fit came to a result.
    """
    n = len(columns)
    results = np.zeros((n, RESULT_SIZE))
    fitted = np.zeros(n, np.bool_)
    work = new_work()
    start = np.zeros(4)
    for i in range(n):
        start[2] = 1.0
        start[3] = math.log(blur_guess[i])
        fitted[i] = fit_disc(
            image, floor_xy, columns[i], rows[i], radius, settings, start, blur_guess[i], detail,
            PATIENT, work, results[i],
        )  # fmt: skip
    return results, fitted
