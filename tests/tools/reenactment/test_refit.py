"""A run of known truth comes back, as near as the predicted uncertainty says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from tests.tools.reenactment.synthetic import MOUNTING_HEIGHT, MOUNTING_VECTOR, make_run
from tools.reenactment.fitting import RefitError, Weighting, nominal_geometry, refit, row_distances
from tools.reenactment.mounted_discs import Geometry
from tools.reenactment.recording import Recording, recording_of_frames, start_from_odometry


def mounting_error(geometry: Geometry, truth: Geometry) -> NDArray[np.float64]:
    """Rotation vector (robot frame) and height from the true mounting to the fitted one."""
    turn = Rotation.from_matrix(geometry.rotation @ np.linalg.inv(truth.rotation)).as_rotvec()
    return np.append(turn, geometry.centre[2] - truth.centre[2])


def odometry_start(camera: Camera, recording: Recording) -> Geometry:
    return nominal_geometry(camera, *start_from_odometry(recording))


@pytest.mark.parametrize("metric", ["floor", "pixel"])
def test_without_noise_the_truth_comes_back_exactly(published_camera: Camera, metric: str) -> None:
    run = make_run(published_camera, 1, noisy=False)
    recording = recording_of_frames(published_camera, run.frames)
    weighting = Weighting(metric="floor" if metric == "floor" else "pixel")
    start = odometry_start(published_camera, recording)
    fit = refit(published_camera, recording, start, weighting, tolerance=1e-12)
    np.testing.assert_allclose(mounting_error(fit.geometry, run.geometry), 0.0, atol=1e-6)
    np.testing.assert_allclose(fit.geometry.poses, run.geometry.poses, atol=1e-5)
    np.testing.assert_allclose(fit.geometry.disc_xy, run.geometry.disc_xy, atol=1e-5)
    assert fit.cost < 1e-6


def test_the_cost_is_chi_squared(published_camera: Camera) -> None:
    chi_squared = []
    for seed in range(6):
        run = make_run(published_camera, seed)
        recording = recording_of_frames(published_camera, run.frames)
        fit = refit(
            published_camera, recording, odometry_start(published_camera, recording), Weighting()
        )
        freedom = 2 * len(recording.disc) - 2 * len(recording.disc_ids) - 4
        chi_squared.append(fit.cost / freedom)
    np.testing.assert_allclose(chi_squared, 1.0, atol=0.15)


def test_without_the_mounting_as_unknown_it_stays_and_the_fit_is_bad(
    published_camera: Camera,
) -> None:
    run = make_run(published_camera, 2)
    recording = recording_of_frames(published_camera, run.frames)
    start = odometry_start(published_camera, recording)
    fixed = refit(published_camera, recording, start, Weighting(mounting=False))
    free = refit(published_camera, recording, start, Weighting())
    np.testing.assert_array_equal(fixed.geometry.rotation, published_camera.rotation)
    assert fixed.cost > 1.3 * free.cost


def test_tilt_of_each_frame_is_found(published_camera: Camera) -> None:
    run = make_run(published_camera, 3, tilt_deg=1.0)
    recording = recording_of_frames(published_camera, run.frames)
    weighting = Weighting(tilt_sigma=np.radians(1.0))
    start = odometry_start(published_camera, recording)
    fit = refit(published_camera, recording, start, weighting)
    upright = refit(published_camera, recording, start, Weighting())
    # The mean tilt can't be told from the mounting.
    wrong = (fit.geometry.tilt - fit.geometry.tilt.mean(0)) - (
        run.geometry.tilt - run.geometry.tilt.mean(0)
    )
    assert np.all(np.std(wrong, axis=0) < 0.6 * np.std(run.geometry.tilt, axis=0))
    distance = row_distances(published_camera, recording, fit.geometry)
    upright_distance = row_distances(published_camera, recording, upright.geometry)
    assert np.mean(distance <= 4.0) > 0.999 > np.mean(upright_distance <= 4.0)


def test_rows_with_wrong_ids_pull_least_squares_but_not_the_robust_fit(
    published_camera: Camera,
) -> None:
    run = make_run(published_camera, 4)
    recording = recording_of_frames(published_camera, run.frames)
    rng = np.random.default_rng(5)
    wrong = rng.random(len(recording.disc)) < 0.03
    disc = recording.disc.copy()
    disc[wrong] = (disc[wrong] + 1) % len(recording.disc_ids)
    mistaken = replace(recording, disc=disc)
    start = refit(
        published_camera, recording, odometry_start(published_camera, recording), Weighting()
    ).geometry
    robust = refit(published_camera, mistaken, start, Weighting(robust_scale=4.0)).geometry
    pulled = refit(published_camera, mistaken, start, Weighting()).geometry
    share_robust, share_pulled = (
        np.mean(row_distances(published_camera, recording, geometry) <= 4.0)
        for geometry in (robust, pulled)
    )
    assert share_robust > 0.997
    assert share_pulled < 0.97
    assert np.abs(mounting_error(robust, run.geometry)).max() < 0.01


def test_discs_out_of_sight_are_refused_by_least_squares_and_survived_by_the_robust_fit(
    published_camera: Camera,
) -> None:
    run = make_run(published_camera, 6)
    recording = recording_of_frames(published_camera, run.frames)
    start = odometry_start(published_camera, recording)
    lost = replace(start, disc_xy=start.disc_xy.copy())
    lost.disc_xy[0] += 100.0
    with pytest.raises(RefitError, match="can't see"):
        refit(published_camera, recording, lost, Weighting())
    fit = refit(published_camera, recording, lost, Weighting(robust_scale=4.0))
    others = recording.disc != 0
    distance = row_distances(published_camera, recording, fit.geometry)
    assert np.mean(distance[others] <= 4.0) > 0.999


def test_running_out_of_steps_is_an_error(published_camera: Camera) -> None:
    run = make_run(published_camera, 7)
    recording = recording_of_frames(published_camera, run.frames)
    start = odometry_start(published_camera, recording)
    with pytest.raises(RefitError, match="within 1 steps"):
        refit(published_camera, recording, start, Weighting(), max_steps=1)


def test_the_synthetic_camera_is_really_mounted_otherwise(published_camera: Camera) -> None:
    truth = make_run(published_camera, 0).geometry
    nominal = nominal_geometry(published_camera, truth.poses, truth.disc_xy)
    expected = np.append(MOUNTING_VECTOR, MOUNTING_HEIGHT)
    np.testing.assert_allclose(mounting_error(truth, nominal), expected, atol=1e-5)
