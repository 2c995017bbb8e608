"""Tangential distortion: as OpenCV has it, one-to-one where it says so, refused where it folds."""

from __future__ import annotations

import contextlib
import dataclasses

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import Camera, CameraError, format_camera, parse_camera
from camera.distortion import (
    NO_POLYNOMIAL,
    Coef,
    brown_jacobian,
    brown_of,
    brown_shift,
    fold_radius,
    one_to_one_radius,
)
from camera.kernels import brown_shift_point, lens_numbers
from camera.model_checks import border_pixels
from tests.camera.strategies import coefficients

AMOUNT = st.floats(-0.05, 0.05)
TANGENTIAL = (2e-3, -3e-3)
BROWN = brown_of(NO_POLYNOMIAL, TANGENTIAL)


@pytest.fixture
def decentred(published_camera: Camera) -> Camera:
    return dataclasses.replace(published_camera, tangential=TANGENTIAL)


def test_the_terms_are_opencvs() -> None:
    camera = Camera(
        640, 480, 500.0, 505.0, 318.5, 241.0, (0.0,) * 5, np.eye(4)[:3],  # type: ignore[arg-type]
        tangential=(1e-3, -5e-3),
    )  # fmt: skip
    rays = np.random.default_rng(1).uniform(-0.6, 0.6, size=(100, 2))
    K = np.array([[500.0, 0.0, 318.5], [0.0, 505.0, 241.0], [0.0, 0.0, 1.0]])
    points = np.column_stack([rays, np.ones(100)])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([0, 0, 1e-3, -5e-3]))
    np.testing.assert_allclose(camera.distort(rays), theirs[0].reshape(-1, 2), atol=1e-10)


def test_the_compiled_terms_are_the_same() -> None:
    rng = np.random.default_rng(2)
    for x, y in rng.normal(size=(20, 2)):
        shift = brown_shift(np.array([x, y]), BROWN)
        assert brown_shift_point(*BROWN, x, y) == pytest.approx(tuple(shift), rel=1e-14)


def test_without_the_terms_nothing_changes(published_camera: Camera, decentred: Camera) -> None:
    assert dataclasses.replace(decentred, tangential=(0.0, -0.0)) == published_camera
    assert decentred != published_camera
    plain = dataclasses.replace(published_camera, tangential=(0.0, -0.0))
    assert plain.content_hash == published_camera.content_hash
    hashes = {
        dataclasses.replace(published_camera, tangential=pair).content_hash
        for pair in [(0.0, 0.0), (1e-6, 0.0), (0.0, 1e-6), (2e-6, 0.0)]
    }
    assert len(hashes) == 4
    assert "tangential" not in str(published_camera)
    assert "tangential 0.002 -0.003" in str(decentred)
    assert lens_numbers(published_camera)[5:10].tolist() == [0.0] * 5


# -- where it is one-to-one -----------------------------------------------------------------------


def determinant(coef: Coef, tangential: tuple[float, float], xy: np.ndarray) -> np.ndarray:
    camera = Camera(
        3, 3, 1e6, 1e6, 1.0, 1.0, coef, np.eye(4)[:3],  # type: ignore[arg-type]
        tangential=tangential,
    )  # fmt: skip
    return np.asarray(np.linalg.det(camera.distort_jacobian(xy))) / 1e12


def circle(radius: float, places: int = 720) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, places)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@given(coefficients(), AMOUNT, AMOUNT, st.floats(0.01, 0.999))
def test_up_to_r_max_the_jacobian_is_positive_in_all_directions(
    coef: Coef, p1: float, p2: float, share: float
) -> None:
    r_max = one_to_one_radius(coef, (0.0, 0.0, p1, p2, 0.0))
    assert 0.0 < r_max <= fold_radius(coef)
    assert np.all(determinant(coef, (p1, p2), circle(share * min(r_max, 573.0))) > 0.0)


@pytest.mark.parametrize(
    "coef", [(0.0,) * 5, (-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)]
)
@pytest.mark.parametrize("tangential", [TANGENTIAL, (0.04, 0.01), (0.0, -0.02)])
def test_at_r_max_it_vanishes_in_one(coef: Coef, tangential: tuple[float, float]) -> None:
    r_max = one_to_one_radius(coef, brown_of(NO_POLYNOMIAL, tangential))
    edge = determinant(coef, tangential, circle(r_max * (1.0 - 1e-9)))
    assert edge.min() == pytest.approx(0.0, abs=1e-4 * edge.max())
    if not any(coef):
        # The nearest fold of x + p2 3 x^2 along the direction of (p2, p1).
        assert r_max == pytest.approx(1.0 / (6.0 * np.hypot(*tangential)), rel=1e-9)


