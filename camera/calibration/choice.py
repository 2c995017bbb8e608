"""Chooses the free coefficients of a lens by the error in held-out pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from camera.calibration.adjustment import (
    Adjusted,
    Estimate,
    Points,
    adjust,
    fit_points,
    residuals_of,
    rms,
)
from camera.calibration.model import (
    COUNT,
    INTRINSICS,
    TANGENTIAL,
    CalibrationSettings,
    FreeLens,
    has_pole,
)
from redetect.array_types import IntArray
from redetect.least_squares.solver import StartError

_FOLDS = 8
# Fits to folds end at a step that lowers the cost by less than this share: they begin where the fit
# to all views ended, and what the rest would change is far less than a variance.
_FOLD_TOLERANCE = 1e-6
# An additional coefficient must lower the sum of squared cross-validation errors by this, in
# variances.
_WORTH = 4.0
# With fewer coefficients than the lens has, a fold can bar the way to a fit of more: those are also
# fitted from the fullest fit, if their residuals are this many times as large as its.
_STUCK, _CAN_BE_STUCK = 3.0, 2
# The two tangential terms must lower it by `_TANGENTIAL_WORTH` variances and differ from 0 by
# `_TANGENTIAL_SIGNIFICANCE` variances: small systematic errors of a board's points can look like
# decentering.
_TANGENTIAL_WORTH = 20.0
_TANGENTIAL_SIGNIFICANCE = 50.0
# The same for the polynomial, compared with a rational function with as many coefficients.
_POLYNOMIAL_WORTH = 20.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fit with some coefficients free, to points without the circles' shifts."""

    adjusted: Adjusted
    points: Points
    cross_validation_px: float  #: `cross_validation_error`


Candidates = dict[FreeLens, Candidate]
#: From an estimate to begin with, and lenses, to fits of these.
Fitted = Callable[[Estimate, Iterable[FreeLens]], Candidates]


def choose_lens(
    start: Estimate, points: Points, settings: CalibrationSettings, radius_m: float
) -> tuple[FreeLens, Candidates]:
    """Fit with an increasing number of free coefficients, and choose.

    `start` is a fit with all of them. The choice is the fewest radial coefficients whose
    error is not worse than the best. Tangential terms are added if they lower that error by more
    than they would by chance and are significant; then the radial coefficients are chosen again.
    The polynomial replaces the rational function if, with the same tangential terms, it needs fewer
    coefficients for an error that is not worse, or lowers the error by more than it would by
    chance. Whether it needs tangential terms is then tested as well.
    """
    fitted = partial(_fitted, points, settings, radius_m, start)
    counts = range(settings.most + 1) if settings.coefficients is None else [settings.most]
    fixed = settings.tangential is True
    radial = fitted(start, [settings.lens(count, tangential=fixed) for count in counts])
    chosen, tried = _with_tangential(fitted, start, settings, radial)
    if settings.polynomial is not None or settings.coefficients is not None:
        return chosen, tried
    # Not one: a3 alone is k1.
    polynomials = fitted(start, [FreeLens(0, chosen.tangential, count) for count in (2, 3)])
    other = _fewest_needed(polynomials)
    # Unnecessary coefficients make the projection uncertain where there are no points.
    worth = -_WORTH if other.polynomial < chosen.coefficients else _POLYNOMIAL_WORTH
    if _is_lower(polynomials[other], tried[chosen], worth):
        chosen = other
        if not chosen.tangential:
            chosen, polynomials = _with_tangential(fitted, start, settings, polynomials)
    return chosen, tried | polynomials


def _with_tangential(
    fitted: Fitted, start: Estimate, settings: CalibrationSettings, radial: Candidates
) -> tuple[FreeLens, Candidates]:
    """Choose among radial lenses, and add tangential terms if they pay off and are not set."""
    chosen = _fewest_needed(radial)
    if settings.tangential is not None:
        return chosen, radial
    beside = chosen._replace(tangential=True)
    tried = radial | fitted(radial[chosen].adjusted.estimate, [beside])
    # They have to explain the held-out points, and to be more than noise.
    if not (
        _is_lower(tried[beside], tried[chosen], _TANGENTIAL_WORTH)
        and tangential_significance(tried[beside].adjusted) >= _TANGENTIAL_SIGNIFICANCE
    ):
        return chosen, tried
    others = [lens._replace(tangential=True) for lens in radial if lens != chosen]
    more = {beside: tried[beside]} | fitted(start, others)
    return _fewest_needed(more), tried | more


