"""The share of a disc's contrast that a pixel sees, for a disc blurred by optics and pixel.

There are two formulas, `edge_shares` and `chord_shares`.

Both approximate the floor locally at each pixel, by its position and its steps from pixel to pixel
(`detect.discs.patch.PATCH`), in nominal radii. The blur is a Gaussian along the image axes, with
the optics' variance plus that of a pixel (1/12). The shares W and their derivatives by log blur
along either axis, radius, x and y are written into the six rows of the patch's `shares`.

`edge_shares` is for discs that are large compared to the blur. Across its edge such a disc is a
blurred step, slightly shifted and bent by the edge's curvature. With z the distance from the edge
and t the blur over the radius, both in the metric in which the blur is round,

    W(z, t) = Phi(-g),    g = z + t (1/2 + t Q(z, t)),

since a Gaussian blur moves an edge of curvature 1/R by sigma^2 / (2 R) towards its centre. Q is a
polynomial fitted to the exact profile (a noncentral chi-square distribution with two degrees of
freedom) over ``|z|`` <= `Z_LIMIT` and t <= `T_LIMIT`; the largest error of W is 0.0011.

`chord_shares` is for discs that appear so flat that the blur reaches across them. They are composed
of chords along the steeper image axis, at the distances s from the centre:

    W = integral k((s - s0) / h) / h  [Phi(top(s) / sigma) - Phi(bottom(s) / sigma)] ds

Along the chords the blur is exact; across, it is the kernel k(t) = 15/16 (1 - t^2)^2 of the same
variance, h = sqrt(7) sigma. The integral is a Gauss-Legendre quadrature at four angles theta, for
s = R sin(theta): as a function of the angle, the disc's tips are smooth.

All code is in single precision and without branches, so that the compiler vectorises it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from redetect.compiled import kernel

#: Single precision. For Numba it is the type, for the type checker a function.
F32: Callable[[Any], Any] = np.float32
#: Optimisations allowed in the kernels of discs: reordered sums, fused products. Not allowed is the
#: assumption that no value is NaN or infinite.
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}

#: Rows of a patch's `shares`: the share and its derivatives (for the blur, by its logarithm).
SHARE, BY_BLUR_1, BY_BLUR_2, BY_RADIUS, BY_X, BY_Y = range(6)

PIXEL_VARIANCE = 1.0 / 12.0

#: Domain of the polynomial Q, and its coefficients: rows are powers of z, columns powers of t.
Z_LIMIT, T_LIMIT = 4.0, 0.4
BEND = (
    (-1.764051e-01, 9.261172e-01, -9.298910e-01),
    (-1.769709e-01, -1.028644e00, 1.689269e00),
    (6.787577e-01, -3.150550e00, 3.804857e00),
    (-2.493398e-01, 2.102750e00, -3.483120e00),
    (-2.104200e-01, 9.209596e-01, -7.555281e-01),
    (2.401504e-02, -2.055932e-01, 2.540854e-01),
)
((_Q00, _Q01, _Q02), (_Q10, _Q11, _Q12), (_Q20, _Q21, _Q22),
 (_Q30, _Q31, _Q32), (_Q40, _Q41, _Q42), (_Q50, _Q51, _Q52)) = (
    tuple(F32(q) for q in row) for row in BEND
)  # fmt: skip
_3, _4, _5 = F32(3.0), F32(4.0), F32(5.0)
_Z_LIMIT, _T_LIMIT = F32(Z_LIMIT), F32(T_LIMIT)
#: The domain is cut off at the disc's centre, z = -1 / t.
_Z_PER_T = F32((Z_LIMIT - 1.0 / T_LIMIT) / T_LIMIT)
_ASIDE = F32(1e-6)
#: Gauss-Legendre quadrature at four nodes, two to either side of the middle.
_NEAR_NODE, _FAR_NODE = F32(0.3399810436), F32(0.8611363116)
_NEAR_WEIGHT, _FAR_WEIGHT = F32(0.6521451549), F32(0.3478548451)
#: The kernel across the chords: its reach in deviations, and its height.
_KERNEL_REACH = math.sqrt(7.0)
_KERNEL_HEIGHT = F32(15.0 / 16.0)
#: Steps along the chords get longer or shorter by at most this share over the blur.
_MOST_BEND = F32(0.7)
_SMALLEST = F32(1e-6)


class Disc(NamedTuple):
    """A disc, relative to its candidate and in nominal radii."""

    x: float
    y: float
    radius: float


class Blur(NamedTuple):
    """The optics' standard deviation along a patch's two axes, pixels."""

    first: float
    second: float


_0, _1, _2, _HALF = F32(0.0), F32(1.0), F32(2.0), F32(0.5)
_TINY = F32(1e-12)

# exp(-y) = p(y / 32)^32 with the Taylor polynomial p.
_PER_32 = F32(0.5 / 32.0)
_E2, _E3, _E4, _E5 = F32(1 / 2), F32(1 / 6), F32(1 / 24), F32(1 / 120)
_PER_ROOT_2PI = F32(1.0 / math.sqrt(2.0 * math.pi))
_FAR = F32(5.0)  #: Deviations beyond which the normal distribution is cut off.
# Abramowitz and Stegun, 26.2.17: the normal distribution's tail, within 8e-8.
_TAIL = F32(0.2316419)
_B1, _B2, _B3 = F32(0.319381530), F32(-0.356563782), F32(1.781477937)
_B4, _B5 = F32(-1.821255978), F32(1.330274429)
# asin(x) = pi / 2 - sqrt(1 - x) * polynomial(x) for x from 0 to 1 (Abramowitz and Stegun, 4.4.45).
_A0, _A1, _A2, _A3 = F32(1.5707288), F32(-0.2121144), F32(0.0742610), F32(-0.0187293)
_HALF_PI = F32(0.5 * math.pi)
# Taylor polynomials of the sine and the cosine.
_S3, _S5, _S7, _S9 = F32(-1 / 6), F32(1 / 120), F32(-1 / 5040), F32(1 / 362880)
_C2, _C4, _C6, _C8 = F32(-1 / 2), F32(1 / 24), F32(-1 / 720), F32(1 / 40320)
_C10 = F32(-1 / 3628800)


@kernel(forceinline=True, fastmath=FASTMATH)
def normal(x: float) -> tuple[float, float]:
    """Density and distribution function of a standard normal variable, within 2e-6."""
    a = min(abs(x), _FAR)
    y = a * a * _PER_32
    e = _1 - y * (_1 - y * (_E2 - y * (_E3 - y * (_E4 - y * _E5))))
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    density = e * _PER_ROOT_2PI
    k = _1 / (_1 + _TAIL * a)
    tail = density * k * (_B1 + k * (_B2 + k * (_B3 + k * (_B4 + k * _B5))))
    return density, (_1 - tail if x > _0 else tail)


@kernel(forceinline=True, fastmath=FASTMATH)
def arcsine(x: float) -> float:
    """Arcsine, within 7e-5; x is clipped to -1 and 1."""
    a = min(abs(x), _1)
    angle: float = _HALF_PI - math.sqrt(_1 - a) * (_A0 + a * (_A1 + a * (_A2 + a * _A3)))
    return angle if x > _0 else -angle


@kernel(forceinline=True, fastmath=FASTMATH)
def edge_shares(patch: Any, n: int, disc: Disc, blur: Blur) -> None:
    """W from the profile of a curved edge, for the first n pixels.

    With G the standard deviation of the blur across the edge, on the floor, and D^2 the area of the
    blur's ellipse, an edge of radius R has the curvature t = D^2 / (R G^3) in units of the blur.
    """
    shares = patch.shares
    x0, y0, r0 = F32(disc.x), F32(disc.y), F32(disc.radius)
    per_r0 = _1 / r0
    variance_1 = F32(blur.first * blur.first + PIXEL_VARIANCE)
    variance_2 = F32(blur.second * blur.second + PIXEL_VARIANCE)
    optics_1 = F32(blur.first * blur.first) / variance_1
    optics_2 = F32(blur.second * blur.second) / variance_2
    area = variance_1 * variance_2
    for i in range(n):
        # At the centre any direction will do, but there must be one.
        x = patch.x[i] - x0 + _ASIDE
        y = patch.y[i] - y0
        r = math.sqrt(x * x + y * y)
        nx, ny = x / r, y / r
        g1, g2 = patch.x1[i] * nx + patch.y1[i] * ny, patch.x2[i] * nx + patch.y2[i] * ny
        g1, g2 = g1 * g1 * variance_1, g2 * g2 * variance_2
        per_g = _1 / math.sqrt(g1 + g2 + _TINY)
        by_1, by_2 = g1 * optics_1 * per_g * per_g, g2 * optics_2 * per_g * per_g
        steps = patch.x1[i] * patch.y2[i] - patch.x2[i] * patch.y1[i]
        t = min(steps * steps * area * per_g * per_g * per_g * per_r0, _T_LIMIT)
        z_all = (r - r0) * per_g
        z = min(max(z_all, _Z_PER_T * t - _Z_LIMIT), _Z_LIMIT)
        c0 = _Q00 + t * (_Q01 + t * _Q02)
        c1 = _Q10 + t * (_Q11 + t * _Q12)
        c2 = _Q20 + t * (_Q21 + t * _Q22)
        c3 = _Q30 + t * (_Q31 + t * _Q32)
        c4 = _Q40 + t * (_Q41 + t * _Q42)
        c5 = _Q50 + t * (_Q51 + t * _Q52)
        q = c0 + z * (c1 + z * (c2 + z * (c3 + z * (c4 + z * c5))))
        q_z = c1 + z * (_2 * c2 + z * (_3 * c3 + z * (_4 * c4 + z * _5 * c5)))
        q_t = _Q01 + z * (_Q11 + z * (_Q21 + z * (_Q31 + z * (_Q41 + z * _Q51))))
        q_tt = _Q02 + z * (_Q12 + z * (_Q22 + z * (_Q32 + z * (_Q42 + z * _Q52))))
        q_t += _2 * t * q_tt
        density, outside = normal(z + t * (_HALF + t * q))
        by_z = -density * (_1 + t * t * q_z)
        by_z = by_z if z == z_all else _0
        by_t = -density * (_HALF + t * (_2 * q + t * q_t))
        by_t = by_t if t < _T_LIMIT else _0
        per_radius = by_z * per_g
        shares[SHARE, i] = _1 - outside
        shares[BY_BLUR_1, i] = by_t * t * (_2 * optics_1 - _3 * by_1) - by_z * z * by_1
        shares[BY_BLUR_2, i] = by_t * t * (_2 * optics_2 - _3 * by_2) - by_z * z * by_2
        shares[BY_RADIUS, i] = -per_radius - by_t * t * per_r0
        shares[BY_X, i] = -per_radius * nx
        shares[BY_Y, i] = -per_radius * ny


class _Pixel(NamedTuple):
    """A pixel among the chords."""

    along: float  # position along the chords, from the disc's centre, in steps of the first axis
    across: float  # position across them, radii
    slant: float  # movement along the chords for a movement of one radius across them
    reach: float  # of the kernel across, radii
    per_length: float  # steps of the first axis per radius
    growth: float  # relative growth of these steps from one to the next


@kernel(forceinline=True, fastmath=FASTMATH)
def _chord(
    theta: float, weight: float, radius: float, per_sigma: float, pixel: _Pixel
) -> tuple[float, float, float, float, float, float]:
    """The contribution of one chord to W and its derivatives.

    Derivatives are by log blur along the chords and across, position along and across, radius.
    """
    square = theta * theta
    sine = theta * (_1 + square * (_S3 + square * (_S5 + square * (_S7 + square * _S9))))
    cosine = _1 + square * (_C2 + square * (_C4 + square * (_C6 + square * (_C8 + square * _C10))))
    off = radius * sine - pixel.across
    k = off / pixel.reach
    # The kernel, and its derivative by the logarithm of its reach.
    kernel = weight * (_1 - k * k) * (_1 - k * k)
    by_reach = weight * (_1 - k * k) * (_5 * k * k - _1)
    half = radius * cosine * pixel.per_length
    middle = off * pixel.slant - pixel.along
    inside = by_z = by_along = by_end = _0
    for end in range(2):
        d = middle + half if end == 1 else middle - half
        sign = _1 if end == 1 else -_1
        bend = min(max(pixel.growth * d, -_MOST_BEND), _MOST_BEND)
        z = d * (_1 - _HALF * bend) * per_sigma
        density, below = normal(z)
        inside += sign * below
        by_z -= sign * density * z
        by_along += sign * density * (_1 - bend)
        by_end += density * (_1 - bend)
    # The end of the chord at distance s moves by -s / sqrt(R^2 - s^2) = -tan(theta).
    return (
        kernel * cosine * inside,
        kernel * cosine * by_z,
        by_reach * cosine * inside,
        kernel * cosine * by_along,
        kernel * sine * by_end,
        kernel * by_end,
    )


@kernel(forceinline=True, fastmath=FASTMATH)
def chord_shares(patch: Any, n: int, disc: Disc, blur: Blur) -> None:
    """W from the blurred chords along the patch's first axis, for the first n pixels."""
    shares = patch.shares
    x0, y0, r0 = F32(disc.x), F32(disc.y), F32(disc.radius)
    per_r0 = _1 / r0
    variance_1 = blur.first * blur.first + PIXEL_VARIANCE
    variance_2 = blur.second * blur.second + PIXEL_VARIANCE
    per_sigma = F32(1.0 / math.sqrt(variance_1))
    reach_px = F32(_KERNEL_REACH * math.sqrt(variance_2))
    optics_1 = F32(blur.first * blur.first / variance_1)
    optics_2 = F32(blur.second * blur.second / variance_2)
    growth = patch.growth
    for i in range(n):
        x, y = patch.x[i] - x0, patch.y[i] - y0
        x1, y1, x2, y2 = patch.x1[i], patch.y1[i], patch.x2[i], patch.y2[i]
        per_length = _1 / math.sqrt(x1 * x1 + y1 * y1 + _TINY)
        along_x, along_y = x1 * per_length * per_length, y1 * per_length * per_length
        across_x, across_y = -y1 * per_length, x1 * per_length
        across = x * across_x + y * across_y
        step = x2 * across_x + y2 * across_y
        step = step if abs(step) > _SMALLEST else _SMALLEST
        reach = abs(step) * reach_px
        slant = -(x2 * along_x + y2 * along_y) / step
        pixel = _Pixel(x * along_x + y * along_y, across, slant, reach, per_length, growth)
        first = arcsine((across - reach) * per_r0)
        last = arcsine((across + reach) * per_r0)
        middle, half = _HALF * (first + last), _HALF * (last - first)
        a = _chord(middle - _FAR_NODE * half, _FAR_WEIGHT, r0, per_sigma, pixel)
        b = _chord(middle - _NEAR_NODE * half, _NEAR_WEIGHT, r0, per_sigma, pixel)
        c = _chord(middle + _NEAR_NODE * half, _NEAR_WEIGHT, r0, per_sigma, pixel)
        d = _chord(middle + _FAR_NODE * half, _FAR_WEIGHT, r0, per_sigma, pixel)
        total = _KERNEL_HEIGHT * half * r0 / reach
        by_along = total * per_sigma * (a[3] + b[3] + c[3] + d[3])
        by_across = total * per_sigma * per_length * (a[4] + b[4] + c[4] + d[4])
        shares[SHARE, i] = total * (a[0] + b[0] + c[0] + d[0])
        shares[BY_BLUR_1, i] = total * optics_1 * (a[1] + b[1] + c[1] + d[1])
        shares[BY_BLUR_2, i] = total * optics_2 * (a[2] + b[2] + c[2] + d[2])
        shares[BY_RADIUS, i] = total * per_sigma * per_length * (a[5] + b[5] + c[5] + d[5])
        shares[BY_X, i] = by_along * along_x + by_across * across_x
        shares[BY_Y, i] = by_along * along_y + by_across * across_y
