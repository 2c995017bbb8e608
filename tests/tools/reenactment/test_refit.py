"""A run of known truth comes back, as near as the predicted uncertainty says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera import Camera
from redetect.slam.mapping.graph import Estimate, first_sight
from redetect.slam.mapping.graph_terms import Weighting, cost
from tests.tools.reenactment.synthetic import TrueRun, camera_at, make_run
from tools.reenactment.prepare import nominal, predicted_rows, refit, row_distances

LEAST_SQUARES = Weighting(calibrate=True, row_errors="recorded")
ROBUST = replace(LEAST_SQUARES, loss="geman-mcclure", loss_scale=4.0)


def mounting_error(estimate: Estimate, truth: Estimate) -> NDArray[np.float64]:
    """Rotation vector (robot frame) and height from the true mounting to the fitted one."""
    assert estimate.mounting is not None
    assert truth.mounting is not None
    turn = estimate.mounting[:, :3] @ np.linalg.inv(truth.mounting[:, :3])
    height = estimate.mounting[2, 3] - truth.mounting[2, 3]
    return np.append(Rotation.from_matrix(turn).as_rotvec(), height)


def odometry_start(run: TrueRun) -> Estimate:
    assert run.graph.camera is not None
    start = first_sight(run.graph)
    return nominal(run.graph.camera, start.poses, start.disc_xy)


def test_predicted_rows_are_those_of_a_camera_mounted_and_tilted_so(
    published_camera: Camera,
) -> None:
    run = make_run(published_camera, 3, tilt_deg=1.0, noisy=False)
    graph, truth = run.graph, run.truth
    rows = predicted_rows(graph, truth, graph.disc_pose, graph.disc_index)
    # The printed rotation is one to 6 digits only: its transpose is its inverse to 1e-4 px.
    np.testing.assert_allclose(rows, graph.disc_xy, atol=1e-5)
    x, y, theta = truth.poses[1]
    behind = [x, y] - 60.0 * np.array([np.sin(theta), -np.cos(theta)])
    elsewhere = replace(truth, disc_xy=np.array([behind]))
    assert np.isnan(camera_at(published_camera, truth, 1).project_floor([0.0, 60.0])).all()
    assert np.isnan(predicted_rows(graph, elsewhere, np.array([1]), np.array([0]))).all()


def test_without_noise_the_truth_comes_back_exactly(published_camera: Camera) -> None:
    run = make_run(published_camera, 1, noisy=False)
    fit = refit(run.graph, odometry_start(run), LEAST_SQUARES, tolerance=1e-12)
    np.testing.assert_allclose(mounting_error(fit, run.truth), 0.0, atol=1e-6)
    np.testing.assert_allclose(fit.poses, run.truth.poses, atol=1e-5)
    np.testing.assert_allclose(fit.disc_xy, run.truth.disc_xy, atol=1e-5)


def test_the_cost_is_chi_squared(published_camera: Camera) -> None:
    chi_squared = []
    for seed in range(6):
        run = make_run(published_camera, seed)
        fit = refit(run.graph, odometry_start(run), LEAST_SQUARES)
        freedom = 2 * len(run.graph.disc_index) - 2 * len(run.graph.disc_ids) - 4
        chi_squared.append(cost(run.graph, fit, LEAST_SQUARES) / freedom)
    np.testing.assert_allclose(chi_squared, 1.0, atol=0.15)


def test_without_the_mounting_as_unknown_it_stays(published_camera: Camera) -> None:
    run = make_run(published_camera, 2)
    fixed = refit(run.graph, odometry_start(run), Weighting())
    np.testing.assert_array_equal(fixed.mounting, odometry_start(run).mounting)


def test_tilt_of_each_frame_is_found(published_camera: Camera) -> None:
    run = make_run(published_camera, 3, tilt_deg=1.0)
    start = odometry_start(run)
    fit = refit(run.graph, start, replace(LEAST_SQUARES, tilt_sigma_rad=np.radians(1.0)))
    upright = refit(run.graph, start, LEAST_SQUARES)
    assert fit.tilt is not None
    assert run.truth.tilt is not None
    # The mean tilt can't be told from the mounting.
    found, true = fit.tilt[1:], run.truth.tilt[1:]
    wrong = (found - found.mean(axis=0)) - (true - true.mean(axis=0))
    assert np.all(np.std(wrong, axis=0) < 0.6 * np.std(true, axis=0))
    shares = [np.mean(row_distances(run.graph, at) <= 4.0) for at in (fit, upright)]
    assert shares[0] > 0.999 > shares[1]


def test_rows_with_wrong_ids_pull_least_squares_but_not_the_robust_fit(
    published_camera: Camera,
) -> None:
    run = make_run(published_camera, 4)
    wrong = np.random.default_rng(5).random(len(run.graph.disc_index)) < 0.03
    disc = run.graph.disc_index.copy()
    disc[wrong] = (disc[wrong] + 1) % len(run.graph.disc_ids)
    mistaken = replace(run.graph, disc_index=disc)
    start = refit(run.graph, odometry_start(run), LEAST_SQUARES)
    robust, pulled = (refit(mistaken, start, weighting) for weighting in (ROBUST, LEAST_SQUARES))
    assert np.mean(row_distances(run.graph, robust) <= 4.0) > 0.997
    assert np.mean(row_distances(run.graph, pulled) <= 4.0) < 0.97
    assert np.abs(mounting_error(robust, run.truth)).max() < 0.01


def test_a_disc_out_of_sight_is_survived(published_camera: Camera) -> None:
    run = make_run(published_camera, 6)
    lost = odometry_start(run)
    lost.disc_xy[0] += 100.0
    fit = refit(run.graph, lost, ROBUST)
    distance = row_distances(run.graph, fit)[run.graph.disc_index != 0]
    assert np.mean(distance <= 4.0) > 0.999
