"""The detector of square markers: one image in, markers with their corners out.

`detect_markers` processes one image from top to bottom: the three phases of RAWSEEDS deliverable
D2.1 part 2 (candidates, filtering, refinement and identification) and then, by default, the fit of
the whole marker, which makes the corners more exact and rejects false markers.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.markers import identification as identities
from detect.markers.candidates import Mask, Region, candidate_layers, dark_masks, marker_regions
from detect.markers.detections import ACCEPTED, SAME_MARKER, Candidate, MarkerDetections
from detect.markers.identification import (
    Identity,
    likely_patterns,
    nearest_pattern,
    sampled_cells,
    verified_identity,
)
from detect.markers.lens import Lens, Picture, picture_of
from detect.markers.pattern_fit import FIRST_LOOK, Levels, PatternFit, fit_marker
from detect.markers.quadrangle import (
    NO_QUADRANGLE,
    NOT_FOUR_CORNERS,
    count_same,
    is_convex,
    overlap,
    rough_corners,
    signed_area,
)
from detect.markers.refinement import NO_EDGE, RefinedQuadrangle, refine_quadrangle
from detect.markers.settings import MarkerSettings
from detect.markers.templates import Templates, templates_of

FloatArray = NDArray[np.float64]

#: How many rough quadrangles of the same are tried.
_TRIES = 3
#: How far edges may be from the rough ones: pixels of the layer, and in widths of the marker.
_CAPTURE_LAYER_PX = 1.5
_CAPTURE_PX = 0.7
_CAPTURE_WIDTHS = 0.02
#: Where edges and whole marker disagree by more than this (mean normalised squared difference; the
#: edges' systematic error included), the marker is not what the fit takes it for: not flat, or
#: bent by an uncalibrated lens. Its edges are then where they are seen.
_MOST_DISAGREEMENT = 6.0
_EDGE_SYSTEMATIC_PX = 0.02
#: What is white within the border, or round the quiet zone, shines into edges that are softer than
#: this part of the border: these are not used.
_SHARP_BLURS = 0.14
#: Steps from or to grey levels beyond these are clipped, and seem to be where they are not.
_UNCLIPPED = (3.0, 250.0)
#: Smaller markers are flat.
_LEAST_BENT_PX = 40.0
#: Systematic error without optical blur, and the blur's variance (px^2) at which it is gone.
_STAIRCASE_PX = 0.035
_STAIRCASE_VARIANCE = 0.1
#: A first look may explain less than the full fit has to, by this much.
_FIRST_LOOK_SLACK = 0.1


class _Marker(NamedTuple):
    """A marker found: corners (4, 2) in the printed order, straight pixels; their covariances."""

    id: int
    corners: FloatArray
    covariance: FloatArray
    distance: float
    margin: float
    explained: float
    blur_px: float


def detect_markers(
    image: NDArray[np.uint8],
    settings: MarkerSettings,
    camera: Camera | None = None,
    *,
    keep_masks: bool = False,
) -> MarkerDetections:
    """Find the square markers in one image.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    settings : MarkerSettings
        The settings.
    camera : Camera, optional
        The calibration, whose distortion bends the markers' edges; without one they are taken to
        be straight in the image.
    keep_masks : bool
        Whether the result holds the dark pixels of phase 1, for display.

    Returns
    -------
    MarkerDetections

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
    lens = picture.lens

    # Phases 1 and 2: dark regions that may be markers, and their rough corners.
    quadrangles, rejected, masks = _quadrangles(picture, templates, settings)

    # Phase 3: the edges in the image itself, and which marker it is.
    markers: list[_Marker] = []
    candidates: list[Candidate] = []
    tried, tries = np.empty((len(quadrangles), 4, 2)), 0
    for region, rough in quadrangles:
        if count_same(rough, _corners(markers)):
            candidates.append(Candidate(lens.bend(rough), SAME_MARKER))
            continue
        if count_same(rough, tried[:tries]) >= _TRIES:
            continue
        tried[tries] = rough
        tries += 1
        refined = refine_quadrangle(
            picture, rough, capture_px=_capture(region, rough), border=templates.border,
            quick=settings.joint,
        )  # fmt: skip
        found = NO_EDGE if refined is None else _identified(picture, refined, templates, settings)
        if isinstance(found, str):
            fate = found
            rejected[fate] += 1
        elif any(overlap(found.corners, marker.corners) for marker in markers):
            fate = SAME_MARKER
        else:
            fate = ACCEPTED
            markers.append(found)
        candidates.append(Candidate(lens.bend(rough), fate, refined))

    # Back to the image as it is.
    markers.sort(key=lambda m: (m.id, m.corners[0, 0], m.corners[0, 1]))
    outlines = [lens.bend(marker.corners) for marker in markers]
    spreads = [_image_covariance(m, at, lens, settings) for m, at in zip(markers, outlines)]
    return MarkerDetections(
        dictionary=settings.dictionary,
        ids=np.array([m.id for m in markers], dtype=np.int64),
        corners=np.array(outlines).reshape(-1, 4, 2),
        covariance=np.array(spreads).reshape(-1, 4, 2, 2),
        quality=np.array([max(0.0, 1.0 - m.distance) for m in markers]),
        margin=np.array([m.margin for m in markers]),
        explained=np.array([m.explained for m in markers]),
        candidates=tuple(candidates),
        rejected=+rejected,
        masks=tuple(masks) if keep_masks else (),
    )


