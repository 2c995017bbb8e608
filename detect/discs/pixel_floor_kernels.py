"""Compiled: where on the floor pixels are, and the published covariance of such positions.

`camera.model` is the definition; a test holds the two together.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.brown_kernels import straightened_point
from camera.kernels import project_floor_point

#: Newton's method in `camera.distortion` takes at most so many steps, and ends with one this small.
_NEWTON_STEPS = 60
_LAST_STEP = 1e-9


@njit(cache=True, error_model="numpy", nogil=True)
def _factor(coef: NDArray[np.float64], r: float) -> float:
    numerator = r * (coef[0] + r * coef[1])
    factor: float = 1.0 + numerator / (1.0 + r * (coef[2] + r * (coef[3] + r * coef[4])))
    return factor


@njit(cache=True, error_model="numpy", nogil=True)
def _factor_derivative(coef: NDArray[np.float64], r: float) -> float:
    numerator = r * (coef[0] + r * coef[1])
    denominator = 1.0 + r * (coef[2] + r * (coef[3] + r * coef[4]))
    d_numerator = coef[0] + 2.0 * coef[1] * r
    d_denominator = coef[2] + r * (2.0 * coef[3] + 3.0 * coef[4] * r)
    slope: float = d_numerator * denominator - numerator * d_denominator
    slope /= denominator * denominator
    return slope


@njit(cache=True, error_model="numpy", nogil=True)
def undistorted_radius(
    goal: float,
    coef: NDArray[np.float64],
    table_g: NDArray[np.float64],
    table_r: NDArray[np.float64],
) -> float:
    """One radius as by `camera.distortion.undistorted_radius`; NaN where nothing is seen there."""
    last = len(table_g) - 1
    if not 0.0 <= goal <= table_g[last]:
        return math.nan
    upper = min(max(int(np.searchsorted(table_g, goal)), 1), last)
    low, high = table_r[upper - 1], table_r[upper]
    span = table_g[upper] - table_g[upper - 1]
    share = (goal - table_g[upper - 1]) / span if span > 0.0 else 0.0
    return _newton(goal, coef, low + share * (high - low), low, high)


@njit(cache=True, error_model="numpy", nogil=True)
def _newton(goal: float, coef: NDArray[np.float64], start: float, low: float, high: float) -> float:
    """The radius within a bracket, bisecting where a step of Newton's method would leave it."""
    r = start
    for _ in range(_NEWTON_STEPS):
        f = _factor(coef, r)
        error = r * f - goal
        low = r if error <= 0.0 else low
        high = r if error >= 0.0 else high
        newton = r - error / (f + r * _factor_derivative(coef, r))
        newton = r if error == 0.0 else newton
        if abs(newton - r) <= _LAST_STEP * max(1.0, r):
            return min(max(newton, low), high)
        r = newton if low <= newton <= high else 0.5 * (low + high)
    return r


@njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
def _along(pose: NDArray[np.float64], row: int, x: float, y: float) -> float:
    """A coordinate of a pixel's direction, with the rounding of the product of matrices."""
    along: float = (pose[row, 1] * y + pose[row, 0] * x) + pose[row, 2]
    return along


