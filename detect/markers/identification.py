"""Phase 3, second part: identifies the marker.

The homography of the refined corners gives the centres of the cells. The grey values there,
rescaled to 0 to 1, are compared with all patterns in all four rotations. The nearest one is chosen
if it is near enough (RAWSEEDS deliverable D2.1 part 2) and the second nearest is clearly farther
away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography import project, square_homography
from detect.markers.lens import Picture, bent, middle_pixel
from detect.markers.pattern_fit import PatternFit
from detect.markers.settings import MarkerSettings
from detect.markers.templates import Templates

FloatArray = NDArray[np.float64]

#: Causes of rejection, as they are counted.
OUTSIDE = "partly outside the image"
NO_PATTERN = "like no pattern"
AMBIGUOUS = "like two patterns"
NOT_FITTED = "fit of the marker failed"
UNEXPLAINED = "grey values unexplained"
WRONG_CELLS = "wrong cells"
TOO_SMALL = "cells too small for the blur"
NO_MARKER = "like a pattern that is no marker"
NO_WHITE = "edges without contrast"

#: Samples of a cell are this far apart, in cells.
_SPREAD_CELLS = 0.25
#: Patterns whose correlation is this near the best one's are tried, too, at most `_MOST_TRIED`.
_CLOSE_CORRELATION = 0.06
_MOST_TRIED = 3
#: Where cells are blurred by less than this (in cells), only a quarter as near.
_CLEAR_BLUR_CELLS = 0.3
_LEAST_CORRELATION = 0.6
#: Natural logarithm of how much less likely the second best pattern must be.
_LEAST_LOG_ODDS = 15.0
#: Least standard deviation of the whiteness of cells.
_LEAST_CELL_SIGMA = 0.08
#: Cells that are blurred by more than this (in cells) are not used for a decision. The first number
#: of each pair is for dictionaries whose patterns hardly ever occur by chance, the second for the
#: others (see `Templates.weakness`).
_LARGEST_BLUR_CELLS = (0.62, 0.6)
#: From the first blur (in cells) to the second what is demanded of a fit grows: many patterns can
#: be bent to blurred cells, but none fits them to the noise unless it is the right one.
_STRICT_FROM, _STRICT_AT = 0.35, 0.6
#: What a fit may leave over beyond the noise (in contrasts), and least mean agreement of the cells,
#: for clear cells; and for blurred ones.
_CLEAR_MISFIT, _CLEAR_AGREEMENT = 0.12, 0.85
_BLURRED_MISFIT = (0.06, 0.03)
_BLURRED_AGREEMENT = (0.92, 0.95)
#: Patterns that other objects show as well must have at most this misfit.
_PLAIN_LARGEST_MISFIT = 0.04
_PLAIN_LEAST_AGREEMENT = 0.95
_PLAIN_LARGEST_CELL_ERROR = 0.25


@dataclass(frozen=True)
class Identity:
    """A marker recognised.

    Attributes
    ----------
    template : int
        Index of the template.
    distance : float
        Mean absolute difference between cells and pattern, 0 to 1.
    margin : float
        Squared distance to the second best pattern less that to the best, in cells.
    """

    template: int
    distance: float
    margin: float


def sampled_cells(picture: Picture, corners: FloatArray, templates: Templates) -> FloatArray | None:
    """(G, G) grey values of the grid's cells; None if some are outside the image."""
    dictionary = templates.dictionary
    cells = np.empty((len(dictionary.centres),) * 2)
    spread = _SPREAD_CELLS * dictionary.cell
    return cells if _sample_cells(picture, corners, dictionary.centres, spread, cells) else None


@njit(cache=True, error_model="numpy")
def _sample_cells(
    picture: Picture, corners: FloatArray, centres: FloatArray, spread: float, cells: FloatArray
) -> bool:
    """Mean of 3x3 grey values, `spread` apart, round the middle of each cell; False outside."""
    image = picture.grey
    height, width = image.shape
    guess = middle_pixel(picture.lens, corners)
    homography = square_homography(corners)
    n = len(centres)
    for j in range(n):
        for i in range(n):
            total = 0.0
            for b in range(-1, 2):
                for a in range(-1, 2):
                    x, y, _ = project(homography, centres[i] + a * spread, centres[j] + b * spread)
                    u, v = bent(picture.lens, x, y, guess)
                    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                        return False
                    iu = min(math.floor(u), width - 2)
                    iv = min(math.floor(v), height - 2)
                    fu, fv = u - iu, v - iv
                    total += (1.0 - fv) * (
                        (1.0 - fu) * image[iv, iu] + fu * image[iv, iu + 1]
                    ) + fv * ((1.0 - fu) * image[iv + 1, iu] + fu * image[iv + 1, iu + 1])
            cells[j, i] = total / 9.0
    return True


def nearest_pattern(
    cells: FloatArray, templates: Templates, settings: MarkerSettings
) -> Identity | str:
    """The nearest pattern as the report has it, or the cause of there being none.

    Parameters
    ----------
    cells : (G, G) float64
        Grey values.
    templates : Templates
        The patterns.
    settings : MarkerSettings
        ``largest_distance``, ``least_margin``.

    Returns
    -------
    Identity or str
    """
    low, high = float(cells.min()), float(cells.max())
    if high <= low:
        return NO_PATTERN
    whiteness = ((cells - low) / (high - low)).ravel()
    best, distance, margin = _nearest(whiteness, templates)
    if distance > settings.largest_distance:
        return NO_PATTERN
    if margin < settings.least_margin:
        return AMBIGUOUS
    return Identity(best, distance, margin)


