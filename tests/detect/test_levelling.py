"""Discs seen by a tilted robot come back to where they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from camera import Camera, parse_camera
from detect.circles import CircleDetections
from detect.levelling import level_covariances, level_positions, levelled, with_prior
from landmarks import FrameTilt
from tests.conftest import PUBLISHED_CAM

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
    levelled = level_positions(CAMERA, seen, pitch, roll)
    # The projection uses the exact inverse of a rotation printed in 6 digits.
    np.testing.assert_allclose(levelled, TRUE_XY, atol=1e-5)


def test_no_tilt_changes_nothing() -> None:
    np.testing.assert_allclose(level_positions(CAMERA, TRUE_XY, 0.0, 0.0), TRUE_XY, atol=1e-12)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.02, -0.01)])
def test_covariances_are_those_of_a_monte_carlo(pitch: float, roll: float) -> None:
    rng = np.random.default_rng(5)
    seen = seen_by_tilted_robot(CAMERA, pitch, roll)
    own = np.array([[4e-6, 1e-6], [1e-6, 9e-6]])
    tilt = np.array([[2e-6, 5e-7], [5e-7, 1e-6]])
    predicted = level_covariances(
        CAMERA, seen, np.repeat(own[None], len(seen), axis=0), pitch, roll, tilt
    )
    draws = 4000
    tilts = rng.multivariate_normal([pitch, roll], tilt, size=draws)
    noise = rng.multivariate_normal([0.0, 0.0], own, size=(draws, len(seen)))
    levelled = np.array(
        [level_positions(CAMERA, seen + e, p, r) for e, (p, r) in zip(noise, tilts)]
    )
    for k in range(len(seen)):
        drawn = np.cov(levelled[:, k].T)
        scale = np.sqrt(np.outer(np.diag(predicted[k]), np.diag(predicted[k])))
        np.testing.assert_allclose(drawn / scale, predicted[k] / scale, atol=0.1)


def test_rays_that_rise_after_levelling_have_no_position() -> None:
    far = np.array([[0.0, -60.0]])
    assert np.all(np.isnan(level_positions(CAMERA, far, -0.2, 0.0))) or np.all(
        np.isnan(level_positions(CAMERA, far, 0.2, 0.0))
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
    of_tilt = np.array([[2e-6, 5e-7], [5e-7, 1e-6]])
    level_xy = level_positions(CAMERA, floor_xy, pitch, 0.01)
    level_cov = level_covariances(CAMERA, floor_xy, covariance, pitch, 0.01, of_tilt)
    down = np.isfinite(np.column_stack([level_xy, level_cov.reshape(9, 4)])).all(axis=1)
    assert down.all() == (pitch != -0.2 or farthest_m == 5.0)
    np.testing.assert_array_equal(after.floor_xy, level_xy[down])
    np.testing.assert_array_equal(after.covariance, level_cov[down])
    for name in ("pixels", "quality", "evidence"):
        np.testing.assert_array_equal(getattr(after, name), getattr(found, name)[down])


def tilt_of(mean: np.ndarray, covariance: np.ndarray) -> FrameTilt:
    pitch, roll = map(float, mean)
    cpp, cpr, _, crr = map(float, covariance.ravel())
    return FrameTilt("e.0000", pitch, roll, cpp, cpr, crr, 7)


@given(
    pitch=st.floats(-0.003, 0.003),
    sigmas=st.tuples(st.floats(1e-5, 0.05), st.floats(1e-5, 0.05)),
    correlation=st.floats(-0.99, 0.99),
    prior=st.floats(1e-3, 0.1),
)
def test_prior_and_measurement_add_their_information(
    pitch: float, sigmas: tuple[float, float], correlation: float, prior: float
) -> None:
    off = correlation * sigmas[0] * sigmas[1]
    measured = np.array([[sigmas[0] ** 2, off], [off, sigmas[1] ** 2]])
    mean = np.array([pitch, -0.5 * pitch])
    together = np.linalg.inv(np.linalg.inv(measured) + np.eye(2) / prior**2)
    expected = together @ np.linalg.solve(measured, mean)
    found = with_prior(tilt_of(mean, measured), prior)
    covariance = np.array([[found.cpp, found.cpr], [found.cpr, found.crr]])
    np.testing.assert_allclose(covariance, together, rtol=1e-6, atol=1e-6 * together.max())
    contradiction = mean @ np.linalg.solve(measured + prior**2 * np.eye(2), mean) > 13.8
    assert not contradiction
    np.testing.assert_allclose([found.pitch, found.roll], expected, rtol=1e-6, atol=1e-9)
    assert (found.prefix, found.lines) == ("e.0000", 7)


def test_tilts_with_a_prior_are_nearer_to_the_truth_and_as_certain_as_they_say() -> None:
    rng = np.random.default_rng(11)
    sigma, covariance = 0.006, np.array([[1e-4, 3e-5], [3e-5, 2e-5]])
    true = rng.normal(0.0, sigma, (4000, 2))
    measured = true + rng.multivariate_normal([0.0, 0.0], covariance, len(true))
    fused = [with_prior(tilt_of(mean, covariance), sigma) for mean in measured]
    error = np.array([[tilt.pitch, tilt.roll] for tilt in fused]) - true
    said = np.array([[[t.cpp, t.cpr], [t.cpr, t.crr]] for t in fused])
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(said), error)
    assert squares.mean() / 2.0 == pytest.approx(1.0, abs=0.05)
    assert np.all(error.var(axis=0) < 0.8 * (measured - true).var(axis=0))


def test_a_tilt_that_contradicts_what_was_known_is_believed() -> None:
    covariance = np.diag([1e-6, 4e-6])
    leaning = tilt_of(np.array([0.04, 0.0]), covariance)
    assert with_prior(leaning, 0.005) == leaning
    assert with_prior(leaning, 0.02) != leaning
    assert with_prior(leaning, 0.0) == leaning
