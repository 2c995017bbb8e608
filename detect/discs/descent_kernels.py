"""Compiled descent of the disc fit to the least squares, or until there is no hope of a disc."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs import normal_kernels as normal
from detect.discs.blur_kernels import blur_across
from detect.discs.chord_kernels import chord_shares
from detect.discs.evidence_kernels import LEAST_EXPLAINED, evidence_of
from detect.discs.gather_kernels import LEAST_BLUR, Gathered
from detect.discs.model_kernels import (
    CAPACITY,
    FIELDS,
    PIXEL_VARIANCE,
    edge_shares,
)
from detect.discs.normal_kernels import background_products, disc_products, factor_rows, left_over
from detect.discs.outline_kernels import SECTOR_SUMS, blur_widths
from detect.discs.patch_kernels import (
    COLUMNS,
    LIST,
    ONE,
    PATCH_INDICES,
    PATCH_MEMORY,
    FitSettings,
    Patch,
    padded,
    patch_in,
)
from detect.discs.step_kernels import gauss_newton_step, move
from detect.uncounted import uncounted

#: A step that promises less than this, in variances of the noise, is the last,
_CONVERGED = 0.3
#: and one that is shorter than this share of the blur's width, and changes that by less than this
#: share: what is left is less than the square of it.
_SHORT = 0.05
#: After so many evaluations, the step after one that made it worse is damped at least so much:
#: mostly it was the blur of a sharp edge, of which the grey values tell little.
_EARLY, _LATE_DAMPING = 3, 0.2
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


#: Never give up.
PATIENT = Hope(-math.inf, -math.inf, 1.0)


class Work(NamedTuple):
    """Working space of the fits of one image."""

    patch: Patch
    fields: NDArray[np.float32]
    shares: NDArray[np.float32]
    widths: NDArray[np.float32]
    weights: NDArray[np.float32]
    sums: NDArray[np.float32]
    products: NDArray[np.float64]
    kept: NDArray[np.float64]
    damped: NDArray[np.float64]
    factor: NDArray[np.float64]
    values: NDArray[np.float64]
    bare: NDArray[np.float64]
    p: NDArray[np.float64]
    best: NDArray[np.float64]


_MOST_WEIGHTS = 64
#: Sizes of the arrays that `work_in` takes.
WORK_MEMORY = PATCH_MEMORY + (2 * FIELDS + 1) * CAPACITY + _MOST_WEIGHTS + SECTOR_SUMS
WORK_INDICES = PATCH_INDICES


@njit(cache=True, error_model="numpy", forceinline=True)
def work_in(
    memory: NDArray[np.float32], indices: NDArray[np.uint32], marks: NDArray[np.uint8]
) -> Work:
    """Working space in arrays that may be used again, for the next image.

    Whatever is in them does not matter: all is written before it is read. They are of the sizes
    above, and those of `detect.discs.patch_kernels.patch_in`.
    """
    n = normal.ROWS
    shares = PATCH_MEMORY + FIELDS * CAPACITY
    widths = shares + FIELDS * CAPACITY
    weights = widths + CAPACITY
    sums = weights + _MOST_WEIGHTS
    return Work(
        patch_in(memory, indices, marks),
        memory[PATCH_MEMORY:shares],
        memory[shares:widths],
        memory[widths:weights],
        memory[weights:sums],
        memory[sums : sums + SECTOR_SUMS],
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
def new_work() -> Work:
    """Working space of its own."""
    return work_in(
        np.zeros(WORK_MEMORY, np.float32),
        np.zeros(WORK_INDICES, np.uint32),
        np.zeros(CAPACITY, np.uint8),
    )


class Descent(NamedTuple):
    """Where a descent came to; its parameters are the working space's `best`."""

    arrived: bool
    contrast: float
    variance: float
    """Of the residuals, grey levels squared."""
    evaluations: int


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


@uncounted
def _evaluate(patch: Gathered, p: NDArray[np.float64], ratio: float, work: Work) -> tuple[int, int]:
    """The disc's fields at the parameters p (x, y, radius, log blur).

    Returns where those that are not 0 begin and end.
    """
    blur = math.exp(p[3])
    geometry = work.patch.geometry
    terms = work.patch.terms
    if patch.shape == LIST:
        edge_shares(geometry, patch.n, p[0], p[1], p[2], blur, blur * ratio, work.fields)
        return 0, patch.n
    along, across = (blur, blur * ratio) if patch.shape == COLUMNS else (blur * ratio, blur)
    grid = patch.margin > 0
    # Scattered pixels: an even weight of the same variance stands for blur and pixel across.
    width = 1.0 if grid else math.sqrt(12.0) * sigma_of(across)
    shares = work.shares if grid else work.fields
    first, last = chord_shares(
        geometry, padded(patch.n), p[0], p[1], p[2], along, width, not grid, shares,
        work.patch.marks, work.patch.mark_words,
    )  # fmt: skip
    if not grid:
        return 0, patch.n
    begin, end = blur_across(
        work.shares, patch.n, patch.margin, first, last, across, work.weights, work.fields
    )
    _mask(end - begin, terms[begin:], work.fields[begin:])
    return begin, end