def _fitted(
    points: Points,
    settings: CalibrationSettings,
    radius_m: float,
    full: Estimate,
    estimate: Estimate,
    lenses: Iterable[FreeLens],
) -> Candidates:
    """Each lens fitted from where the last ended, or from the fullest fit if that got stuck."""
    tried: Candidates = {}
    much = _STUCK * rms(residuals_of(full, points, radius_m))
    for lens in lenses:
        adjusted, seen = fit_points(estimate, points, settings, lens, radius_m)
        if lens.coefficients >= _CAN_BE_STUCK and adjusted.rms_px > much:
            again, seen_again = fit_points(full, points, settings, lens, radius_m)
            fixed = again.estimate.intrinsics[np.all(lens.span(settings.aspect) == 0.0, axis=1)]
            if again.rms_px < adjusted.rms_px and not fixed.any():
                adjusted, seen = again, seen_again
        estimate = adjusted.estimate
        # A lens with a pole is good for the next start, but useless where there are no points.
        pole = has_pole(estimate.intrinsics, points.width, points.height)
        error = float("inf") if pole else cross_validation_error(estimate, seen, settings, lens)
        tried[lens] = Candidate(adjusted, seen, error)
    return tried


def _fewest_needed(tried: Candidates) -> FreeLens:
    best = min(tried.values(), key=lambda candidate: candidate.cross_validation_px)
    slack = _WORTH * best.adjusted.sigma_px**2 / len(best.points.board)
    limit = best.cross_validation_px**2 + slack
    return min(lens for lens, each in tried.items() if each.cross_validation_px**2 <= limit)


def _is_lower(candidate: Candidate, other: Candidate, variances: float) -> bool:
    """Whether the sum of squared cross-validation errors is lower by at least `variances`."""
    slack = variances * candidate.adjusted.sigma_px**2 / len(candidate.points.board)
    return candidate.cross_validation_px**2 + slack <= other.cross_validation_px**2


def tangential_significance(adjusted: Adjusted) -> float:
    """Squared distance of (p1, p2) from 0 in standard deviations; 2 on average where they are 0."""
    places = [INTRINSICS.index(name) for name in TANGENTIAL]
    found = adjusted.estimate.intrinsics[places]
    return float(found @ np.linalg.pinv(adjusted.covariance[np.ix_(places, places)]) @ found)


def cross_validation_error(
    estimate: Estimate,
    points: Points,
    settings: CalibrationSettings,
    lens: FreeLens,
    folds: Sequence[IntArray] | None = None,
) -> float:
    """RMS reprojection error in views that the intrinsics were not fitted to, pixels.

    Only poses are fitted to held-out views: each of the `folds`, by default every `_FOLDS`-th.
    """
    every = np.arange(len(points.counts))
    if folds is None:
        number = min(_FOLDS, len(every))
        folds = [every[every % number == fold] for fold in range(number)]
    squares = 0.0
    span, nothing = lens.span(settings.aspect), np.zeros((COUNT, 0))
    fitted = partial(adjust, robust=settings.robust, tolerance=_FOLD_TOLERANCE)
    for out in folds:
        used = np.setdiff1d(every, out)
        fit = fitted(estimate.of_views(used), points.of_views(used), span)
        there = replace(estimate.of_views(out), intrinsics=fit.estimate.intrinsics)
        try:
            test = fitted(there, points.of_views(out), nothing, sigma_px=fit.sigma_px)
        except StartError:  # a held-out point is beyond this fit's fold
            return float("inf")
        squares += float(np.sum(test.residuals**2))
    return float(np.sqrt(squares / len(points.board)))
