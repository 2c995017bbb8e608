"""The even polynomial k1 k2 k3: as OpenCV has it, exact both ways, refused where it folds."""

from __future__ import annotations

import dataclasses
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
    brown_jacobian,
    brown_of,
    brown_shift,
    fold_radius,
    one_to_one_radius,
    radial_factor,
    radial_factor_derivative,
    undistorted_radius,
)
from camera.formats.conversion import convert_to_camera, convert_to_foreign
from camera.formats.models import ForeignCamera
from camera.kernels import (
    brown_shift_point,
    camera_numbers,
    has_brown,
    lens_numbers,
    project_floor_point,
)
from tests.camera.strategies import cameras, coefficients, pixel_grid

POLYNOMIAL = (-0.05, 0.02, -0.004)
BROWN = brown_of(POLYNOMIAL, (2e-3, -3e-3))
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


@st.composite
def polynomials(draw: st.DrawFn) -> tuple[float, float, float]:
    small = st.floats(-0.5, 0.5)
    return draw(small), draw(small), draw(small)


@pytest.mark.parametrize("source", [EUROC, TUM], ids=["EuRoC", "TUM"])
def test_published_plumb_bobs_are_exact_both_ways(source: ForeignCamera) -> None:
    there = convert_to_camera(source)
    camera = there.camera
    assert isinstance(camera, Camera)
    assert there.deviation_px < 1e-11
    k1, k2, p1, p2, k3 = source.distortion
    assert (camera.coef, camera.tangential) == ((0.0,) * 5, (p1, p2))
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
    assert rational.distortion == (*EUROC.distortion, *(0.0,) * 7)
    # Kalibr's radtan has no k3: EuRoC's is 0 and goes over, TUM's is not.
    assert convert_to_foreign(convert_to_camera(EUROC).camera, "radtan", free=4).camera == EUROC
    assert convert_to_foreign(convert_to_camera(TUM).camera, "radtan", free=4).deviation_px > 0.01


@pytest.mark.long
def test_with_a_denominator_all_terms_are_fitted_together() -> None:
    """The rational part and tangential terms alone come no nearer than 0.49 px."""
    k = (0.3, -0.9, 2e-3, -1e-3, 1.1, 0.05, 0.1, -0.05, *(0.0,) * 4)
    source = ForeignCamera("rational", 640, 480, 517.0, 516.0, 318.0, 255.0, k)
    found = convert_to_camera(source)
    assert isinstance(found.camera, Camera)
    assert found.deviation_px < 0.02
    assert any(found.camera.coef)
    assert any(found.camera.polynomial)


def test_the_compiled_terms_are_the_same() -> None:
    for x, y in np.random.default_rng(2).normal(size=(20, 2)):
        shift = brown_shift(np.array([x, y]), BROWN)
        assert brown_shift_point(*BROWN, x, y) == pytest.approx(tuple(shift), rel=1e-13)
    for place in range(5):
        terms = np.zeros(5)
        assert not has_brown(terms)
        terms[place] = 1e-9
        assert has_brown(terms)


def test_without_a_polynomial_nothing_changes(
    published_camera: Camera, published_cam_text: str
) -> None:
    zero = dataclasses.replace(published_camera, polynomial=(0.0, -0.0, 0.0))
    assert zero == published_camera
    assert zero.content_hash == published_camera.content_hash
    assert format_camera(zero) == published_cam_text
    assert "polynomial" not in str(zero)
    hashes = {
        dataclasses.replace(published_camera, **terms).content_hash
        for terms in (
            {}, {"polynomial": (1e-6, 0.0, 0.0)}, {"polynomial": (0.0, 1e-6, 0.0)},
            {"polynomial": (0.0, 0.0, 1e-6)}, {"tangential": (1e-6, 0.0)},
            {"tangential": (1e-6, 0.0), "polynomial": (0.0, 1e-6, 0.0)},
        )
    }  # fmt: skip
    assert len(hashes) == 6
    pixels = pixel_grid(published_camera)
    assert np.array_equal(zero.undistort(pixels), published_camera.undistort(pixels))


