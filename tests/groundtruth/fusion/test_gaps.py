"""Gaps in what was measured: bridged, or parted, with honest covariances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.landmarks import wrap_angle
from redetect.plane import between
from tests.groundtruth.fusion.drives import (
    LASER_COVARIANCE,
    chain,
    drive,
    errors_m,
    measure,
    normalised_error,
)

FloatArray = NDArray[np.float64]


def test_what_odometry_is_off_by_is_found_and_bridges_a_gap() -> None:
    rng = np.random.default_rng(12)
    exact = FuseSettings(
        distance_sigma=0.003, lateral_sigma=0.003, turn_sigma=0.003, turn_per_metre_sigma=0.001
    )
    truth, odometry = drive(rng, 120.0, exact)
    # Odometry that takes turns for 2 % and ways for 1 % shorter than they are, and bends.
    steps = np.diff(odometry.poses, axis=0)
    steps[:, 2] = wrap_angle(steps[:, 2])
    c, s = np.cos(odometry.poses[:-1, 2]), np.sin(odometry.poses[:-1, 2])
    along = (c * steps[:, 0] + s * steps[:, 1]) / 1.01
    turn = (steps[:, 2] - 0.005 * along * 1.01) / 1.02
    own = np.column_stack([along, 0 * along, turn])
    biased = PlanarPoses(odometry.times_s, chain(own))
    times = np.concatenate([np.arange(0.0, 50.0, 0.1), np.arange(70.0, 119.9, 0.1)])
    fusion = fuse(biased, {"laser": measure(rng, truth, times, LASER_COVARIANCE / 100)})
    learnt = fusion.odometry
    assert abs(learnt.turn_scale - 0.02) < 4 * learnt.turn_scale_sigma < 0.02
    assert abs(learnt.distance_scale - 0.01) < 4 * learnt.distance_scale_sigma < 0.01
    assert abs(learnt.turn_bias_per_metre - 0.005) < 4 * learnt.turn_bias_per_metre_sigma < 0.01
    assert learnt.turn_sigma < 0.01
    off = errors_m(fusion.poses, truth)
    assert np.max(off) < 0.12
    assert np.mean(normalised_error(fusion.poses, truth)) < 9.0


@pytest.mark.parametrize("slip", [0.0, 0.006])
def test_a_short_gap_is_as_uncertain_along_the_way_as_across_it(slip: float) -> None:
    """Wheels that err along their way, with and without sideways slip; errors found, not given."""
    along, across, expected = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        times = np.arange(0.0, 30.0, 0.02)
        turning = 0.1 * np.sin(0.5 * times + rng.uniform(0, 6))
        steps = 0.02 * np.column_stack([0.6 + 0.0 * times, 0.0 * times, turning])
        truth = PlanarPoses(times, chain(steps[1:], rng.normal(size=3)))
        way = 0.6 * 0.02
        sigmas = np.sqrt(way) * np.array([0.006, slip, 0.004])
        own = steps + rng.normal(size=steps.shape) * sigmas
        odometry = PlanarPoses(times, chain(own[1:]))
        seen = np.concatenate([np.arange(0.0, 13.0, 0.04), np.arange(17.0, 29.9, 0.04)])
        spread = np.diag(np.square([1e-3, 1e-3, 3e-3]))
        found = fuse(odometry, {"laser": measure(rng, truth, seen, spread)}).poses
        assert found.covariances is not None
        k = int(np.argmin(np.abs(found.times_s - 15.0)))
        exact = truth.poses[int(np.argmin(np.abs(truth.times_s - found.times_s[k])))]
        c, s = np.cos(exact[2]), np.sin(exact[2])
        turn = np.array([[c, s], [-s, c]])
        error = turn @ (found.poses[k, :2] - exact[:2])
        variances = np.diagonal(turn @ found.covariances[k, :2, :2] @ turn.T)
        along.append(error[0] ** 2 / variances[0])
        across.append(error[1] ** 2 / variances[1])
        expected.append(variances[0])
    # A random walk between two known ends: a quarter of its variance over the whole gap.
    assert np.mean(expected) == pytest.approx(0.25 * 0.006**2 * 0.6 * 4.0, rel=0.1)
    # 99.8 % bands of the mean of 12 draws of chi-squared with 1 degree of freedom.
    for values in (along, across):
        assert 0.18 < np.mean(values) < 2.75


def test_a_gap_is_bridged_with_covariance_that_grows_towards_its_middle() -> None:
    rng = np.random.default_rng(3)
    truth, odometry = drive(rng, 40.0, FuseSettings())
    times = np.concatenate([np.arange(0.0, 10.0, 0.05), np.arange(30.0, 39.9, 0.05)])
    fusion = fuse(odometry, {"laser": measure(rng, truth, times, LASER_COVARIANCE)})
    assert fusion.poses.covariances is not None
    spread = np.sqrt(np.trace(fusion.poses.covariances[:, :2, :2], axis1=1, axis2=2))
    at = {t: spread[np.argmin(np.abs(fusion.poses.times_s - t))] for t in (5, 12, 20, 28, 35)}
    assert at[5] < at[12] < at[20] > at[28] > at[35]
    assert at[20] > 3.0 * at[5]
    assert len(fusion.poses) == np.count_nonzero(odometry.times_s <= times[-1])


@pytest.mark.parametrize("carried_m", [(4.0, -3.0), (400.0, -300.0)])
def test_a_robot_that_was_carried_away_is_found_again(carried_m: tuple[float, float]) -> None:
    """Also farther than a restart's own deviation lets anything pass."""
    rng = np.random.default_rng(5)
    truth, odometry = drive(rng, 40.0, FuseSettings())
    moved = PlanarPoses(truth.times_s, truth.poses.copy())
    moved.poses[truth.times_s > 20.0, :2] += carried_m
    laser = measure(rng, moved, np.arange(0.0, 39.9, 0.1), LASER_COVARIANCE)
    fusion = fuse(odometry, {"laser": laser})
    assert len(fusion.restarts_s) == 1
    assert 20.0 < fusion.restarts_s[0] < 25.0
    assert len(fusion.rejected) == 0
    off = errors_m(fusion.poses, moved)
    settled = (fusion.poses.times_s < 19.5) | (fusion.poses.times_s > fusion.restarts_s[0] + 1.0)
    assert np.max(off[settled]) < 0.15


