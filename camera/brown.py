"""Brown's distortion on top of the rational radial one: forward, derivative, fold and inverse.

Brown's terms are an even polynomial of the radius and, for a lens whose elements are not on one
axis, tangential terms that move points across their radius, too. With undistorted normalised
(x, y), r = hypot(x, y) and the rational factor f of `camera.distortion`, a ray is seen at

    x (f(r) + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),
    y (f(r) + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

``brown`` is always ``(k1, k2, p1, p2, k3)``, in OpenCV's order and meaning; where f is 1 that is
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

import numpy as np
from numpy.typing import NDArray

from camera.distortion import (
    RADIUS_LIMIT,
    Coef,
    Polynomial,
    fold_radius,
    inverse_table,
    radial_factor,
    radial_factor_derivative,
)

FloatArray = NDArray[np.float64]
Brown = tuple[float, float, float, float, float]
Tangential = tuple[float, float]

NOT_TANGENTIAL: Tangential = (0.0, 0.0)

_NODES = 4096
# Rounds of refining the place of the first fold; the last is between neighbouring doubles.
_REFINEMENTS = 6
_NODES_BETWEEN = 513


def brown_of(polynomial: Polynomial, tangential: Tangential) -> Brown:
    """(k1, k2, p1, p2, k3) of (k1, k2, k3) and (p1, p2)."""
    k1, k2, k3 = polynomial
    return k1, k2, *tangential, k3


def polynomial_of(brown: Brown) -> Polynomial:
    """(k1, k2, k3)."""
    return brown[0], brown[1], brown[4]


def brown_shift(xy: FloatArray, brown: Brown) -> FloatArray:
    """By how much Brown's terms move (..., 2) points, beside the rational distortion."""
    k1, k2, p1, p2, k3 = brown
    q = np.array([p2, p1])
    squared = np.sum(xy * xy, axis=-1)
    shift = 2.0 * (xy @ q)[..., None] * xy + squared[..., None] * q
    if any(polynomial_of(brown)):
        shift = shift + (squared * (k1 + squared * (k2 + squared * k3)))[..., None] * xy
    return np.asarray(shift)


def brown_jacobian(xy: FloatArray, brown: Brown) -> FloatArray:
    """(..., 2, 2) derivative of `brown_shift` by x, y."""
    k1, k2, p1, p2, k3 = brown
    q = np.array([p2, p1])
    outer = xy[..., :, None] * q
    along = (xy @ q)[..., None, None] * np.eye(2)
    jacobian = 2.0 * (along + outer + outer.swapaxes(-1, -2))
    if any(polynomial_of(brown)):
        squared = np.sum(xy * xy, axis=-1)[..., None, None]
        # d(x p)/dx = p + x dp/dx, and the derivative of p by r is r times what is in brackets.
        jacobian = jacobian + squared * (k1 + squared * (k2 + squared * k3)) * np.eye(2)
        slope = 2.0 * k1 + squared * (4.0 * k2 + squared * (6.0 * k3))
        jacobian = jacobian + slope * (xy[..., :, None] * xy[..., None, :])
    return np.asarray(jacobian)


def distorted_jacobian(xy: FloatArray, coef: Coef, brown: Brown) -> FloatArray:
    """(..., 2, 2) derivative of the whole distortion of (..., 2) points by x, y."""
    radius = np.hypot(xy[..., 0], xy[..., 1])
    factor = radial_factor(radius, coef)
    slope = radial_factor_derivative(radius, coef)
    # d(x f)/dx = f + f' x^2 / r; at r = 0 the second term vanishes.
    unit = xy / np.where(radius > 0.0, radius, 1.0)[..., None]
    outer = slope[..., None, None] * xy[..., :, None] * unit[..., None, :]
    jacobian = factor[..., None, None] * np.eye(2) + outer
    return jacobian + brown_jacobian(xy, brown) if any(brown) else jacobian


@lru_cache(maxsize=256)
def one_to_one_radius(coef: Coef, brown: Brown) -> float:
    """r_max: the undistorted radius up to which no two rays are seen at the same place.

    Without Brown's terms the rational distortion's `fold_radius`; with them the largest radius
    below which the Jacobian is positive definite in all directions, and at most `RADIUS_LIMIT`.
    """
    if not any(brown):
        return fold_radius(coef)
    polynomial, amount = polynomial_of(brown), math.hypot(brown[2], brown[3])
    limit = min(fold_radius(coef, polynomial), RADIUS_LIMIT)
    if amount == 0.0:
        return limit
    radius = np.tan(np.linspace(0.0, math.atan(limit), _NODES))
    radius[-1] = limit
    for _ in range(_REFINEMENTS):
        folded = ~(_least_determinant(radius, coef, polynomial, amount) > 0.0)
        first = int(np.argmax(folded))
        if not folded[first]:
            break
        # At 0 the determinant is 1.
        radius = np.linspace(radius[max(first - 1, 0)], radius[first], _NODES_BETWEEN)
    else:
        return float(radius[0])
    return limit


def _least_determinant(
    radius: FloatArray, coef: Coef, polynomial: Polynomial, amount: float
) -> FloatArray:
    """The Jacobian's smallest determinant on circles; `amount` is |(p1, p2)|.

    In the direction of the radius and across it, at an angle of cosine c to q, the Jacobian is
    [[g' + 6 b c, 2 b s], [2 b s, f + 2 b c]] with b = r |q|: a parabola in c.
    """
    factor = radial_factor(radius, coef, polynomial)
    with np.errstate(all="ignore"):
        growth = factor + radius * radial_factor_derivative(radius, coef, polynomial)
        b = radius * amount
        mean = growth + 3.0 * factor
        c = np.where(b > 0.0, np.clip(-mean / (16.0 * b), -1.0, 1.0), -1.0)
        return np.asarray(growth * factor - 4.0 * b * b + 2.0 * b * mean * c + 16.0 * (b * c) ** 2)


def straightened(distorted: FloatArray, coef: Coef, brown: Brown, r_max: float) -> FloatArray:
    """Undistorted normalised coordinates of distorted ones, all terms undone.

    Newton's method from the radial inverse (`camera.brown_kernels.straightened_point`).
    """
    from camera.brown_kernels import straighten_points

    seen = np.ascontiguousarray(distorted, dtype=np.float64).reshape(-1, 2)
    with np.errstate(over="ignore"):
        radius = np.hypot(seen[:, 0], seen[:, 1])
    seen_there, there = inverse_table(coef, polynomial_of(brown))
    straight = np.empty_like(seen)
    lens = np.array([*coef, *brown, r_max])
    straighten_points(lens, seen, np.interp(radius, seen_there, there), straight)
    return straight.reshape(np.shape(distorted))


def first_unseen(border: FloatArray, coef: Coef, brown: Brown) -> int:
    """Index of the first of (N, 2) distorted normalised places at which nothing is seen; -1: none.

    The visible region has no holes: it contains an image whose border it contains.
    """
    r_max = one_to_one_radius(coef, brown)
    unseen = np.isnan(straightened(border, coef, brown, r_max)[:, 0])
    return int(np.argmax(unseen)) if unseen.any() else -1
