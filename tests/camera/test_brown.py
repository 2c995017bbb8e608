"""Brown's terms, k1 k2 k3 and p1 p2: as OpenCV has them, inverted, refused where they fold."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from camera import Camera, CameraError, format_camera, parse_camera
from camera.distortion import (
    RADIUS_LIMIT,
    Coef,
    Lens,
    Polynomial,
    Tangential,
    distorted_jacobian,
    fold_radius,
    one_to_one_radius,
    radial_factor,
    radial_factor_derivative,
    undistorted_radius,
)
from camera.formats.conversion import convert_to_camera, convert_to_foreign
from camera.formats.models import ForeignCamera
from camera.kernels import camera_numbers, project_direction
from camera.model_checks import border_pixels
from redetect.array_types import FloatArray
from tests.camera.strategies import coefficients, pixel_grid

TANGENTIAL, POLYNOMIAL = (2e-3, -3e-3), (-0.05, 0.02, -0.004)
NONE: Coef = (0.0,) * 5
PUBLISHED: Coef = (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)
BROWN = (*POLYNOMIAL[:2], *TANGENTIAL, POLYNOMIAL[2])
IDENTITY: Any = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))

#: As published with EuRoC's cam0 and with TUM's fr1.
EUROC = ForeignCamera(
    "radtan", 752, 480, 458.654, 457.296, 367.215, 248.375,
    (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
)  # fmt: skip
TUM = ForeignCamera(
    "radtan", 640, 480, 517.306408, 516.469215, 318.64304, 255.313989,
    (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
)  # fmt: skip


@pytest.fixture
def bent(published_camera: Camera) -> Camera:
    """The published camera with all terms."""
    return replace(published_camera, tangential=TANGENTIAL, polynomial=POLYNOMIAL)


def lens(coef: Coef, tangential: Tangential, polynomial: Polynomial = (0.0, 0.0, 0.0)) -> Camera:
    """A camera with so small an image that its lens folds beyond it."""
    return Camera(
        3, 3, 1e6, 1e6, 1.0, 1.0, coef, IDENTITY, tangential=tangential, polynomial=polynomial
    )


def circle(radius: float, places: int = 720) -> FloatArray:
    angle = np.linspace(0.0, 2.0 * np.pi, places)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


# -- as OpenCV has them ---------------------------------------------------------------------------


@pytest.mark.parametrize("source", [EUROC, TUM], ids=["EuRoC", "TUM"])
def test_published_plumb_bobs_are_exact_both_ways(source: ForeignCamera) -> None:
    there = convert_to_camera(source)
    camera = there.camera
    assert isinstance(camera, Camera)
    assert there.deviation_px < 1e-11
    k1, k2, p1, p2, k3 = source.distortion
    assert (camera.coef, camera.tangential) == (NONE, (p1, p2))
    assert camera.polynomial == (k1, k2, k3)
    assert convert_to_foreign(camera, "radtan").camera == source
    # Measured apart from the conversion: OpenCV's projection of what the camera's pixels see.
    K = np.array([[source.fx, 0.0, source.cx], [0.0, source.fy, source.cy], [0.0, 0.0, 1.0]])
    pixels = pixel_grid(camera, 25)
    points = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(source.distortion))[0]
    np.testing.assert_allclose(seen.reshape(-1, 2), pixels, atol=1e-9)


def test_rows_and_a_longer_model_are_exact_too() -> None:
    half = convert_to_camera(EUROC, "halve")
    assert isinstance(half.camera, Camera)
    assert half.deviation_px < 1e-11
    assert (half.camera.height, half.camera.offset_y) == (240, 124.1875)
    back = convert_to_foreign(half.camera, "radtan", "double").camera
    assert isinstance(back, ForeignCamera)
    np.testing.assert_allclose(back.matrix, EUROC.matrix, rtol=1e-15)
    np.testing.assert_allclose(back.distortion, EUROC.distortion, rtol=1e-15)
    rational = convert_to_foreign(convert_to_camera(EUROC).camera, "rational").camera
    assert isinstance(rational, ForeignCamera)
    assert rational.distortion == (*EUROC.distortion, *(0.0,) * 3)
    # Kalibr's radtan has no k3: EuRoC's is 0 and goes over, TUM's is not.
    assert convert_to_foreign(convert_to_camera(EUROC).camera, "radtan", free=4).camera == EUROC
    assert convert_to_foreign(convert_to_camera(TUM).camera, "radtan", free=4).deviation_px > 0.01


@pytest.mark.long
def test_with_a_denominator_all_terms_are_fitted_together() -> None:
    """The rational part and tangential terms alone come no nearer than 0.49 px."""
    k = (0.3, -0.9, 2e-3, -1e-3, 1.1, 0.05, 0.1, -0.05)
    source = ForeignCamera("rational", 640, 480, 517.0, 516.0, 318.0, 255.0, k)
    found = convert_to_camera(source)
    assert isinstance(found.camera, Camera)
    assert found.deviation_px < 0.02
    assert any(found.camera.coef)
    assert any(found.camera.polynomial)


@pytest.mark.parametrize("place", range(5))
def test_each_term_is_compiled_alike(published_camera: Camera, place: int) -> None:
    term = [0.01 * (k == place) for k in range(5)]
    tangential, polynomial = (term[0], term[1]), (term[2], term[3], term[4])
    camera = replace(published_camera, tangential=tangential, polynomial=polynomial)
    for direction in ([0.2, -1.0, -0.6], [-0.4, -1.0, -0.3]):
        seen = project_direction(camera_numbers(camera), *direction)
        at = camera.centre + direction
        assert seen == pytest.approx(tuple(camera.project_robot(at)), rel=1e-12)
        assert np.abs(seen - published_camera.project_robot(at)).max() > 1e-9


def test_the_derivative_is_symmetric() -> None:
    places = np.random.default_rng(5).normal(size=(50, 2))
    k1, k2, p1, p2, k3 = BROWN
    derivative = distorted_jacobian(places, Lens(PUBLISHED, (k1, k2, k3), (p1, p2)))
    np.testing.assert_allclose(derivative, derivative.swapaxes(-1, -2), rtol=1e-12)


# -- where it is one-to-one -----------------------------------------------------------------------

SMALL, AMOUNT = st.floats(-0.5, 0.5), st.floats(-0.05, 0.05)
POLYNOMIALS = st.tuples(SMALL, SMALL, SMALL) | st.just((0.0, 0.0, 0.0))


@given(coefficients(), POLYNOMIALS, st.floats(0.001, 0.999))
def test_the_radial_part_grows_up_to_its_fold_and_comes_back(
    coef: Coef, polynomial: Polynomial, share: float
) -> None:
    limit = min(fold_radius(Lens(coef, polynomial)), 20.0)
    radius = share * limit * np.linspace(0.0, 1.0, 200)
    factor = radial_factor(radius, Lens(coef, polynomial))
    slope = factor + radius * radial_factor_derivative(radius, Lens(coef, polynomial))
    assert np.all(slope > 0.0)
    back = undistorted_radius(radius * factor, Lens(coef, polynomial))
    assert np.all(np.abs(back - radius) <= 1e-11 * np.maximum(1.0, radius) / np.minimum(slope, 1.0))


@pytest.mark.parametrize("coef", [NONE, PUBLISHED])
def test_past_the_fold_the_radial_part_falls(coef: Coef) -> None:
    polynomial = (-0.2, 0.01, -0.02)
    fold = fold_radius(Lens(coef, polynomial))
    near = fold * np.array([1.0 - 1e-6, 1.0 + 1e-6])
    slope = radial_factor(near, Lens(coef, polynomial))
    slope = slope + near * radial_factor_derivative(near, Lens(coef, polynomial))
    assert slope[0] > 0.0 > slope[1]
    # x - 0.1 x^3 folds at r = sqrt(1 / 0.3).
    assert fold_radius(Lens(NONE, (-0.1, 0.0, 0.0))) == pytest.approx(np.sqrt(1.0 / 0.3), rel=1e-11)


@given(coefficients(), POLYNOMIALS, AMOUNT, AMOUNT, st.floats(0.01, 0.999))
def test_up_to_r_max_the_lens_grows_in_all_directions_and_is_inverted(
    coef: Coef, polynomial: Polynomial, p1: float, p2: float, share: float
) -> None:
    r_max = one_to_one_radius(Lens(coef, polynomial, (p1, p2)))
    rational, radial = fold_radius(Lens(coef)), fold_radius(Lens(coef, polynomial))
    assert 0.0 < r_max <= max(min(radial, RADIUS_LIMIT), rational)
    assume(r_max > 1e-3)
    camera = lens(coef, (p1, p2), polynomial)
    rays = circle(share * min(r_max, 20.0))
    slope = np.linalg.eigvalsh(camera.distort_jacobian(rays) / 1e6)[:, 0]
    assert np.all(slope > 0.0)
    seen = camera.distort(rays)
    # Next to the fold a small error of what is seen is a large one of the ray.
    scale = max(1.0, share * r_max, np.linalg.norm(seen / 1e6, axis=1).max())
    away = np.linalg.norm(camera.undistort(seen) - rays, axis=1)
    assert np.all(away <= 1e-9 * scale / np.minimum(slope, 1.0))


@pytest.mark.parametrize("coef", [NONE, PUBLISHED])
@pytest.mark.parametrize("tangential", [TANGENTIAL, (0.04, 0.01), (0.0, -0.02)])
def test_at_r_max_it_vanishes_in_one(coef: Coef, tangential: Tangential) -> None:
    camera = lens(coef, tangential)
    edge = np.linalg.det(camera.distort_jacobian(circle(camera.r_max * (1.0 - 1e-9))))
    assert edge.min() == pytest.approx(0.0, abs=1e-4 * edge.max())
    if not any(coef):
        # The nearest fold of x + p2 3 x^2 along the direction of (p2, p1).
        assert camera.r_max == pytest.approx(1.0 / (6.0 * np.hypot(*tangential)), rel=1e-9)


def test_past_the_fold_all_is_nan(published_camera: Camera) -> None:
    camera = replace(published_camera, tangential=TANGENTIAL)
    assert camera.r_max < 2.0421
    ray = np.array([0.6, -0.8])
    assert np.isfinite(camera.distort(ray * camera.r_max * 0.9999)).all()
    for radius in (camera.r_max * 1.0001, 10.0, 1e300, np.inf):
        with np.errstate(invalid="ignore"):
            assert np.isnan(camera.distort(radius * ray)).all()
            assert np.isnan(camera.distort_jacobian(radius * ray)).all()
    for pixel in ([384 + 600, 144], [1e9, 0.0], [np.nan, 3.0], [3.0, np.inf], [1e308, 1e308]):
        assert np.isnan(camera.undistort(pixel)).all()
        assert np.isnan(camera.floor_from_pixel(pixel)).all()
    assert np.array_equal(camera.undistort([384.0, 144.0]), [0.0, 0.0])


@pytest.mark.parametrize(
    ("terms", "complaint"),
    [
        (
            {"tangential": (0.2, 0.1)},
            r"folds inside the image: with tangential p1 p2 = 0.2 0.1 it is one-to-one only up to "
            r"r = 0.594671, which pixel \(0, 0\) lies beyond; \d+ % of the image see anything",
        ),
        (
            {"tangential": (0.01, 0.0), "polynomial": (-0.6, 0.0, 0.0)},
            r"with tangential p1 p2 = 0.01 0, polynomial k1 k2 k3 = -0.6 0 0 it is one-to-one only "
            r"up to r = 0.\d+, which pixel \(0, 0\) lies beyond",
        ),
        (
            {"polynomial": (-0.6, 0.0, 0.0)},
            r"folds inside the image: with polynomial k1 k2 k3 = -0.6 0 0 it is one-to-one only up",
        ),
        ({"tangential": (1e5, 0.0)}, "folds inside the image"),
        ({"tangential": (float("nan"), 0.0)}, "tangential p1 is nan: expected a finite number"),
        ({"tangential": (0.0, float("inf"))}, "tangential p2 is inf: expected a finite number"),
        ({"tangential": (1e200, 0.0)}, "tangential is .* expected at most 1e.06 each"),
        ({"tangential": (1e-3,)}, r"tangential has 1 numbers: expected 2 \(p1 p2\)"),
        ({"polynomial": (0.0, 0.0, float("inf"))}, "polynomial k3 is inf: expected a finite"),
        ({"polynomial": (1e-3, 0.0)}, r"polynomial has 2 numbers: expected 3 \(k1 k2 k3\)"),
    ],
)
def test_what_cannot_be_is_refused(
    published_camera: Camera, terms: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(CameraError, match=complaint):
        replace(published_camera, **terms)


@given(st.floats(0.0, 0.15), st.floats(0.0, 6.2832))
def test_folds_inside_exactly_where_the_border_is_not_seen(amount: float, angle: float) -> None:
    plain = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (0.0, -0.1, 0.0, 0.0, 0.0), IDENTITY)
    tangential = (amount * np.sin(angle), amount * np.cos(angle))
    border = border_pixels(64, 48, 17)
    camera = None
    with contextlib.suppress(CameraError):
        camera = replace(plain, tangential=tangential)
    if camera is None or camera.seen_share < 1.0:
        # Somewhere on the way from the middle to the border the determinant is no more positive,
        # or just is: the border lies outside of what is seen from within r_max.
        larger = replace(plain, scale_x=5e3, scale_y=5e3, tangential=tangential)
        edge = (larger.distort(circle(larger.r_max * (1.0 - 1e-9))) - [31.5, 23.5]) / 5e3 * 50.0
        hull = cv2.convexHull(edge.astype(np.float32))
        outside = [
            cv2.pointPolygonTest(hull, tuple(p - [31.5, 23.5]), measureDist=True) for p in border
        ]
        assert min(outside) < 0.02
    else:
        inside = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1)
        rays = camera.undistort(inside)
        assert np.isfinite(rays).all()
        assert np.all(np.linalg.det(camera.distort_jacobian(rays)) > 0.0)
        assert np.isfinite(camera.undistort(border)).all()


def test_a_polynomial_unfolds_what_the_rational_part_folds() -> None:
    folded = (0.0, -0.4, 0.0, 0.0, 0.0)
    inside = Camera(768, 288, 460.0, 230.0, 384.0, 144.0, folded, IDENTITY)
    assert inside.seen_share < 1.0
    camera = replace(inside, polynomial=(0.3, 0.0, 0.0))
    assert camera.seen_share == 1.0
    alone = replace(camera, coef=NONE, polynomial=(-0.1, 0.0, 0.0))
    pixels = pixel_grid(camera)
    # With b1 = b2 = b3 = 0, a3 is k1.
    np.testing.assert_allclose(camera.undistort(pixels), alone.undistort(pixels), atol=1e-12)
    assert camera.r_max == pytest.approx(alone.r_max, rel=1e-9)


# -- a value, and its file ------------------------------------------------------------------------


def test_without_the_terms_nothing_changes(
    published_camera: Camera, published_cam_text: str
) -> None:
    zero = replace(published_camera, tangential=(0.0, -0.0), polynomial=(0.0, -0.0, 0.0))
    assert zero == published_camera
    assert format_camera(zero) == published_cam_text
    terms: list[dict[str, Any]] = [
        {}, {"polynomial": (1e-6, 0.0, 0.0)}, {"polynomial": (0.0, 1e-6, 0.0)},
        {"polynomial": (0.0, 0.0, 1e-6)}, {"tangential": (1e-6, 0.0)}, {"tangential": (0.0, 1e-6)},
        {"tangential": (1e-6, 0.0), "polynomial": (0.0, 1e-6, 0.0)},
    ]  # fmt: skip
    assert len({replace(zero, **some).content_hash for some in terms}) == len(terms)
    assert zero.content_hash == published_camera.content_hash
    pixels = pixel_grid(published_camera)
    assert np.array_equal(zero.undistort(pixels), published_camera.undistort(pixels))


@pytest.mark.parametrize(
    ("name", "numbers", "zero", "folding"),
    [
        ("tangential", "0.002 -0.003", "0, -0", "0.5 0.5"),
        ("polynomial", "-0.05 0.02 -0.004", "0, 0 -0", "-0.9 0 0"),
    ],
)
def test_the_file_has_a_key_only_where_there_are_terms(
    published_camera: Camera, published_cam_text: str, name: str, numbers: str, zero: str,
    folding: str,
) -> None:  # fmt: skip
    terms: dict[str, Any] = {name: tuple(map(float, numbers.split()))}
    camera = replace(published_camera, **terms)
    text = format_camera(camera)
    assert text == published_cam_text[:-2] + f"{name}: {{ {numbers} }}\n}}\n"
    assert parse_camera(text) == camera
    assert f"{name} {numbers}" in str(camera)
    assert name not in str(published_camera)
    assert parse_camera(text.replace(numbers, zero)) == published_camera
    count = len(numbers.split())
    for wrong, complaint in (
        ("0.002", rf":11: {name} has 1 numbers: expected {count}"),
        ("0.002 x", rf":11: {name} has 'x': expected a number"),
        (folding, rf"folds inside the image: with {name} .* = {folding} it is one-to-one only"),
    ):
        with pytest.raises(CameraError, match=complaint):
            parse_camera(text.replace(numbers, wrong))


def test_the_file_may_have_both(bent: Camera) -> None:
    text = format_camera(bent)
    assert "tangential: { 0.002 -0.003 }\npolynomial: { -0.05 0.02 -0.004 }\n}" in text
    assert parse_camera(text) == bent
