"""The descent of the disc fit to the least squares: Levenberg-Marquardt, by variable projection.

Model of a grey value, with W the share of the disc that the pixel sees (`detect.discs.model`):

    grey = background + contrast * W(x, y, radius, log blur)

The background is a plane plus the two saddle terms, which let light fall off across the disc
without imitating one. Contrast and background are linear, and every step solves for them anew
(Golub and Pereyra 1973). Radius and log blur are normally distributed beforehand.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from detect.discs.least_squares import (
    BACKGROUND,
    UNKNOWNS,
    background_products,
    blur_width,
    disc_products,
    factor_rows,
    left_over,
    solution,
)
from detect.discs.model import (
    BY_BLUR,
    BY_RADIUS,
    BY_X,
    BY_Y,
    GREY,
    PIXEL_VARIANCE,
    ROWS,
    SHARE,
    Blur,
    Disc,
    chord_shares,
    edge_shares,
)
from detect.discs.patch import CAPACITY, CHORDS_ALONG_V, EDGE, PATCH, FitSettings, Gathered
from redetect.compiled import kernel

#: Limits of what a fit may come to; the blur in pixels, the radius in nominal ones.
LEAST_BLUR, MOST_BLUR = 0.1, 8.0
_LEAST_RADIUS, _MOST_RADIUS = 0.4, 2.0
#: Longest step of the position, in nominal radii.
_LONGEST_STEP = 0.3
#: A step that promises less than this, in variances of the noise, is the last,
_CONVERGED = 1.0
#: and one that is shorter than this share of the blur's width, and changes that by less than this
#: share: what is left is less than the square of it.
_SHORT = 0.05
#: After this number of evaluations, the step after one that made it worse is damped at least this
#: much: mostly it was the blur of a sharp edge, which the grey values hardly determine.
_EARLY, _LATE_DAMPING = 3, 0.2
#: A descent ends after this number of evaluations.
_MOST_EVALUATIONS = 15

_SQUARE = (np.float64, (ROWS, ROWS))
#: What the fits of one image work in, from one to the next. What is left there does not matter.
WORK = np.dtype(
    [
        ("patch", PATCH),
        # The normal equations now, where the fit was best, and those with the damping; the factor.
        ("products", *_SQUARE),
        ("best", *_SQUARE),
        ("damped", *_SQUARE),
        ("factor", *_SQUARE),
        # The unknowns, and the background without a disc.
        ("values", np.float64, UNKNOWNS),
        ("bare", np.float64, UNKNOWNS),
        ("by_sector", np.float32, (9, CAPACITY)),  # the rows of `detect.discs.placing`
    ]
)


class Descent(NamedTuple):
    """Where a descent came to."""

    arrived: bool
    best: Disc
    contrast: float
    variance: float  # of the residuals, grey levels squared


@kernel(forceinline=True)
def blur_of(shape: int, blur: float, ratio: float) -> Blur:
    """A blur (along u, pixels) along the axes of a patch of that shape."""
    return Blur(blur * ratio, blur) if shape == CHORDS_ALONG_V else Blur(blur, blur * ratio)


@kernel(forceinline=True)
def _sigma(disc: Disc) -> float:
    """Standard deviation of optics and pixel together, pixels."""
    return math.sqrt(math.exp(2.0 * disc.log_blur) + PIXEL_VARIANCE)


@kernel(forceinline=True)
def _add_ridge(begin: int, end: int, n: int, work: Any) -> None:
    """Where two unknowns do the same, or one does nothing, there is still one solution."""
    for j in range(begin, end):
        work.products[j, j] += 1e-9 * n


@kernel(forceinline=True)
def solve_step(
    best: Disc, contrast: float, variance: float, damping: float, settings: FitSettings,
    log_most: float, work: Any,
) -> bool:  # fmt: skip
    """Solve for the steps of the four nonlinear parameters, times contrast, into `work.values`.

    The factor has its first six rows from the products; the priors of radius and blur, and
    the damping, come in only then.
    """
    damped, factor, values = work.damped, work.factor, work.values
    for i in range(BY_BLUR, ROWS):
        for j in range(ROWS):
            damped[i, j] = work.best[i, j]
    for parameter, off, sigma in (
        (BY_BLUR, best.log_blur - math.log(settings.blur_px), settings.blur_sigma),
        (BY_RADIUS, best.radius - 1.0, settings.radius_sigma),
    ):
        prior = variance / (sigma * sigma)
        damped[parameter, parameter] += prior / (contrast * contrast)
        damped[GREY, parameter] -= prior * off / contrast
    for i in range(BY_BLUR, UNKNOWNS):
        damped[i, i] *= 1.0 + damping
    if not factor_rows(damped, BY_BLUR, UNKNOWNS, factor):
        return False
    solution(factor, BY_BLUR, UNKNOWNS, values)
    if best.log_blur >= log_most and values[BY_BLUR] / contrast > 0.0:
        # The blur stays at its bound.
        damped[BY_BLUR, BY_BLUR] *= 1e9
        damped[GREY, BY_BLUR] = 0.0
        if not factor_rows(damped, BY_BLUR, UNKNOWNS, factor):
            return False
        solution(factor, BY_BLUR, UNKNOWNS, values)
    return True


@kernel(forceinline=True)
def moved(best: Disc, contrast: float, log_most: float, work: Any) -> Disc:
    """A step on from the best parameters, within limits."""
    values = work.values
    length = math.hypot(values[BY_X], values[BY_Y]) / abs(contrast)
    share = min(1.0, _LONGEST_STEP / max(length, 1e-12)) / contrast
    radius = best.radius + share * values[BY_RADIUS]
    log_blur = best.log_blur + share * values[BY_BLUR]
    return Disc(
        best.x + share * values[BY_X],
        best.y + share * values[BY_Y],
        min(max(radius, _LEAST_RADIUS), _MOST_RADIUS),
        min(max(log_blur, math.log(LEAST_BLUR)), log_most),
    )


@kernel(forceinline=True)
def descend(
    gathered: Gathered, start: Disc, settings: FitSettings, most_blur: float, work: Any
) -> Descent:  # fmt: skip
    """Levenberg-Marquardt steps from `start` (see `detect.discs.fit.fit_disc`).

    In the working space are then the normal equations for the best parameters (`best`), and in the
    patch the rows of the design matrix.
    """
    patch, products, factor = work.patch, work.products, work.factor
    n = gathered.n
    freedom = gathered.fitted - UNKNOWNS
    noise_2 = settings.noise * settings.noise
    log_most = math.log(most_blur)
    disc = best = Disc(start.x, start.y, start.radius, min(start.log_blur, log_most))
    damping = 1e-3
    cost = math.inf
    contrast = 0.0
    variance = noise_2
    evaluations = 0
    width_per_px = 0.0
    done = False
    background_products(patch, n, products)
    _add_ridge(0, BACKGROUND, gathered.fitted, work)
    while True:
        blur = blur_of(gathered.shape, math.exp(disc.log_blur), settings.blur_ratio)
        if gathered.shape == EDGE:
            edge_shares(patch, n, disc, blur)
        else:
            chord_shares(patch, n, disc, blur)
        if done:
            # These were the best parameters' shares once more.
            return Descent(True, best, contrast, variance)
        evaluations += 1
        disc_products(patch, n, products)
        _add_ridge(BACKGROUND, UNKNOWNS, gathered.fitted, work)
        if not factor_rows(products, 0, BY_BLUR, factor):
            break
        residual = left_over(products, factor, BY_BLUR)
        variance_now = max(residual / freedom, noise_2)
        prior_blur = (disc.log_blur - math.log(settings.blur_px)) / settings.blur_sigma
        prior_radius = (disc.radius - 1.0) / settings.radius_sigma
        now = residual + variance_now * (prior_blur * prior_blur + prior_radius * prior_radius)
        better = now <= cost
        if better:
            done = cost - now <= 1e-3 * variance_now
            cost, variance, best = now, variance_now, disc
            contrast = factor[GREY, SHARE] * factor[SHARE, SHARE]
            for i in range(ROWS):
                for j in range(ROWS):
                    work.best[i, j] = products[i, j]
            damping = max(0.2 * damping, 1e-7)
            if not abs(contrast) > 1e-6:
                break
        else:
            damping *= 10.0
            if evaluations > _EARLY:
                damping = max(damping, _LATE_DAMPING)
            done = damping > 1e6
            if not factor_rows(work.best, 0, BY_BLUR, factor):
                break
        if not done:
            if not solve_step(best, contrast, variance, damping, settings, log_most, work):
                break
            promised = 0.0
            for k in range(BY_BLUR, UNKNOWNS):
                promised += factor[GREY, k] ** 2
            disc = moved(best, contrast, log_most, work)
            if evaluations == 1:
                # How wide a blur is on the floor: the first pixels give it for all blurs.
                width_per_px = blur_width(patch, n, best, blur) / _sigma(best)
            sigma = _sigma(disc)
            width = width_per_px * sigma
            longest = max(
                math.hypot(disc.x - best.x, disc.y - best.y), abs(disc.radius - best.radius)
            )
            short = longest < _SHORT * width and abs(sigma - _sigma(best)) < _SHORT * sigma
            done = promised <= _CONVERGED * variance or short or evaluations == _MOST_EVALUATIONS
        if done:
            if better:
                return Descent(True, best, contrast, variance)
            disc = best
    return Descent(False, best, contrast, variance)