def _quadrangles(
    picture: Picture, templates: Templates, settings: MarkerSettings
) -> tuple[list[tuple[Region, FloatArray]], Counter[str], list[Mask]]:
    """Regions with their rough corners; how many were rejected, by cause; all masks."""
    found, masks = [], []
    rejected: Counter[str] = Counter()
    layers = candidate_layers(picture.grey, settings)
    for layer in layers:
        for mask in dark_masks(layer, picture.noise, settings):
            masks.append(mask)
            regions, causes = marker_regions(
                mask, templates.dictionary, settings, last=layer is layers[-1]
            )
            rejected += causes
            for region in regions:
                corners = _rough_quadrangle(region, picture.lens, settings)
                if isinstance(corners, str):
                    rejected[corners] += 1
                else:
                    found.append((region, corners))
    return found, rejected, masks


def _corners(markers: list[_Marker]) -> FloatArray:
    return np.array([marker.corners for marker in markers]).reshape(-1, 4, 2)


def _rough_quadrangle(region: Region, lens: Lens, settings: MarkerSettings) -> FloatArray | str:
    """Rough corners of a region at straight positions, or the cause of there being none."""
    hull = lens.straighten(region.hull)
    corners = rough_corners(hull, settings.corners)
    if corners is None or not is_convex(corners):
        return NOT_FOUR_CORNERS
    if signed_area(corners) < settings.least_square * abs(signed_area(hull)):
        return NO_QUADRANGLE
    return corners


def _capture(region: Region, rough: FloatArray) -> float:
    """How far the edges of a region may be from the rough ones, pixels."""
    side = float(np.sqrt(abs(signed_area(rough))))
    return _CAPTURE_LAYER_PX * region.scale + _CAPTURE_PX + _CAPTURE_WIDTHS * side


def _identified(
    picture: Picture, refined: RefinedQuadrangle, templates: Templates, settings: MarkerSettings
) -> _Marker | str:
    """The marker in a refined quadrangle, or the cause of there being none."""
    contrast = refined.edges.light - refined.edges.dark
    strongest = float(contrast.max())
    least = max(settings.least_contrast * picture.noise, settings.edge_balance * strongest)
    if strongest <= 0.0 or contrast.min() < least:
        return identities.NO_WHITE
    cells = sampled_cells(picture, refined.corners, templates)
    if cells is None:
        return identities.OUTSIDE
    if settings.joint:
        return _fitted(picture, refined, cells, templates, settings)
    found = nearest_pattern(cells, templates, settings)
    if isinstance(found, str):
        return found
    return _marker(found, refined, templates, float(np.median(refined.edges.blur)), np.nan)


