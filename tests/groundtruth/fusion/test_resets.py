"""Odometry that a driver restarts, that stalls, that is rounded or out of scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from redetect.array_types import FloatArray
from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.fusion.resets import continuous_odometry
from redetect.groundtruth.fusion.sync import synchronise
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from redetect.plane import between, compose
from tests.groundtruth.fusion.drives import drive, errors_m, measure, normalised_error

WHEELS = FuseSettings(distance_sigma=0.006, lateral_sigma=0.001, turn_sigma=0.008)
FINE = np.diag([4e-6, 4e-6, 1e-5])


def restarted(own: PlanarPoses, at_s: float, start: FloatArray) -> PlanarPoses:
    """Odometry that begins anew at a pose."""
    first = int(np.searchsorted(own.times_s, at_s))
    poses = own.poses.copy()
    poses[first:] = compose(start, between(poses[first], poses[first:]))
    return PlanarPoses(own.times_s, poses)


def stalled(own: PlanarPoses, from_s: float, to_s: float) -> PlanarPoses:
    """Odometry that repeats a pose for some time."""
    poses, during = own.poses.copy(), (own.times_s > from_s) & (own.times_s < to_s)
    poses[during] = poses[np.flatnonzero(during)[0] - 1]
    return PlanarPoses(own.times_s, poses)


def with_gap(seed: int) -> tuple[PlanarPoses, PlanarPoses, PlanarPoses]:
    """A true path, odometry, and poses measured except from 30 s to 60 s."""
    rng = np.random.default_rng(seed)
    truth, own = drive(rng, 90.0, WHEELS)
    times = np.arange(0.0, 89.9, 0.08)
    return truth, own, measure(rng, truth, times[(times < 30.0) | (times > 60.0)], FINE)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-7.0, 2.0, 1.0)])
def test_a_restart_in_a_gap_is_no_movement(start: tuple[float, float, float]) -> None:
    truth, own, laser = with_gap(31)
    odometry = restarted(own, 45.0, np.array(start))
    fusion, expected = (fuse(each, {"laser": laser}) for each in (odometry, own))
    [(before, after)] = fusion.resets_s
    assert before < 45.0 <= after
    assert fusion.localisation is None
    assert expected.resets_s == ()
    off = errors_m(fusion.poses, truth).max()
    assert off < errors_m(expected.poses, truth).max() + 0.02
    assert np.mean(normalised_error(fusion.poses, truth)) / 3.0 < 1.6


@pytest.mark.parametrize("at_s", [15.0, 45.0])
def test_clocks_do_not_depend_on_a_restart(at_s: float) -> None:
    """Neither while the robot is measured, nor in a gap."""
    _, own, laser = with_gap(35)
    own = PlanarPoses(own.times_s + 0.2, own.poses)
    odometry = restarted(own, at_s, np.zeros(3))
    found, expected = (synchronise(each, laser) for each in (odometry, own))
    assert [one.status for one in found] == [one.status for one in expected] == ["ok", "ok"]
    for one, other in zip(found, expected):
        assert one.offset_s == pytest.approx(0.2, abs=0.02)
        assert one.offset_s == pytest.approx(other.offset_s, abs=5e-3)


@pytest.mark.parametrize("from_s", [10.0, 40.0])
def test_a_stall_is_a_pause(from_s: float) -> None:
    """While the robot is measured, and in a gap."""
    truth, own, laser = with_gap(32)
    fusion = fuse(stalled(own, from_s, from_s + 3.0), {"laser": laser})
    assert fusion.resets_s == ()
    [(begin, end)] = fusion.pauses_s
    assert begin == pytest.approx(from_s, abs=0.1)
    assert end == pytest.approx(from_s + 3.0, abs=0.1)
    assert len(fusion.rejected) < 0.01 * len(laser)
    assert np.mean(normalised_error(fusion.poses, truth)) / 3.0 < 1.6
    inside = own.during(laser.times_s[0], laser.times_s[-1])
    np.testing.assert_array_equal(fusion.poses.times_s, own.times_s[inside])


def test_a_robot_that_rests_has_not_stalled() -> None:
    times_s = np.arange(0.0, 60.0, 0.02)
    poses = np.zeros((len(times_s), 3))
    poses[:, 0] = 0.5 * np.clip(times_s - 20.0, 0.0, 20.0)
    found = continuous_odometry(PlanarPoses(times_s, poses))
    assert found.resets_s == ()
    np.testing.assert_array_equal(found.poses.poses, poses)


@given(st.integers(0, 2**32 - 1), st.floats(1.0, 30.0), st.floats(-3.0, 3.0))
def test_odometry_goes_on_from_where_it_was(seed: int, off_m: float, turned: float) -> None:
    """After any restart its steps are what they were."""
    _, own = drive(np.random.default_rng(seed), 20.0, WHEELS)
    broken = restarted(own, 10.0, own.poses[500] + [off_m, -off_m, turned])
    poses, resets_s = continuous_odometry(broken)
    assert len(resets_s) == 1
    steps, expected = (between(each.poses[:-1], each.poses[1:]) for each in (poses, own))
    different = np.flatnonzero(np.abs(steps - expected).max(axis=1) > 1e-6)
    assert len(different) <= 1  # the one at which it began anew


@pytest.mark.parametrize(("step_m", "step_rad"), [(0.01, 0.01), (0.01, np.pi / 180.0)])
def test_rounded_odometry_is_believed_to_its_last_digit(step_m: float, step_rad: float) -> None:
    truth, own, laser = with_gap(33)
    steps = np.array([step_m, step_m, step_rad])
    fusion = fuse(PlanarPoses(own.times_s, steps * np.rint(own.poses / steps)), {"laser": laser})
    assert len(fusion.rejected) < 0.005 * len(laser)
    measured = ~fusion.poses.during(30.0, 60.0)
    squared = normalised_error(fusion.poses, truth)
    assert np.mean(squared[measured]) / 3.0 < 1.3
    assert squared[measured].max() < 30.0


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_a_scale_that_is_known_is_no_random_error(scale: float) -> None:
    """Gaps are bridged about as certainly as with wheels of the right size."""
    truth, own, laser = with_gap(34)
    scaled = PlanarPoses(own.times_s, own.poses * [scale, scale, 1.0])
    fusion, expected = (fuse(each, {"laser": laser}) for each in (scaled, own))
    assert fusion.odometry.distance_scale == pytest.approx(1.0 / scale - 1.0, abs=0.01)
    sigmas = []
    for found in (fusion, expected):
        assert found.poses.covariances is not None
        sigmas.append(np.sqrt(found.poses.covariances[found.poses.during(40.0, 50.0), 0, 0].max()))
    assert sigmas[0] < 1.6 * sigmas[1]
    assert np.mean(normalised_error(fusion.poses, truth)) / 3.0 < 1.6