def test_a_gap_too_long_to_be_bridged_parts_the_path_and_no_more() -> None:
    """A quarter of an hour of odometry that bends: poses after it are believed at once."""
    rng = np.random.default_rng(14)
    exact = FuseSettings(distance_sigma=0.01, lateral_sigma=0.0, turn_per_metre_sigma=0.03)
    truth, own = drive(rng, 940.0, exact, rate_hz=10.0)
    steps = between(own.poses[:-1], own.poses[1:])
    steps[:, 2] += 0.02 * np.hypot(steps[:, 0], steps[:, 1])
    odometry = PlanarPoses(own.times_s, chain(steps))
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(920.0, 939.8, 0.1)])
    fusion = fuse(odometry, {"laser": measure(rng, truth, seen, LASER_COVARIANCE / 10)})
    assert len(fusion.rejected) <= 2
    assert all(time == pytest.approx(920.0, abs=0.2) for time in fusion.restarts_s)
    off = errors_m(fusion.poses, truth)
    near = (fusion.poses.times_s < 20.0) | (fusion.poses.times_s > 920.1)
    assert np.max(off[near]) < 0.1
    assert fusion.poses.covariances is not None
    assert np.all(np.linalg.eigvalsh(fusion.poses.covariances) > 0.0)


def test_odometry_that_errs_smoothly_bridges_long_gaps_and_holes_beside_them() -> None:
    """A localisation as odometry: never far off, and wrong for seconds, not from row to row."""
    rng = np.random.default_rng(31)
    times = np.arange(0.0, 1700.0, 0.1)
    # It turns left more than right: what is learnt of turns counts at the long gaps' ends.
    turning = 0.01 + 0.4 * np.sin(0.3 * times)
    steps = 0.1 * np.column_stack([0.7 + 0.0 * times, 0.0 * times, turning])
    truth = PlanarPoses(times, chain(steps[1:]))
    # 50 mm and 1.5 degrees, smooth within a second and forgotten after a few.
    kept = math.exp(-0.1 / 1.5)
    off = lfilter([1.0], [1.0, -2.0 * kept, kept**2], rng.normal(size=(len(times), 3)), axis=0)
    off *= [0.05, 0.05, math.radians(1.5)] / np.std(off, axis=0)
    off += rng.normal(size=off.shape) * [0.001, 0.001, 0.004]
    odometry = PlanarPoses(times, truth.poses + off)
    times = times[:-10]
    long_gap = ((times > 40.0) & (times < 260.0)) | ((times > 300.0) & (times < 1450.0))
    begins = [20.0, 35.0, 260.0, 280.0, 290.0, 1450.0, 1480.0, 1520.0, 1560.0, 1620.0, 1670.0]
    lengths = [5.0, 5.0, 2.0, 5.0, 10.0, 5.0, 20.0, 20.0, 5.0, 20.0, 5.0]
    holes = [(begin, begin + length) for begin, length in zip(begins, lengths)]

    def in_hole(at: FloatArray) -> NDArray[np.bool_]:
        return np.asarray(np.any([(at >= begin) & (at < end) for begin, end in holes], axis=0))

    spread = np.diag(np.square([2e-3, 2e-3, 3e-3]))
    laser = measure(rng, truth, times[~(long_gap | in_hole(times))], spread)
    fusion = fuse(odometry, {"laser": laser})
    assert fusion.restarts_s == ()
    assert fusion.odometry.looser_in_gaps > 1.0
    assert abs(fusion.odometry.turn_bias_per_metre) < 0.005
    found = fusion.poses
    within = in_hole(found.times_s)
    distance = errors_m(found, truth)
    squared = normalised_error(found, truth) / 3.0
    assert np.mean(distance[within]) < 0.1
    assert 0.3 < np.mean(squared[within]) < 2.0
    assert np.mean(squared) < 2.0


