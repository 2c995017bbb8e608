"""The detector of square markers: one image in, markers with their corners out.

`detect_markers` processes one image from top to bottom: the three phases of RAWSEEDS deliverable
D2.1 part 2 (candidates, filtering, refinement and identification) and then, by default, the fit of
the whole marker, which makes the corners more exact and rejects false markers.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.markers import identification as identities
from detect.markers.candidates import candidate_regions
from detect.markers.dictionaries import Templates, templates_of
from detect.markers.edges import NO_EDGE, RefinedQuadrangle, refine_quadrangle
from detect.markers.identification import (
    Identity,
    likely_patterns,
    nearest_pattern,
    sampled_cells,
    verified_identity,
)
from detect.markers.lens import Picture, picture_of
from detect.markers.pattern_fit import FIRST_LOOK, PatternFit, fit_marker
from detect.markers.quadrangle import (
    NO_QUADRANGLE,
    NOT_FOUR_CORNERS,
    count_same,
    covered,
    is_convex,
    rough_corners,
    signed_area,
)
from detect.markers.settings import MarkerSettings
from redetect.landmarks import MarkerCorner, MarkerLandmark

FloatArray = NDArray[np.float64]

#: Fates of candidates, beside the causes of rejection.
ACCEPTED = "accepted"
SAME_MARKER = "a marker already found"

#: How many rough quadrangles of the same are tried.
_TRIES = 3
#: How far edges may be from the rough ones: pixels of the layer, of the image, and in widths.
_CAPTURE_LAYER_PX, _CAPTURE_PX, _CAPTURE_WIDTHS = 1.5, 0.7, 0.02
#: Edges of cells that are blurred by more than this are not fitted.
_HOPELESS_BLUR_CELLS = 0.75
#: A first look may explain less than the full fit has to, by this much.
_FIRST_LOOK_SLACK = 0.1
#: Where edges and whole marker disagree by more than this (mean normalised squared difference; the
#: edges' systematic error included), the marker is not what the fit takes it for: not flat, or
#: bent by an uncalibrated lens. Its edges are then where they are seen.
_MOST_DISAGREEMENT, _EDGE_SYSTEMATIC_PX = 6.0, 0.02
#: Smaller markers are flat. What is white within the border, or round the quiet zone, shines into
#: edges that are softer than this part of the border: these are not used.
_LEAST_BENT_PX, _SHARP_BLURS = 40.0, 0.14
#: Steps from or to grey levels beyond these are clipped, and seem to be where they are not.
_UNCLIPPED = (3.0, 250.0)
#: Systematic error without optical blur, and the blur's variance (px^2) at which it is gone.
_STAIRCASE_PX, _STAIRCASE_VARIANCE = 0.035, 0.1


@dataclass(frozen=True)
class Candidate:
    """A region that came as far as having corners, and what became of it."""

    outline: FloatArray  # (4, 2) its rough corners, pixels of the image
    fate: str  # "accepted" or why not
    refined: RefinedQuadrangle | None = None  # its fitted edges, if it came so far


@dataclass(frozen=True)
class MarkerDetections:
    """The N markers found in one image, by ID and place, and the rejected candidates."""

    dictionary: str
    ids: NDArray[np.int64]  # (N,)
    #: (N, 4, 2) top left, top right, bottom right, bottom left as printed; pixels of the image.
    corners: FloatArray
    covariance: FloatArray  # (N, 4, 2, 2) of each corner, pixels squared
    quality: FloatArray  # (N,) 1 less the mean difference between cells' whiteness and pattern
    margin: FloatArray  # (N,) how much nearer the pattern is than the second best, in cells
    #: (N,) share of the grey values' variance, noise aside, that the fit explains; NaN without one.
    explained: FloatArray
    candidates: tuple[Candidate, ...]  # all regions that came as far as having corners
    rejected: Counter[str]  # how many regions and candidates were not taken, by cause

    def __len__(self) -> int:
        return len(self.ids)

    def landmarks(self) -> tuple[MarkerLandmark, ...]:
        """The markers as rows of a file."""
        rows = []
        for k, number in enumerate(self.ids):
            spreads = self.covariance[k].reshape(4, 4)[:, [0, 1, 3]]
            a, b, c, d = (
                MarkerCorner(*row) for row in np.hstack([self.corners[k], spreads]).tolist()
            )
            quality = float(self.quality[k])
            rows.append(MarkerLandmark(self.dictionary, int(number), quality, (a, b, c, d)))
        return tuple(rows)


class _Marker(NamedTuple):
    """A marker found."""

    id: int
    corners: FloatArray  # (4, 2) in the printed order, straight pixels
    covariance: FloatArray  # (4, 2, 2)
    identity: Identity
    explained: float
    blur_px: float


def detect_markers(
    image: NDArray[np.uint8],
    settings: MarkerSettings,
    camera: Camera | None = None,
) -> MarkerDetections:
    """Find the square markers in one image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    settings : MarkerSettings
    camera : Camera, optional
        The calibration, whose distortion bends the markers' edges; without one they are taken to
        be straight in the image.

    Raises
    ------
    DetectError
        If there is no such dictionary, or it lacks an ID that is expected.
    FrameError
        If the image has not the camera's size.

    References
    ----------
    RAWSEEDS deliverable D2.1 part 2: ground truth from cameras.
    """
    templates = templates_of(settings.dictionary, settings.ids)
    picture = picture_of(image, camera)

    # Phases 1 and 2: dark regions that may be markers.
    regions, rejected = candidate_regions(
        picture.grey, picture.noise, templates.dictionary, settings
    )

    # Phase 3: their corners, the edges in the image itself, and which marker it is.
    markers: list[_Marker] = []
    candidates: list[Candidate] = []
    tried = np.empty((0, 4, 2))
    hulls = picture.straighten(np.concatenate([np.empty((0, 2)), *(r.hull for r in regions)]))
    ends = np.cumsum([len(region.hull) for region in regions])
    for region, hull in zip(regions, np.split(hulls, ends)):
        rough = _rough_quadrangle(hull, settings)
        if isinstance(rough, str):
            rejected[rough] += 1
            continue
        outline = picture.bend(rough)
        if markers and covered(rough, np.array([marker.corners for marker in markers])):
            candidates.append(Candidate(outline, SAME_MARKER))
            continue
        if count_same(rough, tried) >= _TRIES:
            continue
        tried = np.concatenate([tried, rough[None]])
        side = math.sqrt(signed_area(rough))
        capture_px = _CAPTURE_LAYER_PX * region.scale + _CAPTURE_PX + _CAPTURE_WIDTHS * side
        refined = refine_quadrangle(
            picture, rough, outline, templates.border, capture_px, quick=settings.joint
        )
        found = NO_EDGE if refined is None else _identified(picture, refined, templates, settings)
        if isinstance(found, str):
            fate = found
            rejected[fate] += 1
        else:
            fate = ACCEPTED
            markers.append(found)
        candidates.append(Candidate(outline, fate, refined))

    # Back to the image as it is.
    markers.sort(key=lambda m: (m.id, m.corners[0, 0], m.corners[0, 1]))
    outlines = [picture.bend(marker.corners) for marker in markers]
    spreads = [_image_covariance(m, at, picture, settings) for m, at in zip(markers, outlines)]
    return MarkerDetections(
        dictionary=settings.dictionary,
        ids=np.array([m.id for m in markers], dtype=np.int64),
        corners=np.array(outlines).reshape(-1, 4, 2),
        covariance=np.array(spreads).reshape(-1, 4, 2, 2),
        quality=np.array([max(0.0, 1.0 - m.identity.distance) for m in markers]),
        margin=np.array([m.identity.margin for m in markers]),
        explained=np.array([m.explained for m in markers]),
        candidates=tuple(candidates),
        rejected=+rejected,
    )


def _rough_quadrangle(hull: FloatArray, settings: MarkerSettings) -> FloatArray | str:
    """Rough corners of a region by its straight hull, or the cause of there being none."""
    corners = rough_corners(hull, settings.corners)
    if corners is None or not is_convex(corners):
        return NOT_FOUR_CORNERS
    if signed_area(corners) < settings.least_square * cv2.contourArea(hull.astype(np.float32)):
        return NO_QUADRANGLE
    return corners


def _identified(
    picture: Picture, refined: RefinedQuadrangle, templates: Templates, settings: MarkerSettings
) -> _Marker | str:
    """The marker in a refined quadrangle, or the cause of there being none."""
    contrast = refined.light - refined.dark
    strongest = float(contrast.max())
    least = max(settings.least_contrast * picture.noise, settings.edge_balance * strongest)
    if strongest <= 0.0 or contrast.min() < least:
        return identities.NO_WHITE
    cells = sampled_cells(picture, refined.corners, templates)
    if cells is None:
        return identities.OUTSIDE
    blur_px = float(np.median(refined.blur))
    if not settings.joint:
        identity = nearest_pattern(cells, templates, settings)
        if isinstance(identity, str):
            return identity
        return _marker(identity, refined, templates, np.nan, blur_px)

    # The whole marker, fitted to the likely patterns.
    side = math.sqrt(signed_area(refined.corners))
    blur_cells = blur_px / (templates.dictionary.cell * side)
    if blur_cells > _HOPELESS_BLUR_CELLS:
        return identities.TOO_SMALL
    likely = likely_patterns(cells, templates, blur_cells)
    if not likely:
        return identities.NO_PATTERN
    looks = [
        (fit_marker(picture, refined, templates, template, FIRST_LOOK), template)
        for template in likely
    ]
    possible = [(look, template) for look, template in looks if look is not None]
    if not possible:
        return identities.NOT_FITTED
    first, template = max(possible, key=lambda look: look[0].explained)
    if first.explained < settings.least_explained - _FIRST_LOOK_SLACK:
        return identities.UNEXPLAINED
    start = refined._replace(corners=first.corners)
    fit = fit_marker(picture, start, templates, template)
    if fit is None:
        return identities.NOT_FITTED
    identity = verified_identity(fit, template, templates, settings)
    if isinstance(identity, str):
        return identity
    best: RefinedQuadrangle | PatternFit = fit
    if side >= _LEAST_BENT_PX and fit.blur_px <= _SHARP_BLURS * templates.border * side:
        capture_px = _CAPTURE_PX + 2.0 * fit.blur_px
        outline = picture.bend(fit.corners)
        again = refine_quadrangle(picture, fit.corners, outline, templates.border, capture_px)
        if again is not None and _contradicts(again, fit):
            best = again
    return _marker(identity, best, templates, fit.explained, fit.blur_px)


def _contradicts(refined: RefinedQuadrangle, fit: PatternFit) -> bool:
    """Whether edges that are wholly seen and not clipped are not those of the fit."""
    clipped = refined.dark.min() <= _UNCLIPPED[0] or refined.light.max() >= _UNCLIPPED[1]
    if clipped or refined.support.min() < 1.0:
        return False
    apart = fit.corners - refined.corners
    spread = refined.covariance + fit.covariance + _EDGE_SYSTEMATIC_PX**2 * np.eye(2)
    solved = np.linalg.solve(spread, apart[..., None])[..., 0]
    return float(np.mean(apart * solved)) > _MOST_DISAGREEMENT


def _marker(
    identity: Identity,
    found: RefinedQuadrangle | PatternFit,
    templates: Templates,
    explained: float,
    blur_px: float,
) -> _Marker:
    """A marker with its corners in the printed order."""
    number, turns = templates.turned_id(identity.template)
    order = (np.arange(4) - turns) % 4
    corners, covariance = found.corners[order], found.covariance[order]
    return _Marker(number, corners, covariance, identity, explained, blur_px)


def _image_covariance(
    marker: _Marker, pixels: FloatArray, picture: Picture, settings: MarkerSettings
) -> FloatArray:
    """(4, 2, 2) covariances of a marker's corners at their pixels in the image."""
    # A pixel's own square is taken for a Gaussian of its variance, 1/12 px^2; where there is little
    # other blur, edges are staircases, and one along rows or columns up to 0.06 px beside where it
    # seems to be.
    optics = max(0.0, marker.blur_px**2 - 1.0 / 12.0)
    staircase_px = _STAIRCASE_PX * max(0.0, 1.0 - optics / _STAIRCASE_VARIANCE)
    jacobian = picture.pixel_jacobians(pixels)
    covariance = jacobian @ marker.covariance @ jacobian.transpose(0, 2, 1)
    return np.asarray(covariance + (settings.systematic_px**2 + staircase_px**2) * np.eye(2))
