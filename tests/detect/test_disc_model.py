"""The two models of a blurred disc: values by integration, derivatives by finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from detect.disc_model_kernels import chord_pixel, profile_pixel
from detect.disc_profile import T_LIMIT, Z_LIMIT, disc_profile

FloatArray = NDArray[np.float64]

NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(31)
WEIGHTS = _WEIGHTS / _WEIGHTS.sum()

#: A pixel's own blur, per axis: that of a box one pixel wide.
PIXEL_SIGMA = math.sqrt(1.0 / 12.0)

STEP = 1e-6


def share_of_a_round_blur(distance: float, sigma: float) -> float:
    """Share of a unit disc under a round Gaussian, integrated chord by chord."""
    count = 20_000
    angle = ((np.arange(count) + 0.5) / count - 0.5) * np.pi
    x, half = np.sin(angle), np.cos(angle)
    chords = norm.pdf((x - distance) / sigma) / sigma * (2.0 * norm.cdf(half / sigma) - 1.0)
    return float(np.sum(chords * half) * np.pi / count)


def central_difference(function: Callable[[float], float], at: float = 0.0) -> float:
    return (function(at + STEP) - function(at - STEP)) / (2.0 * STEP)


# -- the tabulated profile ------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0625, 0.25, 0.5, 1.0, 2.5])
@pytest.mark.parametrize("z", [-5.0, -2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.5, 5.5])
def test_profile_is_the_blurred_disc(sigma: float, z: float) -> None:
    table = disc_profile()
    row = sigma / T_LIMIT * (table.shape[0] - 1)
    column = (z + Z_LIMIT) / (2.0 * Z_LIMIT) * (table.shape[1] - 1)
    assert row == pytest.approx(round(row))
    assert column == pytest.approx(round(column))
    expected = share_of_a_round_blur(abs(1.0 + z * sigma), sigma)
    assert table[round(row), round(column)] == pytest.approx(expected, abs=1e-8)


def test_profile_of_hardly_any_blur_is_a_straight_edge() -> None:
    table = disc_profile()
    z = np.linspace(-Z_LIMIT, Z_LIMIT, table.shape[1])
    np.testing.assert_allclose(table[0], norm.cdf(-z), atol=1e-12)
    assert not table.flags.writeable
    assert table.min() >= 0.0
    assert table.max() <= 1.0


def round_pixel(x: float, y: float, radius: float, blur: float, step: float = 0.1) -> FloatArray:
    """`profile_pixel` where both the floor's steps and the blur are the same in all directions."""
    sigma = math.hypot(blur, PIXEL_SIGMA)
    return np.array(
        profile_pixel(
            x, y, step, 0.0, 0.0, step, radius, blur, blur, sigma, sigma,
            disc_profile(), Z_LIMIT, T_LIMIT,
        )
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-1.6, 1.6),
    y=st.floats(-1.6, 1.6),
    radius=st.floats(0.8, 1.25),
    blur=st.floats(0.2, 3.0),
    step=st.floats(0.02, 0.4),
)
def test_round_blur_is_exact(x: float, y: float, radius: float, blur: float, step: float) -> None:
    """But for what linear interpolation of the table leaves: most at the centre."""
    sigma = step * math.hypot(blur, PIXEL_SIGMA)
    distance = math.hypot(x, y)
    expected = share_of_a_round_blur(distance / radius, sigma / radius)
    tolerance = 2e-3 if distance > 0.5 * radius else 6e-3
    assert round_pixel(x, y, radius, blur, step)[0] == pytest.approx(expected, abs=tolerance)


def round_cell(x: float, y: float, radius: float, blur: float, step: float) -> tuple[float, float]:
    """Where a pixel falls between the table's nodes, in columns and rows."""
    sigma = step * math.hypot(blur, PIXEL_SIGMA)
    rows, columns = disc_profile().shape
    z = (math.hypot(x, y) - radius) / sigma
    column = (z + Z_LIMIT) / (2.0 * Z_LIMIT) * (columns - 1)
    return column, sigma / radius / T_LIMIT * (rows - 1)


@settings(max_examples=200, deadline=None)
@given(
    x=st.floats(-1.5, 1.5),
    y=st.floats(-1.5, 1.5),
    radius=st.floats(0.8, 1.25),
    blur=st.floats(0.2, 2.0),
    step=st.floats(0.02, 0.5),
)
def test_profile_derivatives_are_those_of_its_values(
    x: float, y: float, radius: float, blur: float, step: float
) -> None:
    """The interpolated table has kinks at its nodes: pixels right on them are passed over."""
    assume(math.hypot(x, y) > 0.05)
    assume(all(0.002 < part % 1.0 < 0.998 for part in round_cell(x, y, radius, blur, step)))
    value = round_pixel(x, y, radius, blur, step)
    numeric = [
        -central_difference(lambda d: float(round_pixel(x + d, y, radius, blur, step)[0])),
        -central_difference(lambda d: float(round_pixel(x, y + d, radius, blur, step)[0])),
        central_difference(lambda d: float(round_pixel(x, y, radius + d, blur, step)[0])),
        central_difference(lambda d: float(round_pixel(x, y, radius, blur * math.exp(d), step)[0])),
    ]
    np.testing.assert_allclose(value[1:], numeric, rtol=1e-5, atol=1e-6)


