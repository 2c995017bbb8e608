"""The two models of a blurred disc: values by integration, derivatives by finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from detect.discs import model
from detect.discs.model import BEND, T_LIMIT, Z_LIMIT, Blur, Disc
from detect.discs.patch import CAPACITY, PATCH
from tests.reference.discs import (
    Pixels,
    chord_share,
    edge_share,
    share_of_a_round_blur,
    share_of_an_ellipse,
)

FloatArray = NDArray[np.float64]

#: A pixel's own blur, per axis: that of a box one pixel wide.
PIXEL_SIGMA = math.sqrt(1.0 / 12.0)


# -- the normal distribution and the arc sine -------------------------------------------------


def test_single_precision_functions_are_near_enough() -> None:
    for x in np.linspace(-7.0, 7.0, 301):
        density, below = model.normal(float(x))
        assert density == pytest.approx(math.exp(-0.5 * x * x) / math.sqrt(2 * math.pi), abs=2e-6)
        assert below == pytest.approx(float(ndtr(x)), abs=2e-6)
    for x in np.linspace(-1.5, 1.5, 301):
        cut = min(max(x, -1.0), 1.0)
        assert model.arcsine(float(x)) == pytest.approx(math.asin(cut), abs=5e-4)


# -- the edge's profile -------------------------------------------------------------------------


def test_profile_is_the_blurred_disc() -> None:
    """The polynomial from its coefficients, against the distribution, all over its reach."""
    z, t = np.meshgrid(np.linspace(-Z_LIMIT, Z_LIMIT, 161), np.linspace(0.01, T_LIMIT, 40))
    inside = z * t >= -1.0
    z, t = z[inside], t[inside]
    q = sum(c * z**i * t**j for i, row in enumerate(BEND) for j, c in enumerate(row))
    share = ndtr(-(z + t * (0.5 + t * q)))
    np.testing.assert_allclose(share, share_of_a_round_blur(1.0 + z * t, t), atol=1.1e-3)


def edge_values(
    x: FloatArray,
    y: FloatArray,
    steps: tuple[float, float, float, float],
    radius: float,
    blur_u: float,
    blur_v: float,
    centre: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """(6, N) results for pixels that see (x, y); the floor's steps are xu, yu, xv, yv."""
    xu, yu, xv, yv = (np.full(x.size, step) for step in steps)
    at = Pixels(x, y, xu, yu, xv, yv)
    return values_of(at, Disc(*centre, radius), Blur(blur_u, blur_v), flat=False)


def values_of(at: Pixels, disc: Disc, blur: Blur, *, flat: bool) -> FloatArray:
    """(6, N) shares and their derivatives by log blur along either axis, radius, x and y."""
    n = at.x.size
    assert n <= CAPACITY
    patch = np.zeros(1, PATCH)
    for name in ("x", "y", "x1", "y1", "x2", "y2"):
        patch[name][0, :n] = getattr(at, name)
    patch["growth"] = at.growth
    if flat:
        model.chord_shares(patch[0], n, disc, blur)
    else:
        model.edge_shares(patch[0], n, disc, blur)
    return np.asarray(patch["shares"][0, :, :n], np.float64)


def disc_of_pixels(reach: float, step: float) -> tuple[FloatArray, FloatArray]:
    grid = np.arange(-reach, reach, step) + 0.13 * step
    x, y = np.meshgrid(grid, grid)
    return x.ravel(), y.ravel()


@pytest.mark.parametrize("blur", [0.3, 0.8, 2.0])
@pytest.mark.parametrize("step", [0.04, 0.1, 0.15])
def test_round_blur_is_exact(blur: float, step: float) -> None:
    x, y = disc_of_pixels(1.8, 0.07)
    sigma = np.full(x.shape, step * math.hypot(blur, PIXEL_SIGMA))
    if sigma[0] > T_LIMIT:
        pytest.skip("too blurred for this model")
    share = edge_values(x, y, (step, 0.0, 0.0, step), 1.0, blur, blur)[0]
    np.testing.assert_allclose(share, share_of_a_round_blur(np.hypot(x, y), sigma), atol=3e-3)


