"""Phase 2, second part: rough corners of a region.

RAWSEEDS deliverable D2.1 part 2 has two algorithms. A takes the local maxima of the distance from
the barycentre, and needs exactly four. B takes the quadrangle of largest area in the perimeter, by
coordinate ascent with a decaying random perturbation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from detect.markers.polygon_kernels import signed_area
from detect.markers.quadrangle_kernels import farthest_corners, largest_quadrangle
from detect.markers.settings import CornerAlgorithm

FloatArray = NDArray[np.float64]

#: Causes of rejection, as they are counted.
NOT_FOUR_CORNERS = "not four corners"
NO_QUADRANGLE = "no quadrangle"

_SEED = 20061
#: Algorithm A: corners are this far apart as seen from the barycentre.
_CORNER_SPACING_RAD = math.radians(25.0)
#: Algorithm A: distance of the points along the perimeter, in perimeters.
_CHAIN_STEP = 1.0 / 160.0


def rough_corners(hull: FloatArray, algorithm: CornerAlgorithm) -> FloatArray | None:
    """Four corners of a region.

    Parameters
    ----------
    hull : (N, 2) float64
        The region's convex hull.
    algorithm : "A" or "B"
        See the module.

    Returns
    -------
    (4, 2) float64, or None
        Top left, top right, bottom right, bottom left up to a rotation (clockwise as seen in the
        image); None if there are not exactly four.
    """
    if len(hull) < 4:
        return None
    if algorithm == "B":
        corners = hull[largest_quadrangle(hull, _SEED)]
    else:
        chain = dense_chain(hull)
        index = farthest_corners(chain, _CORNER_SPACING_RAD)
        if len(index) != 4:
            return None
        corners = chain[index]
    return np.ascontiguousarray(corners if signed_area(corners) > 0.0 else corners[::-1])


def dense_chain(hull: FloatArray) -> FloatArray:
    """Points at equal distances along a closed polygon."""
    closed = np.concatenate([hull, hull[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.arange(0.0, 1.0 - 0.5 * _CHAIN_STEP, _CHAIN_STEP) * along[-1]
    # The corners themselves stay: the farthest points are among them.
    at = np.unique(np.concatenate([at, along[:-1]]))
    return np.stack([np.interp(at, along, closed[:, k]) for k in range(2)], axis=-1)
