"""One movement by odometry: arcs, derivatives, and errors integrated along the way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from redetect.groundtruth.fusion.kernels import STATE, arc_integrals, predict
from redetect.groundtruth.fusion.movement import movement_problem
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle
from redetect.plane import between, compose, log_motion

FloatArray = NDArray[np.float64]

numbers = st.floats(-1.0, 1.0)
states = arrays(np.float64, STATE, elements=numbers).map(
    lambda unit: unit * [9.0, 9.0, 3.0, 0.1, 0.1, 0.1]
)
roots = arrays(np.float64, (STATE, STATE), elements=numbers).map(
    lambda unit: unit * np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02])[:, None]
)
ways = arrays(np.float64, 3, elements=numbers)
noises = arrays(np.float64, 3, elements=st.floats(0.0, 1.0)).map(lambda unit: 1e-3 * unit)


def control_of(way: FloatArray) -> FloatArray:
    """A movement of up to a metre or so and 172 degrees, all of whose turn is distinct."""
    return np.append(way * [1.0, 1.0, 3.0], way[2] * 3.0)


def moved(
    x: FloatArray,
    p: FloatArray,
    control: FloatArray,
    variances: FloatArray,
    point: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, p, f = x.copy(), p.copy(), np.eye(STATE)
    predict(x, p, f, control, variances, x.copy() if point is None else point)
    return x, p, f


def planar_exp(twist: FloatArray) -> FloatArray:
    full = se3.exp(np.array([twist[0], twist[1], 0.0, 0.0, 0.0, twist[2]]))
    return np.array([full[0, 3], full[1, 3], math.atan2(full[1, 0], full[0, 0])])


def expected_mean(x: FloatArray, control: FloatArray) -> FloatArray:
    """The end of the arc whose way and turn are put right."""
    way = math.hypot(control[0], control[1])
    twist = np.array(
        [
            (1.0 + x[5]) * control[0],
            (1.0 + x[5]) * control[1],
            control[2] + x[3] * control[3] + x[4] * way,
        ]
    )
    end = compose(x[:3], planar_exp(twist))
    return np.array([*end[:2], x[2] + twist[2], *x[3:]])


def integrated_noise(x: FloatArray, control: FloatArray, variances: FloatArray) -> FloatArray:
    """Covariance of the end pose: what noise in each of many small parts of the arc does to it."""
    count = 1000
    share = (np.arange(count) + 0.5) / count
    end = expected_mean(x, control)
    spread = np.zeros((3, 3))
    for part in share[:, None] * control:
        here = expected_mean(x, part)
        direction = math.atan2(part[1], part[0]) + here[2]
        c, s = math.cos(direction), math.sin(direction)
        by_noise = np.array(
            [[c, -s, -(end[1] - here[1])], [s, c, end[0] - here[0]], [0.0, 0.0, 1.0]]
        )
        spread += by_noise @ np.diag(variances / count) @ by_noise.T
    return spread


@pytest.mark.parametrize("half", [0.0, 1e-6, 0.0999, 0.1001, -0.0999, -0.1001, 0.7, -1.5, 3.0])
def test_integrals_along_an_arc_are_those_of_quadrature(half: float) -> None:
    node, weight = np.polynomial.legendre.leggauss(40)
    t, weight = 0.5 * node, 0.5 * weight
    tangent = np.exp(2j * half * t)
    # The way that is left, of an arc of length 1 whose chord lies along the real axis.
    left = np.array([_left(half, value) for value in t])
    moved_end = 1j * left
    mean = np.sum(weight * moved_end)
    chord, mean_along, variance_along, variance_across, mean_cosine = arc_integrals(half)
    assert chord == pytest.approx(np.sum(weight * tangent).real, abs=1e-12)
    assert mean_along == pytest.approx(mean.real, abs=1e-11)
    assert 0.5 * chord == pytest.approx(mean.imag, abs=1e-11)
    off = moved_end - mean
    assert variance_along == pytest.approx(np.sum(weight * off.real**2), abs=1e-11)
    assert variance_across == pytest.approx(np.sum(weight * off.imag**2), abs=1e-11)
    assert abs(np.sum(weight * off.real * off.imag)) < 1e-12
    assert mean_cosine == pytest.approx(np.sum(weight * tangent**2).real, abs=1e-12)


def _left(half: float, t: float) -> complex:
    """The integral of exp(2 i half u) over u from t to 1/2."""
    node, weight = np.polynomial.legendre.leggauss(30)
    width = 0.5 - t
    return complex(
        np.sum(0.5 * width * weight * np.exp(2j * half * (t + 0.5 * width * (node + 1))))
    )


@given(states, ways)
def test_the_mean_is_the_end_of_the_arc(x: FloatArray, way: FloatArray) -> None:
    control = control_of(way)
    found, _, _ = moved(x, np.zeros((STATE, STATE)), control, np.zeros(3))
    expected = expected_mean(x, control)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(states, ways)
def test_derivatives_are_those_of_finite_differences(x: FloatArray, way: FloatArray) -> None:
    control = control_of(way)
    _, _, f = moved(x, np.zeros((STATE, STATE)), control, np.zeros(3))
    step = 1e-5
    for k in range(STATE):
        d = step * np.eye(STATE)[k]
        difference = expected_mean(x + d, control) - expected_mean(x - d, control)
        np.testing.assert_allclose(f[:, k], difference / (2 * step), atol=1e-8)


@given(states, states, ways)
def test_away_from_the_point_it_is_linear(
    x: FloatArray, point: FloatArray, way: FloatArray
) -> None:
    control = control_of(way)
    zero = np.zeros((STATE, STATE))
    found, _, f = moved(x, zero, control, np.zeros(3), point)
    expected = moved(point, zero, control, np.zeros(3))[0] + f @ (x - point)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(states, roots, ways, noises, st.floats(0.01, 0.99))
def test_a_movement_in_two_parts_is_the_whole_movement(
    x: FloatArray, root: FloatArray, way: FloatArray, variances: FloatArray, cut: float
) -> None:
    control, p = control_of(way), root @ root.T
    whole, spread, f = moved(x, p, control, variances)
    half, halfway, first = moved(x, p, cut * control, cut * variances)
    end, at_end, second = moved(half, halfway, (1.0 - cut) * control, (1.0 - cut) * variances)
    np.testing.assert_allclose(end, whole, atol=1e-12)
    np.testing.assert_allclose(second @ first, f, atol=1e-10)
    np.testing.assert_allclose(at_end, spread, atol=1e-12)


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.6, -0.3, 0.4), (-0.5, 0.1, -0.9), (0, 0, 0.8)])
def test_noise_is_integrated_along_the_way(way: tuple[float, float, float]) -> None:
    x = np.array([3.0, -2.0, 1.0, 0.05, -0.03, 0.02])
    control, variances = control_of(np.array(way)), np.array([4e-4, 1e-4, 2e-3])
    _, spread, _ = moved(x, np.zeros((STATE, STATE)), control, variances)
    expected = integrated_noise(x, control, variances)
    np.testing.assert_allclose(spread[:3, :3], expected, atol=1e-9)
    np.testing.assert_array_equal(spread[3:], 0.0)


def test_a_heading_that_wanders_leads_aside() -> None:
    """Straight on: variances s q + s^3 q / 3 across, s^2 q / 2 with the heading (a classic)."""
    way = 7.0
    _, p, _ = moved(
        np.zeros(STATE),
        np.zeros((STATE, STATE)),
        np.array([way, 0.0, 0.0, 0.0]),
        np.array([0.01 * way, 0.002 * way, 1e-4 * way]),
    )
    assert p[0, 0] == pytest.approx(0.01 * way)
    assert p[1, 1] == pytest.approx(0.002 * way + 1e-4 * way**3 / 3.0)
    assert p[1, 2] == pytest.approx(1e-4 * way**2 / 2.0)
    assert p[2, 2] == pytest.approx(1e-4 * way)


@given(arrays(np.float64, 3, elements=numbers))
def test_a_motions_logarithm_leads_back_to_it(unit: FloatArray) -> None:
    twist = unit * [2.0, 2.0, 3.1]
    np.testing.assert_allclose(log_motion(planar_exp(twist)), twist, atol=1e-10)


def test_controls_are_shares_of_arcs() -> None:
    """Measurements between two samples of odometry cut its arc; together they lead to its end."""
    turns = np.array([0.3, -1.2, 0.0, 2.0])
    ends = [np.array([5.0, -1.0, 2.5])]
    for turn in turns:
        ends.append(compose(ends[-1], planar_exp(np.array([0.4, 0.05, turn]))))
    odometry = PlanarPoses(np.array([0.0, 1.0, 1.5, 3.0, 4.0]), np.array(ends))
    times = np.array([0.0, 0.25, 0.7, 1.0, 2.9, 4.0])
    seen = PlanarPoses(times, np.zeros((6, 3)), np.tile(1e-4 * np.eye(3), (6, 1, 1)))
    problem = movement_problem(odometry, {"laser": seen}, FuseSettings())
    np.testing.assert_allclose(problem.times_s, [0.0, 0.25, 0.7, 1.0, 1.5, 2.9, 3.0, 4.0])
    np.testing.assert_allclose(problem.controls[1:4, :3].sum(axis=0), [0.4, 0.05, 0.3])
    np.testing.assert_allclose(problem.controls[1, :3], 0.25 * np.array([0.4, 0.05, 0.3]))
    pose = odometry.poses[0]
    for control in problem.controls[1:]:
        pose = compose(pose, planar_exp(control[:3]))
    np.testing.assert_allclose(pose[:2], odometry.poses[-1, :2], atol=1e-12)
    assert abs(wrap_angle(pose[2] - odometry.poses[-1, 2])) < 1e-12
    halfway = compose(odometry.poses[0], planar_exp(problem.controls[1:3, :3].sum(axis=0)))
    np.testing.assert_allclose(
        between(odometry.poses[0], halfway), planar_exp(0.7 * np.array([0.4, 0.05, 0.3]))
    )
