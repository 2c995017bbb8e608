"""Poses from corners: exact recovery, Jacobians, and covariances that are true."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.errors import GeometryError
from redetect.groundtruth.markers import refinement
from redetect.groundtruth.markers.adjustment import (
    Chain,
    project_chain,
    project_chain_with_jacobians,
)
from redetect.groundtruth.markers.pairs import MarkerPose, pair_estimates
from redetect.groundtruth.markers.poses import solve_camera, solve_robot
from redetect.groundtruth.markers.refinement import (
    predicted_errors,
    refine_pose,
)
from redetect.groundtruth.settings import Solver
from redetect.groundtruth.trajectories import se3
from tests.groundtruth.markers.scene import (
    box_rig,
    hall_cameras,
    lens,
    network_of,
    pose_problem,
    robot_pose,
)

FloatArray = NDArray[np.float64]


def planar(pose: FloatArray) -> FloatArray:
    return np.array([pose[0, 3], pose[1, 3], se3.heading(pose)])


# -- Jacobians ------------------------------------------------------------------------------


def test_the_chains_jacobians_are_its_derivatives() -> None:
    generator = np.random.default_rng(2)
    problem = pose_problem(robot_pose(generator), cameras=3)
    seen = problem.seen
    poses = {
        "camera": problem.network.world_from_camera,
        "body": robot_pose(generator)[None],
        "part": problem.rig.robot_from_marker,
    }

    def chain(by: dict[str, FloatArray]) -> Chain:
        return Chain(problem.network.cameras, by["camera"], by["body"], by["part"])

    def project(by: dict[str, FloatArray]) -> FloatArray:
        return project_chain(chain(by), seen)

    projection = project_chain_with_jacobians(chain(poses), seen)
    np.testing.assert_allclose(projection.pixels, project(poses), atol=1e-9)
    step = 1e-6
    for name in poses:
        analytic = getattr(projection, f"by_{name}")
        for k in range(6):
            moved = []
            for sign in (1.0, -1.0):
                changed = dict(poses)
                changed[name] = poses[name] @ se3.exp(sign * step * np.eye(6)[k])
                moved.append(project(changed))
            numeric = (moved[0] - moved[1]) / (2.0 * step)
            np.testing.assert_allclose(analytic[..., k], numeric, rtol=1e-5, atol=2e-3)


def test_the_planes_jacobians_are_derivatives() -> None:
    generator = np.random.default_rng(3)
    step = 1e-6
    for _ in range(20):
        pose = se3.exp(generator.normal(0.0, 0.4, 6))
        to_plane = se3.planar_jacobian(pose)
        for k in range(6):
            ahead = pose @ se3.exp(step * np.eye(6)[k])
            behind = pose @ se3.exp(-step * np.eye(6)[k])
            numeric = (planar(ahead) - planar(behind)) / (2 * step)
            np.testing.assert_allclose(numeric, to_plane[:, k], atol=1e-8)


def test_covariances_of_relative_poses() -> None:
    generator = np.random.default_rng(4)
    a, b = se3.exp(generator.normal(size=(2, 6)))
    root_a, root_b = generator.normal(0, 1e-3, (2, 6, 6))
    draws = 40000
    moved_a = a @ se3.exp(generator.normal(size=(draws, 6)) @ root_a.T)
    moved_b = b @ se3.exp(generator.normal(size=(draws, 6)) @ root_b.T)
    sample = se3.log(se3.inverse(b) @ a @ se3.inverse(moved_a) @ moved_b)
    own, other = (
        MarkerPose(pose[None], (root @ root.T)[None], np.zeros(1))
        for pose, root in ((a, root_a), (b, root_b))
    )
    (expected,) = pair_estimates(own, other).covariances
    scale = np.sqrt(np.diagonal(expected))
    empirical = np.cov(sample.T) / np.outer(scale, scale)
    np.testing.assert_allclose(empirical, expected / np.outer(scale, scale), atol=0.03)


# -- exact recovery -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, marks=pytest.mark.lowest) if s == "pycolmap" else s for s in get_args(Solver)],
)
@pytest.mark.parametrize("cameras", [1, 2, 4])
@pytest.mark.parametrize("markers", [1, 3, 6])
def test_every_solver_recovers_the_pose_exactly(solver: Solver, cameras: int, markers: int) -> None:
    if solver == "epnp" and markers < 6:
        pytest.skip("EPnP may take the mirror image of points in one plane")
    generator = np.random.default_rng(5)
    tried = 0
    while tried < 2:
        truth = robot_pose(generator)
        problem = pose_problem(truth, cameras=cameras, markers=markers)
        if not problem.views or (solver == "epnp" and max(np.bincount(problem.seen.camera)) < 8):
            continue
        tried += 1
        results = [refine_pose(problem, pose) for pose in solve_robot(problem, solver)]
        best = min(results, key=lambda result: result.cost)
        np.testing.assert_allclose(best.world_from_robot, truth, atol=1e-8)
        assert best.cost < 1e-12


def test_both_solutions_of_a_single_marker_are_given_the_better_first() -> None:
    corners = box_rig(1).corners[0]
    pose = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.exp(np.array([0, 0, 0, 0.4, 0.2, 0.1]))
    pose[:3, 3] = [0.2, -0.1, 4.0]
    camera = lens()
    pixels = camera.project(corners @ pose[:3, :3].T + pose[:3, 3])
    first, second = solve_camera(camera, corners, pixels, "ippe")
    np.testing.assert_allclose(first, pose, atol=1e-6)
    # The other one is turned about the line of sight's perpendicular, at almost the same place.
    assert np.linalg.norm(second[:3, 3] - pose[:3, 3]) < 0.05
    assert np.degrees(np.arccos((np.trace(second[:3, :3].T @ pose[:3, :3]) - 1) / 2)) > 20


def test_what_is_no_pose_is_refused() -> None:
    camera = lens()
    square = box_rig(1).corners[0]
    with pytest.raises(GeometryError, match="expected at least 4"):
        solve_camera(camera, square[:3], np.zeros((3, 2)))
    folding = lens(1500.0, (0.0, -0.5, 0.0, 0.0, 0.0))
    with pytest.raises(GeometryError, match="lens sees nothing"):
        solve_camera(folding, square, np.full((4, 2), 1e5))
    problem = pose_problem(robot_pose(np.random.default_rng(6)), cameras=2)
    behind = problem.network.world_from_camera[0] @ se3.exp(np.array([0, 0, -3.0, 0, 0, 0]))
    with pytest.raises(GeometryError, match="behind its camera"):
        refine_pose(problem, behind)


# -- covariances ----------------------------------------------------------------------------


def normalised_errors(
    draws: int, *, seed: int, calibration_sigma: float, cameras: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normalised errors squared of the poses (6 dof) and of x, y, theta (3 dof); costs / dof."""
    generator = np.random.default_rng(seed)
    rig = box_rig()
    sigmas = calibration_sigma * np.array([1, 1, 1, 0.7, 0.7, 0.7])
    camera_covariance = np.asarray(np.kron(np.eye(cameras), np.diag(sigmas**2)), np.float64)
    # Markers whose errors go together, as a bundle adjustment leaves them.
    mix = np.kron(np.eye(6) * 0.8 + 0.3, np.eye(6))
    marker_factor = mix * np.tile(sigmas, 6)[:, None]
    marker_covariance = marker_factor @ marker_factor.T
    squares, plane, costs = [], [], []
    for _ in range(draws):
        truth = robot_pose(generator)
        true = pose_problem(truth, cameras=cameras, noise=generator, sigma_px=0.15)
        moved_rig = rig.robot_from_marker @ se3.exp(
            (marker_factor @ generator.normal(size=36)).reshape(6, 6)
        )
        moved_cameras = true.network.world_from_camera @ se3.exp(
            generator.normal(size=(cameras, 6)) * sigmas
        )
        believed = replace(
            true,
            network=network_of(moved_cameras, camera_covariance),
            rig=replace(rig, robot_from_marker=moved_rig, covariance=marker_covariance),
        )
        result = refine_pose(believed, truth)
        error = se3.log(se3.inverse(truth) @ result.world_from_robot)
        squares.append(error @ np.linalg.solve(result.covariance, error))
        difference = planar(result.world_from_robot) - planar(truth)
        difference[2] = (difference[2] + np.pi) % (2 * np.pi) - np.pi
        covariance = se3.planar_covariance(result.world_from_robot, result.covariance)
        plane.append(difference @ np.linalg.solve(covariance, difference))
        costs.append(result.cost / result.degrees_of_freedom)
    return np.array(squares), np.array(plane), np.array(costs)


