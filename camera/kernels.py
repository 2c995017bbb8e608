"""The camera's projection for single points, compiled, for tables that need millions of them.

`camera.model` is the definition; a test holds the two together.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from camera.brown_kernels import brown_shift_point
from camera.model import Camera

#: Length of the vector that `camera_numbers` returns.
NUMBERS = 27


def camera_numbers(camera: Camera) -> NDArray[np.float64]:
    """All that a projection needs, as one vector, the form in which kernels take a camera.

    Order: scale x, y; offset x, y; a2, a3, b1, b2, b3; r_max; the 9 entries of the rotation
    robot -> camera row by row; the camera's centre in the robot frame; k1, k2, p1, p2, k3.
    """
    return np.array(
        [
            camera.scale_x,
            camera.scale_y,
            camera.offset_x,
            camera.offset_y,
            *camera.coef,
            camera.r_max,
            *camera.camera_from_robot.ravel(),
            *camera.centre,
            *camera.brown,
        ]
    )


def lens_numbers(camera: Camera) -> NDArray[np.float64]:
    """The distortion alone, as `straightened_point` takes it.

    Order: a2, a3, b1, b2, b3; k1, k2, p1, p2, k3; r_max.
    """
    return np.array([*camera.coef, *camera.brown, camera.r_max])


@njit(cache=True, error_model="numpy")
def has_brown(terms: NDArray[np.float64]) -> bool:
    """Whether any of k1, k2, p1, p2, k3 is not 0."""
    k1, k2, p1, p2, k3 = terms[0], terms[1], terms[2], terms[3], terms[4]
    return bool(k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0)


@njit(cache=True, error_model="numpy")
def project_direction(
    numbers: NDArray[np.float64], dx: float, dy: float, dz: float
) -> tuple[float, float]:
    """Pixel (u, v) of a direction in the robot frame; both NaN where it is undefined."""
    z = numbers[16] * dx + numbers[17] * dy + numbers[18] * dz
    if not z > 0.0:
        return math.nan, math.nan
    x = (numbers[10] * dx + numbers[11] * dy + numbers[12] * dz) / z
    y = (numbers[13] * dx + numbers[14] * dy + numbers[15] * dz) / z
    r = math.sqrt(x * x + y * y)
    if not r <= numbers[9]:
        return math.nan, math.nan
    factor = 1.0 + r * (numbers[4] + r * numbers[5]) / (
        1.0 + r * (numbers[6] + r * (numbers[7] + r * numbers[8]))
    )
    u, v = numbers[0] * x * factor, numbers[1] * y * factor
    if has_brown(numbers[22:27]):
        x_shift, y_shift = brown_shift_point(
            numbers[22], numbers[23], numbers[24], numbers[25], numbers[26], x, y
        )
        u += numbers[0] * x_shift
        v += numbers[1] * y_shift
    return u + numbers[2], v + numbers[3]


@njit(cache=True, error_model="numpy")
def project_floor_point(
    numbers: NDArray[np.float64], x_robot: float, y_robot: float
) -> tuple[float, float]:
    """Pixel (u, v) of a floor point; both NaN where the projection is undefined."""
    return project_direction(numbers, x_robot - numbers[19], y_robot - numbers[20], -numbers[21])
