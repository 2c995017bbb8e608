"""What share of a disc's contrast a pixel sees: two models of a blurred disc, with derivatives.

Both work in units of the nominal radius, on the floor, and take a patch of pixels as arrays: each
pixel sees the floor at some place, and by its step in u or v the floor moves as a Jacobian says. A
blur is given by its standard deviation along the image axes: of all of it (the optics and the pixel
itself), and of the optics alone, which is what a fit varies. Results are five rows of values,

    W, dW/dlog(blur), dW/dradius, dW/dx_centre, dW/dy_centre

`edge_shares` is for discs that are large against the blur: what a pixel sees depends on how far the
edge is from it, and on how curved the edge is there. `chord_shares`
(`detect.discs.chord_kernels`) is for discs that are seen so flat that the blur reaches across them:
along the steeper image axis the blurred chord is integrated exactly, along the other by quadrature.

All is single precision, without branches and without library functions, so that the compiler can
work on several pixels at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from detect.discs.profile import BEND, T_LIMIT, Z_LIMIT

#: Single precision. Numba knows it as the type, the type checker as a function.
F32: Callable[[Any], Any] = np.float32
#: What the compiler may do in the kernels of discs: another order of sums, products into sums. Not
#: that nothing is NaN or infinite.
FASTMATH = {"reassoc", "contract", "arcp", "nsz"}

#: Rows of the results.
SHARE, BY_BLUR, BY_RADIUS, BY_X, BY_Y = range(5)
FIELDS = 5

#: Rows of a patch's geometry for `edge_shares`: floor x, y and d(x, y)/d(u, v).
EDGE_X, EDGE_Y, EDGE_XU, EDGE_YU, EDGE_XV, EDGE_YV = range(6)
#: For `chord_shares`: floor x, y; the floor's step (x, y) along the steep axis over its squared
#: length; the unit normal of that step; how far one step along the other axis moves across the
#: chord (radii) and along it (steps); one over the length of the steep step; its relative growth
#: from one pixel to the next.
CHORD_X, CHORD_Y, ALONG_X, ALONG_Y, ACROSS_X, ACROSS_Y = range(6)
PER_STEP_ACROSS, PER_STEP_ALONG, PER_LENGTH, GROWTH = range(6, 10)
GEOMETRY = 10

#: Most pixels of a patch. Rows are stretches of this length in one flat array: at distances that
#: the compiler knows, it sees that they do not overlap.
CAPACITY = 4096

PIXEL_VARIANCE = 1.0 / 12.0

_0, _1, _2, _HALF = F32(0.0), F32(1.0), F32(2.0), F32(0.5)
_TINY = F32(1e-12)
_ASIDE = F32(1e-6)
_Z_LIMIT = F32(Z_LIMIT)
_T_LIMIT = F32(T_LIMIT)
_Q00, _Q01, _Q02 = (F32(q) for q in BEND[0])
_Q10, _Q11, _Q12 = (F32(q) for q in BEND[1])
_Q20, _Q21, _Q22 = (F32(q) for q in BEND[2])
_Q30, _Q31, _Q32 = (F32(q) for q in BEND[3])
_Q40, _Q41, _Q42 = (F32(q) for q in BEND[4])
_Q50, _Q51, _Q52 = (F32(q) for q in BEND[5])
_3, _4, _5 = F32(3.0), F32(4.0), F32(5.0)
#: The polynomial ends where the disc does: at z = -1 / t is the centre.
_Z_PER_T = F32((Z_LIMIT - 1.0 / T_LIMIT) / T_LIMIT)
_TWO_THIRDS = F32(2.0 / 3.0)

# exp(-y) = p(y / 32)^32 with the Taylor polynomial p.
_PER_32 = F32(0.5 / 32.0)
_E2, _E3, _E4, _E5 = F32(1 / 2), F32(1 / 6), F32(1 / 24), F32(1 / 120)
_PER_ROOT_2PI = F32(1.0 / math.sqrt(2.0 * math.pi))
#: Where the normal distribution ends, deviations.
FAR = F32(5.0)
# Abramowitz and Stegun, 26.2.17: the normal distribution's tail, within 8e-8.
_TAIL = F32(0.2316419)
_B1, _B2, _B3 = F32(0.319381530), F32(-0.356563782), F32(1.781477937)
_B4, _B5 = F32(-1.821255978), F32(1.330274429)


@njit(cache=True, error_model="numpy", inline="always", fastmath=FASTMATH)
def normal(x: float) -> tuple[float, float]:
    """Density and distribution function of a standard normal variable, within 2e-6."""
    a = min(abs(x), FAR)
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


@njit(cache=True, error_model="numpy", forceinline=True, fastmath=FASTMATH)
def edge_shares(
    geometry: NDArray[np.float32],
    n: int,
    x_centre: float,
    y_centre: float,
    radius: float,
    blur_u: float,
    blur_v: float,
    fields: NDArray[np.float32],
) -> None:
    """W by the profile of a curved edge (see `detect.discs.profile`), for the first n pixels.

    Distance from the edge and its curvature are counted in the metric in which the blur is round:
    with G the deviation of the blur across the edge, on the floor, and D that of its area, an edge
    of radius R has the curvature D^2 / (R G^3) in units of the blur.
    """
    x0, y0, r0 = F32(x_centre), F32(y_centre), F32(radius)
    per_r0 = _1 / r0
    variance_u = F32(blur_u * blur_u + PIXEL_VARIANCE)
    variance_v = F32(blur_v * blur_v + PIXEL_VARIANCE)
    area = variance_u * variance_v
    optics_u = F32(blur_u * blur_u) / variance_u
    optics_v = F32(blur_v * blur_v) / variance_v
    for i in range(n):
        # At the centre itself any direction will do, but one there must be.
        x = geometry[EDGE_X * CAPACITY + i] - x0 + _ASIDE
        y = geometry[EDGE_Y * CAPACITY + i] - y0
        xu = geometry[EDGE_XU * CAPACITY + i]
        yu = geometry[EDGE_YU * CAPACITY + i]
        xv = geometry[EDGE_XV * CAPACITY + i]
        yv = geometry[EDGE_YV * CAPACITY + i]
        r = math.sqrt(x * x + y * y)
        nx = x / r
        ny = y / r
        gu = xu * nx + yu * ny
        gv = xv * nx + yv * ny
        gu = gu * gu * variance_u
        gv = gv * gv * variance_v
        per_g = _1 / math.sqrt(gu + gv + _TINY)
        optics = (gu * optics_u + gv * optics_v) * per_g * per_g
        steps = xu * yv - xv * yu
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
        per_radius = by_z * per_g
        fields[SHARE * CAPACITY + i] = _1 - outside
        fields[BY_BLUR * CAPACITY + i] = (by_t * t - by_z * z) * optics
        fields[BY_RADIUS * CAPACITY + i] = -per_radius - by_t * t * per_r0
        fields[BY_X * CAPACITY + i] = -per_radius * nx
        fields[BY_Y * CAPACITY + i] = -per_radius * ny
