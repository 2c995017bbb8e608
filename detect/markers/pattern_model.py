"""Model of a marker: the grey values of a pattern, blurred and lit.

A pattern of black and white cells on the marker's plane is seen through a homography, blurred by a
Gaussian of any shape (optics, motion and the pixel itself) and lit unevenly. The blurred pattern is
exact where the homography is affine over the width of the blur: each cell is a product of two
differences of normal distributions along the marker's axes, and where the blur is correlated along
them the cells' corners contribute what the bivariate normal distribution has more than the product.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.markers.homography import project

#: Parameters: 8 of the homography, 6 of white and 6 of black (level, along x, along y, x^2, xy,
#: y^2), 3 of the blur's covariance (uu, uv, vv; px^2), 1 of the tone curve.
PARAMETERS = 24
#: Where white, black, blur and tone curve begin among the parameters, and the numbers of a light.
WHITE_AT, BLACK_AT, BLUR_AT, TONE_AT = 8, 14, 20, 23
LIGHT_NUMBERS = 6

_LEAST_VARIANCE = 0.07
_LARGEST_VARIANCE = 60.0
_REACH = 3.6
#: Twice the negative exponent beyond which a cell's corner adds nothing: exp(-6) and less.
_FAR_FROM_CORNER = 12.0
_ROOT_HALF = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2.0 * math.pi)
_LEAST_CORRELATION = 0.02
_LARGEST_CORRELATION = 0.96
#: Nodes and weights of Gauss and Legendre's quadrature over (0, 1).
NODES = np.array([0.1127016653792583, 0.5, 0.8872983346207417])
_WEIGHTS = np.array([0.2777777777777778, 0.4444444444444444, 0.2777777777777778])


class Pattern(NamedTuple):
    """A pattern of black and white cells on the marker's unit square.

    Attributes
    ----------
    lines : (L,) float64
        Where cells end, in widths of the marker, from 0 to 1; along both axes.
    black : (L - 1, L - 1) float64
        1 where the pattern is black.
    corner : (L, L) float64
        Mixed differences of the pattern: the weights of the cells' corners.
    """

    lines: NDArray[np.float64]
    black: NDArray[np.float64]
    corner: NDArray[np.float64]


class MarkerPlace(NamedTuple):
    """Where a pixel is on the marker, and how the blur lies there.

    Attributes
    ----------
    x, y : float
        In widths of the marker.
    x_u, x_v, y_u, y_v : float
        Their derivatives with respect to the pixel's straight position.
    sigma_x, sigma_y, correlation : float
        Of the blur, along the marker's axes.
    """

    x: float
    y: float
    x_u: float
    x_v: float
    y_u: float
    y_v: float
    sigma_x: float
    sigma_y: float
    correlation: float


def corner_signs(black: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n + 1, n + 1) mixed differences of a pattern (n, n): what its corners weigh."""
    return np.diff(np.diff(np.pad(black, 1), axis=0), axis=1)


@njit(cache=True, error_model="numpy", inline="always")
def cell_profile(
    x: float,
    sigma: float,
    lines: NDArray[np.float64],
    z: NDArray[np.float64],
    cdf: NDArray[np.float64],
    pdf: NDArray[np.float64],
) -> tuple[int, int]:
    """Normal distribution at the cells' ends; returns the cells from, to that have a share."""
    n = len(lines)
    first = 0
    last = n
    for k in range(n):
        t = (lines[k] - x) / sigma
        z[k] = t
        if t <= -_REACH:
            cdf[k] = 0.0
            pdf[k] = 0.0
            first = k
        elif t >= _REACH:
            cdf[k] = 1.0
            pdf[k] = 0.0
            if last == n:
                last = k
        else:
            cdf[k] = 0.5 * (1.0 + math.erf(t * _ROOT_HALF))
            pdf[k] = math.exp(-0.5 * t * t) / _ROOT_2PI
    return first, min(last, n - 1)


@njit(cache=True, error_model="numpy", inline="always")
def corner_excess(h: float, k: float, sines: NDArray[np.float64], angle: float) -> float:
    """Bivariate normal distribution at (h, k) less the product of its margins.

    Drezner and Wesolowsky, "On the computation of the bivariate normal integral", 1990. `sines`
    are those of the nodes' shares of `angle`, the arc sine of the correlation.
    """
    total = 0.0
    for i in range(3):
        s = sines[i]
        total += _WEIGHTS[i] * math.exp(-(h * h + k * k - 2.0 * h * k * s) / (2.0 * (1.0 - s * s)))
    return total * angle / (2.0 * math.pi)


