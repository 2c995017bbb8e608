"""Model of a marker: the grey values of a pattern, blurred and lit.

A pattern of black and white cells on the marker's plane is seen through a homography, blurred by a
Gaussian of any shape (optics, motion and the pixel itself) and lit unevenly. The blurred pattern is
exact if the homography is affine over the width of the blur: each cell is a product of two
differences of normal distributions along the marker's axes; if the blur is correlated along them,
the cells' corners contribute the excess of the bivariate normal distribution over the product.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from redetect.array_types import FloatArray, IntArray
from redetect.compiled import kernel

#: The parameters of a model: homography from the unit square to straight positions, whose last
#: entry is 1; white and black, grey levels (factors of 1, x, y, x^2, xy, y^2 in sizes of the
#: marker); covariance uu, uv, vv of the blur, pixels squared; curvature of the tone curve.
PARAMETERS = 24
HOMOGRAPHY, WHITE, BLACK = slice(0, 8), slice(8, 14), slice(14, 20)
BLUR, TONE = slice(20, 23), 23

#: Clipped pixels are ignored if the model is this near the limit (grey levels) or beyond.
_CLIP_ZONE = 6.0
#: Standard deviations beyond which the normal distribution is 0 or 1.
_REACH = 3.6
#: Twice the negative exponent beyond which a cell's corner is negligible: below exp(-6).
_FAR_FROM_CORNER = 12.0
_LEAST_CORRELATION, _LARGEST_CORRELATION = 0.02, 0.96
_ROOT_HALF, _ROOT_2PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)
#: Gauss-Legendre quadrature over (0, 1).
NODES = (0.1127016653792583, 0.5, 0.8872983346207417)
_WEIGHTS = (0.2777777777777778, 0.4444444444444444, 0.2777777777777778)


class Pattern(NamedTuple):
    """A pattern of black and white cells on the marker's unit square."""

    lines: FloatArray  # (L,) boundaries of cells along both axes, widths of the marker, 0 to 1
    black: FloatArray  # (L - 1, L - 1) 1 where the pattern is black
    corner: FloatArray  # (L, L) mixed differences of the pattern: weights of the cells' corners


class Samples(NamedTuple):
    """Pixels to which a marker is fitted, row by row."""

    pixel: IntArray  # (N, 2) u, v
    straight: FloatArray  # (N, 2) without distortion, relative to the marker's centre, pixels
    grey: FloatArray  # (N,)
    light: FloatArray  # (6, N) 1, x, y, x^2, xy, y^2 in sizes of the marker


class Places(NamedTuple):
    """Positions of N pixels on the marker, in its widths, and the blur there."""

    x: FloatArray  # (N,)
    y: FloatArray
    sigma_x: FloatArray
    sigma_y: FloatArray
    correlation: FloatArray


class Linearised(NamedTuple):
    """A model at N pixels."""

    residual: FloatArray  # (N,) 0 if a clipped grey value is consistent with the model
    weight: FloatArray  # (N,) of robust least squares
    jacobian: FloatArray  # (PARAMETERS, N)
    at: Places
    contrast: FloatArray  # (N,) of white and black, grey levels


def pattern_of(lines: FloatArray, black: FloatArray) -> Pattern:
    """A pattern with the weights of its cells' corners."""
    return Pattern(lines, black, np.diff(np.diff(np.pad(black, 1), axis=0), axis=1))


@kernel(inline="always")
def _cell_profile(
    x: float, sigma: float, lines: FloatArray, z: FloatArray, cdf: FloatArray, pdf: FloatArray
) -> tuple[int, int]:
    """Normal distribution at the cells' boundaries; returns the range of cells that contribute."""
    n = len(lines)
    first, last = 0, n - 1
    for k in range(n):
        z[k] = (lines[k] - x) / sigma
        if z[k] <= -_REACH:
            cdf[k], pdf[k] = 0.0, 0.0
            first = k
        elif z[k] >= _REACH:
            cdf[k], pdf[k] = 1.0, 0.0
            last = min(last, k)
        else:
            cdf[k] = 0.5 * (1.0 + math.erf(z[k] * _ROOT_HALF))
            pdf[k] = math.exp(-0.5 * z[k] * z[k]) / _ROOT_2PI
    return first, last


