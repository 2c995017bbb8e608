"""Phase 3, first part: edges and corners with sub-pixel precision.

Each edge of the rough quadrangle is fitted to the image itself (`detect.markers.edges`).
Intersections of the edges are the refined corners; their covariance follows from the edges'.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.edges import EdgeFits, EdgeSearch, fit_edges
from detect.markers.lens import Picture
from detect.markers.quadrangle import is_convex

FloatArray = NDArray[np.float64]

#: Causes of rejection, as they are counted.
NO_EDGE = "edge not found"

_PASSES = 3
_CLOSE_ENOUGH_PX = 0.05
_FIRST_BLUR_PX = 0.9
#: Pixels per edge in the first pass, and later.
_FIRST_PIXELS = 100
_MOST_PIXELS = 1500
#: Pixels per edge in later passes if the edges are not the last word.
_QUICK_PIXELS = 250
_QUICK_PASSES = 2
#: Steps that end a fit's iteration, in these passes and in the last.
_ROUGHLY_PX = 0.02
_EXACTLY_PX = 0.002
#: In the last passes an edge is searched within this many of its blurs, and this many pixels.
_REACH_BLURS = 2.5
_REACH_PX = 0.8
#: With fewer rows of pixels on each side than that there would be more unknowns than rows.
_LEAST_REACH_PX = 2.2
#: Corners that move farther than this (in capture ranges) left their quadrangle.
_LARGEST_MOVE = 2.5


class RefinedQuadrangle(NamedTuple):
    """A quadrangle whose edges were fitted.

    Attributes
    ----------
    corners : (4, 2) float64
        Straight pixels, clockwise as seen in the image; edge k goes from corner k to k + 1.
    covariance : (4, 2, 2) float64
        Of each corner, from its two edges, pixels squared.
    edges : EdgeFits
        Grey levels, blur and support of each edge.
    """

    corners: FloatArray
    covariance: FloatArray
    edges: EdgeFits


def refine_quadrangle(
    picture: Picture,
    rough: FloatArray,
    *,
    capture_px: float,
    border: float,
    quick: bool = False,
) -> RefinedQuadrangle | None:
    """Fit the edges of a quadrangle to the image.

    Parameters
    ----------
    picture : Picture
        The image.
    rough : (4, 2) float64
        Rough corners, straight pixels, clockwise as seen in the image.
    capture_px : float
        How far edges may be from the rough ones.
    border : float
        Thickness of the marker's black border, in its widths.
    quick : bool
        Use few pixels and two passes: enough to begin the fit of the whole marker with.

    Returns
    -------
    RefinedQuadrangle or None
        None if an edge is not there, or the edges make no convex quadrangle near the rough one.
    """
    corners = np.ascontiguousarray(rough, dtype=np.float64)
    covariance = np.empty((4, 2, 2))
    edges = EdgeFits(*np.empty((len(EdgeFits._fields), 4)))
    capture, blur = capture_px, _FIRST_BLUR_PX
    pixels = _QUICK_PIXELS if quick else _MOST_PIXELS
    for attempt in range(_QUICK_PASSES if quick else _PASSES):
        search = EdgeSearch(
            capture, border, blur,
            _FIRST_PIXELS if attempt == 0 else pixels,
            _ROUGHLY_PX if quick or attempt == 0 else _EXACTLY_PX,
        )  # fmt: skip
        refined = np.empty((4, 2))
        if not fit_edges(picture, corners, search, edges):
            return None
        if not _intersect(corners, edges, refined, covariance):
            return None
        if np.abs(refined - rough).max() > _LARGEST_MOVE * capture_px or not is_convex(refined):
            return None
        moved = float(np.abs(refined - corners).max())
        corners = refined
        blur = float(np.clip(np.median(edges.blur), 0.3, 6.0))
        capture = max(_REACH_BLURS * blur + _REACH_PX, _LEAST_REACH_PX)
        if attempt > 0 and moved < _CLOSE_ENOUGH_PX:
            break
    return RefinedQuadrangle(corners, covariance, edges)


@njit(cache=True, error_model="numpy")
def _intersect(
    corners: FloatArray,
    edges: EdgeFits,
    refined: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Intersections of the fitted edges (4, 2), and their covariances (4, 2, 2) in pixels squared.

    The edges' offsets are relative to the lines between `corners`. Returns whether all intersect.
    """
    normal = np.empty((4, 2))
    level = np.empty(4)
    for k in range(4):
        p0 = corners[k]
        p1 = corners[(k + 1) % 4]
        length = math.hypot(p1[0] - p0[0], p1[1] - p0[1])
        tx, ty = (p1[0] - p0[0]) / length, (p1[1] - p0[1]) / length
        # Outward normal (ty, -tx); the fitted line runs through the shifted ends.
        b0 = edges.offset[k] - edges.turn[k]
        b1 = edges.offset[k] + edges.turn[k]
        ax, ay = p0[0] + b0 * ty, p0[1] - b0 * tx
        bx, by = p1[0] + b1 * ty, p1[1] - b1 * tx
        span = math.hypot(bx - ax, by - ay)
        normal[k, 0] = (by - ay) / span
        normal[k, 1] = -(bx - ax) / span
        level[k] = normal[k, 0] * ax + normal[k, 1] * ay
    for k in range(4):
        j = (k + 3) % 4
        determinant = normal[j, 0] * normal[k, 1] - normal[j, 1] * normal[k, 0]
        if abs(determinant) < 0.05:
            return False
        x = (level[j] * normal[k, 1] - level[k] * normal[j, 1]) / determinant
        y = (normal[j, 0] * level[k] - normal[k, 0] * level[j]) / determinant
        refined[k, 0] = x
        refined[k, 1] = y
        # Each line's variance at the corner moves it along the other line.
        covariance[k] = 0.0
        for which in range(2):
            e = j if which == 0 else k
            o = k if which == 0 else j
            q0 = corners[e]
            q1 = corners[(e + 1) % 4]
            length = math.hypot(q1[0] - q0[0], q1[1] - q0[1])
            s = ((x - q0[0]) * (q1[0] - q0[0]) + (y - q0[1]) * (q1[1] - q0[1])) / length / (
                0.5 * length
            ) - 1.0
            variance = edges.var_offset[e] + 2.0 * s * edges.covar[e] + s * s * edges.var_turn[e]
            mx = normal[o, 1] / determinant
            my = -normal[o, 0] / determinant
            covariance[k, 0, 0] += variance * mx * mx
            covariance[k, 0, 1] += variance * mx * my
            covariance[k, 1, 1] += variance * my * my
        covariance[k, 1, 0] = covariance[k, 0, 1]
    return True
