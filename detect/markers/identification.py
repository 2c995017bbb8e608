"""Phase 3, second part: identifies the marker.

The homography of the refined corners gives the centres of the cells. The grey values there,
rescaled to 0 to 1, are compared with all patterns in all four rotations. The nearest one is chosen
if it is near enough (RAWSEEDS deliverable D2.1 part 2) and the second nearest is clearly farther
away.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from detect.markers.dictionaries import Templates
from detect.markers.lens import Picture
from detect.markers.pattern_fit import PatternFit
from detect.markers.quadrangle import square_homography
from detect.markers.settings import MarkerSettings

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


class Identity(NamedTuple):
    """A marker recognised."""

    template: int
    distance: float  # mean absolute difference between cells and pattern, 0 to 1
    margin: float  # squared distance to the second best pattern less that to the best, in cells


def sampled_cells(picture: Picture, corners: FloatArray, templates: Templates) -> FloatArray | None:
    """(G, G) grey values of the grid's cells, each the mean of 3x3; None if some are outside."""
    centres, cell = templates.dictionary.centres, templates.dictionary.cell
    along = (centres[:, None] + _SPREAD_CELLS * cell * np.array([-1.0, 0.0, 1.0])).ravel()
    x, y = np.meshgrid(along, along)
    straight = cv2.perspectiveTransform(np.stack([x, y], axis=-1), square_homography(corners))
    u, v = picture.bend(np.asarray(straight, np.float64).reshape(-1, 2)).T
    height, width = picture.grey.shape
    if not np.all((u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)):
        return None
    side = len(centres)
    grey = map_coordinates(picture.grey, [v, u], np.float64, order=1)
    return np.asarray(grey.reshape(side, 3, side, 3).mean(axis=(1, 3)))


def nearest_pattern(
    cells: FloatArray, templates: Templates, settings: MarkerSettings
) -> Identity | str:
    """The pattern nearest to grey values (G, G) as the report has it, or why there is none."""
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


def likely_patterns(cells: FloatArray, templates: Templates, blur_cells: float) -> list[int]:
    """Templates that grey values (G, G) may show under a blur in cells, the best first."""
    flat = cells.ravel() - cells.mean()
    length = float(np.linalg.norm(flat))
    if length <= 0.0:
        return []
    correlation = templates.nearest_blur(blur_cells) @ (flat / length).astype(np.float32)
    best = np.argsort(-correlation, kind="stable")[:_MOST_TRIED]
    close = _CLOSE_CORRELATION if blur_cells > _CLEAR_BLUR_CELLS else 0.25 * _CLOSE_CORRELATION
    least = max(_LEAST_CORRELATION, float(correlation[best[0]]) - close)
    return [int(template) for template in best if correlation[template] >= least]


def verified_identity(
    fit: PatternFit, template: int, templates: Templates, settings: MarkerSettings
) -> Identity | str:
    """The identity of a fitted template by its cells, or the cause of its rejection."""
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
    others = np.delete(squared, best).min(initial=np.inf)
    return best, distance, float(others - squared[best])


def _log_odds(fit: PatternFit, template: int, templates: Templates) -> tuple[float, float]:
    """Log-odds of a template against the likeliest other one and the likeliest decoy.

    Given the cells' precision, as if each cell were seen apart from its neighbours; where blur
    mixes them they are known less well than that.
    """
    mixing = 1.0 + 4.0 * float(np.exp(-0.25 / fit.blur_cells**2))
    sigma = np.hypot(mixing * fit.cell_sigma, _LEAST_CELL_SIGMA)
    gain = ((1.0 - 2.0 * fit.cells) / (2.0 * sigma**2)).astype(np.float32)
    cost = templates.cells @ gain
    others = np.delete(cost, template).min(initial=np.inf)
    decoys = (templates.decoys @ gain).min(initial=np.inf)
    return float(others - cost[template]), float(decoys - cost[template])