@njit(cache=True, error_model="numpy")
def blurred_blackness(
    at: MarkerPlace, pattern: Pattern, profiles: NDArray[np.float64]
) -> tuple[float, float, float, float, float, float]:
    """Blurred pattern at a place, and its derivatives.

    Parameters
    ----------
    at, pattern
        The place and the pattern.
    profiles : (7, L) float64
        Working memory.

    Returns
    -------
    blackness, by_x, by_y, by_sigma_x, by_sigma_y, by_correlation : float
        1 is black, 0 white.
    """
    black = pattern.black
    sx, sy, rho = at.sigma_x, at.sigma_y, at.correlation
    zx, cx, px = profiles[0], profiles[1], profiles[2]
    zy, cy, py = profiles[3], profiles[4], profiles[5]
    x0, x1 = cell_profile(at.x, sx, pattern.lines, zx, cx, px)
    y0, y1 = cell_profile(at.y, sy, pattern.lines, zy, cy, py)
    value, by_x, by_y, by_sx, by_sy = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(y0, y1):
        wy = cy[j + 1] - cy[j]
        wy_y = -(py[j + 1] - py[j]) / sy
        wy_s = -(zy[j + 1] * py[j + 1] - zy[j] * py[j]) / sy
        row, row_x, row_s = 0.0, 0.0, 0.0
        for i in range(x0, x1):
            if black[j, i] != 0.0:
                row += cx[i + 1] - cx[i]
                row_x -= px[i + 1] - px[i]
                row_s -= zx[i + 1] * px[i + 1] - zx[i] * px[i]
        value += row * wy
        by_x += row_x * wy / sx
        by_sx += row_s * wy / sx
        by_y += row * wy_y
        by_sy += row * wy_s
    by_rho = 0.0
    if abs(rho) > _LEAST_CORRELATION:
        r = min(max(rho, -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
        root = math.sqrt(1.0 - r * r)
        far = _FAR_FROM_CORNER * (1.0 + abs(r))
        angle = math.asin(r)
        sines = profiles[6]
        for i in range(3):
            sines[i] = math.sin(angle * NODES[i])
        for j in range(y0, y1 + 1):
            if py[j] == 0.0:
                continue
            for i in range(x0, x1 + 1):
                sign = pattern.corner[j, i]
                if px[i] == 0.0 or sign == 0.0:
                    continue
                h, k = zx[i], zy[j]
                if h * h + k * k > far:
                    continue
                value += sign * corner_excess(h, k, sines, angle)
                # Of the bivariate distribution less the product of its margins.
                by_h = (
                    sign * px[i] * (0.5 * (1.0 + math.erf((k - r * h) / root * _ROOT_HALF)) - cy[j])
                )
                by_k = (
                    sign * py[j] * (0.5 * (1.0 + math.erf((h - r * k) / root * _ROOT_HALF)) - cx[i])
                )
                by_x -= by_h / sx
                by_y -= by_k / sy
                by_sx -= by_h * h / sx
                by_sy -= by_k * k / sy
                by_rho += (
                    sign * px[i] * math.exp(-0.5 * ((k - r * h) / root) ** 2) / (_ROOT_2PI * root)
                )
    return value, by_x, by_y, by_sx, by_sy, by_rho


@njit(cache=True, error_model="numpy", inline="always")
def place_on_marker(
    inverse: NDArray[np.float64], x: float, y: float, p: NDArray[np.float64]
) -> MarkerPlace:
    """Where a straight position (x, y) is on the marker, by the inverse of its homography."""
    mx, my, q = project(inverse, x, y)
    ax = (inverse[0, 0] - mx * inverse[2, 0]) / q
    ay = (inverse[0, 1] - mx * inverse[2, 1]) / q
    bx = (inverse[1, 0] - my * inverse[2, 0]) / q
    by = (inverse[1, 1] - my * inverse[2, 1]) / q
    uu, uv, vv = p[BLUR_AT], p[BLUR_AT + 1], p[BLUR_AT + 2]
    sx = math.sqrt(ax * ax * uu + 2.0 * ax * ay * uv + ay * ay * vv)
    sy = math.sqrt(bx * bx * uu + 2.0 * bx * by * uv + by * by * vv)
    rho = (ax * bx * uu + (ax * by + ay * bx) * uv + ay * by * vv) / (sx * sy)
    return MarkerPlace(mx, my, ax, ay, bx, by, sx, sy, rho)


@njit(cache=True, error_model="numpy", inline="always")
def light_level(p: NDArray[np.float64], first: int, x: float, y: float) -> float:
    """Grey level of white or black at a place."""
    along_x = x * (p[first + 1] + x * p[first + 3] + y * p[first + 4])
    along_y = y * (p[first + 2] + y * p[first + 5])
    return float(p[first] + along_x + along_y)


@njit(cache=True, error_model="numpy")
def confine_blur(p: NDArray[np.float64]) -> None:
    """Keep the blur's covariance between what a pixel does and what is still an image."""
    mean = 0.5 * (p[BLUR_AT] + p[BLUR_AT + 2])
    half = 0.5 * (p[BLUR_AT] - p[BLUR_AT + 2])
    spread = math.sqrt(half * half + p[BLUR_AT + 1] ** 2)
    high = min(max(mean + spread, _LEAST_VARIANCE), _LARGEST_VARIANCE)
    low = min(max(mean - spread, _LEAST_VARIANCE), _LARGEST_VARIANCE)
    if spread > 0.0:
        c, s = half / spread, p[BLUR_AT + 1] / spread
    else:
        c, s = 1.0, 0.0
    new_mean, new_half = 0.5 * (high + low), 0.5 * (high - low)
    p[BLUR_AT] = new_mean + new_half * c
    p[BLUR_AT + 2] = new_mean - new_half * c
    p[BLUR_AT + 1] = new_half * s
