"""Stamps that are not one after the other: several of one time, and pauses of odometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.fusion.movement import movement_problem
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, interpolate_poses
from tests.groundtruth.fusion.drives import LASER_COVARIANCE, drive, measure, normalised_error

FloatArray = NDArray[np.float64]


def test_odometry_with_several_samples_of_one_stamp_moves_on() -> None:
    """Stamps of a buffer read now and then: what moves between equal stamps must not get lost."""
    rng = np.random.default_rng(21)
    truth, odometry = drive(rng, 20.0, FuseSettings())
    coarse = PlanarPoses(np.floor(odometry.times_s * 10.0) / 10.0, odometry.poses)
    # The last sample of a stamp was taken 0.08 s after it.
    late = PlanarPoses(truth.times_s - 0.08, truth.poses)
    laser = measure(rng, late, np.arange(0.5, 19.0, 0.5), LASER_COVARIANCE / 100)
    fusion = fuse(coarse, {"laser": laser})
    assert fusion.rejected == ()
    assert fusion.restarts_s == ()
    error = fusion.poses.poses - interpolate_poses(late, fusion.poses.times_s)[0].poses
    assert np.max(np.hypot(error[:, 0], error[:, 1])) < 0.02
    _, last = np.unique(coarse.times_s, return_index=True)
    unique = np.append(last[1:] - 1, len(coarse) - 1)
    once = PlanarPoses(coarse.times_s[unique], coarse.poses[unique])
    np.testing.assert_array_equal(fusion.poses.poses[::5], fuse(once, {"laser": laser}).poses.poses)


def test_a_measurement_written_twice_counts_once() -> None:
    rng = np.random.default_rng(22)
    truth, odometry = drive(rng, 10.0, FuseSettings())
    laser = measure(rng, truth, np.arange(0.5, 9.0, 0.5), LASER_COVARIANCE)
    assert laser.covariances is not None
    twice = PlanarPoses(
        *(np.repeat(part, 2, axis=0) for part in (laser.times_s, laser.poses, laser.covariances))
    )
    once, found = fuse(odometry, {"laser": laser}), fuse(odometry, {"laser": twice})
    np.testing.assert_array_equal(found.poses.covariances, once.poses.covariances)
    assert found.used == once.used


def test_where_odometry_pauses_the_way_is_not_known() -> None:
    """Its poses tell where the robot came to; the errors are those of all it may have driven."""
    squares = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth, odometry = drive(rng, 70.0, FuseSettings())
        times = odometry.times_s
        paused = (times > 12.0) & (times < 52.0)
        laser = measure(rng, truth, np.r_[0.0:10.0:0.2, 60.0:69.9:0.2], LASER_COVARIANCE / 25)
        fusion = fuse(
            PlanarPoses(times[~paused], odometry.poses[~paused]),
            {"laser": laser},
            FuseSettings(learn_noise=False),
        )
        assert np.round(fusion.pauses_s, 2).tolist() == [[12.0, 52.0]]
        between = (fusion.poses.times_s > 52.5) & (fusion.poses.times_s < 53.0)
        squares.append(float(np.mean(normalised_error(fusion.poses, truth)[between])) / 3.0)
    assert np.mean(squares) < 1.5
    # A robot that stood still throughout hides nothing.
    stood = np.repeat(odometry.poses[:1], 100, axis=0)
    still = PlanarPoses(np.r_[0.0:1.0:0.02, 40.0:41.0:0.02][:100], stood)
    both = PlanarPoses(still.times_s[[0, -1]], stood[:2], np.tile(LASER_COVARIANCE, (2, 1, 1)))
    problem = movement_problem(still, {"laser": both}, FuseSettings())
    assert not np.any(problem.unseen)


@pytest.mark.parametrize("seen_s", [8.0, 4.0])
def test_measurements_within_a_pause_of_odometry_are_used(seen_s: float) -> None:
    """They contradict the arc over the pause, and are right."""
    settings = FuseSettings(
        distance_sigma=0.01, lateral_sigma=0.005, turn_sigma=0.01, turn_per_metre_sigma=0.005
    )
    for seed in range(4):
        rng = np.random.default_rng(seed)
        truth, odometry = drive(rng, 60.0, settings, rate_hz=20.0)
        times = np.arange(3.0, 57.0, 0.08)
        times = times[(times < 20.0 + seen_s) | (times > 28.0)]
        laser = measure(rng, truth, times, np.diag([9e-6, 9e-6, 16e-6]))
        there = (odometry.times_s < 20.0) | (odometry.times_s > 28.0)
        fusion = fuse(odometry.only(there), {"laser": laser})
        assert len(fusion.rejected) < 5
        assert not fusion.slips_s
        assert float(np.mean(normalised_error(fusion.poses, truth))) / 3.0 < 1.3


def test_a_buffer_read_every_other_second_makes_no_pauses() -> None:
    """What is told of pauses is what the estimate takes for them."""
    rng = np.random.default_rng(23)
    truth, odometry = drive(rng, 30.0, FuseSettings())
    coarse = PlanarPoses(np.floor(odometry.times_s / 2.0) * 2.0, odometry.poses)
    laser = measure(rng, truth, np.arange(2.5, 27.0, 0.5), LASER_COVARIANCE)
    settings = FuseSettings(learn_noise=False)
    assert not np.any(movement_problem(coarse, {"laser": laser}, settings).unseen)
    assert fuse(coarse, {"laser": laser}, settings).pauses_s == ()
