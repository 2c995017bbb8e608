"""Where on the floor pixels are, and the covariances of positions.

With J = d(x, y) / d(u, v), the floor's Jacobian at a position (the inverse of the projection's, by
central differences), a position that is a pixel has the covariance of the data set's rows,

    C = s I + p J J^T,

a fitted one that of its fit, plus p J J^T for a systematic error in the image, plus what the tilt
of the robot may do: pitch and roll move a position along the line of sight, by its offset from the
camera over the camera's height, times the height that the tilt seems to give the position
(`detect.circles.tilt_jacobian`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.kernels import has_brown, project_floor_point, straightened_point

FloatArray = NDArray[np.float64]

#: Most steps of Newton's method in `camera.distortion`, and the step that ends it.
_NEWTON_STEPS = 60
_LAST_STEP = 1e-9
#: Of the central differences of the projection, metres.
_STEP_M = 1e-5


@njit(cache=True, error_model="numpy", nogil=True)
def _undistorted_radius(
    goal: float, coef: FloatArray, table_g: FloatArray, table_r: FloatArray
) -> float:
    """One radius as by `camera.distortion.undistorted_radius`; NaN where nothing is seen there."""
    last = len(table_g) - 1
    if not 0.0 <= goal <= table_g[last]:
        return math.nan
    upper = min(max(int(np.searchsorted(table_g, goal)), 1), last)
    low, high = table_r[upper - 1], table_r[upper]
    span = table_g[upper] - table_g[upper - 1]
    r = low + ((goal - table_g[upper - 1]) / span if span > 0.0 else 0.0) * (high - low)
    # Newton's method, bisecting where a step would leave the bracket.
    for _ in range(_NEWTON_STEPS):
        above = r * (coef[0] + r * coef[1])
        below = 1.0 + r * (coef[2] + r * (coef[3] + r * coef[4]))
        factor = 1.0 + above / below
        slope = (coef[0] + 2.0 * coef[1] * r) * below
        slope -= above * (coef[2] + r * (2.0 * coef[3] + 3.0 * coef[4] * r))
        error = r * factor - goal
        low = r if error <= 0.0 else low
        high = r if error >= 0.0 else high
        newton = r - error / (factor + r * slope / (below * below)) if error != 0.0 else r
        if abs(newton - r) <= _LAST_STEP * max(1.0, r):
            return float(min(max(newton, low), high))
        r = newton if low <= newton <= high else 0.5 * (low + high)
    return float(r)


@njit(cache=True, error_model="numpy", forceinline=True, fastmath={"contract"})
def _along(pose: FloatArray, row: int, x: float, y: float) -> float:
    """A coordinate of a pixel's direction, with the rounding of the product of matrices."""
    along: float = (pose[row, 1] * y + pose[row, 0] * x) + pose[row, 2]
    return along


@njit(cache=True, error_model="numpy", nogil=True)
def floor_of_pixel(
    u: float,
    v: float,
    lens: FloatArray,
    pose: FloatArray,
    table_g: FloatArray,
    table_r: FloatArray,
) -> tuple[float, float]:
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
    """
    x = (u - lens[2]) / lens[0]
    y = (v - lens[3]) / lens[1]
    coef = lens[4:]
    goal = math.hypot(x, y)
    shifted = has_brown(lens[9:])
    if shifted:
        # The rational inverse is where to begin, and where it ends as good a place as any.
        goal = min(goal, table_g[len(table_g) - 1])
    r = _undistorted_radius(goal, coef, table_g, table_r)
    denominator = 1.0 + r * (coef[2] + r * (coef[3] + r * coef[4]))
    factor = 1.0 + r * (coef[0] + r * coef[1]) / denominator
    if shifted:
        x, y = straightened_point(coef, x, y, x / factor, y / factor)
    else:
        x /= factor
        y /= factor
    down = _along(pose, 2, x, y)
    if not down * pose[2, 3] < 0.0:
        return math.nan, math.nan
    along = -pose[2, 3] / down
    return pose[0, 3] + along * _along(pose, 0, x, y), pose[1, 3] + along * _along(pose, 1, x, y)


@njit(cache=True, error_model="numpy", nogil=True)
def _add_pixels(
    numbers: FloatArray, x: float, y: float, pixel_variance: float, covariance: FloatArray
) -> None:
    """Add the covariance of the pixel that sees (x, y) to one on the floor: p J J^T."""
    h = _STEP_M
    u1, v1 = project_floor_point(numbers, x + h, y)
    u0, v0 = project_floor_point(numbers, x - h, y)
    u3, v3 = project_floor_point(numbers, x, y + h)
    u2, v2 = project_floor_point(numbers, x, y - h)
    ux, vx, uy, vy = u1 - u0, v1 - v0, u3 - u2, v3 - v2
    scale = pixel_variance * (2.0 * h / (ux * vy - uy * vx)) ** 2
    covariance[0, 0] += scale * (uy * uy + vy * vy)
    covariance[0, 1] -= scale * (ux * uy + vx * vy)
    covariance[1, 0] -= scale * (ux * uy + vx * vy)
    covariance[1, 1] += scale * (ux * ux + vx * vx)


@njit(cache=True, error_model="numpy", nogil=True)
def published_positions(
    pixels: NDArray[np.int64],
    lens: FloatArray,
    pose: FloatArray,
    table_g: FloatArray,
    table_r: FloatArray,
    rigid: FloatArray,
    floor_variance: float,
    pixel_variance: float,
) -> tuple[FloatArray, FloatArray]:
    """Positions of pixels on the floor, and s I + p J J^T.

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
    floor_xy, covariance : (N, 2), (N, 2, 2) float64
        Metres, square metres.
    """
    floor_xy = np.empty((len(pixels), 2))
    covariance = np.zeros((len(pixels), 2, 2))
    for k in range(len(pixels)):
        u, v = float(pixels[k, 0]), float(pixels[k, 1])
        x, y = floor_of_pixel(u, v, lens, pose, table_g, table_r)
        floor_xy[k, 0], floor_xy[k, 1] = x, y
        covariance[k, 0, 0] = covariance[k, 1, 1] = floor_variance
        _add_pixels(rigid, x, y, pixel_variance, covariance[k])
    return floor_xy, covariance


@njit(cache=True, error_model="numpy", nogil=True)
def refined_covariances(
    camera_numbers: FloatArray,
    centre: FloatArray,
    floor_xy: FloatArray,
    fitted: FloatArray,
    pixel_variance: float,
    tilt_variance: float,
) -> FloatArray:
    """The fits' covariances, plus a systematic error in pixels and the camera's tilt.

    Parameters
    ----------
    camera_numbers : (K,) float64
        `camera.kernels.camera_numbers`.
    centre : (3,) float64
        Of the camera in the robot frame, metres.
    floor_xy : (N, 2) float64
        Positions, metres.
    fitted : (N, 2, 2) float64
        Covariances of the fits.
    pixel_variance, tilt_variance : float
        Square pixels, square radians: in either direction.

    Returns
    -------
    (N, 2, 2) float64
        Square metres.
    """
    result = fitted.copy()
    for k in range(len(floor_xy)):
        x, y = floor_xy[k, 0], floor_xy[k, 1]
        _add_pixels(camera_numbers, x, y, pixel_variance, result[k])
        # A product of a column and a row: see `detect.circles.tilt_jacobian`.
        sight = np.array([(x - centre[0]) / centre[2], (y - centre[1]) / centre[2]])
        for i in range(2):
            for j in range(2):
                result[k, i, j] += tilt_variance * (x * x + y * y) * sight[i] * sight[j]
    return result
