"""The two models of a blurred disc: values by integration, derivatives by finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import chndtr, ndtr

from detect.discs import chord_kernels
from detect.discs import model_kernels as kernels
from detect.discs.blur_kernels import blur_across, blur_weights
from detect.discs.patch_kernels import padded
from detect.discs.profile import BEND, T_LIMIT, Z_LIMIT

FloatArray = NDArray[np.float64]

#: A pixel's own blur, per axis: that of a box one pixel wide.
PIXEL_SIGMA = math.sqrt(1.0 / 12.0)
CAPACITY = kernels.CAPACITY


def share_of_a_round_blur(distance: FloatArray, sigma: FloatArray) -> FloatArray:
    """Share of a unit disc under a round Gaussian: a noncentral chi-square distribution."""
    return np.asarray(chndtr(1.0 / sigma**2, 2, (distance / sigma) ** 2))


def share_of_an_ellipse(
    half_u: float, half_v: float, blur_u: float, blur_v: float, u: FloatArray, v: FloatArray
) -> FloatArray:
    """What pixels at (u, v) from its centre see of an ellipse blurred by Gaussian and pixel.

    A sum over chords along v: their weights depend on a pixel's u only, what it sees of them on
    its v only, so each is computed once for every u and every v that occurs.
    """
    step = 1.0 / 32.0
    fine = np.arange(-half_u - step, half_u + step, step) + 0.5 * step
    half = half_v * np.sqrt(np.maximum(1.0 - (fine / half_u) ** 2, 0.0))
    box = (np.arange(16) + 0.5) / 16.0 - 0.5
    each_u, of_u = np.unique(u, return_inverse=True)
    each_v, of_v = np.unique(v, return_inverse=True)
    across = fine - each_u[:, None]
    weights = ndtr((across + 0.5) / blur_u) - ndtr((across - 0.5) / blur_u)
    rows = each_v[:, None, None] + box[:, None]
    chords = ndtr((half - rows) / blur_v) - ndtr((-half - rows) / blur_v)
    share = step * weights @ chords.mean(axis=1).T
    return np.asarray(share[of_u.reshape(u.shape), of_v.reshape(v.shape)])


# -- the normal distribution and the arc sine -------------------------------------------------


def test_single_precision_functions_are_near_enough() -> None:
    for x in np.linspace(-7.0, 7.0, 301):
        density, below = kernels.normal(float(x))
        assert density == pytest.approx(math.exp(-0.5 * x * x) / math.sqrt(2 * math.pi), abs=2e-6)
        assert below == pytest.approx(float(ndtr(x)), abs=2e-6)
    for x in np.linspace(-1.5, 1.5, 301):
        cut = min(max(x, -1.0), 1.0)
        assert chord_kernels._arcsine(float(x)) == pytest.approx(math.asin(cut), abs=5e-4)


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
    """(5, N) results for pixels that see (x, y); the floor's steps are xu, yu, xv, yv."""
    n = x.size
    assert n <= CAPACITY
    geometry = np.zeros(kernels.GEOMETRY * CAPACITY, np.float32)
    for row, values in enumerate([x, y, *(np.full(n, step) for step in steps)]):
        geometry[row * CAPACITY : row * CAPACITY + n] = values
    fields = np.zeros(kernels.FIELDS * CAPACITY, np.float32)
    kernels.edge_shares(geometry, n, *centre, radius, blur_u, blur_v, fields)
    return np.asarray(fields.reshape(kernels.FIELDS, CAPACITY)[:, :n], np.float64)


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
    share = edge_values(x, y, (step, 0.0, 0.0, step), 1.0, blur, blur)[kernels.SHARE]
    np.testing.assert_allclose(share, share_of_a_round_blur(np.hypot(x, y), sigma), atol=3e-3)