def _fitted(
    picture: Picture,
    refined: RefinedQuadrangle,
    cells: FloatArray,
    templates: Templates,
    settings: MarkerSettings,
) -> _Marker | str:
    """The marker in a refined quadrangle by a fit of the whole of it."""
    edges = refined.edges
    levels = Levels(
        float(np.median(edges.dark)), float(np.median(edges.light)), float(np.median(edges.blur))
    )
    side = np.sqrt(abs(signed_area(refined.corners)))
    likely = likely_patterns(cells, templates, levels.blur_px / (templates.dictionary.cell * side))
    if not len(likely):
        return identities.NO_PATTERN
    looks = [
        (fit_marker(picture, refined.corners, templates, int(other), levels, FIRST_LOOK), other)
        for other in likely
    ]
    possible = [(look, int(other)) for look, other in looks if look is not None]
    if not possible:
        return identities.NOT_FITTED
    first, template = max(possible, key=lambda look: look[0].explained)
    if first.explained < settings.least_explained - _FIRST_LOOK_SLACK:
        return identities.UNEXPLAINED
    fit = fit_marker(picture, first.corners, templates, template, levels)
    if fit is None:
        return identities.NOT_FITTED
    verified = verified_identity(fit, template, templates, settings)
    if isinstance(verified, str):
        return verified
    best: RefinedQuadrangle | PatternFit = fit
    if side >= _LEAST_BENT_PX and fit.blur_px <= _SHARP_BLURS * templates.border * side:
        again = refine_quadrangle(
            picture, fit.corners, capture_px=_CAPTURE_PX + 2.0 * fit.blur_px,
            border=templates.border,
        )  # fmt: skip
        if again is not None and _trusted(again) and _disagreement(again, fit) > _MOST_DISAGREEMENT:
            best = again
    return _marker(verified, best, templates, fit.blur_px, fit.explained)


def _trusted(refined: RefinedQuadrangle) -> bool:
    """Whether edges are seen over their whole length, and not clipped to white or black."""
    low, high = _UNCLIPPED
    edges = refined.edges
    seen = edges.support.min() >= 1.0
    return bool(seen and edges.light.max() < high and edges.dark.min() > low)


def _disagreement(refined: RefinedQuadrangle, fit: PatternFit) -> float:
    """Mean normalised squared difference of the corners by the edges and by the whole marker."""
    apart = fit.corners - refined.corners
    spread = refined.covariance + fit.covariance + _EDGE_SYSTEMATIC_PX**2 * np.eye(2)
    solved = np.linalg.solve(spread, apart[..., None])[..., 0]
    return float(np.sum(apart * solved)) / 8.0


def _marker(
    identity: Identity,
    found: RefinedQuadrangle | PatternFit,
    templates: Templates,
    blur_px: float,
    explained: float,
) -> _Marker:
    """A marker with its corners in the printed order."""
    order = (np.arange(4) - int(templates.turns[identity.template])) % 4
    return _Marker(
        id=int(templates.dictionary.ids[templates.marker[identity.template]]),
        corners=found.corners[order],
        covariance=found.covariance[order],
        distance=identity.distance,
        margin=identity.margin,
        explained=explained,
        blur_px=blur_px,
    )


def _image_covariance(
    marker: _Marker, pixels: FloatArray, lens: Lens, settings: MarkerSettings
) -> FloatArray:
    """(4, 2, 2) covariances of a marker's corners at their pixels in the image."""
    systematic = np.hypot(settings.systematic_px, _staircase_px(marker.blur_px))
    jacobian = np.array([lens.pixel_jacobian(pixel) for pixel in pixels])
    covariance = jacobian @ marker.covariance @ jacobian.transpose(0, 2, 1)
    return np.asarray(covariance + systematic**2 * np.eye(2))


def _staircase_px(blur_px: float) -> float:
    """Systematic error of a corner in an image without blur, which shows edges as staircases.

    A pixel's own square is taken for a Gaussian of its variance, 1/12 px^2; where there is little
    else, a straight edge along rows or columns is up to 0.06 px beside where it seems to be.
    """
    optics = max(0.0, blur_px**2 - 1.0 / 12.0)
    return _STAIRCASE_PX * max(0.0, 1.0 - optics / _STAIRCASE_VARIANCE)
