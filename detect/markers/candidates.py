"""Phases 1 and 2: dark regions in brighter surroundings, and those that may be markers.

The grayscale closing I2 of the image I1 with a disc fills all dark regions that the disc does not
fit into; pixels where I1 is much darker than I2 are candidates for (a part of) a marker. These
regions are filtered by inexpensive measures, the cheapest first: area, number of holes, solidity,
area ratio of the holes. RAWSEEDS deliverable D2.1 part 2. The disc is replaced by an octagon,
composed of squares and crosses at a cost that grows slowly with its size, and large markers are
searched in reduced images.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.markers.dictionaries import MarkerDictionary
from detect.settings import MarkerSettings
from redetect.array_types import FloatArray, GreyImage

_DISC_WIDTHS = 0.5  #: Radius of the closing's disc in marker widths.
#: A disc of radius r as an octagon: half the side of its square, in r; crosses complete it.
_SQUARE_SHARE = math.sqrt(2.0) - 1.0
#: Radius of the disc in the reduced images, in their pixels: each level finds markers of up to
#: twice this, usually more. If a width is given, the image is reduced until the disc is no larger.
_LEVEL_RADIUS_PX = 12
#: Smaller levels are not searched.
_LEAST_LEVEL_PX = 16
#: Dark pixels are darker than the closing by at least this many deviations of the image's noise.
_DARK_SIGMAS = 2.0
#: Thresholds below this are applied to a smoothed image.
_SMOOTH_BELOW = 0.2
#: With more noise than this (grey levels) it is smoothed more.
_MUCH_NOISE = 2.5
#: A seam of white around a marker on a dark ground is bright only beside what is next to it: in the
#: finest layer, pixels darker than the mean of these squares, by this share, are dark, too.
_LOCAL_PX, _LOCAL_THRESHOLD = (5, 13), 0.12

#: Reasons for rejection, as reported.
AT_THE_BORDER = "at the image's border"
AREA = "area"
HOLES = "number of holes"
SOLIDITY = "solidity"
WHITE_SHARE = "share of holes"

#: A candidate's area is within this factor of the expected width squared.
_AREA_FACTOR = 6.0
#: Least area of a candidate, with holes filled, over that of its convex hull.
_LEAST_SOLIDITY = 0.75
#: A marker seen at a slant of 70 degrees has a third of its area.
_LEAST_FORESHORTENING = 0.3
#: Least ratio of a marker's dark area to its whole area.
_LEAST_DARK = 0.3
#: Narrowest bounding box, pixels of the layer.
_LEAST_SIDE_PX = 4
#: Wider regions (in radii of the disc) are left to the next level, if there is one.
_WIDEST_RADII = 12.0


class Layer(NamedTuple):
    """An image reduced by `scale`, and its closing by a disc of `radius` pixels of the layer."""

    scale: int
    radius: int
    grey: GreyImage
    closed: GreyImage


class Region(NamedTuple):
    """A dark region that may be a marker."""

    scale: int  # pixels of the image per pixel of the layer where it was found
    hull: FloatArray  # (N, 2) convex hull of its pixels' centres, pixels of the image


def closing(grey: GreyImage, radius: int) -> GreyImage:
    """Grayscale closing (H, W) uint8 of an image with an octagon in a circle of that radius, px."""
    half = round(_SQUARE_SHARE * radius)
    square = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    result = cv2.dilate(cv2.dilate(grey, square), cross, iterations=radius - half)
    return np.asarray(cv2.erode(cv2.erode(result, square), cross, iterations=radius - half))


def candidate_regions(
    image: GreyImage, noise: float, dictionary: MarkerDictionary, settings: MarkerSettings
) -> tuple[list[Region], Counter[str]]:
    """Regions of an image that may be markers, and counts of rejected regions by reason.

    In order of fine to coarse layers and high to low thresholds; the smallest specks are not
    counted. The limits of a region's holes depend on the white area of the dictionary's markers.
    """
    layers = _layers(image, settings)
    white = float(dictionary.patterns.sum(axis=(1, 2)).mean()) * dictionary.cell**2
    regions: list[Region] = []
    rejected: Counter[str] = Counter()
    for layer in layers:
        widest = math.inf if layer is layers[-1] else _WIDEST_RADII * layer.radius
        for dark in _masks(layer, noise, settings, layer is layers[0]):
            for found in _marker_regions(dark, layer.scale, widest, white, settings):
                if isinstance(found, str):
                    rejected[found] += 1
                else:
                    regions.append(found)
    return regions, rejected


def _layers(image: GreyImage, settings: MarkerSettings) -> list[Layer]:
    """The image at the scales to be searched, from fine to coarse, with its closings."""
    expected = _DISC_WIDTHS * settings.width_px
    scale = 1
    if expected:
        while expected / scale > _LEVEL_RADIUS_PX:
            scale *= 2
        if scale > min(image.shape):
            return []  # the marker is much larger than the image
        levels = [(scale, max(4, math.ceil(expected / scale)))]
    else:
        levels = [(1, _LEVEL_RADIUS_PX)]
        while min(image.shape) // (2 * scale) >= _LEAST_LEVEL_PX:
            scale *= 2
            levels.append((scale, _LEVEL_RADIUS_PX))
    layers = []
    for scale, radius in levels:
        # Means over squares of pixels; remaining rows and columns are dropped.
        height, width = image.shape[0] // scale, image.shape[1] // scale
        grey = np.asarray(image[: height * scale, : width * scale])
        if scale > 1:
            grey = np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA))
        layers.append(Layer(scale, radius, grey, closing(grey, radius)))
    return layers


def _masks(
    layer: Layer, noise: float, settings: MarkerSettings, finest: bool
) -> Iterator[GreyImage]:
    """Masks of dark pixels for each threshold; for low ones, the full image is smoothed first."""
    gate = _DARK_SIGMAS * noise / layer.scale
    plain = smooth = layer.grey, layer.closed
    if layer.scale == 1 and min(settings.thresholds) < _SMOOTH_BELOW:
        window = (5, 5) if noise > _MUCH_NOISE else (3, 3)
        grey = np.asarray(cv2.GaussianBlur(layer.grey, window, 0), np.uint8)
        smooth = grey, closing(grey, layer.radius)
    for threshold in settings.thresholds:
        soft = threshold < _SMOOTH_BELOW and smooth is not plain
        source, least = (smooth, 0.5 * gate) if soft else (plain, gate)
        yield dark_pixels(*source, threshold, least)
    if finest:
        for side in _LOCAL_PX:
            mean = cv2.blur(layer.grey, (side, side))
            yield dark_pixels(layer.grey, np.asarray(mean, np.uint8), _LOCAL_THRESHOLD, gate)


def dark_pixels(grey: GreyImage, closed: GreyImage, threshold: float, gate: float) -> GreyImage:
    """1 where an image is darker than its closing by the threshold and by `gate` grey levels.

    The darkness of I1 under its closing I2 is 1 - I1/I2.
    """
    levels = np.arange(256.0)
    # I1 < limit(I2), for integer grey levels; the limit itself is not dark.
    limit = np.minimum(levels * (1.0 - threshold), levels - gate)
    table = np.clip(np.ceil(limit), 0, 255).astype(np.uint8)
    dark = cv2.compare(grey, cv2.LUT(closed, table), cv2.CMP_LT)
    return np.asarray(dark, np.uint8) & np.uint8(1)


def _marker_regions(
    dark: GreyImage, scale: int, widest: float, white: float, settings: MarkerSettings
) -> Iterator[Region | str]:
    """Dark regions of a layer that may be markers, and the reasons for rejecting the others.

    `white` is the expected share of white area, `widest` the largest side of a region.
    """
    least_px, most_px = _area_limits(settings, scale)
    most_white = min(settings.most_white * white, 0.9)
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    height, width = dark.shape
    for k, outline in enumerate(contours):
        if hierarchy[0, k, 3] >= 0 or len(outline) < 4 * (_LEAST_SIDE_PX - 1):
            continue
        left, top, wide, high = cv2.boundingRect(outline)
        if min(wide, high) < _LEAST_SIDE_PX:
            continue
        # Pick's theorem: pixels inside the outline and on it; for holes, inside only.
        area = cv2.contourArea(outline) + 0.5 * len(outline) + 1.0
        if area < _LEAST_DARK * least_px:
            continue
        if left == 0 or top == 0 or left + wide == width or top + high == height:
            yield AT_THE_BORDER
            continue
        if not least_px <= area <= most_px or max(wide, high) > widest:
            yield AREA
            continue
        holes = []
        child = hierarchy[0, k, 2]
        while child >= 0:
            holes.append(contours[child])
            child = hierarchy[0, child, 0]
        if len(holes) > settings.most_holes:
            yield HOLES
            continue
        hull = np.asarray(cv2.convexHull(outline)[:, 0], np.int32)
        if area < _LEAST_SOLIDITY * pixel_area(hull):
            yield SOLIDITY
            continue
        bright = sum(cv2.contourArea(hole) - 0.5 * len(hole) + 1.0 for hole in holes)
        if bright / area > most_white:
            yield WHITE_SHARE
            continue
        yield Region(scale, np.asarray(scale * hull + 0.5 * (scale - 1), np.float64))


def _area_limits(settings: MarkerSettings, scale: int) -> tuple[float, float]:
    """Least and greatest area, pixels of the layer."""
    if settings.width_px:
        expected = (settings.width_px / scale) ** 2
        return expected / _AREA_FACTOR, expected * _AREA_FACTOR
    least = settings.least_width_px**2
    # Markers that are small in a reduced image are found in finer ones.
    return (least if scale == 1 else max(least, 100.0) * _LEAST_FORESHORTENING), math.inf


def pixel_area(polygon: NDArray[np.int32]) -> float:
    """Number of pixels inside and on a polygon (N, 2) through pixel centres, by Pick's theorem.

    Oblique sides are counted as the digital lines that they represent.
    """
    steps = np.abs(polygon - polygon[np.arange(len(polygon)) - 1]).max(axis=1)
    return float(cv2.contourArea(polygon) + 0.5 * steps.sum() + 1.0)
