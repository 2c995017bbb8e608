"""The detector of square markers: one image in, markers with their corners out.

`detect_markers` has the three phases of RAWSEEDS deliverable D2.1 part 2 (candidates, filtering,
refinement and identification), the last by a fit of the whole marker, which makes the corners more
accurate and rejects false markers. The homography of the refined corners gives the centres of the
cells, whose grey values are compared with all patterns in all four rotations; the best matches are
fitted. The nearest one is accepted if it is near enough and the second nearest clearly farther.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from camera import Camera
from detect.markers import geometry
from detect.markers.candidates import candidate_regions
from detect.markers.dictionaries import Templates, templates_of
from detect.markers.edges import RefinedQuadrangle, refine_quadrangle
from detect.markers.geometry import Picture
from detect.markers.pattern_fit import PatternFit, fit_marker
from detect.settings import MarkerSettings
from redetect.array_types import FloatArray, GreyImage, IntArray
from redetect.landmarks import MarkerCorner, MarkerLandmark

#: Outcomes of candidates, beside the reasons for rejection.
ACCEPTED = "accepted"
SAME_MARKER = "duplicate of a marker"

#: Least area of the rough quadrangle over that of the convex hull.
_LEAST_SQUARE = 0.75
#: Largest difference between the whiteness of any cell and that of the pattern.
_LARGEST_CELL_ERROR = 0.45
#: Number of similar rough quadrangles that are tried.
_TRIES = 3
#: Largest distance of edges from the rough ones: pixels of the layer, of the image, and in widths.
_CAPTURE_LAYER_PX, _CAPTURE_PX, _CAPTURE_WIDTHS = 1.5, 0.7, 0.02
#: Markers whose cells are blurred by more than this (in cells) are not fitted.
_HOPELESS_BLUR_CELLS = 0.75
#: The first, coarse fit may explain less variance than the full fit must, by this much.
_COARSE_SLACK = 0.1
#: If the edges of a marker and its fit disagree by more than this (mean normalised squared
#: difference, including the edges' systematic error), the marker is not flat, or distorted by an
#: uncalibrated lens: the measured edges are then used.
_MOST_DISAGREEMENT = 6.0
_EDGE_SYSTEMATIC_PX = 0.02
_PARTS = 8  #: Of each of these edges.
_LEAST_BENT_PX = 40.0  #: Smaller markers are assumed flat.
#: Edges with a blur above this share of the border are not used: they are biased by the brightness
#: of the cells inside, or beyond the quiet zone.
_SHARP_BLURS = 0.14
#: Steps from or to grey levels beyond these are clipped, which shifts the edges.
_UNCLIPPED = (3.0, 250.0)
#: Systematic error without optical blur, and the blur's variance (px^2) at which it vanishes.
_STAIRCASE_PX, _STAIRCASE_VARIANCE = 0.035, 0.1

#: Reasons for rejection, as reported.
OUTSIDE = "partly outside the image"
NO_PATTERN = "no matching pattern"
AMBIGUOUS = "two matching patterns"
NOT_FITTED = "fit of the marker failed"
UNEXPLAINED = "grey values unexplained"
WRONG_CELLS = "wrong cells"
TOO_SMALL = "cells too small for the blur"
NO_MARKER = "similar to common non-markers"
#: Distance between samples of a cell, in cells.
_SPREAD_CELLS = 0.25
#: Patterns with a correlation this close to the best are tried, too, up to `_MOST_TRIED` in all.
_CLOSE_CORRELATION = 0.06
_MOST_TRIED = 3
#: If cells are blurred by less than this (in cells), it must be four times as close.
_CLEAR_BLUR_CELLS = 0.3
_LEAST_CORRELATION = 0.6
#: Least log-odds of the best pattern against the second best.
_LEAST_LOG_ODDS = 15.0
#: Least standard deviation of the whiteness of cells.
_LEAST_CELL_SIGMA = 0.08
#: Markers whose cells are blurred by more than this (in cells) are rejected. The first number of
#: each pair is for dictionaries whose patterns hardly ever occur by chance, the second for the
#: others (see `Templates.weakness`).
_LARGEST_BLUR_CELLS = (0.62, 0.6)
#: The requirements on a fit increase from the first blur (in cells) to the second: many patterns
#: fit blurred cells roughly, but only the right one fits them to within the noise.
_STRICT_FROM, _STRICT_AT = 0.3, 0.6
#: Largest misfit beyond the noise (in contrasts), and least mean agreement of the cells: for clear
#: cells, and for blurred ones.
_CLEAR_MISFIT, _CLEAR_AGREEMENT = 0.12, 0.85
_BLURRED_MISFIT = (0.06, 0.03)
_BLURRED_AGREEMENT = (0.92, 0.95)
#: The same for patterns that also occur on other objects, and their largest error of a cell.
_PLAIN_MISFIT, _PLAIN_AGREEMENT, _PLAIN_CELL_ERROR = 0.04, 0.95, 0.25


@dataclass(frozen=True)
class Candidate:
    """A region with four corners, and its outcome."""

    outline: FloatArray  # (4, 2) its rough corners, pixels of the image
    outcome: str  # "accepted", or the reason for rejection


@dataclass(frozen=True)
class MarkerDetections:
    """The N markers found in one image, sorted by ID and position, and the rejected candidates."""

    dictionary: str
    ids: IntArray  # (N,)
    #: (N, 4, 2) top left, top right, bottom right, bottom left as printed; pixels of the image.
    corners: FloatArray
    covariance: FloatArray  # (N, 4, 2, 2) of each corner, pixels squared
    quality: FloatArray  # (N,) 1 minus the mean difference between cells' whiteness and pattern
    candidates: tuple[Candidate, ...]  # all regions with four corners
    rejected: Counter[str]  # number of rejected regions and candidates, by reason

    def __len__(self) -> int:
        return len(self.ids)

    def landmarks(self) -> tuple[MarkerLandmark, ...]:
        """The markers as rows of a file."""
        spreads = self.covariance.reshape(-1, 4, 4)[..., [0, 1, 3]]
        corners = np.concatenate([self.corners, spreads], axis=-1).tolist()
        rows = []
        for number, quality, own in zip(self.ids.tolist(), self.quality.tolist(), corners):
            a, b, c, d = (MarkerCorner(*corner) for corner in own)
            rows.append(MarkerLandmark(self.dictionary, number, quality, (a, b, c, d)))
        return tuple(rows)


class _Marker(NamedTuple):
    """A detected marker."""

    id: int
    corners: FloatArray  # (4, 2) in the printed order, straight pixels
    covariance: FloatArray  # (4, 2, 2)
    quality: float
    blur_px: float


def detect_markers(
    image: GreyImage, settings: MarkerSettings, camera: Camera | None = None
) -> MarkerDetections:
    """Find the square markers in one grey image (RAWSEEDS deliverable D2.1 part 2).

    Parameters
    ----------
    image : (H, W) uint8
    settings : MarkerSettings
    camera : Camera, optional
        The calibration, whose distortion bends markers' edges; without one they count as straight.

    Raises
    ------
    DetectError
        If there is no such dictionary, or it lacks an expected ID.
    FrameError
        If the image is not an 8-bit grey image of the camera's size.
    """
    templates = templates_of(settings.dictionary, settings.ids)
    picture = geometry.picture_of(image, camera)

    # Phases 1 and 2: dark regions that may be markers.
    regions, rejected = candidate_regions(
        picture.grey, picture.noise, templates.dictionary, settings
    )

    # Phase 3: their corners, their edges in the full image, and their identity.
    markers: list[_Marker] = []
    candidates: list[Candidate] = []
    tried = np.empty((0, 4, 2))
    hulls = picture.undistort(np.concatenate([np.empty((0, 2)), *(r.hull for r in regions)]))
    ends = np.cumsum([len(region.hull) for region in regions])
    for region, hull in zip(regions, np.split(hulls, ends)):
        if not np.isfinite(hull).all():
            rejected[geometry.UNSEEN] += 1
            continue
        rough = geometry.rough_corners(hull)
        if rough is None or not geometry.is_convex(rough):
            rejected[geometry.NOT_FOUR_CORNERS] += 1
            continue
        if geometry.signed_area(rough) < _LEAST_SQUARE * cv2.contourArea(hull.astype("f4")):
            rejected[geometry.NO_QUADRANGLE] += 1
            continue
        outline = picture.distort(rough)
        if markers and geometry.covered(rough, np.array([marker.corners for marker in markers])):
            candidates.append(Candidate(outline, SAME_MARKER))
            continue
        if geometry.count_same(rough, tried) >= _TRIES:
            continue
        tried = np.concatenate([tried, rough[None]])
        side = math.sqrt(geometry.signed_area(rough))
        capture_px = _CAPTURE_LAYER_PX * region.scale + _CAPTURE_PX + _CAPTURE_WIDTHS * side
        found = _marker_at(picture, rough, capture_px, templates, settings)
        if isinstance(found, str):
            rejected[found] += 1
        else:
            markers.append(found)
        candidates.append(Candidate(outline, found if isinstance(found, str) else ACCEPTED))

    # Back to the distorted image.
    markers.sort(key=lambda m: (m.id, m.corners[0, 0], m.corners[0, 1]))
    outlines = [picture.distort(marker.corners) for marker in markers]
    spreads = [_image_covariance(m, at, picture, settings) for m, at in zip(markers, outlines)]
    return MarkerDetections(
        dictionary=settings.dictionary,
        ids=np.array([m.id for m in markers], dtype=np.int64),
        corners=np.array(outlines).reshape(-1, 4, 2),
        covariance=np.array(spreads).reshape(-1, 4, 2, 2),
        quality=np.array([m.quality for m in markers]),
        candidates=tuple(candidates),
        rejected=+rejected,
    )


def _marker_at(
    picture: Picture,
    rough: FloatArray,
    capture_px: float,
    templates: Templates,
    settings: MarkerSettings,
) -> _Marker | str:
    """The marker in a rough quadrangle (4, 2), or the reason for rejection."""
    refined = refine_quadrangle(picture, rough, templates.border, capture_px, settings)
    if isinstance(refined, str):
        return refined
    cells = sampled_cells(picture, refined.corners, templates)
    if cells is None:
        return OUTSIDE

    # Fit the whole marker with each likely pattern.
    side = math.sqrt(geometry.signed_area(refined.corners))
    blur_cells = refined.blur_px / (templates.dictionary.cell * side)
    if blur_cells > _HOPELESS_BLUR_CELLS:
        return TOO_SMALL
    likely = likely_patterns(cells, templates, blur_cells)
    if not likely:
        return NO_PATTERN
    coarse_fits = [
        (coarse, template)
        for template in likely
        if (coarse := fit_marker(picture, refined, templates, template, coarse=True)) is not None
    ]
    if not coarse_fits:
        return NOT_FITTED
    first, template = max(coarse_fits, key=lambda each: each[0].explained)
    if first.explained < settings.least_explained - _COARSE_SLACK:
        return UNEXPLAINED
    fit = fit_marker(picture, refined._replace(corners=first.corners), templates, template)
    if fit is None:
        return NOT_FITTED
    quality = verified_quality(fit, template, templates, settings)
    if isinstance(quality, str):
        return quality
    best: RefinedQuadrangle | PatternFit = fit
    sharp = fit.blur_px <= _SHARP_BLURS * templates.border * side
    if side >= _LEAST_BENT_PX and sharp and fit.surrounded:
        capture_px = _CAPTURE_PX + 2.0 * fit.blur_px
        edges = refine_quadrangle(
            picture, fit.corners, templates.border, capture_px, settings, _PARTS
        )
        if not isinstance(edges, str):
            edges = edges._replace(corners=edges.corners - fit.toned)
            best = edges if _contradicts(edges, fit) else fit
    number, turns = templates.turned_id(template)
    printed = (np.arange(4) - turns) % 4
    corners, covariance = best.corners[printed], best.covariance[printed]
    return _Marker(number, corners, covariance, quality, fit.blur_px)


def _contradicts(edges: RefinedQuadrangle, fit: PatternFit) -> bool:
    """Whether completely visible edges without clipping contradict the fit."""
    clipped = edges.dark.min() <= _UNCLIPPED[0] or edges.light.max() >= _UNCLIPPED[1]
    if clipped or edges.support < 0.5:
        return False
    apart = fit.corners - edges.corners
    spread = edges.covariance + fit.covariance + _EDGE_SYSTEMATIC_PX**2 * np.eye(2)
    solved = np.linalg.solve(spread, apart[..., None])[..., 0]
    return float(np.mean(apart * solved)) > _MOST_DISAGREEMENT


def _image_covariance(
    marker: _Marker, pixels: FloatArray, picture: Picture, settings: MarkerSettings
) -> FloatArray:
    """(4, 2, 2) covariances of a marker's corners at their pixels in the image."""
    # A pixel's square is modelled as a Gaussian of its variance, 1/12 px^2; with little other blur,
    # edges are staircases, and one along rows or columns is biased by up to 0.06 px.
    optics = max(0.0, marker.blur_px**2 - 1.0 / 12.0)
    staircase_px = _STAIRCASE_PX * max(0.0, 1.0 - optics / _STAIRCASE_VARIANCE)
    jacobian = picture.pixel_jacobians(pixels)
    covariance = jacobian @ marker.covariance @ jacobian.transpose(0, 2, 1)
    return np.asarray(covariance + (settings.systematic_px**2 + staircase_px**2) * np.eye(2))


