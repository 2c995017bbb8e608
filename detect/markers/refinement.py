"""Phase 3, first part: edges and corners with sub-pixel precision.

Each edge of the rough quadrangle is fitted to the image itself: a straight, blurred step between
two grey levels, by robust least squares of all pixels near its expected place except near the
corners. Intersections of the edges are the refined corners; their covariance follows from the
edges'. Everything happens at straight positions (see `detect.markers.lens`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.interrupts import interrupts_deferred_in
from detect.markers.edge_corner_kernels import corners_of_edges
from detect.markers.edge_kernels import EdgeSearch, fit_edges
from detect.markers.lens import Lens
from detect.markers.polygon_kernels import is_convex

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


@dataclass(frozen=True)
class RefinedQuadrangle:
    """A quadrangle whose edges were fitted.

    Attributes
    ----------
    corners : (4, 2) float64
        Straight pixels, clockwise as seen in the image; edge k goes from corner k to k + 1.
    covariance : (4, 2, 2) float64
        Of each corner, from its two edges, pixels squared.
    contrast : (4,) float64
        Step of each edge, from inside to outside, grey levels.
    dark, light : (4,) float64
        Its two levels.
    blur_px : (4,) float64
        Its blur (standard deviation), the pixel's own included.
    rest : (4,) float64
        Standard deviation of what the step leaves over, grey levels.
    pixels : (4,) float64
        How many were used.
    support : (4,) float64
        Share of the edge's length where the step is seen.
    """

    corners: FloatArray
    covariance: FloatArray
    contrast: FloatArray
    dark: FloatArray
    light: FloatArray
    blur_px: FloatArray
    rest: FloatArray
    pixels: FloatArray
    support: FloatArray


def refine_quadrangle(
    image: NDArray[np.uint8],
    lens: Lens,
    rough: FloatArray,
    *,
    capture_px: float,
    border: float,
    noise: float,
    quick: bool = False,
) -> RefinedQuadrangle | None:
    """Fit the edges of a quadrangle to the image.

    Parameters
    ----------
    image : (H, W) uint8
        The image.
    lens : Lens
        Its lens.
    rough : (4, 2) float64
        Rough corners, straight pixels, clockwise as seen in the image.
    capture_px : float
        How far edges may be from the rough ones.
    border : float
        Thickness of the marker's black border, in its widths.
    noise : float
        Standard deviation of the image's noise, grey levels.
    quick : bool
        Use few pixels and two passes: enough to begin the fit of the whole marker with.

    Returns
    -------
    RefinedQuadrangle or None
        None if an edge is not there, or the edges make no convex quadrangle near the rough one.
    """
    corners = np.ascontiguousarray(rough, dtype=np.float64)
    guess = lens.bend(corners.mean(axis=0)[None], corners.mean(axis=0))[0]
    covariance = np.empty((4, 2, 2))
    capture, blur = capture_px, _FIRST_BLUR_PX
    pixels = _QUICK_PIXELS if quick else _MOST_PIXELS
    for attempt in range(_QUICK_PASSES if quick else _PASSES):
        search = EdgeSearch(
            capture, border, blur, noise,
            _FIRST_PIXELS if attempt == 0 else pixels,
            _ROUGHLY_PX if quick or attempt == 0 else _EXACTLY_PX,
        )  # fmt: skip
        with interrupts_deferred_in(fit_edges):
            found, edges = fit_edges(image, lens.grid, lens.step, corners, guess, search)
        if not found:
            return None
        refined = np.empty((4, 2))
        if not corners_of_edges(corners, edges, refined, covariance):
            return None
        if np.abs(refined - rough).max() > _LARGEST_MOVE * capture_px or not is_convex(refined):
            return None
        moved = float(np.abs(refined - corners).max())
        corners = refined
        blur = float(np.clip(np.median(edges.blur), 0.3, 6.0))
        capture = max(_REACH_BLURS * blur + _REACH_PX, _LEAST_REACH_PX)
        if attempt > 0 and moved < _CLOSE_ENOUGH_PX:
            break
    return RefinedQuadrangle(
        corners=corners,
        covariance=covariance,
        contrast=edges.light - edges.dark,
        dark=edges.dark,
        light=edges.light,
        blur_px=edges.blur,
        rest=edges.rest,
        pixels=edges.pixels,
        support=edges.support,
    )
