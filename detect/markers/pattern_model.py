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
from scipy.special import ndtr

FloatArray = NDArray[np.float64]

#: Columns of the Jacobian, for each part of a `Model`; the homography's last entry is 1.
PARAMETERS = 24
HOMOGRAPHY, WHITE, BLACK = slice(0, 8), slice(8, 14), slice(14, 20)
BLUR, TONE = slice(20, 23), 23

#: Clipped pixels do not count if the model is this near the limit, grey levels, or beyond.
_CLIP_ZONE = 6.0
#: Standard deviations beyond which the normal distribution is 0 or 1.
_REACH = 3.6
#: Twice the negative exponent beyond which a cell's corner adds nothing: exp(-6) and less.
_FAR_FROM_CORNER = 12.0
_LEAST_CORRELATION, _LARGEST_CORRELATION = 0.02, 0.96
_ROOT_HALF, _ROOT_2PI = math.sqrt(0.5), math.sqrt(2.0 * math.pi)
#: Gauss and Legendre's quadrature over (0, 1).
NODES = (0.1127016653792583, 0.5, 0.8872983346207417)
_WEIGHTS = (0.2777777777777778, 0.4444444444444444, 0.2777777777777778)


class Pattern(NamedTuple):
    """A pattern of black and white cells on the marker's unit square."""

    lines: FloatArray  # (L,) where cells end along both axes, widths of the marker, from 0 to 1
    black: FloatArray  # (L - 1, L - 1) 1 where the pattern is black
    corner: FloatArray  # (L, L) mixed differences of the pattern: weights of the cells' corners


class Samples(NamedTuple):
    """Pixels to which a marker is fitted, row by row."""

    pixel: NDArray[np.int64]  # (N, 2) u, v
    straight: FloatArray  # (N, 2) without distortion, from the marker's middle, pixels
    grey: FloatArray  # (N,)
    size: float  # distance of the farthest corner from the middle, pixels


class Model(NamedTuple):
    """How a marker is seen."""

    inverse: FloatArray  # (3, 3) homography from straight positions to the unit square
    denominator: FloatArray  # (2,) h20 and h21 of the homography from the unit square
    white: FloatArray  # (6,) grey level: factors of 1, x, y, x^2, xy, y^2 in sizes
    black: FloatArray  # (6,)
    blur: FloatArray  # (3,) covariance uu, uv, vv, pixels squared
    tone: float  # bend of the tone curve


class MarkerPlace(NamedTuple):
    """A pixel's place on the marker in widths, by its straight position, and the blur there."""

    x: float
    y: float
    x_u: float
    x_v: float
    y_u: float
    y_v: float
    sigma_x: float
    sigma_y: float
    correlation: float


class Blackness(NamedTuple):
    """The blurred pattern at a place, 1 for black, and its derivatives."""

    value: float
    by_x: float
    by_y: float
    by_sigma_x: float
    by_sigma_y: float
    by_correlation: float


class Linearised(NamedTuple):
    """A model at N pixels."""

    residual: FloatArray  # (N,)
    weight: FloatArray  # (N,) of robust least squares
    jacobian: FloatArray  # (N, PARAMETERS)
    place: FloatArray  # (N, 2) on the marker, in widths
    sigma: FloatArray  # (N, 2) of the blur there
    contrast: FloatArray  # (N,) of white and black there, grey levels


def pattern_of(lines: FloatArray, black: FloatArray) -> Pattern:
    """A pattern with the weights of its corners."""
    return Pattern(lines, black, np.diff(np.diff(np.pad(black, 1), axis=0), axis=1))


@njit(cache=True, error_model="numpy", inline="always")
def _cell_profile(
    x: float, sigma: float, lines: FloatArray, z: FloatArray, cdf: FloatArray, pdf: FloatArray
) -> tuple[int, int]:
    """Normal distribution at the cells' ends; returns the cells from, to that have a share."""
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


@njit(cache=True, error_model="numpy", inline="always")
def corner_excess(h: float, k: float, sines: tuple[float, float, float], angle: float) -> float:
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
def blurred_blackness(at: MarkerPlace, pattern: Pattern, work: FloatArray) -> Blackness:
    """Blurred pattern at a place; `work` is memory of (6, L)."""
    sx, sy = at.sigma_x, at.sigma_y
    zx, cx, px, zy, cy, py = work[0], work[1], work[2], work[3], work[4], work[5]
    x0, x1 = _cell_profile(at.x, sx, pattern.lines, zx, cx, px)
    y0, y1 = _cell_profile(at.y, sy, pattern.lines, zy, cy, py)
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
    if abs(at.correlation) > _LEAST_CORRELATION:
        r = min(max(at.correlation, -_LARGEST_CORRELATION), _LARGEST_CORRELATION)
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
                # Of the bivariate distribution less the product of its margins.
                beside_h, beside_k = (h - r * k) / root, (k - r * h) / root
                by_h = sign * px[i] * (0.5 * (1.0 + math.erf(beside_k * _ROOT_HALF)) - cy[j])
                by_k = sign * py[j] * (0.5 * (1.0 + math.erf(beside_h * _ROOT_HALF)) - cx[i])
                by_x -= by_h / sx
                by_y -= by_k / sy
                by_sx -= by_h * h / sx
                by_sy -= by_k * k / sy
                by_rho += sign * px[i] * math.exp(-0.5 * beside_k**2) / (_ROOT_2PI * root)
    return Blackness(value, by_x, by_y, by_sx, by_sy, by_rho)


