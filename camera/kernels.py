"""Compiled projection of single points and its inverse, for tables that need millions of them.

`camera.model` and `camera.distortion` are the definitions; tests compare both.
"""

from __future__ import annotations

import math

import numpy as np

from camera.model import Camera
from redetect.array_types import FloatArray
from redetect.compiled import kernel

# Places of the parameters in `camera_numbers`. A named tuple in place of that vector would take
# longer to compile, in every kernel to which it is passed.
_SCALE_X, _SCALE_Y, _OFFSET_X, _OFFSET_Y = range(4)
_A2, _A3, _B1, _B2, _B3, _R_MAX = range(4, 10)
# Of the rotation: axes of the camera, then of the robot.
_XX, _XY, _XZ, _YX, _YY, _YZ, _ZX, _ZY, _ZZ = range(10, 19)
_CENTRE_X, _CENTRE_Y, _CENTRE_Z = range(19, 22)
_K1, _K2, _P1, _P2, _K3 = range(22, 27)

_NEWTON_STEPS = 100
_LAST_STEP = 1e-9
_CONVERGED = 1e-12
_SMALLEST_SHARE = 1e-6


def camera_numbers(camera: Camera) -> FloatArray:
    """(27,) all parameters of a projection as one vector, the form of a camera for kernels.

    Their order is that of the places above; the rotation is robot -> camera, row by row, the
    camera's centre is in the robot frame.
    """
    pose = camera.camera_from_robot.ravel(), camera.centre
    return np.concatenate([camera.pinhole, camera.coef, [camera.r_max], *pose, camera.brown])


def published_camera_numbers(camera: Camera) -> FloatArray:
    """`camera_numbers` of the data set's own detector.

    It uses the transpose of the rotation, which the file gives in few digits, not the inverse.
    """
    numbers = camera_numbers(camera)
    numbers[_XX : _ZZ + 1] = camera.rotation.T.ravel()
    return numbers


@kernel()
def undistort_point(
    lens: FloatArray, x_seen: float, y_seen: float, x: float, y: float
) -> tuple[float, float]:
    """Undistorted normalised coordinates of a distorted point, of a lens with Brown's terms.

    Newton's method within the circle of r_max; a step that would leave it or raise the error is
    halved. As the distortion is the gradient of a convex function there, that ends at the one
    solution, if there is one.

    Parameters
    ----------
    lens : (11,) float64
        a2, a3, b1, b2, b3, k1, k2, p1, p2, k3, r_max.
    x_seen, y_seen : float
        The distorted point, normalised.
    x, y : float
        Initial values: the radial inverse, or a neighbour's result.

    Returns
    -------
    x, y : float
        Both NaN where nothing is seen.
    """
    a2, a3, b1, b2, b3 = lens[0], lens[1], lens[2], lens[3], lens[4]
    k1, k2, p1, p2, k3, r_max = lens[5], lens[6], lens[7], lens[8], lens[9], lens[10]
    polynomial = k1 != 0.0 or k2 != 0.0 or k3 != 0.0
    r = math.sqrt(x * x + y * y)
    if r > r_max:
        x *= 0.999 * r_max / r
        y *= 0.999 * r_max / r
    # The residual before the last step; initially infinite.
    least = math.inf
    x_kept, y_kept, x_step, y_step = x, y, 0.0, 0.0
    share = 1.0
    last = False
    for _ in range(_NEWTON_STEPS):
        r = math.sqrt(x * x + y * y)
        numerator = r * (a2 + r * a3)
        denominator = 1.0 + r * (b1 + r * (b2 + r * b3))
        squared = r * r
        factor = 1.0 + numerator / denominator
        if polynomial:
            factor += squared * (k1 + squared * (k2 + squared * k3))
        along = 2.0 * (p2 * x + p1 * y)
        x_off = x_seen - (x * factor + along * x + squared * p2)
        y_off = y_seen - (y * factor + along * y + squared * p1)
        off = math.sqrt(x_off * x_off + y_off * y_off)
        if r <= r_max and (off < least or last):
            if last:
                seen_radius = math.sqrt(x_seen * x_seen + y_seen * y_seen)
                if off <= _CONVERGED * max(1.0, seen_radius):
                    return x, y
                return math.nan, math.nan
            x_kept, y_kept, least, share = x, y, off, 1.0
            slope = (
                (a2 + 2.0 * a3 * r) * denominator - numerator * (b1 + r * (2.0 * b2 + 3.0 * b3 * r))
            ) / (denominator * denominator)
            per_r = slope / r if r > 0.0 else 0.0
            if polynomial:
                per_r += 2.0 * k1 + squared * (4.0 * k2 + squared * (6.0 * k3))
            xx = factor + per_r * x * x + along + 4.0 * p2 * x
            xy = per_r * x * y + 2.0 * (p1 * x + p2 * y)
            yy = factor + per_r * y * y + along + 4.0 * p1 * y
            determinant = xx * yy - xy * xy
            x_step = (yy * x_off - xy * y_off) / determinant
            y_step = (xx * y_off - xy * x_off) / determinant
            length = math.sqrt(x_step * x_step + y_step * y_step)
            # Newton's error is squared by each step: after one this small it has converged.
            last = length <= _LAST_STEP * max(1.0, r)
        else:
            # Go back, and make a smaller step.
            share *= 0.5
            last = False
            if not share > _SMALLEST_SHARE:
                break
        x = x_kept + share * x_step
        y = y_kept + share * y_step
    return math.nan, math.nan