def test_far_from_the_edge_nothing_changes() -> None:
    inside = round_pixel(0.1, 0.0, 1.0, 0.5, 0.02)
    outside = round_pixel(3.0, 0.0, 1.0, 0.5, 0.02)
    np.testing.assert_allclose(inside, [1.0, 0.0, 0.0, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(outside, np.zeros(5), atol=1e-8)


def test_at_the_very_centre_it_is_finite() -> None:
    value = round_pixel(0.0, 0.0, 1.0, 1.0, 0.5)
    expected = share_of_a_round_blur(0.0, 0.5 * math.hypot(1.0, PIXEL_SIGMA))
    assert np.all(np.isfinite(value))
    assert value[0] == pytest.approx(expected, abs=6e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 90.0, 140.0])
def test_uneven_blur_counts_across_the_edge(angle_deg: float) -> None:
    """Of a small blur a straight edge sees what lies across it: pixels a little off the edge."""
    nx, ny = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    xu, xv, yu, yv = 0.02, 0.004, -0.003, 0.035
    blur_u, blur_v, off = 0.6, 0.3, 0.02
    sigma_u, sigma_v = math.hypot(blur_u, PIXEL_SIGMA), math.hypot(blur_v, PIXEL_SIGMA)
    sigma = math.hypot(sigma_u * (xu * nx + yu * ny), sigma_v * (xv * nx + yv * ny))
    value = profile_pixel(
        (1.0 + off) * nx, (1.0 + off) * ny, xu, xv, yu, yv, 1.0, blur_u, blur_v, sigma_u, sigma_v,
        disc_profile(), Z_LIMIT, T_LIMIT,
    )  # fmt: skip
    assert value[0] == pytest.approx(norm.cdf(-off / sigma), abs=0.012)


# -- chords ---------------------------------------------------------------------------------

#: The floor's steps along the steep image axis and the other, in radii: discs seen flat.
FLAT = [
    ((0.02, 0.45), (0.05, -0.002)),
    ((-0.1, 0.9), (0.08, 0.01)),
    ((0.3, 0.6), (0.09, -0.06)),
]
OFFSETS = [(0.0, 0.1), (0.5, 0.3), (-0.6, -0.4), (0.3, 1.2), (-0.2, -1.6), (0.7, 0.9)]


def chord(
    place: tuple[float, float],
    steps: tuple[tuple[float, float], tuple[float, float]],
    radius: float = 1.0,
    log_blur: float = 0.0,
    growth: float = 0.0,
) -> FloatArray:
    blur_1, blur_2 = 0.4 * math.exp(log_blur), 0.8 * math.exp(log_blur)
    sigma_1, sigma_2 = math.hypot(blur_1, PIXEL_SIGMA), math.hypot(blur_2, PIXEL_SIGMA)
    return np.array(
        chord_pixel(
            *place, *steps[0], *steps[1], growth, radius, blur_1, blur_2, sigma_1, sigma_2,
            NODES, WEIGHTS,
        )
    )  # fmt: skip


def share_of_a_flat_disc(
    place: tuple[float, float], steps: tuple[tuple[float, float], tuple[float, float]]
) -> float:
    """The Gaussian of the image, laid on the floor, summed over a fine grid."""
    sigma_1, sigma_2 = math.hypot(0.4, PIXEL_SIGMA), math.hypot(0.8, PIXEL_SIGMA)
    normal = np.linspace(-6.0, 6.0, 2401)
    weight = norm.pdf(normal)
    along, across = np.meshgrid(normal * sigma_1, normal * sigma_2)
    x = place[0] + steps[0][0] * along + steps[1][0] * across
    y = place[1] + steps[0][1] * along + steps[1][1] * across
    total = np.outer(weight, weight)
    return float(total[np.hypot(x, y) < 1.0].sum() / total.sum())


@pytest.mark.parametrize("steps", FLAT)
@pytest.mark.parametrize("place", OFFSETS)
def test_chords_add_up_to_the_blurred_disc(
    place: tuple[float, float], steps: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    assert chord(place, steps)[0] == pytest.approx(share_of_a_flat_disc(place, steps), abs=2e-3)


@pytest.mark.parametrize("growth", [0.0, 0.15, -0.1])
@pytest.mark.parametrize("steps", FLAT)
@pytest.mark.parametrize("place", OFFSETS)
def test_chord_derivatives_are_those_of_its_values(
    place: tuple[float, float],
    steps: tuple[tuple[float, float], tuple[float, float]],
    growth: float,
) -> None:
    x, y = place
    value = chord(place, steps, growth=growth)
    numeric = [
        -central_difference(lambda d: float(chord((x + d, y), steps, growth=growth)[0])),
        -central_difference(lambda d: float(chord((x, y + d), steps, growth=growth)[0])),
        central_difference(lambda d: float(chord(place, steps, 1.0 + d, growth=growth)[0])),
        central_difference(lambda d: float(chord(place, steps, log_blur=d, growth=growth)[0])),
    ]
    np.testing.assert_allclose(value[1:], numeric, rtol=1e-4, atol=1e-6)


def test_chords_that_miss_the_disc_see_nothing() -> None:
    np.testing.assert_array_equal(chord((3.0, 0.0), FLAT[0]), np.zeros(5))