def sampled_cells(picture: Picture, corners: FloatArray, templates: Templates) -> FloatArray | None:
    """(G, G) grey values of the grid's cells, each the mean of 3x3; None if some are outside."""
    centres, cell = templates.dictionary.centres, templates.dictionary.cell
    along = (centres[:, None] + _SPREAD_CELLS * cell * np.array([-1.0, 0.0, 1.0])).ravel()
    x, y = np.meshgrid(along, along)
    homography = geometry.square_homography(corners)
    straight = cv2.perspectiveTransform(np.stack([x, y], axis=-1), homography)
    u, v = picture.distort(np.asarray(straight, np.float64).reshape(-1, 2)).T
    height, width = picture.grey.shape
    if not np.all((u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)):
        return None
    side = len(centres)
    grey = map_coordinates(picture.grey, [v, u], np.float64, order=1)
    return np.asarray(grey.reshape(side, 3, side, 3).mean(axis=(1, 3)))


def likely_patterns(cells: FloatArray, templates: Templates, blur_cells: float) -> list[int]:
    """Templates that match grey values (G, G) under a blur in cells, the best first."""
    flat = cells.ravel() - cells.mean()
    length = float(np.linalg.norm(flat))
    if length <= 0.0:
        return []
    correlation = templates.nearest_blur(blur_cells) @ (flat / length).astype(np.float32)
    best = np.argsort(-correlation, kind="stable")[:_MOST_TRIED]
    close = _CLOSE_CORRELATION if blur_cells > _CLEAR_BLUR_CELLS else 0.25 * _CLOSE_CORRELATION
    least = max(_LEAST_CORRELATION, float(correlation[best[0]]) - close)
    return [int(template) for template in best if correlation[template] >= least]


