"""What share of a disc's contrast a pixel sees: two models of a blurred disc, with derivatives.

Both work in units of the nominal radius, on the floor, about a pixel that sees the floor at (x, y)
from the disc's centre and by whose step in u or v the floor moves as the Jacobian says. Both return

    W, dW/dx_centre, dW/dy_centre, dW/dradius, dW/dlog(blur)

A blur is given by its standard deviation along the image axes: of all of it (`sigma`: the optics
and the pixel itself), and of the optics alone (`blur`), which is what the fit varies.

`profile_pixel` is exact for a disc blurred evenly in all directions of the floor, and good where
the blur is small against the disc. `chord_pixel` is for discs that are seen so flat that the blur
reaches across them: along the steeper image axis the blurred chord is integrated exactly, along
the other by quadrature.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

_ROOT_HALF = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2.0 * math.pi)
#: A chord's ends move without bound where the axis touches the circle: slopes end here.
_FLATTEST = 0.05


@njit(cache=True, error_model="numpy", inline="always")
def profile_pixel(
    x: float,
    y: float,
    xu: float,
    xv: float,
    yu: float,
    yv: float,
    radius: float,
    blur_u: float,
    blur_v: float,
    sigma_u: float,
    sigma_v: float,
    profile: NDArray[np.float64],
    z_limit: float,
    t_limit: float,
) -> tuple[float, float, float, float, float]:
    """W by the tabulated profile of an evenly blurred disc (see `detect.disc_profile`)."""
    nz = profile.shape[1] - 1
    nt = profile.shape[0] - 1
    z_step = 2.0 * z_limit / nz
    t_step = t_limit / nt
    r = math.sqrt(x * x + y * y)
    # At the centre itself every direction is as good.
    nx = x / r if r > 0.0 else 1.0
    ny = y / r if r > 0.0 else 0.0
    gu = xu * nx + yu * ny
    gv = xv * nx + yv * ny
    gu *= gu
    gv *= gv
    sigma = math.sqrt(sigma_u * sigma_u * gu + sigma_v * sigma_v * gv)
    optics = (blur_u * blur_u * gu + blur_v * blur_v * gv) / (sigma * sigma)
    z = (r - radius) / sigma
    t = min(sigma / radius, t_limit)
    fz = (min(max(z, -z_limit), z_limit) + z_limit) / z_step
    ft = t / t_step
    iz = min(int(fz), nz - 1)
    it = min(int(ft), nt - 1)
    az = fz - iz
    at = ft - it
    w00 = profile[it, iz]
    w01 = profile[it, iz + 1]
    w10 = profile[it + 1, iz]
    w11 = profile[it + 1, iz + 1]
    w0 = w00 + az * (w01 - w00)
    w1 = w10 + az * (w11 - w10)
    dwz = ((1.0 - at) * (w01 - w00) + at * (w11 - w10)) / z_step
    dwt = (w1 - w0) / t_step
    if z <= -z_limit or z >= z_limit:
        dwz = 0.0
    per_r = dwz / sigma
    return (
        w0 + at * (w1 - w0),
        -per_r * nx,
        -per_r * ny,
        -per_r - dwt * t / radius,
        (dwt * t - dwz * z) * optics,
    )


@njit(cache=True, error_model="numpy")
def chord_pixel(
    x: float,
    y: float,
    x1: float,
    y1: float,
    x2: float,
    y2: float,
    growth: float,
    radius: float,
    blur_1: float,
    blur_2: float,
    sigma_1: float,
    sigma_2: float,
    nodes: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[float, float, float, float, float]:
    """W by chords along the steep image axis.

    (x1, y1) is the floor's step along the steep axis, (x2, y2) along the other, and so are the
    blurs; `growth` the relative growth of the steep step from one pixel to the next; `nodes` and
    `weights` are those of the Gauss-Hermite quadrature for a standard normal distribution.
    """
    total = 0.0
    d_x = 0.0
    d_y = 0.0
    d_radius = 0.0
    d_blur = 0.0
    a = x1 * x1 + y1 * y1
    flattest = _FLATTEST * math.sqrt(a)
    for k in range(len(nodes)):
        aside = sigma_2 * nodes[k]
        qx = x + x2 * aside
        qy = y + y2 * aside
        b = qx * x1 + qy * y1
        c = qx * qx + qy * qy - radius * radius
        discriminant = b * b - a * c
        if discriminant <= 0.0:
            continue
        root = math.sqrt(discriminant)
        for end in range(2):
            sign = 1.0 if end == 1 else -1.0
            d = (-b + sign * root) / a
            # The step grows along the way: the pixel distance that covers d of today's steps.
            bend = min(max(1.0 - growth * d, 0.3), 3.0)
            delta = d * (1.0 - 0.5 * growth * d) if abs(growth * d) < 0.7 else d
            s = delta / sigma_1
            total += sign * weights[k] * 0.5 * math.erfc(-s * _ROOT_HALF)
            density = sign * weights[k] * math.exp(-0.5 * s * s) / (_ROOT_2PI * sigma_1)
            nx = (qx + x1 * d) / radius
            ny = (qy + y1 * d) / radius
            slope = nx * x1 + ny * y1
            if abs(slope) < flattest:
                slope = flattest if slope >= 0.0 else -flattest
            per_d = density * bend
            d_x += per_d * nx / slope
            d_y += per_d * ny / slope
            d_radius += per_d / slope
            along = density * s * blur_1 * blur_1 / sigma_1
            across = per_d * nodes[k] * (nx * x2 + ny * y2) / slope
            d_blur -= along + across * blur_2 * blur_2 / sigma_2
    return total, d_x, d_y, d_radius, d_blur