@njit(cache=True, error_model="numpy", inline="always")
def _place_on_marker(model: Model, x: float, y: float) -> MarkerPlace:
    inverse = model.inverse
    q = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
    mx = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / q
    my = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / q
    ax = (inverse[0, 0] - mx * inverse[2, 0]) / q
    ay = (inverse[0, 1] - mx * inverse[2, 1]) / q
    bx = (inverse[1, 0] - my * inverse[2, 0]) / q
    by = (inverse[1, 1] - my * inverse[2, 1]) / q
    uu, uv, vv = model.blur[0], model.blur[1], model.blur[2]
    sx = math.sqrt(ax * ax * uu + 2.0 * ax * ay * uv + ay * ay * vv)
    sy = math.sqrt(bx * bx * uu + 2.0 * bx * by * uv + by * by * vv)
    rho = (ax * bx * uu + (ax * by + ay * bx) * uv + ay * by * vv) / (sx * sy)
    return MarkerPlace(mx, my, ax, ay, bx, by, sx, sy, rho)


@njit(cache=True, error_model="numpy", inline="always")
def _light(c: FloatArray, x: float, y: float) -> float:
    """Grey level of white or black at a place."""
    return float(c[0] + x * (c[1] + x * c[3] + y * c[4]) + y * (c[2] + y * c[5]))


@njit(cache=True, error_model="numpy")
def linearise(samples: Samples, pattern: Pattern, model: Model, outlier: float) -> Linearised:
    """The model at all pixels; residuals beyond `outlier` lose weight."""
    count = len(samples.grey)
    left = Linearised(
        np.zeros(count), np.ones(count), np.zeros((count, PARAMETERS)),
        np.empty((count, 2)), np.empty((count, 2)), np.empty(count),
    )  # fmt: skip
    work = np.empty((6, len(pattern.lines)))
    for n in range(count):
        x, y = samples.straight[n, 0], samples.straight[n, 1]
        at = _place_on_marker(model, x, y)
        d = blurred_blackness(at, pattern, work)
        lx, ly = x / samples.size, y / samples.size
        dark = _light(model.black, lx, ly)
        contrast = _light(model.white, lx, ly) - dark
        left.place[n], left.sigma[n] = (at.x, at.y), (at.sigma_x, at.sigma_y)
        left.contrast[n] = contrast
        light = 1.0 - d.value
        toned = light + model.tone * light * d.value
        value = dark + contrast * toned
        grey = samples.grey[n]
        # A clipped grey value says no more than that the light was at least (at most) that.
        if (grey > 254.5 and value > 255.0 - _CLIP_ZONE) or (grey < 0.5 and value < _CLIP_ZONE):
            continue
        r = grey - value
        left.residual[n] = r
        if abs(r) > outlier:
            left.weight[n] = (outlier / r) ** 2
        g = left.jacobian[n]
        # d(value)/d(blackness), and from there on by the chain rule.
        slope = -contrast * (1.0 + model.tone * (1.0 - 2.0 * light))
        gu = slope * (d.by_x * at.x_u + d.by_y * at.y_u)
        gv = slope * (d.by_x * at.x_v + d.by_y * at.y_v)
        w = model.denominator[0] * at.x + model.denominator[1] * at.y + 1.0
        # The pattern moves with the homography: against its own gradient.
        g[0], g[1], g[2] = -gu * at.x / w, -gu * at.y / w, -gu / w
        g[3], g[4], g[5] = -gv * at.x / w, -gv * at.y / w, -gv / w
        moved = (gu * x + gv * y) / w
        g[6], g[7] = moved * at.x, moved * at.y
        for i, term in enumerate((1.0, lx, ly, lx * lx, lx * ly, ly * ly)):
            g[WHITE.start + i] = toned * term
            g[BLACK.start + i] = (1.0 - toned) * term
        # sigma_x^2, sigma_y^2 and their covariance are linear in the blur's.
        sx, sy = at.sigma_x, at.sigma_y
        fx = slope * (d.by_sigma_x - d.by_correlation * at.correlation / sx) / (2.0 * sx)
        fy = slope * (d.by_sigma_y - d.by_correlation * at.correlation / sy) / (2.0 * sy)
        fxy = slope * d.by_correlation / (sx * sy)
        blur = g[BLUR]
        blur[0] = fx * at.x_u**2 + fy * at.y_u**2 + fxy * at.x_u * at.y_u
        blur[1] = 2.0 * (fx * at.x_u * at.x_v + fy * at.y_u * at.y_v)
        blur[1] += fxy * (at.x_u * at.y_v + at.x_v * at.y_u)
        blur[2] = fx * at.x_v**2 + fy * at.y_v**2 + fxy * at.x_v * at.y_v
        g[TONE] = contrast * light * d.value
    return left


def cell_sums(pattern: Pattern, left: Linearised) -> tuple[FloatArray, FloatArray]:
    """For each cell (L - 1, L - 1) the sums, over all pixels, of the grey levels that a change from
    black to white would add, times residuals and squared.

    These do not spare outliers: a cell that is not what it should be must show.
    """
    z = (pattern.lines - left.place[..., None]) / left.sigma[..., None]
    across, down = np.diff(ndtr(np.clip(z, -_REACH, _REACH)), axis=-1).transpose(1, 0, 2)
    down = down * left.contrast[:, None]
    return (down * left.residual[:, None]).T @ across, (down**2).T @ across**2