@njit(cache=True, error_model="numpy", nogil=True)
def floor_of_pixel(
    u: float,
    v: float,
    lens: NDArray[np.float64],
    pose: NDArray[np.float64],
    table_g: NDArray[np.float64],
    table_r: NDArray[np.float64],
    near: float,
) -> tuple[float, float, float]:
    """Where the ray of a pixel meets the floor, metres; both NaN where it does not.

    Parameters
    ----------
    u, v : float
        Pixel.
    lens : (15,) float64
        Scale x, y; offset x, y; a2, a3, b1, b2, b3; k1, k2, p1, p2, k3; r_max.
    pose : (3, 4) float64
        `robot_from_camera`.
    table_g, table_r : (N,) float64
        `camera.distortion.inverse_table`.
    near : float
        Undistorted radius of a pixel nearby, which saves looking into the table; NaN without.

    Returns
    -------
    x, y : float
        Metres.
    r : float
        Undistorted radius, by the rational distortion.
    """
    x = (u - lens[2]) / lens[0]
    y = (v - lens[3]) / lens[1]
    coef = lens[4:]
    last = len(table_g) - 1
    goal = math.hypot(x, y)
    shifted = lens[9] != 0.0 or lens[10] != 0.0 or lens[11] != 0.0 or lens[12] != 0.0
    shifted = shifted or lens[13] != 0.0
    if shifted:
        # The rational inverse is where to begin, and where it ends as good a place as any.
        goal = min(goal, table_g[last])
    if near >= 0.0 and goal <= table_g[last]:
        r = _newton(goal, coef, near, 0.0, table_r[last])
    else:
        r = undistorted_radius(goal, coef, table_g, table_r)
    factor = _factor(coef, r)
    if shifted:
        x, y = straightened_point(coef, x, y, x / factor, y / factor)
    else:
        x /= factor
        y /= factor
    down = _along(pose, 2, x, y)
    if not down * pose[2, 3] < 0.0:
        return math.nan, math.nan, r
    along = -pose[2, 3] / down
    return (
        pose[0, 3] + along * _along(pose, 0, x, y),
        pose[1, 3] + along * _along(pose, 1, x, y),
        r,
    )


#: Of central differences on the floor.
_STEP_M = 1e-5


@njit(cache=True, error_model="numpy", nogil=True)
def published_positions(
    pixels: NDArray[np.int64],
    lens: NDArray[np.float64],
    pose: NDArray[np.float64],
    table_g: NDArray[np.float64],
    table_r: NDArray[np.float64],
    rigid: NDArray[np.float64],
    floor_variance: float,
    pixel_variance: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions of pixels on the floor, and s I + p J J^T, J the derivative of the position.

    Parameters
    ----------
    pixels : (N, 2) int64
        Pixels (u, v).
    lens, pose, table_g, table_r
        See `floor_of_pixel`.
    rigid : (27,) float64
        `camera.kernels.camera_numbers`, with the transpose of the rotation for its inverse: the
        projection whose derivative is inverted.
    floor_variance, pixel_variance : float
        s (square metres) and p (square pixels).

    Returns
    -------
    floor_xy : (N, 2) float64
        Metres.
    covariance : (N, 2, 2) float64
        Square metres.
    """
    floor_xy = np.empty((len(pixels), 2))
    covariance = np.empty((len(pixels), 2, 2))
    for k in range(len(pixels)):
        u = np.float64(pixels[k, 0])
        v = np.float64(pixels[k, 1])
        x, y, _ = floor_of_pixel(u, v, lens, pose, table_g, table_r, math.nan)
        floor_xy[k, 0] = x
        floor_xy[k, 1] = y
        u1, v1 = project_floor_point(rigid, x + _STEP_M, y)
        u0, v0 = project_floor_point(rigid, x - _STEP_M, y)
        ux, vx = u1 - u0, v1 - v0
        u1, v1 = project_floor_point(rigid, x, y + _STEP_M)
        u0, v0 = project_floor_point(rigid, x, y - _STEP_M)
        uy, vy = u1 - u0, v1 - v0
        per_determinant = 2.0 * _STEP_M / (ux * vy - uy * vx)
        xu, xv = vy * per_determinant, -uy * per_determinant
        yu, yv = -vx * per_determinant, ux * per_determinant
        covariance[k, 0, 0] = floor_variance + pixel_variance * (xu * xu + xv * xv)
        covariance[k, 0, 1] = pixel_variance * (xu * yu + xv * yv)
        covariance[k, 1, 0] = covariance[k, 0, 1]
        covariance[k, 1, 1] = floor_variance + pixel_variance * (yu * yu + yv * yv)
    return floor_xy, covariance