@kernel()
def undistort_points(
    lens: FloatArray, seen: FloatArray, start_radius: FloatArray, straight: FloatArray
) -> None:
    """`undistort_point` of many."""
    for k in range(len(seen)):
        x, y = seen[k, 0], seen[k, 1]
        radius = math.sqrt(x * x + y * y)
        ratio = start_radius[k] / radius if radius > 0.0 else 1.0
        straight[k, 0], straight[k, 1] = undistort_point(lens, x, y, x * ratio, y * ratio)


@kernel()
def project_direction(numbers: FloatArray, dx: float, dy: float, dz: float) -> tuple[float, float]:
    """Pixel (u, v) of a direction in the robot frame; both NaN where it is undefined."""
    z = numbers[_ZX] * dx + numbers[_ZY] * dy + numbers[_ZZ] * dz
    if not z > 0.0:
        return math.nan, math.nan
    x = (numbers[_XX] * dx + numbers[_XY] * dy + numbers[_XZ] * dz) / z
    y = (numbers[_YX] * dx + numbers[_YY] * dy + numbers[_YZ] * dz) / z
    r = math.sqrt(x * x + y * y)
    if not r <= numbers[_R_MAX]:
        return math.nan, math.nan
    factor = 1.0 + r * (numbers[_A2] + r * numbers[_A3]) / (
        1.0 + r * (numbers[_B1] + r * (numbers[_B2] + r * numbers[_B3]))
    )
    u, v = numbers[_SCALE_X] * x * factor, numbers[_SCALE_Y] * y * factor
    k1, k2, p1, p2, k3 = numbers[_K1], numbers[_K2], numbers[_P1], numbers[_P2], numbers[_K3]
    if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0:
        squared = x * x + y * y
        along = 2.0 * (p2 * x + p1 * y) + squared * (k1 + squared * (k2 + squared * k3))
        u += numbers[_SCALE_X] * (along * x + squared * p2)
        v += numbers[_SCALE_Y] * (along * y + squared * p1)
    return u + numbers[_OFFSET_X], v + numbers[_OFFSET_Y]


@kernel()
def project_floor_point(numbers: FloatArray, x_robot: float, y_robot: float) -> tuple[float, float]:
    """Pixel (u, v) of a floor point; both NaN where the projection is undefined."""
    return project_direction(
        numbers, x_robot - numbers[_CENTRE_X], y_robot - numbers[_CENTRE_Y], -numbers[_CENTRE_Z]
    )


@kernel()
def distance_of_floor_point(numbers: FloatArray, x_robot: float, y_robot: float) -> float:
    """Distance of a floor point from the camera's centre, metres."""
    x, y = x_robot - numbers[_CENTRE_X], y_robot - numbers[_CENTRE_Y]
    return math.sqrt(x * x + y * y + numbers[_CENTRE_Z] ** 2)


@kernel()
def project_floor_points(numbers: FloatArray, floor_xy: FloatArray) -> FloatArray:
    """(N, 2) pixels of (N, 2) floor points, as `project_floor_point`."""
    pixels = np.empty((len(floor_xy), 2))
    for k in range(len(floor_xy)):
        pixels[k, 0], pixels[k, 1] = project_floor_point(numbers, floor_xy[k, 0], floor_xy[k, 1])
    return pixels
