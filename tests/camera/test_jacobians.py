"""Gradients, tested apart from the values: against finite differences of fourth order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import given

from camera import Camera
from redetect.array_types import FloatArray
from tests.camera.strategies import cameras, pixel_grid


def differences(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, step: FloatArray
) -> FloatArray:
    """(N, M, K) derivatives of an (N, K) -> (N, M) function with a step for each of the N."""
    columns = []
    for axis in range(at.shape[-1]):
        offset = np.zeros_like(at)
        offset[:, axis] = step
        once = function(at + offset) - function(at - offset)
        twice = function(at + 2 * offset) - function(at - 2 * offset)
        columns.append((8.0 * once - twice) / (12.0 * step[:, None]))
    return np.stack(columns, axis=-1)


def assert_close(analytic: FloatArray, numeric: FloatArray, tolerance: float) -> None:
    """Equal relative to the largest entry of each matrix."""
    assert np.isfinite(analytic).all()
    size = np.abs(analytic).max(axis=(-2, -1), keepdims=True)
    assert np.all(np.abs(analytic - numeric) <= tolerance * size)


def interior(camera: Camera) -> FloatArray:
    """Pixels of the image off its rim: differences need room on both sides of the fold."""
    middle = np.array([camera.offset_x, camera.offset_y])
    return np.asarray(middle + 0.9 * (pixel_grid(camera, 7) - middle))


@given(cameras())
def test_of_the_distortion(camera: Camera) -> None:
    xy = camera.undistort(interior(camera))
    step = 1e-4 * np.minimum(np.hypot(*xy.T) + 1e-2, camera.r_max - np.hypot(*xy.T))
    numeric = differences(camera.distort, xy, step)
    assert_close(camera.distort_jacobian(xy), numeric, 1e-6)


def test_of_the_distortion_on_the_optical_axis(published_camera: Camera) -> None:
    assert np.array_equal(
        published_camera.distort_jacobian([0.0, 0.0]), [[464.762, 0.0], [0.0, 232.381]]
    )


@given(cameras())
def test_of_the_projection(camera: Camera) -> None:
    depths = np.linspace(0.5, 3.0, 49)
    points = camera.unproject(interior(camera)) * depths[:, None]
    radius = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
    step = 1e-4 * points[:, 2] * np.minimum(radius + 1e-2, camera.r_max - radius)
    step /= 1.0 + radius
    numeric = differences(camera.project, points, step)
    assert_close(camera.project_jacobian(points), numeric, 1e-6)


@given(cameras(down_deg=(10.0, 80.0)))
def test_of_the_floor_position(camera: Camera) -> None:
    pixels = interior(camera)
    direction = camera.directions_robot(pixels)
    pixels = pixels[direction[:, 2] < -0.05 * np.linalg.norm(direction, axis=-1)]
    # Next to the horizon the floor runs away within pixels: a step is a share of the image there.
    step = np.full(len(pixels), 1e-5 * min(camera.width, camera.height))
    numeric = differences(camera.floor_from_pixel, pixels, step)
    assert_close(camera.floor_jacobian(pixels), numeric, 1e-5)


def test_published_jacobian_is_that_of_a_rigid_pose(published_camera: Camera) -> None:
    """The projection turns by the transpose, not by the inverse of a rotation in few digits."""
    camera = published_camera

    def projected(floor_xy: FloatArray) -> FloatArray:
        point = np.concatenate([floor_xy, np.zeros_like(floor_xy[:, :1])], axis=-1)
        return camera.project((point - camera.centre) @ camera.rotation)

    v, u = np.mgrid[116:277:16, 15:756:20]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)
    by_floor = differences(projected, camera.floor_from_pixel(pixels), np.full(len(pixels), 1e-5))
    published = camera.floor_jacobian_published(pixels)
    np.testing.assert_allclose(
        published @ by_floor, np.broadcast_to(np.eye(2), by_floor.shape), atol=1e-7
    )
    analytic = camera.floor_jacobian(pixels)
    error = np.abs(published - analytic) / np.abs(analytic).max(axis=(-2, -1), keepdims=True)
    assert error.max() < 1e-4
    # The published digits tell them apart.
    assert error.max() > 3e-7