@given(coefficients(), polynomials(), st.floats(0.001, 0.999))
def test_the_radial_part_grows_up_to_its_fold_and_comes_back(
    coef: Coef, polynomial: tuple[float, float, float], share: float
) -> None:
    limit = min(fold_radius(coef, polynomial), 20.0)
    radius = share * limit * np.linspace(0.0, 1.0, 200)
    factor = radial_factor(radius, coef, polynomial)
    slope = factor + radius * radial_factor_derivative(radius, coef, polynomial)
    assert np.all(slope > 0.0)
    back = undistorted_radius(radius * factor, coef, polynomial)
    assert np.all(np.abs(back - radius) <= 1e-11 * np.maximum(1.0, radius) / np.minimum(slope, 1.0))


@pytest.mark.parametrize("coef", [(0.0,) * 5, (-0.06, -0.3, 0.3, 1.5, -0.4)])
def test_past_the_fold_the_radial_part_falls(coef: Coef) -> None:
    polynomial = (-0.2, 0.01, -0.02)
    fold = fold_radius(coef, polynomial)
    near = fold * np.array([1.0 - 1e-6, 1.0 + 1e-6])
    slope = radial_factor(near, coef, polynomial)
    slope = slope + near * radial_factor_derivative(near, coef, polynomial)
    assert slope[0] > 0.0 > slope[1]
    # x - 0.1 x^3 folds at r = sqrt(1 / 0.3).
    assert fold_radius((0.0,) * 5, (-0.1, 0.0, 0.0)) == pytest.approx(np.sqrt(1.0 / 0.3), rel=1e-11)