def verified_quality(
    fit: PatternFit, template: int, templates: Templates, settings: MarkerSettings
) -> float | str:
    """The quality of a fitted template, or the reason for rejection by its cells."""
    weakness = templates.weakness
    if fit.blur_cells > _clamped_lerp(weakness, *_LARGEST_BLUR_CELLS):
        return TOO_SMALL
    strict = (fit.blur_cells - _STRICT_FROM) / (_STRICT_AT - _STRICT_FROM)
    misfit = _clamped_lerp(strict, _CLEAR_MISFIT, _clamped_lerp(weakness, *_BLURRED_MISFIT))
    agreement = _clamped_lerp(
        strict, _CLEAR_AGREEMENT, _clamped_lerp(weakness, *_BLURRED_AGREEMENT)
    )
    allowed = _LARGEST_CELL_ERROR
    if templates.plain[template]:
        misfit = min(misfit, _PLAIN_MISFIT)
        agreement = max(agreement, _PLAIN_AGREEMENT)
        allowed = min(allowed, _PLAIN_CELL_ERROR)
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
    return max(0.0, 1.0 - distance)


def _clamped_lerp(share: float, first: float, second: float) -> float:
    """Interpolate from the first number to the second, clamped, as the share goes from 0 to 1."""
    return float(np.interp(share, (0.0, 1.0), (first, second)))


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
    """Log-odds of a template against the most likely other one and the most likely decoy.

    Cells count as independent, with their stated precision, less by the mixing due to blur.
    """
    mixing = 1.0 + 4.0 * float(np.exp(-0.25 / fit.blur_cells**2))
    sigma = np.hypot(mixing * fit.cell_sigma, _LEAST_CELL_SIGMA)
    gain = ((1.0 - 2.0 * fit.cells) / (2.0 * sigma**2)).astype(np.float32)
    cost = templates.cells @ gain
    others = np.delete(cost, template).min(initial=np.inf)
    decoys = (templates.decoys @ gain).min(initial=np.inf)
    return float(others - cost[template]), float(decoys - cost[template])
