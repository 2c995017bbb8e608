"""The rational radial distortion: forward, derivative, where it folds, and its inverse.

A ray with undistorted normalised radius r is seen at the distorted radius

    g(r) = r f(r),    f(r) = 1 + (a2 r + a3 r^2) / (1 + b1 r + b2 r^2 + b3 r^3)

(DLR Spatial Cognition data set report, camera calibration). ``coef`` is always
``(a2, a3, b1, b2, b3)``, the order of the ``.cam`` file.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Coef = tuple[float, float, float, float, float]

#: Largest undistorted radius (tangent of the angle to the optical axis) that is inverted: 89.9 deg.
RADIUS_LIMIT = 573.0

_TABLE_NODES = 4096
_NEWTON_STEPS = 60


def radial_factor(radius: NDArray[np.float64], coef: Coef) -> NDArray[np.float64]:
    """f(r), the factor by which the distortion moves a point along its radius.

    Parameters
    ----------
    radius : array
        Undistorted normalised radii (dimensionless, >= 0).
    coef : tuple of 5 floats
        a2, a3, b1, b2, b3.

    Returns
    -------
    array
        f(r), of the shape of `radius`.
    """
    a2, a3, b1, b2, b3 = coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    return np.asarray(1.0 + numerator / denominator)


def radial_factor_derivative(radius: NDArray[np.float64], coef: Coef) -> NDArray[np.float64]:
    """df/dr at `radius`; parameters as in `radial_factor`."""
    a2, a3, b1, b2, b3 = coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    d_numerator = a2 + 2.0 * a3 * radius
    d_denominator = b1 + radius * (2.0 * b2 + 3.0 * b3 * radius)
    return np.asarray(
        (d_numerator * denominator - numerator * d_denominator) / (denominator * denominator)
    )


@lru_cache(maxsize=256)
def fold_radius(coef: Coef) -> float:
    """r_max, up to which g(r) grows: the first pole of f or zero of g'.

    Past it the image folds back on itself and the projection is undefined.

    Parameters
    ----------
    coef : tuple of 5 floats
        a2, a3, b1, b2, b3.

    Returns
    -------
    float
        r_max > 0; infinity where g grows without end.
    """
    a2, a3, b1, b2, b3 = coef
    r = Polynomial([0.0, 1.0])
    numerator = Polynomial([0.0, a2, a3])
    denominator = Polynomial([1.0, b1, b2, b3])
    # g' * D^2; at r = 0 it is 1, so g grows until the first positive root.
    growth = (
        denominator**2
        + numerator * denominator
        + r * (numerator.deriv() * denominator - numerator * denominator.deriv())
    )
    roots = np.concatenate([growth.trim().roots(), denominator.trim().roots()])
    real = roots.real[np.abs(roots.imag) <= 1e-9 * np.maximum(1.0, np.abs(roots.real))]
    positive = real[real > 0.0]
    return float(positive.min()) if positive.size else float("inf")


@lru_cache(maxsize=64)
def _inverse_table(coef: Coef) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    limit = min(fold_radius(coef), RADIUS_LIMIT)
    radius = np.tan(np.linspace(0.0, np.arctan(limit), _TABLE_NODES))
    radius[-1] = limit
    distorted = radius * radial_factor(radius, coef)
    # At the fold itself rounding can spoil the order by a last digit.
    distorted = np.maximum.accumulate(distorted)
    radius.setflags(write=False)
    distorted.setflags(write=False)
    return distorted, radius


def largest_distorted_radius(coef: Coef) -> float:
    """Largest distorted radius at which a ray is seen: g at the fold or at `RADIUS_LIMIT`."""
    return float(_inverse_table(coef)[0][-1])


def undistorted_radius(distorted: NDArray[np.float64], coef: Coef) -> NDArray[np.float64]:
    """Inverse of g on [0, r_max], to 1e-12 relative to the larger of 1 and r.

    Newton's method inside a bracket from a table of g, bisecting where a step would leave it; so it
    also converges close to the fold, where g' vanishes.

    Parameters
    ----------
    distorted : array
        Distorted normalised radii (>= 0).
    coef : tuple of 5 floats
        a2, a3, b1, b2, b3.

    Returns
    -------
    array
        Undistorted radii; NaN where no ray is seen at that radius.
    """
    target = np.asarray(distorted, dtype=np.float64)
    table_g, table_r = _inverse_table(coef)
    flat = target.ravel()
    seen = np.isfinite(flat) & (flat >= 0.0) & (flat <= table_g[-1])
    goal = np.where(seen, flat, 0.0)

    upper = np.clip(np.searchsorted(table_g, goal, side="left"), 1, len(table_g) - 1)
    low, high = table_r[upper - 1].copy(), table_r[upper].copy()
    span = table_g[upper] - table_g[upper - 1]
    share = np.divide(goal - table_g[upper - 1], span, out=np.zeros_like(goal), where=span > 0.0)
    r = low + share * (high - low)
    for _ in range(_NEWTON_STEPS):
        f = radial_factor(r, coef)
        error = r * f - goal
        low = np.where(error < 0.0, r, low)
        high = np.where(error > 0.0, r, high)
        slope = f + r * radial_factor_derivative(r, coef)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = r - error / slope
        inside = (step >= low) & (step <= high)
        following = np.where(inside, step, 0.5 * (low + high))
        following = np.where(error == 0.0, r, following)
        moved = np.abs(following - r)
        r = following
        if not np.any(moved > 4e-16 * np.maximum(1.0, r)):
            break
    return np.where(seen, r, np.nan).reshape(target.shape)