@pytest.mark.long
@pytest.mark.parametrize(
    ("calibration_sigma", "cameras"),
    [(0.0, 4), (0.0, 1), (2e-3, 2), (5e-3, 4), (3e-3, 2)],
)
def test_the_normalised_error_is_that_of_its_distribution(
    calibration_sigma: float, cameras: int
) -> None:
    draws = 50
    squares, plane, costs = normalised_errors(
        draws, seed=7, calibration_sigma=calibration_sigma, cameras=cameras
    )
    for values, dof in ((squares, 6), (plane, 3)):
        low, high = chi2.ppf([0.005, 0.995], dof * draws) / draws
        assert low < np.mean(values) < high
    assert np.mean(costs) == pytest.approx(1.0, abs=0.15)


def test_without_the_calibrations_uncertainty_the_error_is_underestimated() -> None:
    """What the systematic part is there for: the image's noise alone explains a fraction."""
    generator = np.random.default_rng(8)
    squares = []
    for _ in range(50):
        truth = robot_pose(generator)
        true = pose_problem(truth, cameras=2, noise=generator)
        moved = true.rig.robot_from_marker @ se3.exp(generator.normal(0, 5e-3, (6, 6)))
        believed = replace(true, rig=replace(true.rig, robot_from_marker=moved))
        result = refine_pose(believed, truth)
        error = se3.log(se3.inverse(truth) @ result.world_from_robot)
        squares.append(error @ np.linalg.solve(result.covariance, error))
    assert np.mean(squares) > 5 * 6


