"""The rim of a disc, direction by direction: how much of one circle of the right size is in view.

The fit of a whole disc (`detect.discs.fit_kernels`) explains every grey value near it, so that a
door's edge before the disc, a cable across it or a sheet of paper beside it speaks against the
disc. A person follows the rim instead: where it is in view it lies on one circle of known size, and
elsewhere something hides it. So does this module. From the middle of a candidate the grey value is
followed outwards on the floor in `DIRECTIONS` directions. In each, the rim is where the grey value
changes most from the disc's to the floor's. A circle is fitted to these points by least squares,
those that are not on it are left out, and the fit is repeated until the points on it stay the same
(from several starts, for what hides the disc has moved the middle).

The source of the idea is the circle that a minority of points cannot move: M. A. Fischler and
R. C. Bolles, Random Sample Consensus, CACM 24 (1981). Points are few and starts are near, so that
fixed starts serve as well as random samples, and give the same answer every time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import project_floor_point

#: Directions in which the rim is searched, and steps along each of them.
DIRECTIONS = 32
STEPS = 32
#: Where the search along a direction begins and ends, in nominal radii.
NEAREST, FARTHEST = 0.35, 1.65
#: A step of the grey value counts from this share of the disc's contrast on.
LEAST_STEP = 0.35
#: A point is on the circle within this share of the radius, and this many pixels.
TOLERANCE_RADII, TOLERANCE_PX = 0.04, 0.4
#: Of the radius about the nominal one, relative: the calibrated height may be off by some percent.
RADIUS_SIGMA = 0.06
#: Standard deviation of a point of the rim along its direction, pixels.
POINT_SIGMA_PX = 0.25
#: How far the starts of the circle are from the candidate, nominal radii.
_START = 0.3
_ITERATIONS = 8

_ANGLES = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
_COS, _SIN = np.cos(_ANGLES), np.sin(_ANGLES)
#: Weights of a parabola's beginning, middle and end at the steps.
_SHARES = np.linspace(NEAREST, FARTHEST, STEPS) / FARTHEST
_BEGIN, _MIDDLE, _END = (
    (1.0 - _SHARES) * (1.0 - 2.0 * _SHARES),
    4.0 * _SHARES * (1.0 - _SHARES),
    _SHARES * (2.0 * _SHARES - 1.0),
)


class Rim(NamedTuple):
    """What is known of the rim of a candidate; lengths are in nominal radii."""

    agreeing: float
    """Share of all directions in which the rim lies on the circle."""
    visible: float
    """Share of all directions in which the circle lies in the image."""
    runs: int
    """Stretches of two and more neighbouring directions in which it is not on the circle."""
    scatter: float
    """Root mean square distance of the points on the circle from it, in tolerances."""
    unevenness: float
    """Standard deviation of the step over the directions on the circle, relative to its mean."""
    step: float
    """Mean step of the grey value on the circle (grey levels, inside minus outside)."""
    x: float
    """Centre on the floor, metres."""
    y: float
    radius: float
    """Metres."""
    cov_xx: float
    """Covariance of the centre from the scatter of the points, square metres."""
    cov_xy: float
    cov_yy: float
    radius_px: float
    """Geometric mean of the radius over the directions, pixels."""


@njit(cache=True, error_model="numpy", nogil=True)
def profiles(
    image: NDArray[np.uint8], camera_numbers: NDArray[np.float64], x: float, y: float, radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Grey values along the directions from a point of the floor.

    Parameters
    ----------
    image : (H, W) uint8
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    x, y, radius : float
        Where the directions begin, and the nominal radius, metres.

    Returns
    -------
    grey : (DIRECTIONS, STEPS) float64
        NaN outside the image.
    pixels_per_radius : (DIRECTIONS,) float64
        Length of a radius in the image in each direction, pixels.
    """
    grey = np.full((DIRECTIONS, STEPS), np.nan)
    scale = np.ones(DIRECTIONS)
    u0, v0 = project_floor_point(camera_numbers, x, y)
    half = 0.5 * FARTHEST
    right, bottom = image.shape[1] - 1.0, image.shape[0] - 1.0
    for k in range(DIRECTIONS):
        # The image of a direction is a parabola to well below a tenth of a pixel.
        dx, dy = radius * _COS[k], radius * _SIN[k]
        u1, v1 = project_floor_point(camera_numbers, x + half * dx, y + half * dy)
        u2, v2 = project_floor_point(camera_numbers, x + FARTHEST * dx, y + FARTHEST * dy)
        scale[k] = math.hypot(u1 - u0, v1 - v0) / half
        for m in range(STEPS):
            u = _BEGIN[m] * u0 + _MIDDLE[m] * u1 + _END[m] * u2
            v = _BEGIN[m] * v0 + _MIDDLE[m] * v1 + _END[m] * v2
            if 0.0 <= u < right and 0.0 <= v < bottom:
                i, j = np.int32(u), np.int32(v)
                a, b = np.float32(u - i), np.float32(v - j)
                upper = image[j, i] + a * (np.float32(image[j, i + 1]) - image[j, i])
                lower = image[j + 1, i] + a * (np.float32(image[j + 1, i + 1]) - image[j + 1, i])
                grey[k, m] = upper + b * (lower - upper)
    return grey, scale


