"""The radial distortion: its slope, its fold and its inverse."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from camera.distortion import (
    RADIUS_LIMIT,
    Coef,
    Lens,
    fold_radius,
    radial_factor,
    radial_factor_derivative,
    undistorted_radius,
)
from tests.camera.strategies import coefficients, largest_distorted_radius

PUBLISHED: Coef = (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)
NONE: Coef = (0.0, 0.0, 0.0, 0.0, 0.0)


def test_the_fraction_is_the_published_one() -> None:
    # At r = 2, by hand: 1 + (2 a2 + 4 a3) / (1 + 2 b1 + 4 b2 + 8 b3).
    coef = (0.1, -0.3, 0.25, 0.5, 0.125)
    assert radial_factor(np.array([2.0]), Lens(coef)) == pytest.approx(
        1 + (0.2 - 1.2) / 4.5, rel=1e-15
    )


def test_the_published_calibration_folds_where_it_is_known_to() -> None:
    assert fold_radius(Lens(PUBLISHED)) == pytest.approx(2.0421, abs=5e-5)


def test_no_distortion_never_folds_and_inverts_to_itself() -> None:
    assert fold_radius(Lens(NONE)) == math.inf
    r = np.linspace(0.0, 50.0, 101)
    assert undistorted_radius(r, Lens(NONE)) == pytest.approx(r, rel=1e-14, abs=1e-14)


def test_a_fold_that_can_be_computed_by_hand() -> None:
    # f = 1 - r^2: g = r - r^3 turns round at 1 / sqrt(3).
    assert fold_radius(Lens((0.0, -1.0, 0.0, 0.0, 0.0))) == pytest.approx(
        1 / math.sqrt(3), rel=1e-9
    )


@pytest.mark.parametrize(
    ("coef", "pole"), [((0.1, 0.0, -0.5, 0.0, 0.0), 2.0), ((0.1, 0.0, -1.0, 0.25, 0.0), 2.0)]
)
def test_a_pole_of_first_or_second_order_ends_the_projection(coef: Coef, pole: float) -> None:
    assert fold_radius(Lens(coef)) == pytest.approx(pole, rel=1e-6)
    assert fold_radius(Lens(coef)) < pole
    assert math.isfinite(largest_distorted_radius(coef))


@given(coefficients())
@example(PUBLISHED)
@example((0.1, 0.0, -0.5, 0.0, 0.0))
@example((0.1, 0.0, -1.0, 0.25, 0.0))
@example((0.0, 0.0, 0.0, 0.0, 1e-300))
@example((0.0, -0.25, 0.0, 0.0, 1e-30))
def test_up_to_the_fold_the_distorted_radius_grows_and_no_farther(coef: Coef) -> None:
    end = min(fold_radius(Lens(coef)), 20.0)
    r = np.linspace(0.0, end, 2001)
    g = r * radial_factor(r, Lens(coef))
    assert np.all(np.diff(g[:-1]) > 0.0)
    if fold_radius(Lens(coef)) < 20.0:
        # Past it g falls, or it came from beyond a pole.
        past = np.array([end * (1 + 1e-3)])
        slope = radial_factor(past, Lens(coef)) + past * radial_factor_derivative(past, Lens(coef))
        denominator = np.polyval([*coef[:1:-1], 1.0], past)
        assert slope < 1e-2 or denominator < 1e-2


@given(coefficients(), st.lists(st.floats(0.0, 0.999), min_size=1, max_size=30))
@example(PUBLISHED, [0.0, 0.999])
def test_the_inverse_gives_the_radius_back_to_1e_12(coef: Coef, shares: list[float]) -> None:
    r = np.array(shares) * min(fold_radius(Lens(coef)), 8.0)
    g = r * radial_factor(r, Lens(coef))
    slope = radial_factor(r, Lens(coef)) + r * radial_factor_derivative(r, Lens(coef))
    back = undistorted_radius(g, Lens(coef))
    # A rounding of g by 1e-16 is one of r by 1e-16 / g': next to the fold nobody can do better.
    allowed = 1e-12 * np.maximum(1.0, r) * np.maximum(1.0, 1e-3 / slope)
    assert np.all(np.abs(back - r) <= allowed)


@given(coefficients(), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30))
@example(PUBLISHED, [0.0, 1.0])
@example(PUBLISHED, [1.0 - 1e-13])
def test_distorting_the_inverse_gives_the_distorted_radius_back(
    coef: Coef, shares: list[float]
) -> None:
    g = np.array(shares) * min(largest_distorted_radius(coef), 20.0)
    r = undistorted_radius(g, Lens(coef))
    assert np.all(np.abs(r * radial_factor(r, Lens(coef)) - g) <= 1e-12 * np.maximum(1.0, g))
    assert np.all(r <= min(fold_radius(Lens(coef)), RADIUS_LIMIT))


def test_what_no_ray_reaches_is_nan() -> None:
    seen = largest_distorted_radius(PUBLISHED)
    given_radii = np.array([np.nextafter(seen, np.inf), 100.0, -0.1, np.nan, np.inf])
    assert np.all(np.isnan(undistorted_radius(given_radii, Lens(PUBLISHED))))
    assert not np.isnan(undistorted_radius(np.array([seen]), Lens(PUBLISHED)))


def test_the_inverse_keeps_the_shape() -> None:
    g = np.linspace(0.0, 1.2, 24).reshape(2, 3, 4)
    flat = undistorted_radius(g.ravel(), Lens(PUBLISHED))
    assert np.array_equal(undistorted_radius(g, Lens(PUBLISHED)), flat.reshape(2, 3, 4))
    assert undistorted_radius(np.zeros((0, 2)), Lens(PUBLISHED)).shape == (0, 2)
    assert undistorted_radius(np.array(0.5), Lens(PUBLISHED)).shape == ()


@given(coefficients(), st.floats(0.001, 0.98))
@example(PUBLISHED, 0.5)
def test_the_slope_is_that_of_finite_differences(coef: Coef, share: float) -> None:
    r = share * min(fold_radius(Lens(coef)), 8.0)
    h = 1e-4 * min(r, fold_radius(Lens(coef)) - r)
    f = radial_factor(r + h * np.array([-2.0, -1.0, 1.0, 2.0]), Lens(coef))
    difference = (8.0 * (f[2] - f[1]) - (f[3] - f[0])) / (12.0 * h)
    analytic = float(radial_factor_derivative(np.array(r), Lens(coef)))
    rounding = 1e-15 * float(np.abs(f).max()) / h
    assert difference == pytest.approx(analytic, rel=1e-6, abs=10 * rounding)