def likely_patterns(
    cells: FloatArray, templates: Templates, blur_cells: float
) -> NDArray[np.int64]:
    """Templates that cells may show, the best first; none if none is anything like them.

    Parameters
    ----------
    cells : (G, G) float64
        Grey values.
    templates : Templates
        The patterns.
    blur_cells : float
        Standard deviation of the blur, cells: neighbours shine into each other.
    """
    flat = cells.ravel() - cells.mean()
    length = float(np.linalg.norm(flat))
    if length <= 0.0:
        return np.empty(0, np.int64)
    correlation = templates.nearest_blur(blur_cells) @ (flat / length).astype(np.float32)
    count = min(_MOST_TRIED, len(correlation))
    best = np.argpartition(-correlation, count - 1)[:count]
    # Equal ones in the order of their numbers: the same on every machine.
    best = best[np.lexsort((best, -correlation[best]))]
    close = _CLOSE_CORRELATION if blur_cells > _CLEAR_BLUR_CELLS else 0.25 * _CLOSE_CORRELATION
    least = max(_LEAST_CORRELATION, float(correlation[best[0]]) - close)
    return np.asarray(best[correlation[best] >= least], dtype=np.int64)


def verified_identity(
    fit: PatternFit, template: int, templates: Templates, settings: MarkerSettings
) -> Identity | str:
    """The identity of a fitted marker by its cells, or the cause of its rejection.

    Parameters
    ----------
    fit : PatternFit
        The fit of the template.
    template : int
        Which was fitted.
    templates : Templates
        All patterns.
    settings : MarkerSettings
        ``least_explained``, ``largest_cell_error``, ``least_margin``, ``largest_distance``.

    Returns
    -------
    Identity or str
    """
    weakness = templates.weakness
    if fit.blur_cells > _between(_LARGEST_BLUR_CELLS, weakness):
        return TOO_SMALL
    strict = (fit.blur_cells - _STRICT_FROM) / (_STRICT_AT - _STRICT_FROM)
    misfit = _between((_CLEAR_MISFIT, _between(_BLURRED_MISFIT, weakness)), strict)
    agreement = _between((_CLEAR_AGREEMENT, _between(_BLURRED_AGREEMENT, weakness)), strict)
    allowed = settings.largest_cell_error
    if templates.plain[template]:
        misfit = min(misfit, _PLAIN_LARGEST_MISFIT)
        agreement = max(agreement, _PLAIN_LEAST_AGREEMENT)
        allowed = min(allowed, _PLAIN_LARGEST_CELL_ERROR)
    if fit.explained < settings.least_explained or fit.misfit > misfit:
        return UNEXPLAINED
    error = np.abs(fit.cells - templates.cells[template])
    if error.max() > allowed or (fit.border.size and np.abs(fit.border).max() > allowed):
        return WRONG_CELLS
    best, distance, margin = _nearest(fit.cells, templates)
    if best != template or margin < settings.least_margin:
        return AMBIGUOUS
    if distance > min(settings.largest_distance, 1.0 - agreement):
        return WRONG_CELLS
    others, decoys = _log_odds(fit, template, templates)
    if others < _LEAST_LOG_ODDS:
        return AMBIGUOUS
    if decoys < _LEAST_LOG_ODDS:
        return NO_MARKER
    return Identity(best, distance, margin)


def _between(pair: tuple[float, float], share: float) -> float:
    """From the first number to the second as the share goes from 0 to 1."""
    share = min(max(share, 0.0), 1.0)
    return (1.0 - share) * pair[0] + share * pair[1]


def _nearest(whiteness: FloatArray, templates: Templates) -> tuple[int, float, float]:
    """Nearest template, mean absolute difference to it, margin of squared distance to the next."""
    clipped = np.clip(whiteness, -0.25, 1.25)
    # |w - t|^2 = |w|^2 + sum of t (1 - 2 w) for t in {0, 1}.
    squared = templates.cells @ (1.0 - 2.0 * clipped).astype(np.float32)
    best = int(np.argmin(squared))
    distance = float(np.abs(clipped - templates.cells[best]).mean())
    if len(squared) == 1:
        return best, distance, float("inf")
    others = np.delete(squared, best)
    return best, distance, float(others.min() - squared[best])


def _log_odds(fit: PatternFit, template: int, templates: Templates) -> tuple[float, float]:
    """Log-odds of a template against the likeliest other one and the likeliest decoy.

    Given the cells' precision, as if each cell were seen apart from its neighbours; where blur
    mixes them they are known less well than that.
    """
    mixing = 1.0 + 4.0 * float(np.exp(-0.25 / fit.blur_cells**2))
    sigma = np.hypot(mixing * fit.cell_sigma, _LEAST_CELL_SIGMA)
    gain = ((1.0 - 2.0 * fit.cells) / (2.0 * sigma**2)).astype(np.float32)
    cost = templates.cells @ gain
    own = float(cost[template])
    others = np.delete(cost, template)
    decoys = templates.decoys @ gain
    infinite = float("inf")
    return (
        float(others.min()) - own if len(others) else infinite,
        float(decoys.min()) - own if len(decoys) else infinite,
    )