@pytest.mark.parametrize(("half_u", "half_v"), [(17.0, 5.0), (21.0, 8.0), (26.0, 12.0)])
@pytest.mark.parametrize("blur", [0.7, 1.0])
def test_uneven_scales_and_blur(half_u: float, half_v: float, blur: float) -> None:
    """An ellipse whose curvature changes all the way round, under half the blur along v."""
    v, u = (part + 0.3 for part in np.mgrid[-15:16, 0:30].astype(float))
    share = edge_values(
        u.ravel() / half_u, v.ravel() / half_v, (1 / half_u, 0.0, 0.0, 1 / half_v), 1.0, blur,
        blur / 2,
    )[kernels.SHARE]  # fmt: skip
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
        radius: float = 1.0, grow: float = 1.0, centre: tuple[float, float] = (0.0, 0.0)
    ) -> FloatArray:
        values = edge_values(x, y, steps, radius, 0.8 * grow, 0.5 * grow, centre)
        return np.asarray(values[kernels.SHARE])

    d = 4e-3
    by_x = (share(centre=(d, 0.0)) - share(centre=(-d, 0.0))) / (2 * d)
    by_y = (share(centre=(0.0, d)) - share(centre=(0.0, -d))) / (2 * d)
    by_radius = (share(1.0 + d) - share(1.0 - d)) / (2 * d)
    by_blur = (share(grow=math.exp(d)) - share(grow=math.exp(-d))) / (2 * d)
    derivatives_agree(base[kernels.BY_X], by_x, 0.06)
    derivatives_agree(base[kernels.BY_Y], by_y, 0.06)
    derivatives_agree(base[kernels.BY_RADIUS], by_radius, 0.06)
    derivatives_agree(base[kernels.BY_BLUR], by_blur, 0.06)