@given(coefficients(), polynomials(), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
def test_what_is_seen_comes_back_out_to_the_fold(
    coef: Coef, polynomial: tuple[float, float, float], p1: float, p2: float
) -> None:
    r_max = one_to_one_radius(coef, brown_of(polynomial, (p1, p2)))
    assert 0.0 < r_max <= max(min(fold_radius(coef, polynomial), RADIUS_LIMIT), fold_radius(coef))
    assume(r_max > 1e-3)
    camera = Camera(
        3, 3, 1e6, 1e6, 1.0, 1.0, coef, IDENTITY, tangential=(p1, p2), polynomial=polynomial
    )
    rng = np.random.default_rng(7)
    angle = rng.uniform(0.0, 2.0 * np.pi, 40)
    radius = 0.999 * min(r_max, 20.0) * np.sqrt(rng.random(40))
    rays = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    jacobian = camera.distort_jacobian(rays) / 1e6
    slope = np.linalg.eigvalsh(0.5 * (jacobian + jacobian.swapaxes(-1, -2)))[:, 0]
    assert np.all(slope > 0.0)
    seen = camera.distort(rays)
    back = camera.undistort(seen)
    scale = np.maximum(1.0, np.maximum(radius, np.linalg.norm(seen / 1e6, axis=1)))
    assert np.all(np.linalg.norm(back - rays, axis=1) <= 1e-9 * scale / np.minimum(slope, 1.0))


@given(cameras())
def test_pixels_go_out_and_come_back(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    np.testing.assert_allclose(camera.distort(camera.undistort(pixels)), pixels, atol=1e-6)
    assert parse_camera(format_camera(camera)) == camera


def test_jacobians_are_those_of_differences(published_camera: Camera) -> None:
    camera = dataclasses.replace(published_camera, tangential=(2e-3, -3e-3), polynomial=POLYNOMIAL)
    rays = np.random.default_rng(3).uniform(-0.8, 0.8, size=(60, 2))
    steps = 1e-6 * np.eye(2)
    ahead, behind = (camera.distort(rays[:, None] + s * steps) for s in (1.0, -1.0))
    expected = ((ahead - behind) / 2e-6).swapaxes(-1, -2)
    np.testing.assert_allclose(camera.distort_jacobian(rays), expected, atol=1e-5)
    ahead, behind = (brown_shift(rays[:, None] + s * steps, BROWN) for s in (1.0, -1.0))
    expected = ((ahead - behind) / 2e-6).swapaxes(-1, -2)
    np.testing.assert_allclose(brown_jacobian(rays, BROWN), expected, atol=1e-9)
    pixels = pixel_grid(camera)[-20:]
    steps = 1e-4 * np.eye(2)
    ahead, behind = (camera.floor_from_pixel(pixels[:, None] + s * steps) for s in (1.0, -1.0))
    expected = ((ahead - behind) / 2e-4).swapaxes(-1, -2)
    np.testing.assert_allclose(camera.floor_jacobian(pixels), expected, rtol=1e-5, atol=1e-8)


def test_kernels_project_as_the_camera(published_camera: Camera) -> None:
    for tangential in ((0.0, 0.0), (2e-3, -3e-3)):
        camera = dataclasses.replace(published_camera, tangential=tangential, polynomial=POLYNOMIAL)
        numbers = camera_numbers(camera)
        places = np.random.default_rng(5).uniform([-2.0, -5.0], [2.0, 1.0], size=(200, 2))
        found = np.array([project_floor_point(numbers, *place) for place in places])
        expected = camera.project_floor(places)
        assert np.isfinite(expected).all(axis=1).sum() > 100
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)
        assert lens_numbers(camera)[5:10].tolist() == list(brown_of(POLYNOMIAL, tangential))


@pytest.mark.parametrize(
    ("polynomial", "complaint"),
    [
        (
            (-0.6, 0.0, 0.0),
            r"folds inside the image: with polynomial k1 = -0.6, k2 = 0 and k3 = 0 it grows only "
            r"up to r = 0.\d+, seen at 0.\d+, while the image's corner lies at 1.\d+",
        ),
        ((float("nan"), 0.0, 0.0), "polynomial k1 is nan: expected a finite number"),
        ((0.0, 0.0, float("inf")), "polynomial k3 is inf: expected a finite number"),
        ((0.0, 1e200, 0.0), "polynomial is .* expected at most 1e.06 each"),
        ((1e-3, 0.0), r"polynomial has 2 numbers: expected 3 \(k1 k2 k3\)"),
    ],
)
def test_what_cannot_be_is_refused(
    published_camera: Camera, polynomial: tuple[float, float, float], complaint: str
) -> None:
    with pytest.raises(CameraError, match=complaint):
        dataclasses.replace(published_camera, polynomial=polynomial)


def test_a_fold_by_both_names_both(published_camera: Camera) -> None:
    complaint = (
        r"with tangential p1 = 0.01 and p2 = 0, polynomial k1 = -0.6, k2 = 0 and k3 = 0 it is "
        r"one-to-one only up to r = 0.\d+, which pixel \(0, 0\) lies beyond"
    )
    with pytest.raises(CameraError, match=complaint):
        dataclasses.replace(published_camera, tangential=(0.01, 0.0), polynomial=(-0.6, 0.0, 0.0))


def test_a_polynomial_unfolds_what_the_rational_part_folds() -> None:
    folded = (0.0, -0.4, 0.0, 0.0, 0.0)
    assert Camera(768, 288, 460.0, 230.0, 384.0, 144.0, folded, IDENTITY).seen_share < 1.0
    camera = Camera(
        768, 288, 460.0, 230.0, 384.0, 144.0, folded, IDENTITY, polynomial=(0.3, 0.0, 0.0)
    )
    assert camera.seen_share == 1.0
    alone = dataclasses.replace(camera, coef=(0.0,) * 5, polynomial=(-0.1, 0.0, 0.0))
    pixels = pixel_grid(camera)
    # With b1 = b2 = b3 = 0, a3 is k1.
    np.testing.assert_allclose(camera.undistort(pixels), alone.undistort(pixels), atol=1e-12)
    assert camera.r_max == pytest.approx(alone.r_max, rel=1e-9)


def test_the_file_has_a_key_only_where_there_are_terms(
    published_camera: Camera, published_cam_text: str
) -> None:
    camera = dataclasses.replace(published_camera, polynomial=POLYNOMIAL)
    text = format_camera(camera)
    assert text == published_cam_text[:-2] + "polynomial: { -0.05 0.02 -0.004 }\n}\n"
    assert parse_camera(text) == camera
    assert "polynomial -0.05 0.02 -0.004" in str(camera)
    both = dataclasses.replace(camera, tangential=(0.002, -0.003))
    assert "tangential: { 0.002 -0.003 }\npolynomial: { -0.05 0.02 -0.004 }\n}" in format_camera(
        both
    )
    assert parse_camera(format_camera(both)) == both
    assert parse_camera(text.replace("-0.05 0.02 -0.004", "0, 0 -0")) == published_camera
    for wrong, complaint in (
        ("-0.05 0.02", r":11: polynomial has 2 numbers: expected 3"),
        ("-0.05 x 0", r":11: polynomial has 'x': expected a number"),
        ("-0.9 0 0", r"folds inside the image: with polynomial k1 = -0.9"),
    ):
        with pytest.raises(CameraError, match=complaint):
            parse_camera(text.replace("-0.05 0.02 -0.004", wrong))
