"""Compiled: which maxima of the quality are candidates, and where their fits start.

Rows of arrays are never taken as arrays of their own here: their references would be counted.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.model import F32
from detect.discs.patch import floor_steps, padded
from detect.discs.quality_kernels import suppress_neighbours

#: Candidates of a lower quality than this are kept only if the grey value steps in this share
#: of the directions, by this share of the contrast.
CLEAR_QUALITY = 0.55
_LEAST_STEPS = 0.9
_LEAST_STEP = 0.25
_DIRECTIONS = np.array([[math.cos(k * math.pi / 8), math.sin(k * math.pi / 8)] for k in range(16)])


@njit(cache=True, error_model="numpy", nogil=True)
def strong_and_alone(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
) -> NDArray[np.int64]:
    """Which of the best centres have at least the contrast `weakest`, and no better one nearby.

    Parameters
    ----------
    pixels, quality, contrast : (N, 2) int64, (N,) float64, (N,) float32
        See `detect.discs.centres.best_centres`.
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    weakest : float
        Grey levels.
    separation : float
        Of centres closer than this on the floor the one of the highest quality stays, metres.

    Returns
    -------
    (M,) int64
        Indices, ascending.
    """
    index = np.flatnonzero(np.abs(contrast) >= weakest)
    place = np.empty((len(index), 2))
    for k in range(len(index)):
        i = index[k]
        u, v = pixels[i, 0], pixels[i, 1]
        place[k, 0] = floor_xy[v, u, 0]
        place[k, 1] = floor_xy[v, u, 1]
    return index[suppress_neighbours(place, quality[index], separation)]


@njit(cache=True, error_model="numpy", nogil=True)
def middles(
    pixels: NDArray[np.int64],
    quality: NDArray[np.float64],
    contrast: NDArray[np.float32],
    floor_xy: NDArray[np.float32],
    weakest: float,
    separation: float,
    keep: NDArray[np.int64],
) -> NDArray[np.int64]:
    """In the middle of which pixels of the same disc each best centre lies.

    A large disc has many best centres, and which of them is the very best is up to the noise: a fit
    that starts beside the disc's middle may be given up.

    Parameters
    ----------
    pixels, quality, contrast, floor_xy, weakest, separation
        As in `strong_and_alone`.
    keep : (M,) int64
        What that returned.

    Returns
    -------
    (M, 2) int64
        Pixels (u, v): the means of the centres of at least the contrast `weakest`, and of the same
        sign, within the separation, weighed by quality squared and contrast.
    """
    strong = np.flatnonzero(np.abs(contrast) >= weakest)
    # Looked up once: there are as many pairs as centres, squared.
    centres = np.zeros((5, padded(len(strong))), np.float32)
    for m in range(len(strong)):
        i = strong[m]
        u, v = pixels[i, 0], pixels[i, 1]
        centres[0, m] = floor_xy[v, u, 0]
        centres[1, m] = floor_xy[v, u, 1]
        centres[2, m] = quality[i] * quality[i] * contrast[i]
        centres[3, m] = u
        centres[4, m] = v
    middle = np.empty((len(keep), 2), np.int64)
    near = F32(separation * separation)
    for k in range(len(keep)):
        u, v = pixels[keep[k], 0], pixels[keep[k], 1]
        along_u, along_v = _mean_offset(
            centres, floor_xy[v, u, 0], floor_xy[v, u, 1], contrast[keep[k]], F32(u), F32(v), near
        )
        middle[k, 0] = u + round(along_u)
        middle[k, 1] = v + round(along_v)
    return middle


@njit(cache=True, error_model="numpy", nogil=True)
def _mean_offset(
    centres: NDArray[np.float32],
    x0: float,
    y0: float,
    sign: float,
    u0: float,
    v0: float,
    near: float,
) -> tuple[float, float]:
    """By how much the weighed mean of the pixels near a place is off one; 0 where there are none.

    Rows of `centres` are their x, y, weight, u and v. `near` is a distance squared. Weights of
    another sign than `sign` do not count.
    """
    zero = F32(0.0)
    total = zero
    sum_u = zero
    sum_v = zero
    # All pairs alike, without branches: so several are worked on at a time.
    for m in range(centres.shape[1]):
        dx = centres[0, m] - x0
        dy = centres[1, m] - y0
        weight = centres[2, m]
        counts = (dx * dx + dy * dy < near) & (weight * sign >= zero)
        share = abs(weight) if counts else zero
        total += share
        sum_u += share * (centres[3, m] - u0)
        sum_v += share * (centres[4, m] - v0)
    if total > zero:
        return sum_u / total, sum_v / total
    return zero, zero


@njit(cache=True, error_model="numpy", forceinline=True)
def nearest_pixel(
    floor_xy: NDArray[np.float32], u: int, v: int, x: float, y: float
) -> tuple[int, int]:
    """The pixel that sees the floor nearest to (x, y), starting from one nearby."""
    height, width = floor_xy.shape[:2]
    for _ in range(3):
        u = min(max(u, 1), width - 2)
        v = min(max(v, 1), height - 2)
        xu = 0.5 * (floor_xy[v, u + 1, 0] - floor_xy[v, u - 1, 0])
        yu = 0.5 * (floor_xy[v, u + 1, 1] - floor_xy[v, u - 1, 1])
        xv = 0.5 * (floor_xy[v + 1, u, 0] - floor_xy[v - 1, u, 0])
        yv = 0.5 * (floor_xy[v + 1, u, 1] - floor_xy[v - 1, u, 1])
        area = xu * yv - xv * yu
        dx = x - floor_xy[v, u, 0]
        dy = y - floor_xy[v, u, 1]
        du = (yv * dx - xv * dy) / area
        dv = (xu * dy - yu * dx) / area
        if not (abs(du) < width and abs(dv) < height):
            return u, v
        if abs(du) <= 0.5 and abs(dv) <= 0.5:
            return u, v
        u += round(du)
        v += round(dv)
    return min(max(u, 1), width - 2), min(max(v, 1), height - 2)


@njit(cache=True, error_model="numpy", nogil=True)
def share_of_steps(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u0: int,
    v0: int,
    inner: float,
    outer: float,
    contrast: float,
) -> float:
    """In what share of directions the grey value steps from a small circle to a large one.

    Clutter (an edge, a corner, texture) can part the grey values of the two circles nearly as well
    as a disc does, but it does so on some sides only.

    Parameters
    ----------
    image : (H, W) uint8
    floor_xy : (H, W, 2) float32
        Floor position of each pixel, metres.
    u0, v0 : int
        The circles' centre.
    inner, outer : float
        Radii, metres: on the floor, which is taken to be seen as a plane by parallel rays.
    contrast : float
        Grey levels inside minus outside; a step of the same sign and a quarter of that counts.

    Returns
    -------
    float
        Of the directions in which both circles are in the image; 1 if there are none.
    """
    height, width = image.shape
    xu, yu, xv, yv = floor_steps(floor_xy, u0, v0)
    area = xu * yv - xv * yu
    if not abs(area) > 0.0:
        return 1.0
    per_area = 1.0 / area
    seen = 0
    steps = 0
    for k in range(len(_DIRECTIONS)):
        x, y = _DIRECTIONS[k, 0], _DIRECTIONS[k, 1]
        du = (yv * x - xv * y) * per_area
        dv = (xu * y - yu * x) * per_area
        # Half a pixel up, and rounded down: nearest pixels.
        u1 = math.floor(u0 + inner * du + 0.5)
        v1 = math.floor(v0 + inner * dv + 0.5)
        u2 = math.floor(u0 + outer * du + 0.5)
        v2 = math.floor(v0 + outer * dv + 0.5)
        if min(u1, u2, v1, v2) < 0 or max(u1, u2) >= width or max(v1, v2) >= height:
            continue
        seen += 1
        difference = float(image[v1, u1]) - float(image[v2, u2])
        steps += 1 if difference * contrast > _LEAST_STEP * contrast * contrast else 0
    return steps / seen if seen > 0 else 1.0


@njit(cache=True, error_model="numpy", nogil=True)
def worth_a_look(
    image: NDArray[np.uint8],
    floor_xy: NDArray[np.float32],
    u: int,
    v: int,
    quality: float,
    contrast: float,
    inner: float,
    outer: float,
) -> bool:
    """Whether a candidate's quality is clear, or the grey value steps on most sides.

    Parameters are those of `share_of_steps`.
    """
    if quality >= CLEAR_QUALITY:
        return True
    steps = share_of_steps(image, floor_xy, u, v, inner, outer, contrast)
    return bool(steps >= _LEAST_STEPS)