def test_far_from_the_edge_nothing_changes() -> None:
    values = edge_values(
        np.array([0.1, 3.0]), np.array([0.0, 0.0]), (0.02, 0.0, 0.0, 0.02), 1.0, 0.5, 0.5
    )
    np.testing.assert_allclose(values[:, 0], [1.0, 0.0, 0.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(values[:, 1], np.zeros(5), atol=1e-4)


def test_at_the_very_centre_it_is_finite() -> None:
    values = edge_values(np.zeros(1), np.zeros(1), (0.1, 0.0, 0.0, 0.1), 1.0, 1.0, 1.0)
    assert np.all(np.isfinite(values))
    assert values[kernels.SHARE, 0] == pytest.approx(1.0, abs=1e-3)


# -- chords -------------------------------------------------------------------------------------

MARGIN = 12
LINES, LENGTH = 21, 61


def chord_values(
    half_u: float,
    half_v: float,
    blur_u: float,
    blur_v: float,
    centre_px: tuple[float, float] = (0.0, 0.0),
    radius: float = 1.0,
    slant: float = 0.0,
) -> FloatArray:
    """(5, lines, length) results for an ellipse in the middle of a grid of pixels.

    `slant` is how far the floor that the pixels of a line see moves along the steep axis, in steps
    of that axis, from one pixel to the next.
    """
    wide = LENGTH + 2 * MARGIN
    line, place = np.mgrid[0:LINES, 0:wide].astype(float)
    u = place - MARGIN - LENGTH // 2
    v = line - LINES // 2 + slant * u
    x1, y1, x2, y2 = 0.0, 1.0 / half_v, 1.0 / half_u, slant / half_v
    length = math.hypot(x1, y1)
    across_x, across_y = -y1 / length, x1 / length
    rows = [
        u / half_u,
        v / half_v,
        x1 / length**2,
        y1 / length**2,
        across_x,
        across_y,
        x2 * across_x + y2 * across_y,
        -(x1 * x2 + y1 * y2) / length**2,
        1.0 / length,
        0.0,
    ]
    n = u.size
    assert n <= CAPACITY
    geometry = np.zeros(kernels.GEOMETRY * CAPACITY, np.float32)
    for row, values in enumerate(rows):
        geometry[row * CAPACITY : row * CAPACITY + n] = np.ravel(values)
    shares = np.zeros(kernels.FIELDS * CAPACITY, np.float32)
    fields = np.zeros_like(shares)
    weights = np.zeros(64, np.float32)
    marks = np.zeros(CAPACITY, np.uint8)
    first, last = chord_kernels.chord_shares(
        geometry, padded(n), centre_px[0] / half_u, centre_px[1] / half_v, radius, blur_v, 1.0,
        False, shares, marks, marks.view(np.uint64),
    )  # fmt: skip
    blur_across(shares, n, MARGIN, first, last, blur_u, weights, fields)
    result = fields.reshape(kernels.FIELDS, CAPACITY)[:, :n].reshape(-1, LINES, wide)
    return np.asarray(result[:, :, MARGIN:-MARGIN], np.float64)


def grid_of_pixels() -> tuple[FloatArray, FloatArray]:
    line, place = np.mgrid[0:LINES, 0:LENGTH].astype(float)
    return place - LENGTH // 2, line - LINES // 2


@pytest.mark.parametrize(
    ("half_u", "half_v"), [(6.5, 0.7), (8.0, 1.1), (11.0, 2.0), (14.0, 3.3), (17.0, 5.0)]
)
@pytest.mark.parametrize(("blur", "within"), [(0.5, 0.06), (0.7, 0.035), (1.2, 0.01), (3.0, 0.003)])
def test_chords_add_up_to_the_blurred_disc(
    half_u: float, half_v: float, blur: float, within: float
) -> None:
    """The worst is at the tips; most of what is left for small blurs is the pixel's box along v."""
    u, v = grid_of_pixels()
    place = (0.3, 0.4)
    expected = share_of_an_ellipse(half_u, half_v, blur, blur / 2, u - place[0], v - place[1])
    share = chord_values(half_u, half_v, blur, blur / 2, place)[kernels.SHARE]
    np.testing.assert_allclose(share, expected, atol=within)
    assert np.sqrt(np.mean((share - expected) ** 2)) < 0.1 * within


@pytest.mark.parametrize("slant", [0.0, 0.15, -0.1])
@pytest.mark.parametrize(("half_u", "half_v"), [(6.5, 0.7), (11.0, 2.0), (14.0, 3.3)])
def test_chord_derivatives_are_those_of_its_values(
    half_u: float, half_v: float, slant: float
) -> None:
    def share(
        grow: float = 1.0, place: tuple[float, float] = (0.2, 0.1), radius: float = 1.0
    ) -> FloatArray:
        values = chord_values(half_u, half_v, 0.9 * grow, 0.45 * grow, place, radius, slant)
        return np.asarray(values[kernels.SHARE])

    base = chord_values(half_u, half_v, 0.9, 0.45, (0.2, 0.1), 1.0, slant)
    d = 0.02
    by_x = (share(place=(0.2 + d, 0.1)) - share(place=(0.2 - d, 0.1))) / (2 * d) * half_u
    by_y = (share(place=(0.2, 0.1 + d)) - share(place=(0.2, 0.1 - d))) / (2 * d) * half_v
    by_radius = (share(radius=1.0 + d) - share(radius=1.0 - d)) / (2 * d)
    by_blur = (share(grow=math.exp(d)) - share(grow=math.exp(-d))) / (2 * d)
    derivatives_agree(base[kernels.BY_X], by_x, 0.04)
    derivatives_agree(base[kernels.BY_Y], by_y, 0.01)
    derivatives_agree(base[kernels.BY_RADIUS], by_radius, 0.05)
    # By second differences instead of derivatives: at the tips these are not the same.
    derivatives_agree(base[kernels.BY_BLUR], by_blur, 0.2)


def test_chords_that_miss_the_disc_see_nothing() -> None:
    values = chord_values(3.0, 1.0, 0.5, 0.25)
    np.testing.assert_array_equal(values[:, :, 0], np.zeros((5, LINES)))


@settings(max_examples=100, deadline=None)
@given(blur=st.floats(0.1, 8.0))
def test_weights_have_the_blurs_variance(blur: float) -> None:
    weights = np.zeros(64, np.float32)
    reach = blur_weights(blur, weights)
    k = np.arange(-reach, reach + 1)
    both = np.asarray(weights[np.abs(k)], np.float64)
    assert both.sum() == pytest.approx(1.0, abs=1e-5)
    # What lies beyond three deviations is cut off.
    assert np.sum(both * k**2) == pytest.approx(blur**2, rel=0.04)
    assert np.all(both >= 0.0)