@uncounted
def blur_width(patch: Gathered, p: NDArray[np.float64], ratio: float, work: Work) -> float:
    """Mean width of the blur across the edge, in nominal radii, at the parameters p."""
    blur = math.exp(p[3])
    sigma_u = sigma_of(blur)
    sigma_v = sigma_of(blur * ratio)
    if patch.shape == COLUMNS:
        sigma_u, sigma_v = sigma_v, sigma_u
    return blur_widths(
        work.patch.geometry, work.patch.terms, work.fields, patch.shape == LIST, patch.n,
        p[0], p[1], sigma_u, sigma_v, work.widths,
    )  # fmt: skip


@njit(cache=True, error_model="numpy", forceinline=True)
def _add_ridge(begin: int, end: int, n: int, products: NDArray[np.float64]) -> None:
    """Where two unknowns do the same, or one does nothing, there is still one solution."""
    for j in range(begin, end):
        products[j, j] += 1e-9 * n


@uncounted
def descend(
    patch: Gathered,
    start: NDArray[np.float64],
    settings: FitSettings,
    most_evaluations: int,
    hope: Hope,
    work: Work,
) -> Descent:
    """Levenberg-Marquardt steps from `start` (see `detect.discs.fit_kernels.fit_disc`).

    In the working space are then the best parameters (`best`), the sums of products there (`kept`)
    and the fields of the disc there (`fields`).
    """
    p, best = work.p, work.best
    products, kept, factor, values = work.products, work.kept, work.factor, work.values
    terms = work.patch.terms
    n = patch.n
    freedom = patch.fitted - normal.UNKNOWNS
    noise_2 = settings.noise * settings.noise
    log_least = math.log(LEAST_BLUR)
    log_most = math.log(patch.most_blur)
    log_blur = math.log(settings.blur_px)
    for k in range(4):
        p[k] = start[k]
        best[k] = start[k]
    p[3] = min(p[3], log_most)
    damping = 1e-3
    cost = math.inf
    contrast = 0.0
    variance = noise_2
    evaluations = 0
    width_per_px = 0.0
    done = False
    background_products(terms, n, products)
    _add_ridge(0, normal.BACKGROUND, patch.fitted, products)
    while True:
        begin, end = _evaluate(patch, p, settings.blur_ratio, work)
        if done:
            # These were the best parameters' fields once more.
            break
        evaluations += 1
        disc_products(terms[begin:], work.fields[begin:], end - begin, products)
        _add_ridge(normal.BACKGROUND, normal.UNKNOWNS, patch.fitted, products)
        if not factor_rows(products, 0, normal.LOG_BLUR, factor):
            return Descent(False, contrast, variance, evaluations)
        without = left_over(products, factor, normal.BACKGROUND)
        residual = left_over(products, factor, normal.LOG_BLUR)
        variance_now = max(residual / freedom, noise_2)
        prior_blur = (p[3] - log_blur) / settings.blur_sigma
        prior_radius = (p[2] - 1.0) / settings.radius_sigma
        now = residual + variance_now * (prior_blur * prior_blur + prior_radius * prior_radius)
        current = now <= cost
        if current:
            gain = cost - now
            cost = now
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
                return Descent(False, contrast, variance, evaluations)
            done = gain <= 1e-3 * variance
        else:
            damping *= 10.0
            if evaluations > _EARLY:
                damping = max(damping, _LATE_DAMPING)
            done = damping > 1e6
            if not factor_rows(kept, 0, normal.LOG_BLUR, factor):
                return Descent(False, contrast, variance, evaluations)
        if not done:
            if not gauss_newton_step(
                kept, damping, best, contrast, variance, settings, log_most, work.damped, factor,
                values,
            ):  # fmt: skip
                return Descent(False, contrast, variance, evaluations)
            promised = 0.0
            for k in range(normal.LOG_BLUR, normal.UNKNOWNS):
                promised += factor[normal.GREYS, k] ** 2
            share = 1.0 - max(cost - promised, 0.0) / max(without, 1e-9)
            if share < hope.least_share:
                return Descent(False, contrast, variance, evaluations)
            if hope.least_evidence > -math.inf and share < LEAST_EXPLAINED:
                return Descent(False, contrast, variance, evaluations)
            move(best, values, contrast, log_least, log_most, p)
            if evaluations == 1:
                # How wide a blur is on the floor: the first pixels tell it for all blurs.
                blur = math.exp(best[3])
                width_per_px = blur_width(patch, best, settings.blur_ratio, work) / sigma_of(blur)
            sigma = sigma_of(math.exp(p[3]))
            width = width_per_px * sigma
            if hope.least_evidence > -math.inf:
                slack = _FIRST_STEP_SLACK if evaluations == 1 else 0.0
                promise = evidence_of(share, p[2], 0.0, 1.0, 1.0, width / p[2], hope.optics_px)
                if promise < hope.least_evidence - slack:
                    return Descent(False, contrast, variance, evaluations)
            longest = max(math.hypot(p[0] - best[0], p[1] - best[1]), abs(p[2] - best[2]))
            wider = abs(sigma - sigma_of(math.exp(best[3])))
            short = longest < _SHORT * width and wider < _SHORT * sigma
            done = promised <= _CONVERGED * variance or short or evaluations == most_evaluations
        if done:
            if current:
                break
            for k in range(4):
                p[k] = best[k]
    return Descent(cost < math.inf, contrast, variance, evaluations)