@njit(cache=True, error_model="numpy", nogil=True)
def rim_points(
    grey: NDArray[np.float64], pixels_per_radius: NDArray[np.float64], contrast: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where along each direction the grey value changes most from the disc's to the floor's.

    Parameters
    ----------
    grey, pixels_per_radius
        Of `profiles`.
    contrast : float
        Grey levels inside minus outside.

    Returns
    -------
    distance : (DIRECTIONS,) float64
        From the middle, nominal radii; NaN where no step reaches `LEAST_STEP` of the contrast.
    step : (DIRECTIONS,) float64
        The step there, grey levels.
    """
    distance = np.full(DIRECTIONS, np.nan)
    step = np.zeros(DIRECTIONS)
    per_step = (FARTHEST - NEAREST) / (STEPS - 1)
    sign = 1.0 if contrast > 0.0 else -1.0
    change = np.empty(STEPS)
    for k in range(DIRECTIONS):
        # The step is taken over two pixels, and at least over a sixth of the radius.
        reach = max(2, round(1.0 / (pixels_per_radius[k] * per_step)))
        reach = min(reach, STEPS // 4)
        best = -1
        for m in range(STEPS):
            change[m] = -math.inf
            if reach <= m < STEPS - reach:
                value = sign * (grey[k, m - reach] - grey[k, m + reach])
                if value == value:
                    change[m] = value
                    if best < 0 or value > change[best]:
                        best = m
        if best < 0 or change[best] < LEAST_STEP * abs(contrast):
            continue
        shift = 0.0
        if 0 < best < STEPS - 1:
            before, after = change[best - 1], change[best + 1]
            bend = 2.0 * change[best] - before - after
            if 0.0 < bend < math.inf:
                shift = min(max(0.5 * (after - before) / bend, -0.5), 0.5)
        distance[k] = NEAREST + (best + shift) * per_step
        step[k] = sign * change[best]
    return distance, step


@njit(cache=True, error_model="numpy", nogil=True)
def invert(a: NDArray[np.float64], inverse: NDArray[np.float64]) -> None:
    """Invert a symmetric 3x3 matrix by its cofactors."""
    for i in range(3):
        for j in range(3):
            p, q = (i + 1) % 3, (i + 2) % 3
            r, s = (j + 1) % 3, (j + 2) % 3
            inverse[j, i] = a[p, r] * a[q, s] - a[p, s] * a[q, r]
    determinant = a[0, 0] * inverse[0, 0] + a[0, 1] * inverse[1, 0] + a[0, 2] * inverse[2, 0]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant


@njit(cache=True, error_model="numpy", nogil=True)
def _circle_of(
    distance: NDArray[np.float64],
    weight: NDArray[np.float64],
    on: NDArray[np.bool_],
    circle: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> None:
    """One Gauss-Newton step of centre and radius to the points that are on the circle."""
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    prior = 1.0 / RADIUS_SIGMA**2
    normal[2, 2] = prior
    right[2] = prior * (1.0 - circle[2])
    for k in range(DIRECTIONS):
        if on[k]:
            px = distance[k] * _COS[k] - circle[0]
            py = distance[k] * _SIN[k] - circle[1]
            d = math.hypot(px, py)
            row = (px / d, py / d, 1.0)
            for i in range(3):
                right[i] += weight[k] * row[i] * (d - circle[2])
                for j in range(3):
                    normal[i, j] += weight[k] * row[i] * row[j]
    normal[0, 0] += 1e-9
    normal[1, 1] += 1e-9
    invert(normal, covariance)
    for i in range(3):
        move = 0.0
        for j in range(3):
            move += covariance[i, j] * right[j]
        circle[i] += min(max(move, -0.3), 0.3)


@njit(cache=True, error_model="numpy", nogil=True)
def _on_circle(
    distance: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    circle: NDArray[np.float64],
    on: NDArray[np.bool_],
) -> int:
    """Mark the points on the circle; how many there are."""
    count = 0
    for k in range(DIRECTIONS):
        px = distance[k] * _COS[k] - circle[0]
        py = distance[k] * _SIN[k] - circle[1]
        on[k] = abs(math.hypot(px, py) - circle[2]) < tolerance[k]
        count += on[k]
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def follow_rim(
    image: NDArray[np.uint8],
    camera_numbers: NDArray[np.float64],
    x: float,
    y: float,
    radius: float,
    contrast: float,
) -> Rim:
    """Follow the rim of a candidate.

    Parameters
    ----------
    image : (H, W) uint8
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    x, y : float
        About the middle of the candidate, metres.
    radius : float
        Nominal radius, metres.
    contrast : float
        About how much lighter the disc is than the floor, grey levels.

    Returns
    -------
    Rim
        With nothing agreeing where there is no circle.
    """
    grey, scale = profiles(image, camera_numbers, x, y, radius)
    distance, step = rim_points(grey, scale, contrast)
    tolerance = TOLERANCE_RADII + TOLERANCE_PX / scale
    weight = (scale / POINT_SIGMA_PX) ** 2
    best = np.zeros(3)
    best_on = np.zeros(DIRECTIONS, np.bool_)
    best_count = 0
    best_covariance = np.zeros((3, 3))
    covariance = np.zeros((3, 3))
    on = np.zeros(DIRECTIONS, np.bool_)
    circle = np.zeros(3)
    for start in range(9):
        circle[0] = 0.0 if start == 0 else _START * _COS[(start - 1) * DIRECTIONS // 8]
        circle[1] = 0.0 if start == 0 else _START * _SIN[(start - 1) * DIRECTIONS // 8]
        circle[2] = 1.0
        count = _on_circle(distance, 2.5 * tolerance, circle, on)
        for i in range(_ITERATIONS):
            if count < 6:
                break
            _circle_of(distance, weight, on, circle, covariance)
            wide = 1.6 if i < 2 else 1.0
            count = _on_circle(distance, wide * tolerance, circle, on)
        if count > best_count:
            best_count = count
            best[:] = circle
            best_on[:] = on
            best_covariance[:, :] = covariance
    radius_px = math.exp(np.mean(np.log(scale)))
    nothing = Rim(0.0, 0.0, 0, 0.0, 0.0, 0.0, x, y, radius, 0.0, 0.0, 0.0, radius_px)
    if best_count < 6:
        return nothing
    height, width = image.shape
    squares = 0.0
    mean = 0.0
    mean_2 = 0.0
    visible = 0
    outside = np.zeros(DIRECTIONS, np.bool_)
    for k in range(DIRECTIONS):
        u, v = project_floor_point(
            camera_numbers,
            x + radius * (best[0] + best[2] * _COS[k]),
            y + radius * (best[1] + best[2] * _SIN[k]),
        )
        inside = 0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0
        visible += inside
        outside[k] = not inside
        if best_on[k]:
            px = distance[k] * _COS[k] - best[0]
            py = distance[k] * _SIN[k] - best[1]
            squares += ((math.hypot(px, py) - best[2]) / tolerance[k]) ** 2
            mean += step[k]
            mean_2 += step[k] ** 2
    mean /= best_count
    mean_2 = max(mean_2 / best_count - mean * mean, 0.0)
    runs = 0
    for k in range(DIRECTIONS):
        # A stretch begins after a direction that agrees, and has two that do not.
        last, following = (k - 1) % DIRECTIONS, (k + 1) % DIRECTIONS
        off = not best_on[k] and not outside[k]
        if off and best_on[last] and not best_on[following]:
            runs += 1
    scatter = math.sqrt(squares / best_count)
    inverse = best_covariance
    scale_2 = radius * radius * max(1.0, squares / best_count * 4.0)
    return Rim(
        best_count / DIRECTIONS, visible / DIRECTIONS, runs, scatter,
        math.sqrt(mean_2) / max(abs(mean), 1e-9), mean,
        x + radius * best[0], y + radius * best[1], radius * best[2],
        inverse[0, 0] * scale_2, inverse[0, 1] * scale_2, inverse[1, 1] * scale_2, radius_px,
    )  # fmt: skip
