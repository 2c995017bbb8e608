"""Lens distortion: forward, derivative, the fold, and the inverse.

A ray with undistorted normalised radius r has the distorted radius

    g(r) = r f(r),    f(r) = 1 + (a2 r + a3 r^2) / (1 + b1 r + b2 r^2 + b3 r^3)

(DLR Spatial Cognition data set report, camera calibration). ``coef`` is always
``(a2, a3, b1, b2, b3)``, the order of the ``.cam`` file. Models of other programs also have Brown's
terms: an even polynomial, k1 r^2 + k2 r^4 + k3 r^6 added to f, and, for decentred lenses,
tangential terms that also move points across their radius: (x, y) is distorted to

    x (f(r) + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),
    y (f(r) + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

In OpenCV's order, ``(k1, k2, p1, p2, k3)``, they are called ``brown``; where f is 1 that is
OpenCV's model of five coefficients. With q = (p2, p1) and X = (x, y) the tangential terms are
2 (q X) X + r^2 q. Their Jacobian is symmetric, as that of the radial part is: the distortion is the
gradient of a potential. So it is one-to-one over any convex region in which the Jacobian is
positive definite, and its inverse minimises a convex function.

References
----------
D. C. Brown, Decentering distortion of lenses, Photogrammetric Engineering 32(3), 1966.
OpenCV, Camera Calibration and 3D Reconstruction.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyder, polymul, polymulx, polyroots, polysub
from numpy.typing import ArrayLike

from redetect.array_types import FloatArray

Coef = tuple[float, float, float, float, float]
Polynomial = tuple[float, float, float]
Brown = tuple[float, float, float, float, float]
Tangential = tuple[float, float]

#: Largest plausible coefficient; it also keeps all computations finite.
LARGEST_COEFFICIENT = 1e6

#: Largest undistorted radius (tangent of the angle to the optical axis) that is inverted: 89.9 deg.
RADIUS_LIMIT = 573.0

# So fine that after linear interpolation in the table one step of Newton's method suffices.
_TABLE_NODES = 16384
_NEWTON_STEPS = 60
# Coefficients of a polynomial in r that are negligible even at `RADIUS_LIMIT`.
_NEGLIGIBLE = 1e-30
# Folds farther out than 89.994 deg are rounding, not distortion.
_SMALLEST_INVERSE = 1e-4
_LAST_STEP = 1e-9

_NODES = 4096


class Lens(NamedTuple):
    """The coefficients of a distortion."""

    coef: Coef  #: a2, a3, b1, b2, b3
    polynomial: Polynomial = (0.0, 0.0, 0.0)  #: k1, k2, k3
    tangential: Tangential = (0.0, 0.0)  #: p1, p2

    @property
    def brown(self) -> Brown:
        """k1, k2, p1, p2, k3, in OpenCV's order."""
        k1, k2, k3 = self.polynomial
        return k1, k2, *self.tangential, k3


def radial_factor(radius: FloatArray, lens: Lens) -> FloatArray:
    """f(r), the factor of the distortion at undistorted normalised radii r >= 0."""
    a2, a3, b1, b2, b3 = lens.coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    factor = 1.0 + numerator / denominator
    if any(lens.polynomial):
        k1, k2, k3 = lens.polynomial
        squared = radius * radius
        factor = factor + squared * (k1 + squared * (k2 + squared * k3))
    return np.asarray(factor)


def radial_factor_derivative(radius: FloatArray, lens: Lens) -> FloatArray:
    """df/dr at `radius`."""
    a2, a3, b1, b2, b3 = lens.coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    d_numerator = a2 + 2.0 * a3 * radius
    d_denominator = b1 + radius * (2.0 * b2 + 3.0 * b3 * radius)
    slope = (d_numerator * denominator - numerator * d_denominator) / (denominator * denominator)
    if any(lens.polynomial):
        k1, k2, k3 = lens.polynomial
        squared = radius * radius
        slope = slope + radius * (2.0 * k1 + squared * (4.0 * k2 + squared * (6.0 * k3)))
    return np.asarray(slope)


