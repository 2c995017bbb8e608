"""Odometry that contradicts the measured poses: the path follows these, and says how well."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.plane import between
from tests.groundtruth.fusion.drives import chain, drive, errors_m, measure, normalised_error

FloatArray = NDArray[np.float64]

WHEELS = FuseSettings(distance_sigma=0.006, lateral_sigma=0.001, turn_sigma=0.008)
FINE = np.diag([4e-6, 4e-6, 1e-5])


def slipping(
    own: PlanarPoses, from_s: float, to_s: float, extra_m: float, turned_rad: float = 0.0
) -> PlanarPoses:
    """Odometry whose wheels spin: it measures a way that nobody drove, or a turn."""
    steps = between(own.poses[:-1], own.poses[1:])
    during = (own.times_s[1:] > from_s) & (own.times_s[1:] <= to_s)
    steps[during] += np.array([extra_m, 0.0, turned_rad]) / np.count_nonzero(during)
    return PlanarPoses(own.times_s, chain(steps, own.poses[0]))


@pytest.mark.parametrize("extra_m", [0.2, 1.0])
def test_wheels_that_spin_do_not_carry_the_path_away(extra_m: float) -> None:
    rng = np.random.default_rng(21)
    truth, own = drive(rng, 60.0, WHEELS)
    odometry = slipping(own, 20.0, 21.0, extra_m)
    laser = measure(rng, truth, np.arange(0.0, 59.9, 0.08), FINE)
    fusion = fuse(odometry, {"laser": laser})
    assert errors_m(fusion.poses, truth).max() < 0.05
    assert 0.7 < float(np.mean(normalised_error(fusion.poses, truth))) / 3.0 < 1.5
    assert len(fusion.rejected) < 0.01 * len(laser)
    assert fusion.slips_s
    assert all(19.8 < begin < end < 23.0 for begin, end in fusion.slips_s)


@pytest.mark.parametrize("turned_rad", [0.0, 0.6])
def test_a_slip_does_not_make_gaps_less_certain(turned_rad: float) -> None:
    rng = np.random.default_rng(25)
    truth, own = drive(rng, 90.0, WHEELS)
    times = np.arange(0.0, 89.9, 0.08)
    laser = measure(rng, truth, times[(times < 40.0) | (times > 60.0)], FINE)
    found = []
    for odometry in (own, slipping(own, 20.0, 20.5, 0.3, turned_rad)):
        path = fuse(odometry, {"laser": laser}).poses
        assert path.covariances is not None
        found.append(np.sqrt(path.covariances[path.during(45.0, 55.0), 0, 0].max()))
    assert found[1] == pytest.approx(found[0], rel=0.1)


@pytest.mark.parametrize(("seed", "slip"), [(0, (0.05, 0.1)), (2, (0.3, 0.0))])
def test_slips_between_sparse_poses(seed: int, slip: tuple[float, float]) -> None:
    """Few poses contradict odometry until the filter is uncertain enough to accept them."""
    rng = np.random.default_rng(seed)
    truth, own = drive(rng, 60.0, WHEELS)
    laser = measure(rng, truth, np.arange(0.013 + 0.05 * seed, 59.8, 0.5), FINE)
    fusion = fuse(slipping(own, 20.0, 20.5, *slip), {"laser": laser})
    near = fusion.poses.during(19.0, 22.0)
    assert len(fusion.slips_s) == 1
    assert len(fusion.rejected) == 0
    assert float(np.mean(normalised_error(fusion.poses, truth)[near])) / 3.0 < 2.0


@pytest.mark.parametrize(("every_s", "seed"), [(0.04, 1), (0.02, 3)])
def test_bursts_of_wrong_poses_side_by_side_are_no_slips(every_s: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, own = drive(rng, 60.0, WHEELS)
    laser = measure(rng, truth, np.arange(0.013 + 0.1 * seed * every_s, 59.8, every_s), FINE)
    poses = laser.poses.copy()
    for begin in rng.integers(5, len(poses) - 8, 5):
        poses[begin : begin + 6] += rng.normal(0.0, 0.3, 3)
    fusion = fuse(own, {"laser": PlanarPoses(laser.times_s, poses, laser.covariances)})
    assert fusion.slips_s == ()
    assert errors_m(fusion.poses, truth).max() < 0.02


def test_a_burst_of_wrong_poses_is_no_slip() -> None:
    """A second of poses half a metre off, all by as much: the path stays where it was."""
    rng = np.random.default_rng(22)
    truth, odometry = drive(rng, 60.0, WHEELS)
    laser = measure(rng, truth, np.arange(0.0, 59.9, 0.08), FINE)
    wrong = laser.during(30.0, 31.0)
    laser.poses[wrong, :2] += [0.3, 0.4]
    fusion = fuse(odometry, {"laser": laser})
    assert fusion.slips_s == ()
    assert len(fusion.rejected) == np.count_nonzero(wrong)
    assert errors_m(fusion.poses, truth).max() < 0.02


def test_odometry_that_was_reset_is_followed_at_once() -> None:
    rng = np.random.default_rng(23)
    truth, own = drive(rng, 60.0, WHEELS)
    after = own.times_s >= 30.0
    odometry = PlanarPoses(own.times_s, own.poses.copy())
    odometry.poses[after] = between(own.poses[after][0], own.poses[after])
    laser = measure(rng, truth, np.arange(0.0, 59.9, 0.08), FINE)
    fusion = fuse(odometry, {"laser": laser})
    off = errors_m(fusion.poses, truth)
    away = np.abs(fusion.poses.times_s - 30.0) > 0.2
    assert off[away].max() < 0.02
    assert len(fusion.rejected) < 5


def test_headings_alone_are_no_odometry() -> None:
    rng = np.random.default_rng(24)
    truth, odometry = drive(rng, 20.0, WHEELS)
    odometry.poses[:, :2] = 0.0
    laser = measure(rng, truth, np.arange(0.0, 19.9, 0.08), FINE)
    with pytest.raises(GroundTruthError, match="odometry stays at one place"):
        fuse(odometry, {"laser": laser})
