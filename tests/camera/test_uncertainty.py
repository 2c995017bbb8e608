"""What a calibration's errors do: derivatives against cameras that are wrong, and files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera import Camera, CameraError
from camera.calibration.floor import place_on_floor
from camera.calibration.model import COUNT
from camera.camfile import format_camera, parse_camera
from camera.model import PARAMETERS
from camera.rotations import rotation_of
from camera.uncertainty import (
    covariance_of,
    floor_by_parameters,
    intrinsics_of,
    tilt_by_parameters,
    with_covariance,
    with_intrinsics,
)

#: Steps that move pixels by some tenths: scales, centre, coefficients, position, rotation.
STEPS = np.array([0.2, 0.2, 0.2, 0.2, *[1e-4] * 5, 1e-4, 1e-4, *[1e-4] * 3, *[1e-4] * 6])
FLOOR = np.array([[0.0, -1.2], [0.8, -1.8], [-1.1, -2.5], [0.4, -3.5]])


def moved(camera: Camera, step: np.ndarray) -> Camera:
    """The camera with other parameters."""
    turn = rotation_of(step[COUNT + 3 :])
    pose = np.column_stack([turn @ camera.rotation, camera.centre + step[COUNT : COUNT + 3]])
    a, b, c = ((float(x), float(y), float(z), float(t)) for x, y, z, t in pose)
    camera = with_intrinsics(camera, intrinsics_of(camera) + step[:COUNT])
    return replace(camera, robot_from_camera=(a, b, c))


@pytest.mark.parametrize("parameter", range(PARAMETERS))
def test_floor_positions_follow_the_parameters(published_camera: Camera, parameter: int) -> None:
    step = STEPS * (np.arange(PARAMETERS) == parameter)
    pixels = published_camera.project_floor(FLOOR)
    after, before = (
        moved(published_camera, sign * step).floor_from_pixel(pixels) for sign in (1.0, -1.0)
    )

    jacobian = floor_by_parameters(published_camera, FLOOR)[:, :, parameter]

    found = (after - before) / (2.0 * STEPS[parameter])
    np.testing.assert_allclose(jacobian, found, rtol=2e-3, atol=2e-4 * abs(found).max())


def test_verticals_see_a_turned_camera_lean(published_camera: Camera) -> None:
    jacobian = tilt_by_parameters(published_camera)

    # What the mounting leans by is taken off, a turn about Z and a shift are not seen.
    np.testing.assert_allclose(jacobian[:, COUNT + 3 : COUNT + 5], -np.eye(2), atol=1e-3)
    np.testing.assert_allclose(jacobian[:, COUNT : COUNT + 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(jacobian[:, COUNT + 5], 0.0, atol=1e-3)


def test_poses_of_the_floor_err_as_stated(published_camera: Camera) -> None:
    """Monte Carlo: a lens that is a little wrong, pixels with noise, positions by both."""
    rng = np.random.default_rng(1)
    truth = published_camera
    known = np.zeros((PARAMETERS, PARAMETERS))
    known[range(4), range(4)] = np.array([1.0, 0.5, 1.0, 0.7]) ** 2
    known[0, 1] = known[1, 0] = 0.4
    lens = known[:COUNT, :COUNT]
    places = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-3, -1, 5)), -1).reshape(-1, 2)
    pixels, seen = truth.project_floor(places), truth.project_floor(FLOOR)
    squared = []
    for _ in range(40):
        wrong = with_intrinsics(
            truth, intrinsics_of(truth) + rng.multivariate_normal(np.zeros(COUNT), lens)
        )
        wrong = with_covariance(wrong, known)
        noisy = pixels + 0.1 * rng.standard_normal(pixels.shape)
        camera = place_on_floor(wrong, noisy, places).camera
        covariance = covariance_of(camera)
        assert covariance is not None
        found = camera.floor_from_pixel(seen)
        jacobian = floor_by_parameters(camera, found)
        stated = jacobian @ covariance @ jacobian.swapaxes(1, 2)
        error = found - FLOOR
        squared.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(stated), error) / 2.0)
    # Larger residuals by the wrong lens are taken for noise as well.
    assert 0.6 < np.mean(squared) < 1.2
    # Within the board's places the pose makes up for the lens.
    assert np.sqrt(np.trace(stated[0])) < 2e-3


@given(seed=st.integers(0, 1000))
def test_files_keep_the_covariance(published_camera: Camera, seed: int) -> None:
    root = np.random.default_rng(seed).standard_normal((PARAMETERS, 5)) * STEPS[:, None]
    covariance = root @ root.T
    camera = with_covariance(published_camera, covariance)

    again = parse_camera(format_camera(camera))

    assert again == camera
    found = covariance_of(again)
    assert found is not None
    np.testing.assert_allclose(found, covariance, rtol=1e-6)
    assert camera.content_hash == published_camera.content_hash


def test_covariances_that_are_none_are_refused(published_camera: Camera) -> None:
    with pytest.raises(CameraError, match="covariance has 3 numbers: expected 210"):
        replace(published_camera, covariance=(1.0, 2.0, 3.0))
    with pytest.raises(CameraError, match="negative variance"):
        with_covariance(published_camera, -np.eye(PARAMETERS))
