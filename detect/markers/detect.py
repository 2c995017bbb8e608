"""The detector of square markers: one image in, markers with their corners out.

`detect_markers` processes one image from top to bottom: the three phases of RAWSEEDS deliverable
D2.1 part 2 (candidates, filtering, refinement and identification) and then, by default, the fit of
the whole marker, which makes the corners more exact and rejects false markers.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera import Camera
from detect.markers import identification as identities
from detect.markers.candidates import Mask, candidate_layers, dark_masks
from detect.markers.detections import ACCEPTED, SAME_MARKER, Candidate, MarkerDetections
from detect.markers.identification import (
    Identity,
    likely_patterns,
    nearest_pattern,
    sampled_cells,
    verified_identity,
)
from detect.markers.lens import Lens, lens_of
from detect.markers.pattern_fit import PatternFit, fit_marker
from detect.markers.polygon_kernels import (
    count_same,
    is_convex,
    is_inside,
    same_corners,
    signed_area,
)
from detect.markers.quadrangle import (
    NO_QUADRANGLE,
    NOT_FOUR_CORNERS,
    rough_corners,
)
from detect.markers.refinement import NO_EDGE, RefinedQuadrangle, refine_quadrangle
from detect.markers.regions import Region, marker_regions
from detect.markers.settings import MarkerSettings
from detect.markers.templates import Templates, templates_of
from detect.noise import estimate_noise

FloatArray = NDArray[np.float64]

#: Rows of the image that its noise is estimated from.
_NOISE_ROWS = 64
#: Rough quadrangles whose corners are all this near (pixels, and in widths) are one and the same.
_SAME_PX = 1.0
_SAME_WIDTHS = 0.08
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


@dataclass(frozen=True)
class _Marker:
    """A marker found: its corners in the printed order, straight pixels."""

    id: int
    corners: FloatArray
    covariance: FloatArray
    identity: Identity
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
    lens = lens_of(camera, image)
    image = np.ascontiguousarray(image)
    noise = estimate_noise(image, _NOISE_ROWS)
    rejected: Counter[str] = Counter()
    masks: list[Mask] = []

    # Phases 1 and 2: dark regions that may be markers, and their rough corners.
    quadrangles: list[tuple[Region, FloatArray]] = []
    layers = candidate_layers(image, settings)
    for layer in layers:
        for mask in dark_masks(layer, noise, settings):
            regions, causes = marker_regions(
                mask, templates.dictionary, settings, last=layer is layers[-1]
            )
            rejected += causes
            masks += [mask] if keep_masks else []
            for region in regions:
                corners = _rough_quadrangle(region, lens, settings)
                if isinstance(corners, str):
                    rejected[corners] += 1
                else:
                    quadrangles.append((region, corners))

    # Phase 3: the edges in the image itself, and which marker it is.
    markers: list[_Marker] = []
    candidates: list[Candidate] = []
    tried, tries = np.empty((len(quadrangles), 4, 2)), 0
    for region, rough in quadrangles:
        if any(_same_place(rough, marker.corners) for marker in markers):
            candidates.append(Candidate(region, rough, _bent(rough, lens), SAME_MARKER))
            continue
        if count_same(rough, tried, tries, _SAME_PX, _SAME_WIDTHS) >= _TRIES:
            continue
        tried[tries] = rough
        tries += 1
        refined = refine_quadrangle(
            image, lens, rough, capture_px=_capture(region, rough), border=templates.border,
            noise=noise, quick=settings.joint,
        )  # fmt: skip
        if refined is None:
            result: _Marker | str = NO_EDGE
        else:
            result = _identified(image, lens, refined, templates, settings, noise)
        fate = result if isinstance(result, str) else ACCEPTED
        if not isinstance(result, str):
            if any(_overlap(result.corners, marker.corners) for marker in markers):
                fate = SAME_MARKER
            else:
                markers.append(result)
        if fate not in (ACCEPTED, SAME_MARKER):
            rejected[fate] += 1
        candidates.append(Candidate(region, rough, _bent(rough, lens), fate, refined))
    return _detections(markers, lens, settings, candidates, rejected, masks)


def _bent(corners: FloatArray, lens: Lens) -> FloatArray:
    middle = corners.mean(axis=0)
    return lens.bend(corners, lens.bend(middle[None], middle)[0])


def _rough_quadrangle(region: Region, lens: Lens, settings: MarkerSettings) -> FloatArray | str:
    """Rough corners of a region at straight positions, or the cause of there being none."""
    hull = lens.straighten(region.hull)
    corners = rough_corners(hull, settings.corners)
    if corners is None or not is_convex(corners):
        return NOT_FOUR_CORNERS
    if signed_area(corners) < settings.least_square * abs(signed_area(hull)):
        return NO_QUADRANGLE
    return corners


def _identified(
    image: NDArray[np.uint8],
    lens: Lens,
    refined: RefinedQuadrangle,
    templates: Templates,
    settings: MarkerSettings,
    noise: float,
) -> _Marker | str:
    """The marker in a refined quadrangle, or the cause of there being none."""
    contrast = refined.contrast
    strongest = float(contrast.max())
    least = max(settings.least_contrast * noise, settings.edge_balance * strongest)
    if strongest <= 0.0 or contrast.min() < least:
        return identities.NO_WHITE
    cells = sampled_cells(image, lens, refined.corners, templates)
    if cells is None:
        return identities.OUTSIDE
    if not settings.joint:
        found = nearest_pattern(cells, templates, settings)
        if isinstance(found, str):
            return found
        blur = float(np.median(refined.blur_px))
        return _marker(found, refined.corners, _block_diagonal(refined), templates, blur)

    blur = float(np.median(refined.blur_px))
    side = np.sqrt(abs(signed_area(refined.corners)))
    likely = likely_patterns(cells, templates, blur / (templates.dictionary.cell * side))
    if not len(likely):
        return identities.NO_PATTERN
    levels = float(np.median(refined.dark)), float(np.median(refined.light))
    first: PatternFit | None = None
    template = -1
    for other in likely:
        look = fit_marker(
            image, lens, refined.corners, templates, int(other), dark=levels[0], light=levels[1],
            blur_px=blur, noise=noise, first_look=True,
        )  # fmt: skip
        if look is not None and (first is None or look.explained > first.explained):
            first, template = look, int(other)
    if first is None:
        return identities.NOT_FITTED
    if first.explained < settings.least_explained - _FIRST_LOOK_SLACK:
        return identities.UNEXPLAINED
    fit = fit_marker(
        image, lens, first.corners, templates, template, dark=levels[0], light=levels[1],
        blur_px=blur, noise=noise,
    )  # fmt: skip
    if fit is None:
        return identities.NOT_FITTED
    verified = verified_identity(fit, template, templates, settings)
    if isinstance(verified, str):
        return verified
    if side >= _LEAST_BENT_PX and fit.blur_px <= _SHARP_BLURS * templates.border * side:
        edges = refine_quadrangle(
            image, lens, fit.corners, capture_px=_CAPTURE_PX + 2.0 * fit.blur_px,
            border=templates.border, noise=noise,
        )  # fmt: skip
        if edges is not None and _trusted(edges) and _disagreement(edges, fit) > _MOST_DISAGREEMENT:
            return _marker(
                verified,
                edges.corners,
                _block_diagonal(edges),
                templates,
                fit.blur_px,
                fit.explained,
            )
    return _marker(verified, fit.corners, fit.covariance, templates, fit.blur_px, fit.explained)


def _trusted(edges: RefinedQuadrangle) -> bool:
    """Whether edges are seen over their whole length, and not clipped to white or black."""
    low, high = _UNCLIPPED
    seen = edges.support.min() >= 1.0
    return bool(seen and edges.light.max() < high and edges.dark.min() > low)


def _disagreement(refined: RefinedQuadrangle, fit: PatternFit) -> float:
    """Mean normalised squared difference of the corners by the edges and by the whole marker."""
    total = 0.0
    for k in range(4):
        part = fit.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        apart = fit.corners[k] - refined.corners[k]
        spread = refined.covariance[k] + part + _EDGE_SYSTEMATIC_PX**2 * np.eye(2)
        total += float(apart @ np.linalg.solve(spread, apart)) / 8.0
    return total


def _block_diagonal(refined: RefinedQuadrangle) -> FloatArray:
    """(8, 8) covariance of the corners by the edges, as if the corners were independent."""
    covariance = np.zeros((8, 8))
    for k in range(4):
        covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = refined.covariance[k]
    return covariance


def _marker(
    identity: Identity,
    corners: FloatArray,
    covariance: FloatArray,
    templates: Templates,
    blur_px: float,
    explained: float = float("nan"),
) -> _Marker:
    """A marker with its corners in the printed order."""
    turn = int(templates.turns[identity.template])
    order = (np.arange(4) - turn) % 4
    numbers = np.stack([2 * order, 2 * order + 1], axis=-1).ravel()
    return _Marker(
        id=int(templates.dictionary.ids[templates.marker[identity.template]]),
        corners=corners[order],
        covariance=covariance[np.ix_(numbers, numbers)],
        identity=identity,
        explained=explained,
        blur_px=blur_px,
    )


def _capture(region: Region, rough: FloatArray) -> float:
    side = float(np.sqrt(abs(signed_area(rough))))
    return _CAPTURE_LAYER_PX * region.scale + _CAPTURE_PX + _CAPTURE_WIDTHS * side


def _same_place(first: FloatArray, second: FloatArray) -> bool:
    """Whether two quadrangles have the same corners, in any order."""
    return bool(same_corners(first, second, _SAME_PX, _SAME_WIDTHS))


def _overlap(first: FloatArray, second: FloatArray) -> bool:
    """Whether the middle of either quadrangle is inside the other."""
    return bool(_middle_inside(first, second) or _middle_inside(second, first))


def _middle_inside(first: FloatArray, second: FloatArray) -> bool:
    x, y = first.mean(axis=0)
    return bool(is_inside(x, y, second))


def _staircase_px(blur_px: float) -> float:
    """Systematic error of a corner in an image without blur, which shows edges as staircases.

    A pixel's own square is taken for a Gaussian of its variance, 1/12 px^2; where there is little
    else, a straight edge along rows or columns is up to 0.06 px beside where it seems to be.
    """
    optics = max(0.0, blur_px**2 - 1.0 / 12.0)
    return _STAIRCASE_PX * max(0.0, 1.0 - optics / _STAIRCASE_VARIANCE)


def _detections(
    markers: list[_Marker],
    lens: Lens,
    settings: MarkerSettings,
    candidates: list[Candidate],
    rejected: Counter[str],
    masks: list[Mask],
) -> MarkerDetections:
    """The markers in the image as it is, by ID, then from left to right."""
    markers = sorted(markers, key=lambda m: (m.id, m.corners[0, 0], m.corners[0, 1]))
    count = len(markers)
    corners, covariance = np.empty((count, 4, 2)), np.empty((count, 4, 2, 2))
    for n, marker in enumerate(markers):
        corners[n] = _bent(marker.corners, lens)
        systematic = np.hypot(settings.systematic_px, _staircase_px(marker.blur_px))
        for k in range(4):
            jacobian = lens.pixel_jacobian(corners[n, k])
            part = marker.covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
            covariance[n, k] = jacobian @ part @ jacobian.T + systematic**2 * np.eye(2)
    return MarkerDetections(
        dictionary=settings.dictionary,
        ids=np.array([m.id for m in markers], dtype=np.int64),
        corners=corners,
        covariance=covariance,
        quality=np.array([max(0.0, 1.0 - m.identity.distance) for m in markers]),
        margin=np.array([m.identity.margin for m in markers]),
        explained=np.array([m.explained for m in markers]),
        candidates=tuple(candidates),
        rejected=+rejected,
        masks=tuple(masks),
    )