@kernel(inline="always")
def corner_excess(h: float, k: float, sines: tuple[float, float, float], angle: float) -> float:
    """Bivariate normal distribution at (h, k) minus the product of its marginals.

    Drezner and Wesolowsky, "On the computation of the bivariate normal integral", 1990. `sines`:
    sines of the nodes times `angle`, the arc sine of the correlation.
    """
    total = 0.0
    for i in range(3):
        s = sines[i]
        total += _WEIGHTS[i] * math.exp(-(h * h + k * k - 2.0 * h * k * s) / (2.0 * (1.0 - s * s)))
    return total * angle / (2.0 * math.pi)


@kernel()
def blurred_blackness(at: Places, pattern: Pattern) -> FloatArray:
    """(6, N) the blurred pattern at N positions, 1 for black, and its derivatives by `at`."""
    count, n = len(at.x), len(pattern.lines)
    result = np.empty((6, count))
    zx, cx, px, zy, cy, py = (
        np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    )  # fmt: skip
    for m in range(count):
        sx, sy = at.sigma_x[m], at.sigma_y[m]
        x0, x1 = _cell_profile(at.x[m], sx, pattern.lines, zx, cx, px)
        y0, y1 = _cell_profile(at.y[m], sy, pattern.lines, zy, cy, py)
        value, by_x, by_y, by_sx, by_sy, by_rho = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(y0, y1):
            row, row_x, row_s = 0.0, 0.0, 0.0
            for i in range(x0, x1):
                if pattern.black[j, i] != 0.0:
                    row += cx[i + 1] - cx[i]
                    row_x -= px[i + 1] - px[i]
                    row_s -= zx[i + 1] * px[i + 1] - zx[i] * px[i]
            share = cy[j + 1] - cy[j]
            value += row * share
            by_x += row_x * share / sx
            by_sx += row_s * share / sx
            by_y -= row * (py[j + 1] - py[j]) / sy
            by_sy -= row * (zy[j + 1] * py[j + 1] - zy[j] * py[j]) / sy
        if abs(at.correlation[m]) > _LEAST_CORRELATION:
            r = min(max(at.correlation[m], -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
            root = math.sqrt(1.0 - r * r)
            angle = math.asin(r)
            sines = (
                math.sin(angle * NODES[0]), math.sin(angle * NODES[1]), math.sin(angle * NODES[2])
            )  # fmt: skip
            for j in range(y0, y1 + 1):
                for i in range(x0, x1 + 1):
                    h, k, sign = zx[i], zy[j], pattern.corner[j, i]
                    far = h * h + k * k > _FAR_FROM_CORNER * (1.0 + abs(r))
                    if sign == 0.0 or far or px[i] == 0.0 or py[j] == 0.0:
                        continue
                    value += sign * corner_excess(h, k, sines, angle)
                    # Of the bivariate distribution minus the product of its marginals.
                    beside_h, beside_k = (h - r * k) / root, (k - r * h) / root
                    by_h = sign * px[i] * (0.5 * (1.0 + math.erf(beside_k * _ROOT_HALF)) - cy[j])
                    by_k = sign * py[j] * (0.5 * (1.0 + math.erf(beside_h * _ROOT_HALF)) - cx[i])
                    by_x -= by_h / sx
                    by_y -= by_k / sy
                    by_sx -= by_h * h / sx
                    by_sy -= by_k * k / sy
                    by_rho += sign * px[i] * math.exp(-0.5 * beside_k**2) / (_ROOT_2PI * root)
        result[0, m], result[1, m], result[2, m] = value, by_x, by_y
        result[3, m], result[4, m], result[5, m] = by_sx, by_sy, by_rho
    return result


def linearise(
    samples: Samples, pattern: Pattern, p: FloatArray, inverse: FloatArray, outlier: float
) -> Linearised:
    """The model with parameters p at all pixels; residuals beyond `outlier` are down-weighted.

    `inverse` (3, 3) is that of the homography.
    """
    u, v = samples.straight.T
    q = inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]
    x = (inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]) / q
    y = (inverse[1, 0] * u + inverse[1, 1] * v + inverse[1, 2]) / q
    x_u, x_v = (inverse[0, 0] - x * inverse[2, 0]) / q, (inverse[0, 1] - x * inverse[2, 1]) / q
    y_u, y_v = (inverse[1, 0] - y * inverse[2, 0]) / q, (inverse[1, 1] - y * inverse[2, 1]) / q
    uu, uv, vv = p[BLUR]
    sx = np.sqrt(x_u * x_u * uu + 2.0 * x_u * x_v * uv + x_v * x_v * vv)
    sy = np.sqrt(y_u * y_u * uu + 2.0 * y_u * y_v * uv + y_v * y_v * vv)
    rho = (x_u * y_u * uu + (x_u * y_v + x_v * y_u) * uv + x_v * y_v * vv) / (sx * sy)
    at = Places(x, y, sx, sy, rho)
    black, by_x, by_y, by_sx, by_sy, by_rho = blurred_blackness(at, pattern)

    terms = samples.light
    dark = p[BLACK] @ terms
    contrast = p[WHITE] @ terms - dark
    light = 1.0 - black
    bent = 1.0 + p[TONE] * light
    toned = (1.0 + p[TONE]) * light / bent
    seen, grey = dark + contrast * toned, samples.grey
    residual = grey - seen
    with np.errstate(divide="ignore"):
        weight = np.where(np.abs(residual) > outlier, (outlier / residual) ** 2, 1.0)

    # d(value)/d(blackness), and then the chain rule.
    slope = -contrast * (1.0 + p[TONE]) / bent**2
    gu = slope * (by_x * x_u + by_y * y_u)
    gv = slope * (by_x * x_v + by_y * y_v)
    # sigma_x^2, sigma_y^2 and their covariance are linear in those of the blur.
    fx = slope * (by_sx - by_rho * rho / sx) / (2.0 * sx)
    fy = slope * (by_sy - by_rho * rho / sy) / (2.0 * sy)
    fxy = slope * by_rho / (sx * sy)
    # The pattern moves with the homography: against its own gradient.
    gu, gv = gu / (p[6] * x + p[7] * y + 1.0), gv / (p[6] * x + p[7] * y + 1.0)
    moved = gu * u + gv * v
    jacobian = np.empty((PARAMETERS, len(u)))
    jacobian[HOMOGRAPHY] = -gu * x, -gu * y, -gu, -gv * x, -gv * y, -gv, moved * x, moved * y
    jacobian[WHITE] = toned * terms
    jacobian[BLACK] = terms - jacobian[WHITE]
    jacobian[BLUR] = (
        fx * x_u**2 + fy * y_u**2 + fxy * x_u * y_u,
        2.0 * (fx * x_u * x_v + fy * y_u * y_v) + fxy * (x_u * y_v + x_v * y_u),
        fx * x_v**2 + fy * y_v**2 + fxy * x_v * y_v,
    )
    jacobian[TONE] = contrast * light * black / bent**2
    # A clipped grey value is only a lower (upper) bound of the light.
    clipped = (grey > 254.5) & (seen > 255.0 - _CLIP_ZONE) | (grey < 0.5) & (seen < _CLIP_ZONE)
    residual[clipped], weight[clipped], jacobian[:, clipped] = 0.0, 1.0, 0.0
    return Linearised(residual, weight, jacobian, at, contrast)


def cell_sums(pattern: Pattern, linear: Linearised) -> tuple[FloatArray, FloatArray]:
    """Sums over all pixels, for each cell (L - 1, L - 1), of the grey levels that a change from
    black to white would add, times residuals, and squared.

    Outliers are included, so that a wrong cell is noticed.
    """
    across, down = (
        np.diff(ndtr(np.clip((pattern.lines - place[:, None]) / sigma[:, None], -_REACH, _REACH)))
        for place, sigma in ((linear.at.x, linear.at.sigma_x), (linear.at.y, linear.at.sigma_y))
    )
    down = down * linear.contrast[:, None]
    return (down * linear.residual[:, None]).T @ across, (down**2).T @ across**2
