"""Discs seen by a tilted robot come back to where they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from camera import Camera, parse_camera
from detect.circles import CircleDetections
from detect.levelling import level_discs, levelled, tilt_arrays
from detect.projection import level_positions
from redetect.landmarks import FrameTilt
from tools.published_camera import PUBLISHED_CAM

CAMERA = parse_camera(PUBLISHED_CAM)
TRUE_XY = np.array([[0.0, -1.0], [1.1, -2.0], [-1.4, -3.2], [0.3, -4.5]])


def seen_by_tilted_robot(camera: Camera, pitch: float, roll: float) -> np.ndarray:
    """Floor positions that the level calibration gives of discs that a tilted robot sees."""
    level_from_tilted = Rotation.from_rotvec([pitch, roll, 0.0])
    points = np.column_stack([TRUE_XY, np.zeros(len(TRUE_XY))])
    return camera.floor_from_pixel(camera.project_robot(level_from_tilted.inv().apply(points)))


@given(pitch=st.floats(-0.05, 0.05), roll=st.floats(-0.05, 0.05))
def test_tilted_views_come_back_level(pitch: float, roll: float) -> None:
    seen = seen_by_tilted_robot(CAMERA, pitch, roll)
    levelled = level_positions(CAMERA, seen, (pitch, roll))
    # The projection uses the exact inverse of a rotation printed in 6 digits.
    np.testing.assert_allclose(levelled, TRUE_XY, atol=1e-5)


def test_no_tilt_changes_nothing() -> None:
    np.testing.assert_allclose(level_positions(CAMERA, TRUE_XY, (0.0, 0.0)), TRUE_XY, atol=1e-12)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.02, -0.01)])
def test_covariances_are_those_of_a_monte_carlo(pitch: float, roll: float) -> None:
    rng = np.random.default_rng(5)
    seen = seen_by_tilted_robot(CAMERA, pitch, roll)
    own = np.array([[4e-6, 1e-6], [1e-6, 9e-6]])
    tilt = np.array([[2e-6, 5e-7], [5e-7, 1e-6]])
    covariance = np.repeat(own[None], len(seen), axis=0)
    _, predicted, _ = level_discs(CAMERA, seen, covariance, np.array([pitch, roll]), tilt)
    draws = 4000
    tilts = rng.multivariate_normal([pitch, roll], tilt, size=draws)
    noise = rng.multivariate_normal([0.0, 0.0], own, size=(draws, len(seen)))
    levelled = np.array([level_positions(CAMERA, seen + e, tilt) for e, tilt in zip(noise, tilts)])
    for k in range(len(seen)):
        drawn = np.cov(levelled[:, k].T)
        scale = np.sqrt(np.outer(np.diag(predicted[k]), np.diag(predicted[k])))
        np.testing.assert_allclose(drawn / scale, predicted[k] / scale, atol=0.1)


def test_rays_that_rise_after_levelling_have_no_position() -> None:
    far = np.array([[0.0, -60.0]])
    assert np.all(np.isnan(level_positions(CAMERA, far, (-0.2, 0.0)))) or np.all(
        np.isnan(level_positions(CAMERA, far, (0.2, 0.0)))
    )


@pytest.mark.parametrize("pitch", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("farthest_m", [5.0, 60.0])
def test_discs_are_levelled_as_positions_and_covariances_are(
    pitch: float, farthest_m: float
) -> None:
    rng = np.random.default_rng(7)
    floor_xy = np.column_stack([rng.normal(size=9), np.linspace(-1.0, -farthest_m, 9)])
    half = rng.normal(0.0, 0.01, (9, 2, 2))
    covariance = half @ half.transpose(0, 2, 1)
    found = CircleDetections(
        rng.integers(0, 288, (9, 2)), floor_xy, covariance, rng.random(9), rng.normal(size=9)
    )
    tilt = FrameTilt("e.0000", pitch, 0.01, 2e-6, 5e-7, 1e-6, 9)
    after = levelled(found, CAMERA, tilt)
    level_xy = level_positions(CAMERA, floor_xy, (pitch, 0.01))
    _, level_cov, down = level_discs(CAMERA, floor_xy, covariance, *tilt_arrays([tilt]))
    np.testing.assert_array_equal(down, np.isfinite(level_xy).all(axis=1))
    assert down.all() == (pitch != -0.2 or farthest_m == 5.0)
    np.testing.assert_allclose(after.floor_xy, level_xy[down], rtol=1e-12)
    np.testing.assert_array_equal(after.covariance, level_cov[down])
    for name in ("pixels", "quality", "evidence"):
        np.testing.assert_array_equal(getattr(after, name), getattr(found, name)[down])
