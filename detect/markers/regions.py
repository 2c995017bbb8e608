"""Phase 2, first part: selects dark regions that may be markers, by inexpensive measures.

RAWSEEDS deliverable D2.1 part 2: area, number of holes, solidity, share of the holes; the cheapest
first. OpenCV labels and outlines the regions.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.markers.candidates import Mask
from detect.markers.dictionaries import MarkerDictionary
from detect.markers.polygon_kernels import pixel_area
from detect.markers.settings import MarkerSettings

FloatArray = NDArray[np.float64]

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
#: Holes of fewer pixels are noise.
_LEAST_HOLE_PX = 1


@dataclass(frozen=True)
class Region:
    """A dark region that may be a marker.

    Attributes
    ----------
    scale : int
        Pixels of the image per pixel of the layer that it was found in.
    threshold : float
        That of its mask.
    hull : (N, 2) float64
        Convex hull of its pixels' centres, pixels (u, v) of the image.
    area_px : float
        Its area with its holes filled, pixels of the image.
    holes : int
        How many.
    solidity : float
        Area over that of the convex hull.
    """

    scale: int
    threshold: float
    hull: FloatArray
    area_px: float
    holes: int
    solidity: float


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
        regions.append(
            Region(
                scale=scale,
                threshold=mask.threshold,
                hull=scale * (hull + corner) + 0.5 * (scale - 1),
                area_px=area * scale**2,
                holes=len(contours) - 1,
                solidity=solidity,
            )
        )
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
