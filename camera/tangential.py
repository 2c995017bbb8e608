"""Brown's tangential distortion on top of the radial one: forward, derivative, fold and inverse.

A lens whose elements are not on one axis moves points across their radius, too. With undistorted
normalised (x, y), r = hypot(x, y) and the radial factor f of `camera.distortion`, a ray is seen at

    x f(r) + 2 p1 x y + p2 (r^2 + 2 x^2),    y f(r) + p1 (r^2 + 2 y^2) + 2 p2 x y

``tangential`` is always ``(p1, p2)``, in OpenCV's order and meaning (Brown 1966). With q = (p2, p1)
and X = (x, y) what is added is 2 (q X) X + r^2 q. Its Jacobian is symmetric, as that of the radial
part is: the distortion is the gradient of a potential. So it is one-to-one over any convex region
in which the Jacobian is positive definite, and its inverse minimises a convex function.

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
    fold_radius,
    inverse_table,
    radial_factor,
    radial_factor_derivative,
)

FloatArray = NDArray[np.float64]
Tangential = tuple[float, float]

NONE: Tangential = (0.0, 0.0)

_NODES = 4096
# Rounds of looking more closely where the first fold is; the last is between neighbouring doubles.
_REFINEMENTS = 6
_NODES_BETWEEN = 513


def tangential_shift(xy: FloatArray, tangential: Tangential) -> FloatArray:
    """By how much decentering moves points, beside the radial distortion.

    Parameters
    ----------
    xy : (..., 2) array
        Undistorted normalised coordinates.
    tangential : (float, float)
        p1, p2.

    Returns
    -------
    (..., 2) array
        Normalised.
    """
    q = np.array([tangential[1], tangential[0]])
    squared = np.sum(xy * xy, axis=-1)
    return np.asarray(2.0 * (xy @ q)[..., None] * xy + squared[..., None] * q)


def tangential_jacobian(xy: FloatArray, tangential: Tangential) -> FloatArray:
    """(..., 2, 2) derivative of `tangential_shift` by x, y."""
    q = np.array([tangential[1], tangential[0]])
    outer = xy[..., :, None] * q
    along = (xy @ q)[..., None, None] * np.eye(2)
    return np.asarray(2.0 * (along + outer + outer.swapaxes(-1, -2)))


@lru_cache(maxsize=256)
def one_to_one_radius(coef: Coef, tangential: Tangential) -> float:
    """r_max: the undistorted radius up to which no two rays are seen at the same place.

    Without tangential terms the radial distortion's `fold_radius`; with them the largest radius
    below which the Jacobian is positive definite in all directions, and at most `RADIUS_LIMIT`.

    Parameters
    ----------
    coef : tuple of 5 floats
        a2, a3, b1, b2, b3.
    tangential : (float, float)
        p1, p2.

    Returns
    -------
    float
        r_max > 0.
    """
    if not any(tangential):
        return fold_radius(coef)
    amount = math.hypot(*tangential)
    limit = min(fold_radius(coef), RADIUS_LIMIT)
    radius = np.tan(np.linspace(0.0, math.atan(limit), _NODES))
    radius[-1] = limit
    for _ in range(_REFINEMENTS):
        folded = ~(_least_determinant(radius, coef, amount) > 0.0)
        first = int(np.argmax(folded))
        if not folded[first]:
            break
        # At 0 the determinant is 1.
        radius = np.linspace(radius[max(first - 1, 0)], radius[first], _NODES_BETWEEN)
    else:
        return float(radius[0])
    return limit


def _least_determinant(radius: FloatArray, coef: Coef, amount: float) -> FloatArray:
    """The Jacobian's smallest determinant on circles; `amount` is |(p1, p2)|.

    In the direction of the radius and across it, at an angle of cosine c to q, the Jacobian is
    [[g' + 6 b c, 2 b s], [2 b s, f + 2 b c]] with b = r |q|: a parabola in c.
    """
    factor = radial_factor(radius, coef)
    with np.errstate(all="ignore"):
        growth = factor + radius * radial_factor_derivative(radius, coef)
        b = radius * amount
        mean = growth + 3.0 * factor
        c = np.where(b > 0.0, np.clip(-mean / (16.0 * b), -1.0, 1.0), -1.0)
        return np.asarray(growth * factor - 4.0 * b * b + 2.0 * b * mean * c + 16.0 * (b * c) ** 2)


def straightened(
    distorted: FloatArray, coef: Coef, tangential: Tangential, r_max: float
) -> FloatArray:
    """Undistorted normalised coordinates of distorted ones, radial and tangential terms undone.

    Newton's method from the radial inverse (`camera.tangential_kernels.straightened_point`).

    Parameters
    ----------
    distorted : (..., 2) array
        Distorted normalised coordinates.
    coef : tuple of 5 floats
        a2, a3, b1, b2, b3.
    tangential : (float, float)
        p1, p2.
    r_max : float
        Of `one_to_one_radius`.

    Returns
    -------
    (..., 2) array
        They are seen there to 1e-12 of the larger of 1 and the distorted radius; both NaN where
        nothing is seen.
    """
    from camera.tangential_kernels import straighten_points

    seen = np.ascontiguousarray(distorted, dtype=np.float64).reshape(-1, 2)
    with np.errstate(over="ignore"):
        radius = np.hypot(seen[:, 0], seen[:, 1])
    seen_there, there = inverse_table(coef)
    straight = np.empty_like(seen)
    lens = np.array([*coef, *tangential, r_max])
    straighten_points(lens, seen, np.interp(radius, seen_there, there), straight)
    return straight.reshape(np.shape(distorted))


def first_unseen(border: FloatArray, coef: Coef, tangential: Tangential) -> int:
    """Index of the first of (N, 2) distorted normalised places at which nothing is seen; -1: none.

    What is seen is a region without holes: it holds an image whose border it holds.
    """
    r_max = one_to_one_radius(coef, tangential)
    unseen = np.isnan(straightened(border, coef, tangential, r_max)[:, 0])
    return int(np.argmax(unseen)) if unseen.any() else -1