@pytest.mark.parametrize(("half_u", "half_v"), [(17.0, 5.0), (21.0, 8.0), (26.0, 12.0)])
@pytest.mark.parametrize("blur", [0.7, 1.0])
def test_uneven_scales_and_blur(half_u: float, half_v: float, blur: float) -> None:
    """An ellipse whose curvature changes all the way round, under half the blur along v."""
    v, u = (part + 0.3 for part in np.mgrid[-15:16, 0:30].astype(float))
    share = edge_values(
        u.ravel() / half_u, v.ravel() / half_v, (1 / half_u, 0.0, 0.0, 1 / half_v), 1.0, blur,
        blur / 2,
    )[0]  # fmt: skip
    expected = share_of_an_ellipse(half_u, half_v, blur, blur / 2, u, v)
    np.testing.assert_allclose(share, expected.ravel(), atol=0.01)


def derivatives_agree(analytic: FloatArray, numeric: FloatArray, within: float) -> None:
    assert np.abs(analytic - numeric).max() < within * np.abs(numeric).max()


STEPS = [(0.05, 0.0, 0.0, 0.1), (0.05, 0.01, -0.02, 0.09), (-0.03, 0.06, 0.07, 0.02)]


@pytest.mark.parametrize("steps", STEPS)
def test_edge_derivatives_are_those_of_its_values(steps: tuple[float, float, float, float]) -> None:
    """By x, y, radius and blur; the curvature is held to change slowly, which costs per cents."""
    x, y = disc_of_pixels(1.4, 0.07)
    base = edge_values(x, y, steps, 1.0, 0.8, 0.5)

    def share(
        radius: float = 1.0, grow: tuple[float, float] = (1.0, 1.0),
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> FloatArray:  # fmt: skip
        values = edge_values(x, y, steps, radius, 0.8 * grow[0], 0.5 * grow[1], centre)
        return np.asarray(values[0])

    d = 4e-3
    by_x = (share(centre=(d, 0.0)) - share(centre=(-d, 0.0))) / (2 * d)
    by_y = (share(centre=(0.0, d)) - share(centre=(0.0, -d))) / (2 * d)
    by_radius = (share(1.0 + d) - share(1.0 - d)) / (2 * d)
    more, less = math.exp(d), math.exp(-d)
    by_blur_1 = (share(grow=(more, 1.0)) - share(grow=(less, 1.0))) / (2 * d)
    by_blur_2 = (share(grow=(1.0, more)) - share(grow=(1.0, less))) / (2 * d)
    derivatives_agree(base[model.BY_X], by_x, 0.06)
    derivatives_agree(base[model.BY_Y], by_y, 0.06)
    derivatives_agree(base[model.BY_RADIUS], by_radius, 0.06)
    derivatives_agree(base[model.BY_BLUR_1], by_blur_1, 0.06)
    derivatives_agree(base[model.BY_BLUR_2], by_blur_2, 0.06)


def test_far_from_the_edge_nothing_changes() -> None:
    values = edge_values(
        np.array([0.1, 3.0]), np.array([0.0, 0.0]), (0.02, 0.0, 0.0, 0.02), 1.0, 0.5, 0.5
    )
    np.testing.assert_allclose(values[:, 0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(values[:, 1], np.zeros(6), atol=1e-4)


def test_at_the_very_centre_it_is_finite() -> None:
    values = edge_values(np.zeros(1), np.zeros(1), (0.1, 0.0, 0.0, 0.1), 1.0, 1.0, 1.0)
    assert np.all(np.isfinite(values))
    assert values[0, 0] == pytest.approx(1.0, abs=1e-3)


# -- chords -------------------------------------------------------------------------------------

LINES, LENGTH = 21, 61


def chord_pixels(half_u: float, half_v: float, slant: float = 0.0, growth: float = 0.0) -> Pixels:
    """A grid of pixels round an ellipse of these half axes; the first axis is v.

    `slant` is how far the floor that the pixels of a line see moves along the steep axis, in steps
    of that axis, from one pixel to the next.
    """
    v, u = (part.ravel() for part in np.mgrid[0:LINES, 0:LENGTH].astype(float))
    u, v = u - LENGTH // 2, v - LINES // 2
    even = np.ones_like(u)
    return Pixels(
        u / half_u, (v + slant * u) / half_v, 0.0 * even, even / half_v, even / half_u,
        slant * even / half_v, growth,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("half_u", "half_v"), [(6.5, 0.7), (8.0, 1.1), (11.0, 2.0), (14.0, 3.3), (17.0, 5.0)]
)
@pytest.mark.parametrize(("blur", "within"), [(0.5, 0.06), (0.7, 0.04), (1.2, 0.02), (3.0, 0.04)])
def test_chords_add_up_to_the_blurred_disc(
    half_u: float, half_v: float, blur: float, within: float
) -> None:
    """The worst is at the tips; most of what is left for small blurs is the pixel's box along v."""
    at = chord_pixels(half_u, half_v)
    place = (0.3 / half_u, 0.4 / half_v)
    expected = share_of_an_ellipse(
        half_u, half_v, blur, blur / 2, half_u * (at.x - place[0]), half_v * (at.y - place[1])
    )
    share = values_of(at, Disc(*place, 1.0), Blur(blur / 2, blur), flat=True)[0]
    np.testing.assert_allclose(share, expected, atol=within)
    assert np.sqrt(np.mean((share - expected) ** 2)) < 0.15 * within


@pytest.mark.parametrize("slant", [0.0, 0.15, -0.1])
@pytest.mark.parametrize(("half_u", "half_v"), [(6.5, 0.7), (11.0, 2.0), (14.0, 3.3)])
def test_chord_derivatives_are_those_of_its_values(
    half_u: float, half_v: float, slant: float
) -> None:
    at = chord_pixels(half_u, half_v, slant, growth=0.02)

    def values(
        x: float = 0.02, y: float = 0.05, radius: float = 1.0, first: float = 1.0,
        second: float = 1.0,
    ) -> FloatArray:  # fmt: skip
        return values_of(at, Disc(x, y, radius), Blur(0.45 * first, 0.9 * second), flat=True)

    def difference(name: str, value: float, d: float) -> FloatArray:
        ahead, behind = values(**{name: value + d}), values(**{name: value - d})
        return np.asarray((ahead - behind)[0] / (2.0 * d))

    base = values()
    # The worst is at the tips, where the angles of the quadrature move with disc and blur.
    for row, name, value, d in (
        (model.BY_X, "x", 0.02, 2e-3),
        (model.BY_Y, "y", 0.05, 2e-3),
        (model.BY_RADIUS, "radius", 1.0, 2e-3),
        (model.BY_BLUR_1, "first", 1.0, 1e-2),
        (model.BY_BLUR_2, "second", 1.0, 1e-2),
    ):
        numeric = difference(name, value, d)
        off = base[row] - numeric
        within = 0.35 if name == "second" else 0.15
        assert np.sqrt(np.mean(off**2)) < within * np.sqrt(np.mean(numeric**2))


def test_chords_that_miss_the_disc_see_nothing() -> None:
    at = chord_pixels(3.0, 1.0)
    values = values_of(at, Disc(0.0, 0.0, 1.0), Blur(0.25, 0.5), flat=True)
    np.testing.assert_array_equal(values[:, np.abs(at.x) > 3.0], 0.0)


# -- against the reference ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_both_models_are_their_equations(seed: int) -> None:
    """On a floor that is seen at a slant and grows along the first axis."""
    rng = np.random.default_rng(seed)
    x, y, slant, growth = rng.uniform((-0.1, -0.1, -0.2, -0.03), (0.1, 0.1, 0.2, 0.03))
    place = Disc(x, y, rng.uniform(0.9, 1.1))
    near = chord_pixels(rng.uniform(15.0, 25.0), rng.uniform(8.0, 10.0), slant)
    flat = chord_pixels(rng.uniform(8.0, 15.0), rng.uniform(1.0, 4.0), slant, growth)
    blur = Blur(*rng.uniform(0.3, 1.0, 2))
    share = values_of(near, place, blur, flat=False)[0]
    np.testing.assert_allclose(share, edge_share(near, *place, *blur), atol=2e-4)
    share = values_of(flat, place, blur, flat=True)[0]
    np.testing.assert_allclose(share, chord_share(flat, *place, *blur), atol=0.03)