def test_a_view_that_was_not_used_is_predicted_within_its_covariance() -> None:
    generator = np.random.default_rng(9)
    errors: list[float] = []
    for _ in range(60):
        truth = robot_pose(generator)
        problem = pose_problem(truth, cameras=4, noise=generator)
        first = np.arange(problem.views) < 2
        result = refine_pose(problem.only(first), truth)
        predicted = predicted_errors(problem, result.world_from_robot, result.covariance)
        errors.extend(predicted[~first])
    mean = np.mean(np.square(errors))
    assert mean == pytest.approx(1.0, abs=0.15)


def test_a_bad_view_has_little_say(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(10)
    truth = robot_pose(generator)
    problem = pose_problem(truth, cameras=4, noise=generator)
    seen = problem.seen
    shifted = seen.pixels + 3.0 * (problem.view == 0)[:, None]
    spoilt = replace(problem, seen=replace(seen, pixels=shifted))

    def error() -> float:
        result = refine_pose(spoilt, truth)
        return float(np.linalg.norm(se3.log(se3.inverse(truth) @ result.world_from_robot)))

    robust = error()
    monkeypatch.setattr(refinement, "_HUBER", np.inf)
    assert robust < 0.5 * error()


def test_cameras_are_where_the_scene_says() -> None:
    for pose in hall_cameras(4):
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
        assert pose[2, 2] < 0.0  # they look down