@lru_cache(maxsize=256)
def fold_radius(lens: Lens) -> float:
    """r_max without tangential terms, up to which g(r) grows: the first pole of f or zero of g'.

    Past it the image folds back on itself and the projection is undefined.
    """
    a2, a3, b1, b2, b3 = lens.coef
    k1, k2, k3 = lens.polynomial
    # Coefficients of powers of r, the lowest first; NumPy's classes for them take much longer.
    numerator, denominator = [0.0, a2, a3], [1.0, b1, b2, b3]
    polynomial_growth = [1.0, 0.0, 3.0 * k1, 0.0, 5.0 * k2, 0.0, 7.0 * k3]
    # g' D^2; at r = 0 it is 1, so g grows until the first positive root.
    growth = polymul(polymul(denominator, denominator), polynomial_growth)
    growth = polyadd(growth, polymul(numerator, denominator))
    of_numerator = polymul(polyder(numerator), denominator)
    of_denominator = polymul(numerator, polyder(denominator))
    growth = polyadd(growth, polymulx(polysub(of_numerator, of_denominator)))
    # Stay a little short of a root, so that rounding does not reach past it: near a pole even of
    # second order the denominator must remain more than rounding.
    fold = _first_positive_root(growth) * (1.0 - 1e-12)
    pole = _first_positive_root(denominator) * (1.0 - 1e-7)
    return min(fold, pole)


def _first_positive_root(polynomial: ArrayLike) -> float:
    """The smallest positive root of a polynomial in r whose constant term is 1."""
    # In 1/r the polynomial is monic and the root sought the largest one, so that it is found well
    # even when the higher coefficients all but vanish.
    coefficients = np.asarray(polynomial, np.float64)
    last = np.flatnonzero(np.abs(coefficients) > _NEGLIGIBLE)[-1]
    inverse = polyroots(coefficients[last::-1])
    # Rounding can make a conjugate pair of a double root.
    real = inverse.real[np.abs(inverse.imag) <= 1e-6 * np.abs(inverse)]
    largest = float(max(real, default=0.0))
    return 1.0 / largest if largest > _SMALLEST_INVERSE else float("inf")


