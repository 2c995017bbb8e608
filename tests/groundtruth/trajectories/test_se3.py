"""Laws of SE(3), and Jacobians held against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from camera.rotations import cross_matrices
from redetect.groundtruth.trajectories import se3
from tools.simulator.driving import planar_transform

FloatArray = NDArray[np.float64]


def tangents(largest_angle: float = 3.1) -> st.SearchStrategy[FloatArray]:
    """Tangents whose rotation is within the ball where the logarithm is unique."""
    number = st.floats(-1.0, 1.0, allow_subnormal=False)
    magnitude = st.sampled_from([0.0, 1e-12, 1e-6, 5e-3, 9.99e-3, 0.0101, 0.0999, 0.101, 0.5, 1.0])

    def scaled(parts: tuple[list[float], float]) -> FloatArray:
        xi = np.array(parts[0])
        length = np.linalg.norm(xi[3:])
        if length > 1e-3:
            xi[3:] *= parts[1] * largest_angle / length
        else:
            xi[3:] = 0.0
        xi[:3] *= 5.0
        return xi

    return st.tuples(st.lists(number, min_size=6, max_size=6), magnitude).map(scaled)


@given(tangents())
def test_the_logarithm_undoes_the_exponential(xi: FloatArray) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@given(tangents(), tangents(), tangents())
def test_transforms_are_a_group(a: FloatArray, b: FloatArray, c: FloatArray) -> None:
    ta, tb, tc = se3.exp(a), se3.exp(b), se3.exp(c)
    np.testing.assert_allclose((ta @ tb) @ tc, ta @ (tb @ tc), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(ta) @ ta, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(ta @ tb), se3.inverse(tb) @ se3.inverse(ta), atol=1e-12)
    np.testing.assert_allclose(ta[:3, :3] @ ta[:3, :3].T, np.eye(3), atol=1e-12)


@given(tangents())
def test_the_exponential_is_the_matrix_exponential(xi: FloatArray) -> None:
    from scipy.linalg import expm

    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = cross_matrices(xi[3:]), xi[:3]
    np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=1e-11)
    np.testing.assert_allclose(se3.exp(-xi), se3.inverse(se3.exp(xi)), atol=1e-12)


@given(tangents(), tangents())
def test_the_adjoint_moves_a_perturbation_to_the_other_side(a: FloatArray, b: FloatArray) -> None:
    left = se3.exp(a) @ se3.exp(b)
    right = se3.exp(se3.adjoint(se3.exp(a)) @ b) @ se3.exp(a)
    np.testing.assert_allclose(left, right, atol=1e-11)


@given(tangents(2.5), tangents(1.0))
def test_the_right_jacobian_is_the_derivative(xi: FloatArray, direction: FloatArray) -> None:
    step = 1e-5
    ahead = se3.log(se3.inverse(se3.exp(xi)) @ se3.exp(xi + step * direction))
    behind = se3.log(se3.inverse(se3.exp(xi)) @ se3.exp(xi - step * direction))
    expected = (ahead - behind) / (2.0 * step)
    np.testing.assert_allclose(se3.right_jacobian(xi) @ direction, expected, atol=1e-7)


@given(tangents())
def test_quaternions_come_back(xi: FloatArray) -> None:
    pose = se3.exp(xi)
    quaternion = se3.quaternion_xyzw(pose)
    assert quaternion[3] >= 0.0
    turn = Rotation.from_quat(quaternion).as_matrix()
    np.testing.assert_allclose(se3.transform(turn, pose[:3, 3]), pose, atol=1e-12)


@given(st.floats(-3.1, 3.1), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))
def test_the_heading_is_that_of_yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> None:
    turn_z = se3.exp(np.array([0, 0, 0, 0, 0, yaw]))
    turn_y = se3.exp(np.array([0, 0, 0, 0, pitch, 0]))
    turn_x = se3.exp(np.array([0, 0, 0, roll, 0, 0]))
    pose = turn_z @ turn_y @ turn_x
    assert se3.heading(pose) == pytest.approx(yaw, abs=1e-12)


def test_a_stack_is_worked_on_like_its_members() -> None:
    generator = np.random.default_rng(1)
    stack = generator.normal(size=(3, 2, 6))
    poses = se3.exp(stack)
    for i in np.ndindex(3, 2):
        np.testing.assert_array_equal(poses[i], se3.exp(stack[i]))
    for of_pose in (se3.log, se3.adjoint, se3.inverse, se3.quaternion_xyzw):
        whole = of_pose(poses)
        for i in np.ndindex(3, 2):
            np.testing.assert_allclose(whole[i], of_pose(poses[i]), atol=1e-15)
    points = generator.normal(size=(3, 2, 3))
    np.testing.assert_allclose(
        se3.apply(poses, points)[1, 1], poses[1, 1, :3, :3] @ points[1, 1] + poses[1, 1, :3, 3]
    )


def test_a_robot_on_the_floor() -> None:
    pose = planar_transform(1.0, 2.0, np.pi / 2)
    np.testing.assert_allclose(se3.apply(pose, [1.0, 0.0, 0.5]), [1.0, 3.0, 0.5], atol=1e-15)
