"""The radial distortion: forward, derivative, where it folds, and its inverse.

A ray with undistorted normalised radius r is seen at the distorted radius

    g(r) = r f(r),    f(r) = 1 + (a2 r + a3 r^2) / (1 + b1 r + b2 r^2 + b3 r^3)

(DLR Spatial Cognition data set report, camera calibration). ``coef`` is always
``(a2, a3, b1, b2, b3)``, the order of the ``.cam`` file. Lenses of other programs also have an even
polynomial: to f is added k1 r^2 + k2 r^4 + k3 r^6, and ``polynomial`` is always ``(k1, k2, k3)``.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial as PowerSeries
from numpy.typing import NDArray

Coef = tuple[float, float, float, float, float]
Polynomial = tuple[float, float, float]

NO_POLYNOMIAL: Polynomial = (0.0, 0.0, 0.0)

#: Coefficients beyond this are no distortion; it also keeps all that follows finite.
LARGEST_COEFFICIENT = 1e6

#: Largest undistorted radius (tangent of the angle to the optical axis) that is inverted: 89.9 deg.
RADIUS_LIMIT = 573.0

# So fine that the table's linear interpolation needs but one step of Newton's method.
_TABLE_NODES = 16384
_NEWTON_STEPS = 60
# Coefficients of a polynomial in r that make no difference even at `RADIUS_LIMIT`.
_NEGLIGIBLE = 1e-30
# Folds farther out than 89.994 deg are rounding, not distortion.
_SMALLEST_INVERSE = 1e-4
_LAST_STEP = 1e-9


def radial_factor(
    radius: NDArray[np.float64], coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL
) -> NDArray[np.float64]:
    """f(r), the factor by which the distortion moves a point along its radius."""
    a2, a3, b1, b2, b3 = coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    factor = 1.0 + numerator / denominator
    if any(polynomial):
        k1, k2, k3 = polynomial
        squared = radius * radius
        factor = factor + squared * (k1 + squared * (k2 + squared * k3))
    return np.asarray(factor)


def radial_factor_derivative(
    radius: NDArray[np.float64], coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL
) -> NDArray[np.float64]:
    """df/dr at `radius`; parameters as in `radial_factor`."""
    a2, a3, b1, b2, b3 = coef
    numerator = radius * (a2 + radius * a3)
    denominator = 1.0 + radius * (b1 + radius * (b2 + radius * b3))
    d_numerator = a2 + 2.0 * a3 * radius
    d_denominator = b1 + radius * (2.0 * b2 + 3.0 * b3 * radius)
    slope = (d_numerator * denominator - numerator * d_denominator) / (denominator * denominator)
    if any(polynomial):
        k1, k2, k3 = polynomial
        squared = radius * radius
        slope = slope + radius * (2.0 * k1 + squared * (4.0 * k2 + squared * (6.0 * k3)))
    return np.asarray(slope)


@lru_cache(maxsize=256)
def fold_radius(coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL) -> float:
    """r_max, up to which g(r) grows: the first pole of f or zero of g'.

    Past it the image folds back on itself and the projection is undefined.
    """
    a2, a3, b1, b2, b3 = coef
    r = PowerSeries([0.0, 1.0])
    numerator = PowerSeries([0.0, a2, a3])
    denominator = PowerSeries([1.0, b1, b2, b3])
    # g' * D^2; at r = 0 it is 1, so g grows until the first positive root.
    growth = (
        denominator**2
        + numerator * denominator
        + r * (numerator.deriv() * denominator - numerator * denominator.deriv())
    )
    if any(polynomial):
        k1, k2, k3 = polynomial
        steps = PowerSeries([0.0, 0.0, 3.0 * k1, 0.0, 5.0 * k2, 0.0, 7.0 * k3])
        growth = growth + steps * denominator**2
    # Stay a little short of a root, so that rounding does not reach past it: near a pole even of
    # second order the denominator must remain more than rounding.
    fold = _first_positive_root(growth) * (1.0 - 1e-12)
    pole = _first_positive_root(denominator) * (1.0 - 1e-7)
    return min(fold, pole)


def _first_positive_root(polynomial: PowerSeries) -> float:
    """The smallest positive root of a polynomial whose constant term is 1."""
    # In 1/r the polynomial is monic and the root sought the largest one, so that it is found well
    # even when the higher coefficients all but vanish.
    inverse = PowerSeries(polynomial.trim(_NEGLIGIBLE).coef[::-1]).roots()
    # Rounding can make a conjugate pair of a double root.
    real = inverse.real[np.abs(inverse.imag) <= 1e-6 * np.abs(inverse)]
    largest = float(max(real, default=0.0))
    return 1.0 / largest if largest > _SMALLEST_INVERSE else float("inf")


@lru_cache(maxsize=64)
def inverse_table(
    coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distorted radii, growing, and the undistorted radii that are seen there.

    16384 of each, from 0 to the fold or `RADIUS_LIMIT`; read only.
    """
    limit = min(fold_radius(coef, polynomial), RADIUS_LIMIT)
    radius = np.tan(np.linspace(0.0, np.arctan(limit), _TABLE_NODES))
    radius[-1] = limit
    distorted = radius * radial_factor(radius, coef, polynomial)
    # At the fold itself rounding can spoil the order by a last digit.
    distorted = np.maximum.accumulate(distorted)
    radius.setflags(write=False)
    distorted.setflags(write=False)
    return distorted, radius


def largest_distorted_radius(coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL) -> float:
    """Largest distorted radius at which a ray is seen: g at the fold or at `RADIUS_LIMIT`."""
    return float(inverse_table(coef, polynomial)[0][-1])


def undistorted_radius(
    distorted: NDArray[np.float64], coef: Coef, polynomial: Polynomial = NO_POLYNOMIAL
) -> NDArray[np.float64]:
    """Inverse of g on [0, r_max], to 1e-12 relative to the larger of 1 and r.

    (At the fold itself g' vanishes, so there r is only as good as the last digit of g allows, 1e-8;
    g of the result is always right to the last digits.)

    Newton's method, kept inside the cell of a table of g.
    """
    target = np.asarray(distorted, dtype=np.float64)
    table_g, table_r = inverse_table(coef, polynomial)
    goal = np.where((target >= 0.0) & (target <= table_g[-1]), target, np.nan)
    upper = np.clip(np.searchsorted(table_g, goal), 1, len(table_g) - 1)
    low, high = table_r[upper - 1], table_r[upper]
    r = np.clip(np.interp(goal, table_g, table_r), low, high)
    ended = np.isnan(goal)
    for _ in range(_NEWTON_STEPS):
        f = radial_factor(r, coef, polynomial)
        error = goal - r * f
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = error / (f + r * radial_factor_derivative(r, coef, polynomial))
        moved = np.clip(r + np.where(error == 0.0, 0.0, step), low, high)
        # Newton's error squares with each step: after one this small nothing is left to gain.
        small = np.abs(moved - r) <= _LAST_STEP * np.maximum(1.0, r)
        r = np.where(ended, r, moved)
        ended = ended | small
        if ended.all():
            break
    return np.asarray(r)
