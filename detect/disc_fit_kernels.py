"""Compiled fit of a disc, seen through the camera, to the grey values around a candidate.

Model of a grey value:

    grey = background + contrast * W

W is the share of the disc that the pixel sees (see `detect.disc_model_kernels`). The background is
a plane plus the two saddle terms, which let light fall off across the disc without imitating one.
Parameters are x, y, radius (in units of the nominal radius, relative to the candidate) and log
blur; contrast and background are linear, and every Gauss-Newton step solves for them anew.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect import disc_normal_kernels as normal
from detect.disc_evidence_kernels import evidence_of
from detect.disc_grid_kernels import gather_grid
from detect.disc_list_kernels import gather_list, gather_sparse
from detect.disc_model_kernels import (
    CAPACITY,
    FIELDS,
    PIXEL_VARIANCE,
    blur_across,
    chord_shares,
    edge_shares,
)
from detect.disc_normal_kernels import (
    background_products,
    disc_products,
    factor_rows,
    left_over,
    solution,
)
from detect.disc_outline_kernels import (
    blur_widths,
    correlated_area,
    outline_statistics,
    residuals,
)
from detect.disc_patch_kernels import (
    COLUMNS,
    LIST,
    ONE,
    FitSettings,
    Patch,
    new_patch,
    view_of,
)
from detect.disc_step_kernels import gauss_newton_step, move

#: Columns of a result.
X, Y, RADIUS, BLUR, CONTRAST = range(5)
EXPLAINED, RESIDUAL_VARIANCE, PIXELS = range(5, 8)
COV_XX, COV_XY, COV_YY = range(8, 11)
SECTORS_STEP, SECTORS_GOOD, OUTLINE_DEVIATION, RELATIVE_BLUR = range(11, 15)
ITERATIONS, BLUR_BOUND, COMPLETE = range(15, 18)
RESULT_SIZE = 18

#: How many pixels a fit uses.
LOOK, EDGE, ALL = range(3)
#: About how many for a look, and besides those at the edge.
_LOOK_PIXELS = 160
_OTHER_PIXELS = 400

_LEAST_BLUR, _MOST_BLUR = 0.1, 8.0
_MAX_EVALUATIONS = 15
_LOOK_EVALUATIONS = 3
#: A step that promises less than this, in variances of the noise, is the last.
_CONVERGED = 0.3
#: What the first step of a fit promises may be this much less evidence than is needed.
_FIRST_STEP_SLACK = 2.0


class Hope(NamedTuple):
    """When a fit is given up: as soon as a step promises less than this."""

    least_share: float
    """Share of the variance that the disc explains."""
    least_evidence: float
    """Evidence, as far as it is known by then: for an even outline."""
    optics_px: float
    """Blur of the camera's optics, for the evidence."""


class Work(NamedTuple):
    """Working space of the fits of one image."""

    patch: Patch
    fields: NDArray[np.float32]
    shares: NDArray[np.float32]
    widths: NDArray[np.float32]
    weights: NDArray[np.float32]
    products: NDArray[np.float64]
    kept: NDArray[np.float64]
    damped: NDArray[np.float64]
    factor: NDArray[np.float64]
    values: NDArray[np.float64]
    bare: NDArray[np.float64]
    p: NDArray[np.float64]
    best: NDArray[np.float64]


#: Never give up.
PATIENT = Hope(-math.inf, -math.inf, 1.0)


