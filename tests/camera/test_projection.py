"""From points to pixels and back: what is defined comes back, what is not is NaN."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera import Camera
from camera.kernels import camera_numbers, project_floor_point
from tests.camera.strategies import cameras, pixel_grid


def pinhole(height_m: float = 2.0) -> Camera:
    """Looks straight down; image x is robot X mirrored, so that z points to the floor."""
    return Camera(
        width=101, height=101, scale_x=100.0, scale_y=100.0, offset_x=50.0, offset_y=50.0,
        coef=(0.0, 0.0, 0.0, 0.0, 0.0),
        robot_from_camera=((-1, 0, 0, 0.5), (0, 1, 0, -0.25), (0, 0, -1, height_m)),
    )  # fmt: skip


def test_a_camera_that_looks_straight_down_sees_what_geometry_says() -> None:
    camera = pinhole(height_m=2.0)
    assert camera.floor_from_pixel([50, 50]) == pytest.approx([0.5, -0.25])
    # 10 px at 100 px focal length and 2 m: 0.2 m; u runs towards -X, v towards +Y.
    assert camera.floor_from_pixel([60, 50]) == pytest.approx([0.3, -0.25])
    assert camera.floor_from_pixel([50, 60]) == pytest.approx([0.5, -0.05])
    assert camera.project_robot([0.5, 0.75, 1.0]) == pytest.approx([50, 150])


@given(cameras())
def test_projecting_what_a_pixel_sees_gives_the_pixel_back(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    assert np.abs(camera.project(camera.unproject(pixels)) - pixels).max() <= 1e-9
    assert np.abs(camera.distort(camera.undistort(pixels)) - pixels).max() <= 1e-9


@given(cameras(), st.floats(0.01, 100.0))
def test_depth_along_a_ray_does_not_matter(camera: Camera, depth: float) -> None:
    pixels = pixel_grid(camera)
    assert np.abs(camera.project(depth * camera.unproject(pixels)) - pixels).max() <= 1e-9


@given(cameras())
def test_the_floor_a_pixel_sees_is_seen_at_that_pixel(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    floor_xy = camera.floor_from_pixel(pixels)
    down = camera.directions_robot(pixels)[:, 2]
    # Rays that all but graze the floor meet it kilometres away, where doubles run out.
    clear = np.abs(down) > 1e-3
    assert np.array_equal(np.isnan(floor_xy[clear, 0]), down[clear] > 0.0)
    met = np.asarray(down < -1e-3)
    error_px = np.abs(camera.project_floor(floor_xy) - pixels)
    assert np.all(error_px[met] <= 1e-8)


@given(cameras())
def test_directions_point_from_the_centre_to_the_floor_seen(camera: Camera) -> None:
    pixels = pixel_grid(camera)
    floor_xy = camera.floor_from_pixel(pixels)
    met = np.isfinite(floor_xy[:, 0])
    ray = np.column_stack([floor_xy, np.zeros(len(floor_xy))])[met] - camera.centre
    direction = camera.directions_robot(pixels)[met]
    sine = np.linalg.norm(np.cross(ray, direction), axis=-1) / (
        np.linalg.norm(ray, axis=-1) * np.linalg.norm(direction, axis=-1)
    )
    assert np.all(sine <= 1e-9)


def test_above_the_horizon_no_floor_is_seen(published_camera: Camera) -> None:
    column = np.stack([np.full(288, 384.0), np.arange(288.0)], axis=-1)
    up = published_camera.directions_robot(column)[:, 2] >= 0.0
    assert up[0]
    assert not up[-1]
    nan = np.isnan(published_camera.floor_from_pixel(column))
    assert np.array_equal(nan, np.stack([up, up], axis=-1))
    assert np.array_equal(np.isnan(published_camera.floor_jacobian(column)).all((1, 2)), up)


@pytest.mark.parametrize("depth", [0.0, -0.0, -1e-9, -1.0, np.nan])
def test_behind_the_camera_u_and_v_are_nan(published_camera: Camera, depth: float) -> None:
    assert np.isnan(published_camera.project([0.1, 0.2, depth])).all()
    assert np.isnan(published_camera.project_jacobian([0.1, 0.2, depth])).all()


@given(st.floats(0.0, 2 * np.pi))
def test_past_the_fold_u_and_v_are_nan_and_just_before_it_they_are_not(angle: float) -> None:
    camera = dataclasses.replace(
        pinhole(), coef=(-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806)
    )
    assert camera.r_max == pytest.approx(2.0421, abs=5e-5)
    ray = np.array([np.cos(angle), np.sin(angle)])
    assert np.isfinite(camera.distort(2.0421 * ray)).all()
    for radius in (2.0422, 10.0, 1e300, np.inf):
        with np.errstate(invalid="ignore"):  # 0 * inf of the test's own
            beyond = radius * ray
        assert np.isnan(camera.distort(beyond)).all()
        assert np.isnan(camera.distort_jacobian(beyond)).all()


def test_a_camera_without_a_fold_has_no_pixel_for_infinity() -> None:
    camera = pinhole()
    assert camera.r_max == np.inf
    assert np.isnan(camera.distort([np.inf, 0.0])).all()
    assert np.isnan(camera.project([1.0, 0.0, 5e-324])).all()


def test_a_pixel_past_the_fold_sees_nothing(published_camera: Camera) -> None:
    # The fold is seen at a distorted radius of 1.268: 589 px from the centre along u.
    assert np.isfinite(published_camera.undistort([384 + 589, 144])).all()
    for seen in (published_camera.undistort, published_camera.unproject,
                 published_camera.directions_robot, published_camera.floor_from_pixel):  # fmt: skip
        assert np.isnan(seen([384 + 590, 144])).all()


def test_nan_in_one_coordinate_is_nan_in_all(published_camera: Camera) -> None:
    assert np.isnan(published_camera.distort([np.nan, 0.1])).all()
    assert np.isnan(published_camera.undistort([400.0, np.nan])).all()
    assert np.isnan(published_camera.project([0.1, np.nan, 1.0])).all()
    assert np.isnan(published_camera.project_floor([np.nan, -2.0])).all()


def test_any_leading_shape_is_kept(published_camera: Camera) -> None:
    pixels = pixel_grid(published_camera, 4).reshape(2, 8, 2)
    for function, tail in (
        (published_camera.undistort, (2,)),
        (published_camera.unproject, (3,)),
        (published_camera.floor_from_pixel, (2,)),
        (published_camera.floor_jacobian, (2, 2)),
        (published_camera.floor_jacobian_published, (2, 2)),
    ):
        whole = function(pixels)
        assert whole.shape == (2, 8, *tail)
        assert function(np.zeros((0, 2))).shape == (0, *tail)
        assert np.allclose(function(pixels[1, 3]), whole[1, 3], rtol=1e-9, atol=0, equal_nan=True)


@settings(deadline=None)  # the first example waits for the compiler
@given(cameras(), st.integers(0, 2**32 - 1))
def test_the_compiled_projection_is_the_camera_s(camera: Camera, seed: int) -> None:
    numbers = camera_numbers(camera)
    assert numbers.shape == (27,)
    spread = camera.centre[2] * 10.0 ** np.linspace(-2, 2, 40)
    floor_xy = camera.centre[:2] + spread[:, None] * np.random.default_rng(seed).normal(
        size=(40, 2)
    )
    seen = camera.project_floor(floor_xy)
    compiled = np.array([project_floor_point(numbers, x, y) for x, y in floor_xy])
    assert np.array_equal(np.isnan(compiled), np.isnan(seen))
    inside = np.all(np.abs(seen) < 1e5, axis=-1)
    assert np.all(np.abs(compiled - seen)[inside] <= 1e-8)


def test_the_compiled_projection_is_nan_behind_the_camera_and_past_the_fold(
    published_camera: Camera,
) -> None:
    numbers = camera_numbers(published_camera)
    behind = (0.0, 5.0)  # +Y is backward
    aside = (-30.0, -2.0)
    assert published_camera.robot_to_camera([*behind, 0.0])[2] < 0.0
    x, y, z = published_camera.robot_to_camera([*aside, 0.0])
    assert z > 0.0
    assert np.hypot(x, y) / z > published_camera.r_max
    for point in (behind, aside, (np.nan, -2.0), (0.0, np.nan)):
        assert np.isnan(project_floor_point(numbers, *point)).all()
        assert np.isnan(published_camera.project_floor(point)).all()
