"""The parts of the marker detector, each against a reference of its own."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from camera import Camera
from detect.markers import pattern_model as model
from detect.markers.candidates import closing, dark_pixels, pixel_area
from detect.markers.detect import detect_markers
from detect.markers.dictionaries import templates_of
from detect.markers.geometry import (
    corners_by_homography,
    corners_of,
    count_same,
    is_convex,
    largest_quadrangle,
    picture_of,
    rough_corners,
    signed_area,
    square_homography,
)
from detect.markers.pattern_fit import robust_sigma
from detect.settings import MarkerSettings

FloatArray = NDArray[np.float64]

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
SLANTED = np.array([[12.3, 8.1], [70.2, 15.7], [61.9, 66.0], [20.4, 58.8]])


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
def test_a_closing_is_above_the_image_and_stays_when_repeated(seed: int, radius: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (24, 31)).astype(np.uint8)
    closed = closing(image, radius)
    assert np.all(closed >= image)
    np.testing.assert_array_equal(closing(closed, radius), closed)


@pytest.mark.parametrize("radius", [4, 8, 12, 20])
def test_a_closing_fills_what_its_disc_does_not_fit_into(radius: int) -> None:
    v, u = np.mgrid[0:120, 0:120]
    apart = np.hypot(u - 60, v - 60)
    assert closing(np.where(apart < 0.8 * radius, 20, 200).astype(np.uint8), radius).min() == 200
    wide = closing(np.where(apart < 1.3 * radius, 20, 200).astype(np.uint8), radius)
    assert wide[60, 60] == 20
    # An octagon whose corners are on the disc's circle.
    narrow = np.where(np.abs(u - 60) <= radius - 1, 20, 200).astype(np.uint8)
    assert closing(narrow, radius).min() == 200


def test_dark_pixels_by_definition() -> None:
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (40, 50)).astype(np.uint8)
    closed = np.maximum(grey, rng.integers(0, 256, grey.shape)).astype(np.uint8)
    first, second = grey.astype(float), closed.astype(float)
    ratio = np.where(second > 0.0, 1.0 - first / np.maximum(second, 1.0), 0.0) > 0.3
    np.testing.assert_array_equal(dark_pixels(grey, closed, 0.3, 0.0) == 1, ratio)
    gated = ratio & (second - first > 20.0)
    np.testing.assert_array_equal(dark_pixels(grey, closed, 0.3, 20.0) == 1, gated)


@given(st.integers(0, 2**32 - 1))
def test_the_quadrangle_is_the_largest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Four corners with points along the sides, as the hull of a blurred square has.
    corners = SLANTED + rng.normal(0.0, 3.0, (4, 2))
    share: FloatArray = np.sort(rng.random((4, 4)), axis=1)
    points = np.concatenate(
        [
            corners[k] + np.concatenate([[0.0], share[k]])[:, None] * (corners[k - 3] - corners[k])
            for k in range(4)
        ]
    )
    areas = [
        abs(float(signed_area(points[list(four)])))
        for four in itertools.combinations(range(len(points)), 4)
    ]
    best = max(areas)
    found = abs(signed_area(points[list(largest_quadrangle(points))]))
    assert found == pytest.approx(best, rel=1e-9)


def test_rough_corners_of_a_quadrangle_are_its_own() -> None:
    share = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None]
    chain = np.concatenate([SLANTED[k] + share * (SLANTED[k - 3] - SLANTED[k]) for k in range(4)])
    for order in (chain, chain[::-1]):
        found = rough_corners(np.ascontiguousarray(order))
        assert found is not None
        assert is_convex(found)
        assert count_same(found, np.array([SLANTED, 2.0 * SLANTED])) == 1
        assert sorted(map(tuple, found.round(9))) == sorted(map(tuple, SLANTED))
    angle = np.linspace(0.0, 2.0 * np.pi, 3, endpoint=False)
    triangle = 20.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    assert rough_corners(triangle) is None


def test_areas_count_pixels() -> None:
    box = np.array([[2, 3], [9, 3], [9, 7], [2, 7]], np.int32)
    assert pixel_area(box) == 8 * 5
    assert signed_area(SQUARE) == 1.0
    assert signed_area(SQUARE[::-1].copy()) == -1.0


def test_the_homography_takes_the_square_to_the_corners() -> None:
    homography = square_homography(SLANTED)
    points = np.concatenate([SQUARE, np.ones((4, 1))], axis=1) @ homography.T
    np.testing.assert_allclose(points[:, :2] / points[:, 2:], SLANTED, atol=1e-4)
    np.testing.assert_allclose(corners_of(homography), SLANTED, atol=1e-4)


def test_corners_by_homography_agree_with_finite_differences() -> None:
    homography = square_homography(SLANTED)
    analytic = corners_by_homography(homography)
    for k in range(8):
        row, column = divmod(k, 3)
        step = 1e-6 * max(1.0, abs(float(homography[row, column])))
        moved = []
        for sign in (1.0, -1.0):
            h = homography.copy()
            h[row, column] += sign * step
            moved.append(corners_of(h).ravel())
        np.testing.assert_allclose(
            analytic[:, k], (moved[0] - moved[1]) / (2.0 * step), rtol=1e-5, atol=1e-5
        )


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 60), (60, 1), (2, 2)])
def test_pictures_of_a_pixel_show_no_marker(
    published_camera: Camera, width: int, height: int
) -> None:
    camera = replace(published_camera, width=width, height=height)
    found = detect_markers(np.full((height, width), 90, np.uint8), MarkerSettings(), camera)
    assert len(found) == 0


def test_the_lens_is_the_cameras_distortion(published_camera: Camera) -> None:
    image = np.zeros((published_camera.height, published_camera.width), np.uint8)
    lens = picture_of(image, published_camera)
    rng = np.random.default_rng(3)
    size = np.array([published_camera.width, published_camera.height])
    pixels = rng.random((200, 2)) * (size - 1)
    scale = np.array([published_camera.scale_x, published_camera.scale_y])
    offset = np.array([published_camera.offset_x, published_camera.offset_y])
    expected = published_camera.undistort(pixels) * scale + offset
    straight = lens.undistort(pixels)
    np.testing.assert_allclose(straight, expected, atol=1e-9)
    np.testing.assert_allclose(lens.distort(straight), pixels, atol=1e-5)
    u, v = pixels.astype(int).T
    at = lens.undistort(np.stack([u, v], axis=-1).astype(float))
    np.testing.assert_allclose(lens.straight[v, u], at, atol=1e-3)
    jacobians = lens.pixel_jacobians(pixels)
    moved = [lens.distort(straight + step) - pixels for step in 1e-4 * np.eye(2)]
    np.testing.assert_allclose(jacobians, np.stack(moved, axis=-1) / 1e-4, atol=2e-3)
    plain = picture_of(image, None)
    np.testing.assert_array_equal(plain.undistort(pixels), pixels)
    np.testing.assert_array_equal(plain.straight[7, 5], [5.0, 7.0])


@given(
    st.floats(-3.0, 3.0),
    st.floats(-3.0, 3.0),
    st.floats(-0.9, 0.9).filter(lambda rho: abs(rho) > 0.02),
)
def test_a_blurred_corner_is_the_bivariate_normal_distribution(
    h: float, k: float, rho: float
) -> None:
    exact = multivariate_normal.cdf([h, k], cov=[[1.0, rho], [rho, 1.0]])
    angle = np.arcsin(rho)
    sines = tuple(np.sin(angle * np.array(model.NODES)))
    excess = model.corner_excess(h, k, sines, angle)
    assert norm.cdf(h) * norm.cdf(k) + excess == pytest.approx(exact, abs=4e-3)


@pytest.mark.parametrize("rho", [0.0, 0.5, -0.8])
def test_the_blurred_patterns_derivatives(rho: float) -> None:
    templates = templates_of("6x6_250", (7,))
    pattern = model.pattern_of(templates.lines, templates.blackness(0))

    def value(at: FloatArray) -> FloatArray:
        return model.blurred_blackness(model.Places(*at[:, None]), pattern)[:, 0]

    rng = np.random.default_rng(4)
    for _ in range(50):
        at = np.array([*rng.uniform(-0.05, 1.05, 2), *rng.uniform(0.02, 0.08, 2), rho])
        analytic = value(at)[1:]
        for k in range(5 if rho else 4):
            step = np.zeros(5)
            step[k] = 1e-6
            numeric = (value(at + step)[0] - value(at - step)[0]) / 2e-6
            # Three nodes of quadrature are not the derivative's own.
            scale = 0.02 / at[2] if k < 4 else 0.02
            assert analytic[k] == pytest.approx(numeric, abs=scale + 0.02 * abs(numeric))


def test_the_scale_of_residuals_does_not_follow_outliers() -> None:
    rng = np.random.default_rng(8)
    residual = rng.normal(0.0, 2.0, 19_000)
    residual[::20] = 1e3
    # The median of 95 of 100 is the 52.6 % quantile of them all.
    expected = 2.0 * norm.ppf(0.5 + 0.5 * 0.5 / 0.95) / 0.6745
    assert robust_sigma(residual, 0.3) == pytest.approx(expected, rel=0.02)
    assert robust_sigma(residual, 5.0) == 5.0


def test_decoys_are_no_markers() -> None:
    for name in ("4x4_1000", "rawseeds", "apriltag_36h11"):
        templates = templates_of(name, ())
        apart = np.abs(templates.decoys[:, None, :] - templates.cells[None, :200, :]).sum(axis=-1)
        assert len(templates.decoys)
        assert apart.min() >= 2.0


def test_templates_know_the_turned_patterns_and_their_place() -> None:
    templates = templates_of("rawseeds", ())
    patterns = templates.dictionary.patterns
    for template in (3, 512 + 3, 1024 + 3, 1536 + 3):
        number, turns = templates.turned_id(template)
        assert number == 3
        turned = np.rot90(patterns[3], turns)
        np.testing.assert_array_equal(templates.cells[template].reshape(7, 7) > 0.5, turned)
        black = templates.blackness(template)
        assert black.shape == (9, 9)
        assert black[0].all()
        assert black[:, -1].all()
    # 24 units: the border's end, seven cells of two units from 5 to 19, the border.
    np.testing.assert_allclose(24.0 * templates.lines, [0, 5, 7, 9, 11, 13, 15, 17, 19, 24])