@lru_cache(maxsize=64)
def inverse_table(lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Distorted radii, growing, and the undistorted radii that are seen there.

    16384 of each, from 0 to the fold or `RADIUS_LIMIT`; read only.
    """
    limit = min(fold_radius(lens), RADIUS_LIMIT)
    radius = np.tan(np.linspace(0.0, np.arctan(limit), _TABLE_NODES))
    radius[-1] = limit
    distorted = radius * radial_factor(radius, lens)
    # At the fold itself rounding can spoil the order by a last digit.
    distorted = np.maximum.accumulate(distorted)
    radius.setflags(write=False)
    distorted.setflags(write=False)
    return distorted, radius


def undistorted_radius(distorted: FloatArray, lens: Lens) -> FloatArray:
    """Inverse of g on [0, r_max], to 1e-12 relative to the larger of 1 and r; NaN beyond.

    (At the fold itself g' vanishes, so there r is only as good as the last digit of g allows, 1e-8;
    g of the result is right to the last digits.) Newton's method, within the cell of a table of g.
    """
    target = np.asarray(distorted, dtype=np.float64)
    table_g, table_r = inverse_table(lens)
    goal = np.where((target >= 0.0) & (target <= table_g[-1]), target, np.nan)
    upper = np.clip(np.searchsorted(table_g, goal), 1, len(table_g) - 1)
    low, high = table_r[upper - 1], table_r[upper]
    r = np.clip(np.interp(goal, table_g, table_r), low, high)
    ended = np.isnan(goal)
    for _ in range(_NEWTON_STEPS):
        f = radial_factor(r, lens)
        error = goal - r * f
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = error / (f + r * radial_factor_derivative(r, lens))
        moved = np.clip(r + np.where(error == 0.0, 0.0, step), low, high)
        # Newton's error is squared by each step: after one this small it has converged.
        small = np.abs(moved - r) <= _LAST_STEP * np.maximum(1.0, r)
        r = np.where(ended, r, moved)
        ended = ended | small
        if ended.all():
            break
    return np.asarray(r)


def tangential_shift(xy: FloatArray, tangential: Tangential) -> FloatArray:
    """Displacement of (..., 2) points by the tangential terms, in addition to the radial ones."""
    q = np.array(tangential[::-1])
    return np.asarray(2.0 * (xy @ q)[..., None] * xy + np.sum(xy * xy, axis=-1)[..., None] * q)


def before_fold(xy: FloatArray, lens: Lens) -> FloatArray:
    """(..., 2) undistorted coordinates, NaN where the lens does not see them (past r_max)."""
    radius = np.hypot(xy[..., 0], xy[..., 1])
    seen = (radius <= one_to_one_radius(lens)) & np.isfinite(radius)
    return np.where(seen[..., None], xy, np.nan)


def distort(xy: FloatArray, lens: Lens) -> FloatArray:
    """(..., 2) distorted coordinates of (..., 2) undistorted ones."""
    result = xy * radial_factor(np.hypot(xy[..., 0], xy[..., 1]), lens)[..., None]
    if any(lens.tangential):
        result = result + tangential_shift(xy, lens.tangential)
    return np.asarray(result)


def distorted_jacobian(xy: FloatArray, lens: Lens) -> FloatArray:
    """(..., 2, 2) derivative of the whole distortion with respect to (..., 2) points."""
    q = np.array(lens.tangential[::-1])
    radius = np.hypot(xy[..., 0], xy[..., 1])
    factor = radial_factor(radius, lens)
    slope = radial_factor_derivative(radius, lens)
    # d(x f)/dx = f + f' x^2 / r; at r = 0 the second term vanishes.
    unit = xy / np.where(radius > 0.0, radius, 1.0)[..., None]
    outer = slope[..., None, None] * xy[..., :, None] * unit[..., None, :]
    jacobian = factor[..., None, None] * np.eye(2) + outer
    if q.any():
        outer = xy[..., :, None] * q
        along = (xy @ q)[..., None, None] * np.eye(2)
        jacobian += 2.0 * (along + outer + outer.swapaxes(-1, -2))
    return np.asarray(jacobian)


@lru_cache(maxsize=256)
def one_to_one_radius(lens: Lens) -> float:
    """r_max: the undistorted radius up to which no two rays have the same image.

    Without Brown's terms the rational distortion's `fold_radius`; with them the largest radius
    below which the Jacobian is positive definite in all directions, and at most `RADIUS_LIMIT`.
    """
    if not any(lens.brown):
        return fold_radius(lens)
    limit = min(fold_radius(lens), RADIUS_LIMIT)
    if not any(lens.tangential):
        return limit
    radius = np.tan(np.linspace(0.0, math.atan(limit), _NODES))
    radius[-1] = limit
    folded = ~(_least_determinant(radius, lens) > 0.0)
    if not folded.any():
        return limit
    first = int(np.argmax(folded))  # at 0 the determinant is 1
    before, after = float(radius[first - 1]), float(radius[first])
    # Bisection, down to neighbouring doubles.
    while before < (middle := 0.5 * (before + after)) < after:
        if _least_determinant(np.array(middle), lens) > 0.0:
            before = middle
        else:
            after = middle
    return before


def _least_determinant(radius: FloatArray, lens: Lens) -> FloatArray:
    """The Jacobian's smallest determinant on circles.

    In the direction of the radius and across it, at an angle of cosine c to q, the Jacobian is
    [[g' + 6 b c, 2 b s], [2 b s, f + 2 b c]] with b = r |q|: a parabola in c.
    """
    factor = radial_factor(radius, lens)
    with np.errstate(all="ignore"):
        growth = factor + radius * radial_factor_derivative(radius, lens)
        b = radius * math.hypot(*lens.tangential)
        mean = growth + 3.0 * factor
        c = np.where(b > 0.0, np.clip(-mean / (16.0 * b), -1.0, 1.0), -1.0)
        return np.asarray(growth * factor - 4.0 * b * b + 2.0 * b * mean * c + 16.0 * (b * c) ** 2)


def undistort(distorted: FloatArray, lens: Lens) -> FloatArray:
    """Undistorted normalised coordinates of distorted ones, all terms undone.

    Newton's method from the radial inverse (`camera.kernels.undistort_point`).
    """
    from camera.kernels import undistort_points

    seen = np.ascontiguousarray(distorted, dtype=np.float64).reshape(-1, 2)
    with np.errstate(over="ignore"):
        radius = np.hypot(seen[:, 0], seen[:, 1])
    seen_there, there = inverse_table(lens)
    straight = np.empty_like(seen)
    numbers = np.array([*lens.coef, *lens.brown, one_to_one_radius(lens)])
    undistort_points(numbers, seen, np.interp(radius, seen_there, there), straight)
    return straight.reshape(np.shape(distorted))