def test_beside_a_long_gap_the_path_is_told_by_its_own_side() -> None:
    """Twenty minutes without a pose: for seconds from either end, odometry leads on from there."""
    rng = np.random.default_rng(40)
    exact = FuseSettings(distance_sigma=0.01, lateral_sigma=0.0, turn_per_metre_sigma=0.02)
    truth, own = drive(rng, 1240.0, exact, rate_hz=10.0)
    steps = between(own.poses[:-1], own.poses[1:])
    steps[:, 2] -= 0.02 * np.hypot(steps[:, 0], steps[:, 1])
    odometry = PlanarPoses(own.times_s, chain(steps))
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(1220.0, 1239.8, 0.1)])
    found = fuse(odometry, {"laser": measure(rng, truth, seen, LASER_COVARIANCE / 10)}).poses
    at = found.times_s
    beside = ((at > 20.0) & (at < 25.0)) | ((at > 1215.0) & (at < 1220.0))
    off = errors_m(found, truth)
    assert np.max(off[beside]) < 0.5
    assert np.mean(normalised_error(found, truth)[beside]) < 3.0 * 2.0
    assert np.mean(normalised_error(found, truth)) < 3.0 * 2.0


@pytest.mark.parametrize(("seed", "turned_rad"), [(0, 2.0), (1, 0.0)])
def test_a_robot_carried_away_in_a_gap_keeps_the_covariance_honest(
    seed: int, turned_rad: float
) -> None:
    """What odometry did not see in a gap is laid to the gap; poses after it are believed."""
    rng = np.random.default_rng(seed)
    truth, odometry = drive(rng, 60.0, FuseSettings())
    moved = PlanarPoses(truth.times_s, truth.poses.copy())
    late = truth.times_s > 30.0
    carried = moved.poses[late, 0] + 1j * moved.poses[late, 1] + (4.0 - 3.0j)
    carried *= np.exp(1j * turned_rad)
    moved.poses[late, 0], moved.poses[late, 1] = carried.real, carried.imag
    moved.poses[late, 2] = wrap_angle(moved.poses[late, 2] + turned_rad)
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(40.0, 59.8, 0.1)])
    fusion = fuse(odometry, {"laser": measure(rng, moved, seen, LASER_COVARIANCE)})
    assert len(fusion.rejected) <= 1
    found = fusion.poses
    at = found.times_s
    off = errors_m(found, moved)
    measured = (at < 20.0) | (at > 40.0)
    assert np.max(off[measured]) < 0.1
    squared = normalised_error(found, moved) / 3.0
    assert np.mean(squared[measured]) < 2.0
    assert np.mean(squared) < 10.0


def test_a_wrong_pose_after_a_gap_is_kept_out() -> None:
    rng = np.random.default_rng(0)
    truth, odometry = drive(rng, 60.0, FuseSettings())
    seen = np.concatenate([np.arange(0.0, 20.0, 0.1), np.arange(40.0, 59.8, 0.1)])
    laser = measure(rng, truth, seen, LASER_COVARIANCE)
    laser.poses[200] += [10.0, 10.0, 1.0]
    fusion = fuse(odometry, {"laser": laser})
    assert [rejected.time_s for rejected in fusion.rejected] == [pytest.approx(40.0)]
    assert fusion.restarts_s == ()
    assert fusion.odometry.looser_in_gaps == 1.0
