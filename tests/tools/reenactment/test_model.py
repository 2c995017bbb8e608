"""Predicted pixels against a camera that is really mounted so; Jacobians against differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from redetect.slam.models import chain_steps
from redetect.slam.mounting import rotation_exp, rows_as_recorded
from tools.reenactment.fitting import odometry_residuals
from tools.reenactment.mounted_discs import Geometry, predict_pixels

FloatArray = NDArray[np.float64]


@pytest.fixture
def geometry(published_camera: Camera) -> Geometry:
    rng = np.random.default_rng(3)
    return Geometry(
        poses=np.array([[0.3, -0.2, 0.4], [1.0, 2.0, -2.5]]),
        disc_xy=np.array([[0.9, -2.4], [-0.8, 3.4], [0.4, -3.2]]),
        rotation=Rotation.from_rotvec([-0.04, 0.02, 0.03]).as_matrix() @ published_camera.rotation,
        centre=published_camera.centre + np.array([0.0, 0.0, 0.05]),
        tilt=rng.normal(scale=0.02, size=(2, 2)),
    )


FRAME, DISC = np.array([0, 1, 0]), np.array([0, 1, 2])


def test_pixels_are_those_of_a_camera_mounted_and_tilted_so(
    published_camera: Camera, geometry: Geometry
) -> None:
    pixels, _ = predict_pixels(published_camera, geometry, FRAME, DISC)
    for pixel, frame, disc in zip(pixels, FRAME, DISC):
        x, y, theta = geometry.poses[frame]
        tilt = Rotation.from_rotvec([*geometry.tilt[frame], 0.0]).as_matrix()
        mounting = np.column_stack([tilt @ geometry.rotation, geometry.centre])
        camera = replace(published_camera, robot_from_camera=tuple(map(tuple, mounting.tolist())))
        back = Rotation.from_euler("z", theta).inv()
        in_robot = back.apply([*(geometry.disc_xy[disc] - [x, y]), 0.0])
        # The printed rotation is one to 6 digits only: its transpose is its inverse to 1e-4 px.
        np.testing.assert_allclose(pixel, camera.project_robot(in_robot), rtol=0.0, atol=2e-4)


def test_disc_behind_the_robot_is_nowhere(published_camera: Camera, geometry: Geometry) -> None:
    behind = replace(geometry, disc_xy=geometry.poses[0, :2] - np.array([[0.0, -60.0]]))
    pixels, _ = predict_pixels(published_camera, behind, np.array([0]), np.array([0]))
    assert np.isnan(pixels).all()


def _differences(of: Callable[[float], FloatArray]) -> FloatArray:
    step = 1e-6
    return (of(step) - of(-step)) / (2.0 * step)


@pytest.mark.parametrize(
    ("part", "field", "unknown"),
    [
        *(("pose", "poses", k) for k in range(3)),
        *(("disc", "disc_xy", k) for k in range(2)),
        *(("tilt", "tilt", k) for k in range(2)),
    ],
)
def test_jacobians_by_frame_and_disc(
    published_camera: Camera, geometry: Geometry, part: str, field: str, unknown: int
) -> None:
    def pixels(step: float) -> FloatArray:
        values = getattr(geometry, field).copy()
        values[:, unknown] += step
        changed = replace(geometry, **{field: values})
        return predict_pixels(published_camera, changed, FRAME, DISC)[0]

    _, jacobians = predict_pixels(published_camera, geometry, FRAME, DISC)
    analytic = getattr(jacobians, part)[:, :, unknown]
    np.testing.assert_allclose(analytic, _differences(pixels), rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("unknown", range(4))
def test_jacobian_by_mounting(published_camera: Camera, geometry: Geometry, unknown: int) -> None:
    def pixels(step: float) -> FloatArray:
        change = step * np.eye(4)[unknown]
        turn, _ = rotation_exp(change[:3])
        centre = geometry.centre + np.array([0.0, 0.0, change[3]])
        changed = replace(geometry, rotation=turn @ geometry.rotation, centre=centre)
        return predict_pixels(published_camera, changed, FRAME, DISC)[0]

    _, jacobians = predict_pixels(published_camera, geometry, FRAME, DISC)
    analytic = jacobians.mounting[:, :, unknown]
    np.testing.assert_allclose(analytic, _differences(pixels), rtol=1e-6, atol=1e-4)


@given(arrays(np.float64, 3, elements=st.floats(-1.5, 1.5)))
def test_rotation_vectors_as_scipy_has_them(vector: FloatArray) -> None:
    rotation, left = rotation_exp(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    for axis in np.eye(3):

        def turned(step: float, axis: FloatArray = axis) -> FloatArray:
            return np.asarray(Rotation.from_rotvec(vector + step * axis).as_matrix())

        spin = _differences(turned) @ rotation.T
        np.testing.assert_allclose(
            [spin[2, 1], spin[0, 2], spin[1, 0]], left @ axis, rtol=1e-6, atol=1e-8
        )


def test_odometry_of_a_chained_path_leaves_nothing() -> None:
    steps = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    residuals = odometry_residuals(chain_steps(steps)[1:], steps)
    np.testing.assert_allclose(residuals, 0.0, atol=1e-12)


def test_rows_as_recorded_go_through_the_lens_and_back(published_camera: Camera) -> None:
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform(-1, 1, 20), rng.uniform(-3.5, -1.2, 20)])
    tilt = 0.02 * rng.standard_normal((20, 2))
    turn, _ = rotation_exp(np.array([-0.04, 0.01, 0.002]))
    centre = published_camera.centre + np.array([0.0, 0.0, -0.02])
    geometry = Geometry(np.zeros((20, 3)), floor, turn @ published_camera.rotation, centre, tilt)
    every = np.arange(20)
    pixels, by = predict_pixels(published_camera, geometry, every, every)
    mounting = np.column_stack([geometry.rotation, centre])
    rows, by_rows = rows_as_recorded(published_camera, floor, mounting, tilt)
    np.testing.assert_allclose(rows, published_camera.floor_from_pixel(pixels), atol=1e-5)
    into = published_camera.floor_jacobian(pixels)
    np.testing.assert_allclose(by_rows.mounting, into @ by.mounting, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(by_rows.tilt, into @ by.tilt, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(by_rows.floor, into @ by.disc, rtol=1e-4, atol=1e-4)
