"""Errors of the least-squares problem, their Jacobians, losses and covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from camera import Camera
from camera.rotations import left_jacobian, rotation_of
from redetect.array_types import FloatArray
from redetect.least_squares.covariance import inverse_blocks
from redetect.slam.mapping.graph import Estimate, Graph, first_sight, graph_of_recording, with_lines
from redetect.slam.mapping.graph_terms import Weighting, errors, linearise
from redetect.slam.mapping.solve import marginals, moved, solve
from redetect.slam.models import bearing_of_vertical
from redetect.slam.mounting import mounting_change
from redetect.slam.recording import LineRows
from redetect.slam.settings import RowErrors
from tests.slam.small_run import CAMERA_XY, small_run


def _problem(camera: Camera | None = None) -> tuple[Graph, Estimate]:
    """A problem with discs and lines, some rows of two lines, and an estimate off its minimum."""
    run = small_run(3)
    lines = run.recording.lines
    # Every third row stands for its line and the next one, and measures the mean of both.
    ids = tuple(
        (i, i % len(run.line_xy) + 1) if k % 3 == 0 else (i,) for k, (i,) in enumerate(lines.ids)
    )
    bearing = [
        np.mean(bearing_of_vertical(run.poses[k + 1], run.line_xy[np.array(i) - 1], CAMERA_XY))
        for k, i in zip(lines.frame, ids)
    ]
    rows = LineRows(lines.frame, np.array(bearing), lines.sigma_rad, ids)
    graph = replace(graph_of_recording(run.recording, camera), camera_xy=CAMERA_XY)
    graph = with_lines(graph, rows, np.arange(1, len(run.line_xy) + 1))
    rng = np.random.default_rng(4)
    return graph, Estimate(
        poses=run.poses + np.vstack([np.zeros(3), 0.01 * rng.standard_normal((60, 3))]),
        disc_xy=run.disc_xy + 0.01 * rng.standard_normal(run.disc_xy.shape),
        line_xy=run.line_xy + 0.01 * rng.standard_normal(run.line_xy.shape),
    )


@pytest.mark.parametrize(
    ("calibrate", "row_errors"),
    [(False, "corrected"), (True, "corrected"), (True, "recorded")],
)
def test_jacobians_are_those_of_finite_differences(
    published_camera: Camera, calibrate: bool, row_errors: RowErrors
) -> None:
    weighting = Weighting(calibrate=calibrate, row_errors=row_errors)
    graph, estimate = _problem(published_camera)
    rng = np.random.default_rng(8)
    if calibrate:
        turn = rotation_of(np.array([-0.02, 0.01, 0.03]))
        mounting = np.column_stack([turn @ published_camera.rotation, published_camera.centre])
        estimate = replace(estimate, mounting=mounting)
    problem = linearise(graph, estimate, weighting)
    for _ in range(4):
        step = rng.standard_normal(graph.unknowns)
        change = np.zeros(6)
        change[weighting.unknown_mounting] = rng.standard_normal(len(weighting.unknown_mounting))
        h = 1e-6
        ahead = moved(graph, estimate, h * step, h * change)
        behind = moved(graph, estimate, -h * step, -h * change)
        numeric = [
            np.concatenate([x.ravel() for x in (e.odometry, e.discs, e.lines, e.place)])
            for e in (errors(graph, ahead, weighting), errors(graph, behind, weighting))
        ]
        analytic = problem.jacobian @ step + problem.border @ change[weighting.unknown_mounting]
        np.testing.assert_allclose(
            (numeric[0] - numeric[1]) / (2 * h), analytic, rtol=2e-5, atol=1e-4
        )


def test_a_row_of_two_lines_measures_the_mean_of_their_bearings() -> None:
    graph, estimate = _problem()
    pairs = np.flatnonzero(np.bincount(graph.member_row) == 2)
    assert len(pairs) > 10
    row = pairs[0]
    pose = estimate.poses[graph.line_pose[row]]
    lines = estimate.line_xy[graph.member_line[graph.member_row == row]]
    mean = np.mean(bearing_of_vertical(pose, lines, graph.camera_xy))
    expected = (mean - graph.bearing_rad[row]) / graph.bearing_sigma_rad[row]
    assert errors(graph, estimate, Weighting()).lines[row] == pytest.approx(expected)


def test_inverse_blocks_are_those_of_the_dense_inverse() -> None:
    graph, estimate = _problem()
    problem = linearise(graph, estimate, Weighting())
    matrix = (problem.jacobian.T @ problem.jacobian).tocsc()
    first = np.arange(0, 180, 3)
    (found,) = inverse_blocks(matrix, [(3, first)])
    dense = np.linalg.inv(matrix.toarray())
    for block, at in zip(found, first):
        np.testing.assert_allclose(block, dense[at : at + 3, at : at + 3], rtol=1e-8)


def test_marginals_with_mounting_are_those_of_the_dense_inverse(published_camera: Camera) -> None:
    weighting = Weighting(calibrate=True)
    graph, estimate = _problem(published_camera)
    estimate = solve(graph, estimate, weighting).at
    found = marginals(graph, estimate, weighting)
    problem = linearise(graph, estimate, weighting)
    jacobian = np.hstack([problem.jacobian.toarray(), problem.border])
    dense = np.linalg.inv(jacobian.T @ jacobian)
    assert found.mounting is not None
    np.testing.assert_allclose(found.mounting, dense[-6:, -6:], rtol=1e-7)
    np.testing.assert_allclose(found.poses[60], dense[177:180, 177:180], rtol=1e-7)
    at = graph.first_line
    np.testing.assert_allclose(found.lines[0], dense[at : at + 2, at : at + 2], rtol=1e-7)
    np.testing.assert_array_equal(found.poses[0], 0.0)


def test_mounting_change_is_what_was_applied(published_camera: Camera) -> None:
    vector = np.array([-0.04, 0.01, 0.002])
    turn = rotation_of(vector)
    moved = np.array([0.02, 0.08, -0.045])
    centre = published_camera.centre + moved
    mounting = np.column_stack([turn @ published_camera.rotation, centre])
    found = mounting_change(published_camera, mounting)
    # The file's rotation has six digits.
    np.testing.assert_allclose(found, [*vector, *moved], atol=1e-5)


def test_first_sight_places_each_disc_where_its_first_row_does() -> None:
    run = small_run(5, noise=0.0)
    start = first_sight(graph_of_recording(run.recording))
    seen = np.unique(run.recording.circles.ids)
    np.testing.assert_allclose(start.disc_xy, run.disc_xy[seen - 1], atol=1e-9)
    np.testing.assert_allclose(start.poses, run.poses, atol=1e-9)


@given(arrays(np.float64, 3, elements=st.floats(-1.5, 1.5)))
def test_rotation_vectors_as_scipy_has_them(vector: FloatArray) -> None:
    rotation, left = rotation_of(vector), left_jacobian(vector)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    for axis in 1e-6 * np.eye(3):
        ahead, behind = (Rotation.from_rotvec(vector + s * axis).as_matrix() for s in (1, -1))
        spin = (ahead - behind) / 2e-6 @ rotation.T
        np.testing.assert_allclose(
            [spin[2, 1], spin[0, 2], spin[1, 0]], left @ axis / 1e-6, rtol=1e-6, atol=1e-8
        )
