"""The pixels to which a disc is fitted, with the floor that they see, and what shape they have.

A patch is a flat array of rows of `CAPACITY` values each. Discs that are large against the blur
become a list of pixels: all of those near the edge, which tell where it is, and some of the others,
which tell the grey levels. Flat discs become a grid, line by line across the steep image axis, with
a margin at the lines' ends; pixels of the grid that are not to be fitted have the weight zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model_kernels import (
    CAPACITY,
    GEOMETRY,
    PIXEL_VARIANCE,
)

#: Rows of what the fit knows of each pixel besides the geometry: the terms of the background (1, x,
#: y, x^2 - y^2, x y), the grey value, how many pixels it stands for in the explained variance (0
#: where it is too far from the disc to speak for or against it), and whether the pixel before it
#: is its neighbour. All are zero where the grid has a pixel that is not fitted.
ONE, PLANE_X, PLANE_Y, SADDLE, SADDLE_XY, GREY, NEAR, LINKED = range(8)
TERMS = 8

#: Loops work on this many pixels at a time, or on single ones: a list is filled up with pixels far
#: from the disc whose terms are zero.
WHOLE = 32

#: A patch's shape: a list of pixels, lines of constant v, or lines of constant u.
LIST, ROWS, COLUMNS = range(3)

#: The edge of a disc's flattest end may be this curved, in units of the blur; and its smaller half
#: axis is at least so many deviations of the blur. Else it is seen flat.
_MOST_CURVED = 0.25
_LEAST_HALF_AXIS = 4.0
#: Pixels within this many radii, or this near to the edge, count in the explained variance.
NEAR_RADII = 1.45
NEAR_PX = 2.0


class FitSettings(NamedTuple):
    """What the fit is told, apart from the image and the candidates."""

    noise: float
    """Standard deviation of the noise, grey levels."""
    reach_radii: float
    """Pixels within this many radii of the candidate are fitted,"""
    reach_px: float
    """and those this near to the disc's edge, pixels,"""
    reach_blurs: float
    """or this many standard deviations of the blur."""
    radius_sigma: float
    """Standard deviation of the radius about the nominal one, relative."""
    blur_px: float
    """The blur about which the fitted one lies (along u), pixels,"""
    blur_sigma: float
    """and the standard deviation of its logarithm."""
    blur_ratio: float
    """Blur along v over blur along u, in pixels: 0.5 in single fields of interlaced frames."""


class Patch(NamedTuple):
    """The pixels of one candidate, and working space."""

    geometry: NDArray[np.float32]
    """(GEOMETRY * CAPACITY,): see `detect.discs.model_kernels`."""
    terms: NDArray[np.float32]
    """(TERMS * CAPACITY,)"""
    floor: NDArray[np.float32]
    """(2 * CAPACITY,): working space of the gathering."""
    pixels: NDArray[np.uint32]
    """(2 * CAPACITY,): a list's pixels, and how many each stands for."""
    marks: NDArray[np.uint8]
    """(CAPACITY,): working space of the gathering, for one row of the image."""
    mark_words: NDArray[np.uint64]
    """(CAPACITY / 8,): the same, eight at a time."""


#: Sizes of the arrays that `patch_in` takes.
PATCH_MEMORY = (GEOMETRY + TERMS + 2) * CAPACITY
PATCH_INDICES = 2 * CAPACITY


@njit(cache=True, error_model="numpy", forceinline=True)
def patch_in(
    memory: NDArray[np.float32], indices: NDArray[np.uint32], marks: NDArray[np.uint8]
) -> Patch:
    """A patch in arrays of at least the sizes above, float32 and uint32, and `CAPACITY` uint8."""
    terms = GEOMETRY * CAPACITY
    floor = terms + TERMS * CAPACITY
    return Patch(
        memory[:terms],
        memory[terms:floor],
        memory[floor:PATCH_MEMORY],
        indices,
        marks,
        marks.view(np.uint64),
    )


@njit(cache=True, error_model="numpy")
def new_patch() -> Patch:
    """An empty patch."""
    return patch_in(
        np.zeros(PATCH_MEMORY, np.float32),
        np.zeros(PATCH_INDICES, np.uint32),
        np.zeros(CAPACITY, np.uint8),
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def padded(n: int) -> int:
    """So many pixels, rounded up to what loops work on at once."""
    return (n + WHOLE - 1) // WHOLE * WHOLE


@njit(cache=True, error_model="numpy", forceinline=True)
def view_of(
    floor_xy: NDArray[np.float32], u0: int, v0: int, radius: float, blur: float, ratio: float
) -> tuple[int, float, float, float]:
    """How a disc at a pixel is seen if the blur is `blur`.

    Returns the shape of patch that it wants, how many pixels along u and v one radius can be at
    most, and the area of floor per pixel in squared radii (zero if the pixel sees no floor).
    """
    height, width = floor_xy.shape[:2]
    u1 = min(max(u0, 1), width - 2)
    v1 = min(max(v0, 1), height - 2)
    scale = 0.5 / radius
    xu = scale * (floor_xy[v1, u1 + 1, 0] - floor_xy[v1, u1 - 1, 0])
    yu = scale * (floor_xy[v1, u1 + 1, 1] - floor_xy[v1, u1 - 1, 1])
    xv = scale * (floor_xy[v1 + 1, u1, 0] - floor_xy[v1 - 1, u1, 0])
    yv = scale * (floor_xy[v1 + 1, u1, 1] - floor_xy[v1 - 1, u1, 1])
    area = abs(xu * yv - xv * yu)
    if not area > 1e-10:
        return LIST, 0.0, 0.0, 0.0
    along_u = math.hypot(xv, yv) / area
    along_v = math.hypot(xu, yu) / area
    # In the metric in which the blur is round, the ellipse has the half axes a and b = D / a.
    variance_u = blur * blur + PIXEL_VARIANCE
    variance_v = blur * blur * ratio * ratio + PIXEL_VARIANCE
    uu = variance_u * (xu * xu + yu * yu)
    vv = variance_v * (xv * xv + yv * yv)
    uv = math.sqrt(variance_u * variance_v) * (xu * xv + yu * yv)
    steepest = 0.5 * (uu + vv) + math.hypot(0.5 * (uu - vv), uv)
    flattest = variance_u * variance_v * area * area / steepest
    b = 1.0 / math.sqrt(steepest)
    a = 1.0 / math.sqrt(flattest)
    shape = LIST
    if a > _MOST_CURVED * b * b or b < _LEAST_HALF_AXIS:
        shape = ROWS if along_v <= along_u else COLUMNS
    return shape, along_u, along_v, area