@given(coefficients(), AMOUNT, AMOUNT, st.integers(0, 1000))
def test_what_is_seen_comes_back_out_to_the_fold(
    coef: Coef, p1: float, p2: float, seed: int
) -> None:
    r_max = min(one_to_one_radius(coef, (0.0, 0.0, p1, p2, 0.0)), 20.0)
    camera = Camera(
        3, 3, 1e6, 1e6, 1.0, 1.0, coef, np.eye(4)[:3],  # type: ignore[arg-type]
        tangential=(p1, p2),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    rays = circle(1.0, 50) * (0.999 * r_max * np.sqrt(rng.random((50, 1))))
    back = camera.undistort(camera.distort(rays))
    # Next to the fold a small error of what is seen is a large one of the ray.
    slope = np.linalg.eigvalsh(camera.distort_jacobian(rays))[:, 0] / 1e6
    allowed = 1e-9 * np.maximum(1.0, np.linalg.norm(rays, axis=1)) / np.minimum(slope, 1.0)
    assert np.all(np.linalg.norm(back - rays, axis=1) <= allowed)


def test_past_the_fold_all_is_nan(decentred: Camera) -> None:
    assert decentred.r_max < 2.0421
    ray = np.array([0.6, -0.8])
    assert np.isfinite(decentred.distort(ray * decentred.r_max * 0.9999)).all()
    for radius in (decentred.r_max * 1.0001, 10.0, 1e300, np.inf):
        with np.errstate(invalid="ignore"):
            assert np.isnan(decentred.distort(radius * ray)).all()
            assert np.isnan(decentred.distort_jacobian(radius * ray)).all()
    for pixel in ([384 + 600, 144], [1e9, 0.0], [np.nan, 3.0], [3.0, np.inf], [1e308, 1e308]):
        assert np.isnan(decentred.undistort(pixel)).all()
        assert np.isnan(decentred.floor_from_pixel(pixel)).all()
    assert np.array_equal(decentred.undistort([384.0, 144.0]), [0.0, 0.0])


def test_a_derivative_of_the_terms_is_symmetric() -> None:
    xy = np.random.default_rng(5).normal(size=(50, 2))
    derivative = brown_jacobian(xy, BROWN)
    np.testing.assert_array_equal(derivative, derivative.swapaxes(-1, -2))


@pytest.mark.parametrize(
    ("tangential", "complaint"),
    [
        (
            (0.2, 0.1),
            r"folds inside the image: with tangential p1 = 0.2 and p2 = 0.1 it is one-to-one only "
            r"up to r = 0.594671, which pixel \(0, 0\) lies beyond",
        ),
        ((float("nan"), 0.0), "tangential p1 is nan: expected a finite number"),
        ((0.0, float("inf")), "tangential p2 is inf: expected a finite number"),
        ((1e200, 0.0), "tangential is .* expected at most 1e.06 each"),
        ((1e5, 0.0), "folds inside the image"),
        ((1e-3,), r"tangential has 1 numbers: expected 2 \(p1 p2\)"),
    ],
)
def test_what_cannot_be_is_refused(
    published_camera: Camera, tangential: tuple[float, float], complaint: str
) -> None:
    with pytest.raises(CameraError, match=complaint):
        dataclasses.replace(published_camera, tangential=tangential)


@given(st.floats(0.0, 0.15), st.floats(0.0, 6.2832))
def test_folds_inside_exactly_where_the_border_is_not_seen(amount: float, angle: float) -> None:
    pose = ((-1.0, 0, 0, 0.0), (0, 1.0, 0, 0.0), (0, 0, -1.0, 1.5))
    plain = Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (0.0, -0.1, 0.0, 0.0, 0.0), pose)
    tangential = (amount * np.sin(angle), amount * np.cos(angle))
    border = border_pixels(64, 48, 17)
    camera = None
    with contextlib.suppress(CameraError):
        camera = dataclasses.replace(plain, tangential=tangential)
    if camera is None or camera.seen_share < 1.0:
        # Somewhere on the way from the middle to the border the determinant is no more positive,
        # or just is: the border lies outside of what is seen from within r_max.
        reach = circle(one_to_one_radius(plain.coef, brown_of(NO_POLYNOMIAL, tangential)))
        larger = dataclasses.replace(plain, scale_x=5e3, scale_y=5e3, tangential=tangential)
        edge = (larger.distort(reach * (1.0 - 1e-9)) - [31.5, 23.5]) / 5e3 * 50.0
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


# -- its file -------------------------------------------------------------------------------------


def test_the_file_has_a_key_only_where_there_are_terms(
    published_camera: Camera, decentred: Camera, published_cam_text: str
) -> None:
    assert format_camera(published_camera) == published_cam_text
    text = format_camera(decentred)
    assert text == published_cam_text[:-2] + "tangential: { 0.002 -0.003 }\n}\n"
    assert parse_camera(text) == decentred
    assert parse_camera(text.replace("0.002 -0.003", "0, -0")) == published_camera
    for wrong, complaint in (
        ("0.002", r":11: tangential has 1 numbers: expected 2"),
        ("0.002 x", r":11: tangential has 'x': expected a number"),
        ("0.5 0.5", r"folds inside the image: with tangential p1 = 0.5"),
    ):
        with pytest.raises(CameraError, match=complaint):
            parse_camera(text.replace("0.002 -0.003", wrong))
