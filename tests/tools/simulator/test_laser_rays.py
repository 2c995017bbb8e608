"""Rays, readings, ways and clocks of simulated laser sessions, against answers known otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.lasers.scanners import Scanner
from redetect.plane import apply, compose
from tools.simulator.laser.measuring import (
    Scene,
    cast_on_discs,
    cast_on_walls,
    measured,
    true_ranges,
)
from tools.simulator.laser.motion import Curve, RobotClock, Route, Stop, measured_path, ptpd_lines
from tools.simulator.laser.settings import (
    DrivingLimits,
    Faults,
    LaserSettings,
    ReadingErrors,
    WheelErrors,
)
from tools.simulator.laser.site import LEG_RADIUS_M, Passer, chain, clearance, rectangle

FloatArray = NDArray[np.float64]

angle = st.floats(-3.1, 3.1)
inside = st.floats(-0.9, 0.9)

PERFECT = ReadingErrors(
    sigma_m=0.0, quantum_m=0.001, dropouts=0.0, lost_scans=0.0, mixed=0.0, sweep_s=0.0
)


def scanner(x: float = 0.0, y: float = 0.0, theta: float = 0.0, **changes: Any) -> Scanner:
    plain = Scanner(
        "s", np.array([x, y, theta]), np.zeros((3, 3)), -np.pi / 2, np.pi / 180, 181, 16.0, 0.01
    )
    return replace(plain, **changes)


def nothing(times: FloatArray) -> FloatArray:
    return np.zeros((len(times), 0, 3))


# -- rays -----------------------------------------------------------------------------------


@given(inside, inside, angle)
def test_distances_within_a_square_are_those_of_its_sides(x: float, y: float, a: float) -> None:
    ranges = np.array([np.inf])
    cast_on_walls(np.array([[x, y, a]]), rectangle(-1.0, -1.0, 1.0, 1.0), ranges)
    across, up = np.cos(a), np.sin(a)
    exits = [
        (np.sign(direction) - at) / direction
        for at, direction in ((x, across), (y, up))
        if abs(direction) > 1e-300
    ]
    np.testing.assert_allclose(ranges[0], min(exits), rtol=1e-9)


@given(st.floats(1.0, 5.0), angle, st.floats(0.05, 0.9), st.floats(-0.99, 0.99))
def test_a_disc_is_hit_where_its_circle_is(far: float, a: float, r: float, off: float) -> None:
    centre = far * np.array([np.cos(a), np.sin(a)])
    towards = a + np.arcsin(off * r / far)  # passes the centre at off * r
    ranges = np.array([np.inf])
    discs = np.array([[[*centre, r], [0.1, 0.1, 0.0]]])  # one with radius 0 is none
    cast_on_discs(np.array([[0.0, 0.0, towards]]), discs, np.array([0]), ranges)
    hit = ranges[0] * np.array([np.cos(towards), np.sin(towards)])
    np.testing.assert_allclose(np.linalg.norm(hit - centre), r, rtol=1e-6)
    assert ranges[0] < far
    missed = np.array([np.inf])
    cast_on_discs(np.array([[0.0, 0.0, a + np.pi]]), discs, np.array([0]), missed)
    assert np.isinf(missed[0])


@given(st.floats(-1, 1), st.floats(-1, 1), angle)
def test_a_robot_is_hit_like_walls_at_its_place(x: float, y: float, turn: float) -> None:
    sides = chain([(-0.4, 0.3), (-0.4, -0.3), (0.2, -0.3), (0.4, 0.0), (0.2, 0.3)], closed=True)
    pose = np.array([[x + 3.0, y, turn]])
    there = apply(pose[0], sides.reshape(-1, 2)).reshape(-1, 4)
    none = np.zeros((0, 4))
    moving, still = (
        true_ranges(scanner(), None, np.zeros(1), scene)[0]
        for scene in (
            Scene(none, lambda _: pose, sides, nothing),
            Scene(there, None, none, nothing),
        )
    )
    # A ray through a corner within rounding may hit it in one of the two only.
    hit = np.isfinite(moving) & np.isfinite(still)
    assert np.sum(np.isfinite(moving) != np.isfinite(still)) <= 1
    assert np.sum(np.abs(moving[hit] - still[hit]) > 1e-9) <= 1
    assert hit.any()


def test_a_scanner_sees_the_robot_before_the_wall_and_legs_before_both() -> None:
    walls = rectangle(-1.0, -4.0, 6.0, 4.0)
    square = chain([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)], closed=True)
    times = np.array([0.0, 1.0])

    def robot(t: FloatArray) -> FloatArray:
        return np.column_stack([3.0 + t, np.zeros(len(t)), np.zeros(len(t))])

    def legs(t: FloatArray) -> FloatArray:
        return np.stack([[[1.5, 0.0, 0.1 if at > 0.5 else 0.0]] for at in t])

    ranges = true_ranges(scanner(), None, times, Scene(walls, robot, square, legs))
    np.testing.assert_allclose(ranges[:, 90], [2.5, 1.4])
    np.testing.assert_allclose(ranges[:, 0], 4.0)  # to the right
    np.testing.assert_allclose(ranges[:, 135], 4.0 * np.sqrt(2.0))
    assert ranges[0, 90 + 5] == pytest.approx(2.5 / np.cos(np.deg2rad(5.0)))


def test_a_scanner_on_board_moves_with_the_robot() -> None:
    walls = rectangle(-10.0, -5.0, 10.0, 5.0)

    def robot(t: FloatArray) -> FloatArray:
        return np.column_stack([t, 2.0 + 0 * t, np.full(len(t), np.pi / 2)])

    mounted = scanner(0.5, 0.1, np.pi)  # looks back, half a metre before the origin
    ranges = true_ranges(
        mounted, robot, np.array([0.0, 3.0]), Scene(walls, None, np.zeros((0, 4)), nothing)
    )
    # The scanner is at (t - 0.1, 2.5) and looks towards -y.
    np.testing.assert_allclose(ranges[:, 90], [7.5, 7.5])
    np.testing.assert_allclose(ranges[:, 0], [9.9, 12.9])
    np.testing.assert_allclose(ranges[:, 180], [10.1, 7.1])


def test_beams_of_a_sweep_have_times_of_their_own() -> None:
    """Beam i of n is sent (i / (n - 1) - 1/2) sweeps after the middle one."""
    wall = np.array([[-50.0, 3.0, 50.0, 3.0]])

    def robot(t: FloatArray) -> FloatArray:
        return np.column_stack([0 * t, 0.8 * t, np.zeros(len(t))])

    mounted = scanner(0.0, 0.0, np.pi / 2)
    scene = Scene(wall, None, np.zeros((0, 4)), nothing)
    swept = true_ranges(mounted, robot, np.array([1.0]), scene, 0.1)[0]
    beams = np.arange(20, 161)
    at = 1.0 + 0.1 * (beams / 180.0 - 0.5)
    np.testing.assert_allclose(
        swept[beams] * np.cos(mounted.angles_rad[beams]), 3.0 - 0.8 * at, rtol=1e-9
    )
    at_once = true_ranges(mounted, robot, np.array([1.0]), scene)[0]
    assert swept[90] == pytest.approx(at_once[90])
    assert abs(swept[20] - at_once[20]) > 0.05


# -- readings -------------------------------------------------------------------------------


def test_readings_have_the_noise_that_was_asked_for() -> None:
    rng = np.random.default_rng(5)
    exact = np.full((400, 181), 4.0037)
    errors = ReadingErrors(sigma_m=0.01, quantum_m=0.01, dropouts=0.02, lost_scans=0.1, mixed=0.0)
    scans = measured(np.arange(400.0), exact, scanner(), errors, rng)
    good = scans.ranges_mm[scans.ranges_mm > 0] / 1000.0
    assert good.mean() == pytest.approx(4.0037, abs=2e-4)
    # Gaussian and uniform rounding together.
    assert good.std() == pytest.approx(np.sqrt(0.01**2 + 0.01**2 / 12.0), rel=0.02)
    assert np.all(scans.ranges_mm % 10 == 0)
    assert 1.0 - len(good) / scans.ranges_mm.size == pytest.approx(0.02, abs=0.003)
    assert len(scans) / 400.0 == pytest.approx(0.9, abs=0.05)


def test_perfect_readings_are_the_truth_to_half_a_millimetre_and_end_at_the_largest_range() -> None:
    rng = np.random.default_rng(0)
    exact = np.array([[0.0004, 1.2346, 15.9994, 16.0, 40.0, np.inf]])
    scans = measured(np.zeros(1), exact, scanner(readings=6), PERFECT, rng)
    assert scans.ranges_mm.tolist() == [[0, 1235, 15999, 0, 0, 0]]


def test_mixed_readings_lie_between_the_sides_of_an_edge() -> None:
    rng = np.random.default_rng(1)
    exact = np.tile(np.array([2.0, 2.05, 5.0, 5.0, np.inf]), (4000, 1))
    scans = measured(
        np.arange(4000.0), exact, scanner(readings=5), replace(PERFECT, mixed=0.2), rng
    )
    ranges = scans.ranges_mm / 1000.0
    mixed = np.abs(ranges[:, :4] - exact[:, :4]) > 0.002
    assert mixed[:, 1:3].any(axis=1).mean() == pytest.approx(0.2, abs=0.02)
    assert not mixed[:, [0, 3]].any()
    assert np.all((ranges[:, 1:3] >= 2.049) & (ranges[:, 1:3] <= 5.001))


# -- ways -----------------------------------------------------------------------------------


def test_a_straight_drive_is_a_trapezoid() -> None:
    limits = DrivingLimits(speed_m_s=0.8, turn_rad_s=1.0, acceleration_m_s2=0.4)
    route = Route(np.array([[0.0, 1.0], [2.0, 1.0], [4.0, 1.0]]), [], limits, 100.0)
    # 2 s and 0.8 m to gain 0.8 m/s, the same to lose it, 3 s for the 2.4 m between.
    assert route.end_s == pytest.approx(107.0, abs=1e-6)
    poses = route.poses([90.0, 100.0, 101.0, 102.0, 103.5, 106.0, 107.0, 200.0])
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.0, 0.2, 0.8, 2.0, 3.8, 4.0, 4.0], atol=1e-6)
    np.testing.assert_allclose(poses[:, 1:], np.tile([1.0, 0.0], (8, 1)), atol=1e-9)


def test_a_robot_drives_along_its_heading_within_its_limits_and_stands_at_stops() -> None:
    limits = DrivingLimits(0.8, 0.7, 0.5)
    corners = np.array([[0, 0], [3, 0], [4, 2], [2, 3], [0.5, 1.5], [-1, 3], [-3, 1]], float)
    way = Curve(corners).arc_length_at(3)
    route = Route(corners, [Stop(2.0, 1.5), Stop(way, 3.0)], limits, 0.0)
    step = 1e-3
    times = np.arange(0.0, route.end_s, step)
    poses = route.poses(times)
    velocity = np.gradient(poses[:, :2], step, axis=0)
    speed = np.hypot(*velocity.T)
    assert speed.max() == pytest.approx(0.8, rel=1e-3)
    turn = np.gradient(poses[:, 2], step)
    assert np.abs(turn).max() < 0.7 * 1.02
    assert np.abs(np.gradient(speed, step)[2:-2]).max() < 0.5 * 1.02
    driving = speed > 0.05
    aside = -np.sin(poses[:, 2]) * velocity[:, 0] + np.cos(poses[:, 2]) * velocity[:, 1]
    assert np.abs(aside[driving]).max() < 1e-3
    begin, end = route.stands[1]
    assert end - begin == pytest.approx(3.0)
    stood = route.poses(np.linspace(begin, end, 7))
    assert np.ptp(stood, axis=0).max() < 1e-9
    np.testing.assert_allclose(stood[0, :2], corners[3], atol=3e-3)


def test_odometry_without_errors_is_the_way_and_its_errors_grow_as_they_should() -> None:
    t = np.linspace(0.0, 40.0, 2001)
    corners = np.array([[0, 0], [3, 0], [4, 2], [2, 3], [0.5, 1.5], [-1, 3], [-3, 1]], float)
    poses = Route(corners, [], DrivingLimits(), 0.0).poses(t)
    exact = WheelErrors(1.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    path = measured_path(poses, exact, np.random.default_rng(0))
    found = compose(poses[0], path)
    found[:, 2] = np.unwrap(found[:, 2])
    np.testing.assert_allclose(found, poses, atol=2e-4)
    drifting = measured_path(poses, replace(exact, turn_per_m=0.01), np.random.default_rng(0))
    metres = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert drifting[-1, 2] - path[-1, 2] == pytest.approx(0.01 * metres, rel=1e-3)
    noisy = replace(exact, sigma_turn_per_m=0.02)
    ends = [measured_path(poses, noisy, np.random.default_rng(k))[-1, 2] for k in range(200)]
    assert np.std(ends) == pytest.approx(0.02 * np.sqrt(metres), rel=0.15)


# -- clocks ---------------------------------------------------------------------------------


def test_the_clock_is_a_line_with_a_jump_and_its_ticks_are_regular() -> None:
    clock = RobotClock(1000.0, 0.25, 1e-3, jump_at_s=1010.0, jump_s=0.5)
    np.testing.assert_allclose(
        clock.robot_times([1000.0, 1004.0, 1010.0]), [1000.25, 1004.254, 1010.76]
    )
    ticks = RobotClock(0.0, 3.0, 1e-2).ticks(5.0, 9.0, 0.5, 0.25)
    assert ticks[0] >= 5.0
    assert ticks[-1] <= 9.0
    np.testing.assert_allclose(np.diff(RobotClock(0.0, 3.0, 1e-2).robot_times(ticks)), 0.5)


@pytest.mark.parametrize("offset_s", [-1.25, -0.002, 0.0, 0.75])
def test_reports_of_ptpd_are_read_back(tmp_path: Any, offset_s: float) -> None:
    from redetect.groundtruth.fusion.clock import read_ptpd

    clock = RobotClock(1000.0, offset_s, 2e-5)
    times = np.arange(1000.0, 1200.0, 2.0)
    path = tmp_path / "ptpd.log"
    path.write_text("\n".join(ptpd_lines(clock, times, 1e-5, np.random.default_rng(0))) + "\n")
    log = read_ptpd(path)
    np.testing.assert_allclose(log.times_s, times)
    np.testing.assert_allclose(log.offset_s, clock.robot_times(times) - times, atol=6e-5)
    assert log.drift.mean() == pytest.approx(2e-5, abs=2e-7)


# -- people and places ----------------------------------------------------------------------


def test_a_passer_walks_at_their_speed_with_both_legs_beside_the_way() -> None:
    passer = Passer(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]), 10.0, 1.0)
    assert passer.to_s == 17.0
    places, heading = passer.places(np.array([9.9, 10.0, 12.0, 15.5, 17.1]))
    np.testing.assert_allclose(places[1:4], [[0.0, 0.0], [2.0, 0.0], [4.0, 1.5]])
    assert np.isnan(places[[0, 4]]).all()
    np.testing.assert_allclose(heading[2:4], [0.0, np.pi / 2])
    legs = passer.legs(np.array([9.0, 12.0]))
    assert legs[0, :, 2].tolist() == [0.0, 0.0]
    assert legs[1, :, 2].tolist() == [LEG_RADIUS_M, LEG_RADIUS_M]
    assert legs[1, 0, 1] > 0.05 > -0.05 > legs[1, 1, 1]


def test_clearance_is_the_distance_to_the_nearest_wall_or_its_end() -> None:
    walls = np.array([[0.0, 0.0, 4.0, 0.0]])
    points = np.array([[2.0, 1.5], [7.0, 4.0], [-3.0, 0.0]])
    np.testing.assert_allclose(clearance(points, walls), [1.5, 5.0, 3.0])


@pytest.mark.parametrize(
    ("kind", "wrong", "message"),
    [
        (LaserSettings, {"visits": 0}, "visits is 0"),
        (LaserSettings, {"rate_hz": float("nan")}, "rate_hz"),
        (LaserSettings, {"passers": -1}, "passers"),
        (LaserSettings, {"max_range_m": 70.0}, "at most 65"),
        (LaserSettings, {"camera_misses": 3.0}, "camera_misses is 3: expected 0 to 1"),
        (LaserSettings, {"hand_sigma_m": -1.0}, "hand_sigma_m is -1"),
        (DrivingLimits, {"speed_m_s": -1.0}, "speed_m_s is -1: expected above 0"),
        (ReadingErrors, {"dropouts": 7.0}, "dropouts is 7"),
        (WheelErrors, {"sigma_turn": -0.1}, "sigma_turn is -0.1"),
        (Faults, {"clock_jump_s": -0.1}, "clock_jump_s is -0.1"),
        (Faults, {"wrong_scanner": "fixed4"}, "fixed4"),
    ],
)
def test_impossible_sessions_are_refused(
    kind: type[Any], wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(GroundTruthError, match=message):
        kind(**wrong)
