"""Phases 1 and 2: where the image is dark among brighter surroundings, and what may be a marker.

The grayscale closing I2 of the image I1 with a disc fills everything dark that the disc does not
fit into; where I1 is much darker than I2 is a candidate for (a part of) a marker. Of these regions
inexpensive measures select, the cheapest first: area, number of holes, solidity, share of the
holes. RAWSEEDS deliverable D2.1 part 2. The disc is an octagon here, which two squares and some
crosses make up at a cost that grows little with its size, and large markers are searched in reduced
images; OpenCV labels and outlines the regions.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.dictionaries import MarkerDictionary
from detect.markers.settings import Darkness, MarkerSettings

FloatArray = NDArray[np.float64]
GreyImage = NDArray[np.uint8]

#: A disc of radius r as an octagon: half the side of its square, in r; its crosses do the rest.
_SQUARE_SHARE = math.sqrt(2.0) - 1.0
#: Radius of the disc in the reduced images, their pixels: markers of up to twice this, and mostly
#: more, in each level.
_LEVEL_RADIUS_PX = 12
#: Levels smaller than this hold no marker.
_LEAST_LEVEL_PX = 16
#: Where a width is given, the image is reduced until the disc's radius is no larger.
_LARGEST_GIVEN_RADIUS_PX = 12.0
#: Without a pyramid: radii tried where no width is given.
_PLAIN_RADII_PX = (8, 20, 50)
#: Thresholds below this are applied to a smoothed image.
_SMOOTH_BELOW = 0.2
#: With more noise than this it is smoothed more, grey levels.
_MUCH_NOISE = 2.5

#: Causes of rejection, as they are counted.
AT_THE_BORDER = "at the image's border"
AREA = "area"
HOLES = "number of holes"
SOLIDITY = "solidity"
WHITE_SHARE = "share of holes"

#: A marker seen at a slant of 70 degrees has a third of its area.
_LEAST_FORESHORTENING = 0.3
#: Narrowest bounding box, pixels of the layer.
_LEAST_SIDE_PX = 4
#: If the next level searches larger markers, a region this wide (in radii of the disc) is left to
#: that level.
_WIDEST_RADII = 12.0


@dataclass(frozen=True)
class Layer:
    """An image, possibly reduced, and its closing.

    Attributes
    ----------
    scale : int
        Pixels of the image per pixel of the layer, in both directions.
    radius : int
        Radius of the closing's disc, pixels of the layer.
    grey, closed : (h, w) uint8
        I1 and I2.
    """

    scale: int
    radius: int
    grey: GreyImage
    closed: GreyImage


@dataclass(frozen=True)
class Mask:
    """Where a layer is darker than a threshold: 1 there, 0 elsewhere."""

    layer: Layer
    threshold: float
    dark: GreyImage


def closing(grey: GreyImage, radius: int) -> GreyImage:
    """Grayscale closing with a disc, made an octagon.

    Parameters
    ----------
    grey : (H, W) uint8
        The image.
    radius : int
        Radius of the octagon's corners' circle, pixels.

    Returns
    -------
    (H, W) uint8
    """
    half = round(_SQUARE_SHARE * radius)
    square = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    crosses = radius - half
    result = cv2.dilate(grey, square)
    result = cv2.dilate(result, cross, iterations=crosses)
    result = cv2.erode(result, square)
    return np.asarray(cv2.erode(result, cross, iterations=crosses))


def candidate_layers(image: GreyImage, settings: MarkerSettings) -> tuple[Layer, ...]:
    """The image at the scales to be searched, with its closings.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    settings : MarkerSettings
        ``width_px``, ``disc_widths``, ``pyramid``, ``thresholds``.

    Returns
    -------
    tuple of Layer
        From fine to coarse.
    """
    if not settings.pyramid:
        given = settings.disc_widths * settings.width_px
        radii = (max(2, round(given)),) if settings.width_px else _PLAIN_RADII_PX
        return tuple(Layer(1, radius, image, closing(image, radius)) for radius in radii)
    if settings.width_px:
        wanted = settings.disc_widths * settings.width_px
        scale = 1
        while wanted / scale > _LARGEST_GIVEN_RADIUS_PX:
            scale *= 2
        radius = max(4, math.ceil(wanted / scale))
        levels = [(scale, radius)]
    else:
        scales = [1]
        while min(image.shape) // (2 * scales[-1]) >= _LEAST_LEVEL_PX:
            scales.append(2 * scales[-1])
        levels = [(scale, _LEVEL_RADIUS_PX) for scale in scales]
    reduced = ((scale, radius, _reduced(image, scale)) for scale, radius in levels)
    return tuple(Layer(*level, closing(level[2], level[1])) for level in reduced)


def dark_masks(layer: Layer, noise: float, settings: MarkerSettings) -> tuple[Mask, ...]:
    """Where a layer is dark, for each threshold.

    Parameters
    ----------
    layer : Layer
        The layer.
    noise : float
        Standard deviation of the image's noise, grey levels.
    settings : MarkerSettings
        ``thresholds``, ``darkness``, ``dark_noise``.

    Returns
    -------
    tuple of Mask
    """
    gate = settings.dark_noise * noise / layer.scale
    masks = []
    smooth: Layer | None = None
    for threshold in settings.thresholds:
        source, least = layer, gate
        if layer.scale == 1 and settings.pyramid and threshold < _SMOOTH_BELOW:
            if smooth is None:
                window = (5, 5) if noise > _MUCH_NOISE else (3, 3)
                grey = np.asarray(cv2.GaussianBlur(layer.grey, window, 0), np.uint8)
                smooth = Layer(1, layer.radius, grey, closing(grey, layer.radius))
            source, least = smooth, 0.5 * gate
        dark = dark_pixels(source, threshold, least, settings.darkness)
        masks.append(Mask(source, threshold, dark))
    return tuple(masks)


def dark_pixels(layer: Layer, threshold: float, gate: float, darkness: Darkness) -> GreyImage:
    """1 where a layer is darker than its closing by the threshold and by `gate` grey levels."""
    limit = np.arange(256.0)
    by_threshold = limit * (1.0 - threshold) if darkness == "ratio" else limit - 255.0 * threshold
    # I1 < limit(I2), for whole grey levels; the limit itself is not dark.
    table = np.clip(np.ceil(np.minimum(by_threshold, limit - gate)), 0, 255).astype(np.uint8)
    dark = cv2.compare(layer.grey, cv2.LUT(layer.closed, table), cv2.CMP_LT)
    return np.asarray(dark, np.uint8) & np.uint8(1)


def _reduced(image: GreyImage, scale: int) -> GreyImage:
    """Means over `scale` x `scale` pixels; rows and columns left over are dropped."""
    if scale == 1:
        return image
    height, width = image.shape[0] // scale, image.shape[1] // scale
    whole = image[: height * scale, : width * scale]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


@dataclass(frozen=True)
class Region:
    """A dark region that may be a marker.

    Attributes
    ----------
    scale : int
        Pixels of the image per pixel of the layer that it was found in.
    hull : (N, 2) float64
        Convex hull of its pixels' centres, pixels (u, v) of the image.
    """

    scale: int
    hull: FloatArray


def marker_regions(
    mask: Mask, dictionary: MarkerDictionary, settings: MarkerSettings, *, last: bool
) -> tuple[list[Region], Counter[str]]:
    """Regions of a mask that may be markers.

    Parameters
    ----------
    mask : Mask
        Dark pixels.
    dictionary : MarkerDictionary
        Whose markers' share of white decides how much of a region may be holes.
    settings : MarkerSettings
        ``width_px`` ... ``most_white``.
    last : bool
        Whether there is no coarser layer for large regions.

    Returns
    -------
    regions : list of Region
        In the order of their labels.
    rejected : Counter
        How many were not taken, by cause; the smallest specks are not counted.
    """
    rejected: Counter[str] = Counter()
    scale = mask.layer.scale
    count, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.dark, 8, cv2.CV_32S, cv2.CCL_BBDT
    )
    if count < 2:
        return [], rejected
    left, top, width, height, dark_px = stats[1:].T.astype(np.int64)
    least_px, most_px = _area_limits(settings, scale)
    # A marker's dark part is no less than a third of it, or it is no dark square.
    large = (np.minimum(width, height) >= _LEAST_SIDE_PX) & (dark_px >= 0.3 * least_px)
    inside = (
        (left > 0)
        & (top > 0)
        & (left + width < mask.dark.shape[1])
        & (top + height < mask.dark.shape[0])
    )
    small_enough = dark_px <= most_px
    if not last:
        small_enough &= np.maximum(width, height) <= _WIDEST_RADII * mask.layer.radius
    rejected[AT_THE_BORDER] += int(np.count_nonzero(large & ~inside))
    rejected[AREA] += int(np.count_nonzero(large & inside & ~small_enough))

    white = _white_share(dictionary)
    regions = []
    for k in np.flatnonzero(large & inside & small_enough):
        x, y = int(left[k]) - 1, int(top[k]) - 1
        part = labels[y : y + int(height[k]) + 2, x : x + int(width[k]) + 2] == k + 1
        contours, hierarchy = cv2.findContours(
            part.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
        )
        # The first contour without a parent is the outline; all others are holes.
        outline = contours[0] if hierarchy[0, 0, 3] < 0 else contours[int(hierarchy[0, 0, 3])]
        area = float(pixel_area(outline[:, 0, :]))
        hull = cv2.convexHull(outline)[:, 0, :]
        cause = None
        if not least_px <= area <= most_px:
            cause = AREA
        elif not settings.least_holes <= len(contours) - 1 <= settings.most_holes:
            cause = HOLES
        else:
            hull_area = float(pixel_area(hull))
            solidity = min(1.0, area / hull_area)
            share = max(0.0, area - float(dark_px[k])) / area
            if solidity < settings.least_solidity:
                cause = SOLIDITY
            elif not settings.least_white * white <= share <= min(settings.most_white * white, 0.9):
                cause = WHITE_SHARE
        if cause is not None:
            rejected[cause] += 1
            continue
        corner = np.array([x, y], dtype=np.float64)
        regions.append(Region(scale, scale * (hull + corner) + 0.5 * (scale - 1)))
    return regions, rejected


def _area_limits(settings: MarkerSettings, scale: int) -> tuple[float, float]:
    """Least and greatest area, pixels of the layer."""
    if settings.width_px:
        expected = (settings.width_px / scale) ** 2
        return expected / settings.area_factor, expected * settings.area_factor
    least = settings.least_width_px**2
    # Markers that are small in a reduced image are found in the finer ones.
    return (least if scale == 1 else max(least, 100.0) * _LEAST_FORESHORTENING), math.inf


def _white_share(dictionary: MarkerDictionary) -> float:
    """Mean share of white in the markers' whole area."""
    cells = float(dictionary.patterns.mean()) * dictionary.patterns.shape[-1] ** 2
    return float(cells * dictionary.cell**2)


@njit(cache=True, error_model="numpy")
def pixel_area(polygon: NDArray[np.int32]) -> float:
    """Pixels inside a polygon through pixel centres, those on it included (Pick's theorem).

    Sides between the grid's directions count as the digital lines that they represent.
    """
    total = 0.0
    boundary = 0
    n = len(polygon)
    for k in range(n):
        j = k + 1 if k + 1 < n else 0
        total += polygon[k, 0] * polygon[j, 1] - polygon[j, 0] * polygon[k, 1]
        boundary += max(abs(polygon[k, 0] - polygon[j, 0]), abs(polygon[k, 1] - polygon[j, 1]))
    return 0.5 * abs(total) + 0.5 * boundary + 1.0