@njit(cache=True, error_model="numpy", forceinline=True)
def new_work() -> Work:
    """Working space."""
    n = normal.ROWS
    return Work(
        new_patch(),
        np.zeros(FIELDS * CAPACITY, np.float32),
        np.zeros(FIELDS * CAPACITY, np.float32),
        np.zeros(CAPACITY, np.float32),
        np.zeros(64, np.float32),
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros((n, n)),
        np.zeros(n),
        np.zeros(n),
        np.zeros(4),
        np.zeros(4),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def sigma_of(blur: float) -> float:
    """Standard deviation of optics and pixel together, pixels."""
    return math.sqrt(blur * blur + PIXEL_VARIANCE)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
def _mask(n: int, terms: NDArray[np.float32], fields: NDArray[np.float32]) -> None:
    for field in range(FIELDS):
        row = field * CAPACITY
        for i in range(n):
            fields[row + i] *= terms[ONE * CAPACITY + i]


@njit(cache=True, error_model="numpy", forceinline=True)
def _evaluate(
    shape: int, n: int, margin: int, p: NDArray[np.float64], ratio: float, work: Work
) -> None:
    """The disc's fields at the parameters p (x, y, radius, log blur)."""
    blur = math.exp(p[3])
    if shape == LIST:
        edge_shares(work.patch.geometry, n, p[0], p[1], p[2], blur, blur * ratio, work.fields)
        return
    along, across = (blur, blur * ratio) if shape == COLUMNS else (blur * ratio, blur)
    if margin == 0:
        # Scattered pixels: an even weight of the same variance stands for blur and pixel across.
        width = math.sqrt(12.0) * sigma_of(across)
        chord_shares(work.patch.geometry, n, p[0], p[1], p[2], along, width, work.fields)
        return
    chord_shares(work.patch.geometry, n, p[0], p[1], p[2], along, 1.0, work.shares)
    blur_across(work.shares, n, margin, across, work.weights, work.fields)
    _mask(n, work.patch.terms, work.fields)


@njit(cache=True, error_model="numpy", forceinline=True)
def _blur_width(shape: int, n: int, p: NDArray[np.float64], ratio: float, work: Work) -> float:
    """Mean width of the blur across the edge, in nominal radii, at the parameters p."""
    blur = math.exp(p[3])
    sigma_u = sigma_of(blur)
    sigma_v = sigma_of(blur * ratio)
    if shape == COLUMNS:
        sigma_u, sigma_v = sigma_v, sigma_u
    return blur_widths(
        work.patch.geometry, work.patch.terms, work.fields, shape == LIST, n, p[0], p[1],
        sigma_u, sigma_v, work.widths,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
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
        How many pixels: `LOOK`, about 160 and few steps; `EDGE`, of large discs all that tell where
        the edge is and some hundred others; `ALL`.
    hope : Hope
        When to give up.
    """
    out[:] = 0.0
    patch = work.patch
    p = work.p
    best = work.best
    products = work.products
    kept = work.kept
    factor = work.factor
    values = work.values
    ratio = settings.blur_ratio
    noise_2 = settings.noise * settings.noise
    shape, along_u, along_v, area = view_of(floor_xy, u0, v0, radius, blur_guess, ratio)
    if area == 0.0:
        return False
    beyond_u = max(settings.reach_px, settings.reach_blurs * blur_guess)
    beyond_v = max(settings.reach_px, settings.reach_blurs * blur_guess * ratio)
    room = 1.08 * settings.reach_radii
    half_u = int(max(room * along_u, 1.08 * along_u + beyond_u)) + 1
    half_v = int(max(room * along_v, 1.08 * along_v + beyond_v)) + 1
    half_u = min(half_u, image.shape[1])
    half_v = min(half_v, image.shape[0])
    window = (2 * half_u + 1) * (2 * half_v + 1)
    # How far the blur may grow before the patch is too small for it.
    most_blur = _MOST_BLUR
    margin = 0
    every = 1
    if detail == LOOK:
        every = max(1, window // _LOOK_PIXELS)
        n = gather_sparse(
            image, floor_xy, u0, v0, radius, settings, half_u, half_v, every, shape, patch
        )
        count = n
    else:
        if shape != LIST:
            across = 1.0 if shape != COLUMNS else ratio
            margin = min(int(3.0 * 1.3 * blur_guess * across) + 3, 30)
            length = 2 * (half_u if shape != COLUMNS else half_v) + 1 + 2 * margin
            lines = 2 * (half_v if shape != COLUMNS else half_u) + 1
            if length * (lines + 2) > CAPACITY:
                shape = LIST
                margin = 0
        if shape == LIST:
            every = 1 + window // _OTHER_PIXELS if detail == EDGE else 1
            # All of them, but for discs that are larger than a patch.
            every = max(every, 1 + window // CAPACITY)
            n = gather_list(
                image, floor_xy, u0, v0, radius, blur_guess, settings, half_u, half_v,
                every, patch,
            )  # fmt: skip
            count = n
        else:
            most_blur = min((margin - 1.0) / (2.5 * across), _MOST_BLUR)
            n, count = gather_grid(
                image, floor_xy, u0, v0, radius, blur_guess, settings, half_u, half_v, margin,
                shape == COLUMNS, patch,
            )  # fmt: skip
    out[PIXELS] = count
    out[COMPLETE] = 1.0 if every == 1 else 0.0
    freedom = count - normal.UNKNOWNS
    if freedom < 4:
        return False
    background_products(patch.terms, n, products)
    for j in range(normal.BACKGROUND):
        products[j, j] += 1e-9 * n

    log_least = math.log(_LEAST_BLUR)
    log_most = math.log(most_blur)
    for k in range(4):
        p[k] = start[k]
        best[k] = start[k]
    p[3] = min(p[3], log_most)
    log_blur = math.log(settings.blur_px)
    damping = 1e-3
    cost = math.inf
    contrast = 0.0
    variance = noise_2
    evaluations = 0
    width_per_px = 0.0
    finished = False
    current = False
    most_evaluations = _LOOK_EVALUATIONS if detail == LOOK else _MAX_EVALUATIONS
    while evaluations < most_evaluations:
        evaluations += 1
        _evaluate(shape, n, margin, p, ratio, work)
        disc_products(patch.terms, work.fields, n, products)
        for j in range(normal.BACKGROUND, normal.UNKNOWNS):
            products[j, j] += 1e-9 * n
        if not factor_rows(products, 0, normal.LOG_BLUR, factor):
            return False
        without = left_over(products, factor, normal.BACKGROUND)
        residual = left_over(products, factor, normal.LOG_BLUR)
        variance_now = max(residual / freedom, noise_2)
        prior_blur = (p[3] - log_blur) / settings.blur_sigma
        prior_radius = (p[2] - 1.0) / settings.radius_sigma
        now = residual + variance_now * (prior_blur * prior_blur + prior_radius * prior_radius)
        if now <= cost:
            gain = cost - now
            cost = now
            current = True
            variance = variance_now
            contrast = (
                factor[normal.GREYS, normal.CONTRAST] * factor[normal.CONTRAST, normal.CONTRAST]
            )
            for k in range(4):
                best[k] = p[k]
            for i in range(normal.ROWS):
                for j in range(i + 1):
                    kept[i, j] = products[i, j]
            damping = max(0.2 * damping, 1e-7)
            if not abs(contrast) > 1e-6:
                return False
            if gain <= 1e-3 * variance:
                finished = True
        else:
            current = False
            damping *= 10.0
            if damping > 1e6:
                finished = True
            if not factor_rows(kept, 0, normal.LOG_BLUR, factor):
                return False
        if finished:
            break
        if not gauss_newton_step(
            kept,
            damping,
            best,
            contrast,
            variance,
            settings,
            log_most,
            work.damped,
            factor,
            values,
        ):
            return False
        promised = 0.0
        for k in range(normal.LOG_BLUR, normal.UNKNOWNS):
            promised += factor[normal.GREYS, k] ** 2
        share = 1.0 - max(cost - promised, 0.0) / max(without, 1e-9)
        if share < hope.least_share:
            return False
        move(best, values, contrast, log_least, log_most, p)
        if hope.least_evidence > -math.inf:
            if evaluations == 1:
                # How wide a blur is on the floor: the first pixels tell it for all blurs.
                blur = math.exp(best[3])
                width_per_px = _blur_width(shape, n, best, ratio, work) / sigma_of(blur)
            width = width_per_px * sigma_of(math.exp(p[3])) / p[2]
            slack = _FIRST_STEP_SLACK if evaluations == 1 else 0.0
            promise = evidence_of(share, p[2], 0.0, 1.0, width, hope.optics_px)
            if promise < hope.least_evidence - slack:
                return False
        if promised <= _CONVERGED * variance:
            break
    if not cost < math.inf:
        return False
    if not current:
        _evaluate(shape, n, margin, best, ratio, work)
    # The last step is taken as the linear model has it, and so are its residuals.
    if not factor_rows(kept, 0, normal.LOG_BLUR, factor):
        return False
    solution(factor, 0, normal.BACKGROUND, work.bare)
    if not gauss_newton_step(
        kept,
        0.0,
        best,
        contrast,
        variance,
        settings,
        log_most,
        work.damped,
        factor,
        values,
    ):
        return False
    solution(factor, 0, normal.UNKNOWNS, values)
    move(best, values, contrast, log_least, log_most, p)
    contrast = values[normal.CONTRAST]
    kept_pixels = work.shares
    residual, near, near_total = residuals(
        patch.terms, work.fields, n, values, work.bare, kept_pixels
    )
    variance = residual / freedom
    blur = math.exp(p[3])
    width = _blur_width(shape, n, p, ratio, work)
    out[X] = floor_xy[v0, u0, 0] + p[0] * radius
    out[Y] = floor_xy[v0, u0, 1] + p[1] * radius
    out[RADIUS] = p[2] * radius
    out[BLUR] = blur
    out[CONTRAST] = contrast
    out[EXPLAINED] = 1.0 - min(near / max(near_total, 1e-12), 1.0)
    out[RESIDUAL_VARIANCE] = variance
    out[RELATIVE_BLUR] = width / p[2]
    out[ITERATIONS] = evaluations
    out[BLUR_BOUND] = most_blur
    if detail == LOOK:
        out[SECTORS_GOOD] = 1.0
        return True
    variance = max(variance, noise_2) * correlated_area(patch.terms, kept_pixels, n)
    # x and y come last: their covariance is the inverse of the last two rows' own products.
    per_xx = factor[normal.X, normal.X]
    per_yy = factor[normal.Y, normal.Y]
    xy = factor[normal.Y, normal.X]
    scale = variance * (radius / contrast) ** 2
    out[COV_XX] = scale * per_xx * per_xx * (1.0 + (xy * per_yy) ** 2)
    out[COV_XY] = -scale * per_xx * per_yy * per_yy * xy
    out[COV_YY] = scale * per_yy * per_yy
    out[SECTORS_STEP], out[SECTORS_GOOD], out[OUTLINE_DEVIATION] = outline_statistics(
        patch.terms, work.fields, kept_pixels, n, p[0], p[1], p[2], contrast
    )
    return True


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
            PATIENT,             work, results[i],
        )  # fmt: skip
    return results, fitted
