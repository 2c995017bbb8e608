"""Odometry that is a localisation: recognised, bridged without drift, honest; others are not."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from redetect.groundtruth.cli import main
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.fusion.fuse import fuse, leave_out
from redetect.groundtruth.fusion.sync import synchronise
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, moved_poses, write_planar_poses
from redetect.landmarks import wrap_angle
from redetect.plane import rotation
from tests.groundtruth.fusion.drives import drive, measure

FloatArray = NDArray[np.float64]
SIGMAS = np.array([0.06, 0.06, 0.03])
LASTING_S = np.array([8.0, 8.0, 3.0])
LASER = np.diag(np.square([2e-3, 2e-3, 3e-3]))
VISITS = ((1.0, 21.0), (150.0, 170.0), (300.0, 320.0))


def localisation(rng: np.random.Generator, rate_hz: float = 10.0) -> tuple[PlanarPoses, ...]:
    """A true path, and the same moved rigidly with stationary errors."""
    truth, _ = drive(rng, 322.0, FuseSettings(), rate_hz=rate_hz)
    share = np.exp(-1.0 / rate_hz / LASTING_S)
    errors = np.empty((len(truth), 3))
    errors[0] = rng.normal(size=3) * SIGMAS
    for k in range(1, len(truth)):
        fresh = rng.normal(size=3) * SIGMAS * np.sqrt(1.0 - share**2)
        errors[k] = share * errors[k - 1] + fresh
    moved = moved_poses(PlanarPoses(truth.times_s, truth.poses + errors), np.array([9.0, 3.0, 2.0]))
    poses = moved.poses.copy()
    poses[:, 2] = wrap_angle(poses[:, 2])
    return truth, PlanarPoses(truth.times_s, poses)


def visits(rng: np.random.Generator, truth: PlanarPoses) -> PlanarPoses:
    """Poses measured in three visits, with the deviations that they state."""
    times = np.concatenate([np.arange(begin, end, 0.04) for begin, end in VISITS])
    return measure(rng, truth, times, LASER)


def test_wheels_are_no_localisation_if_another_stream_is_late() -> None:
    """What contradicts both models says nothing of odometry."""
    rng = np.random.default_rng(5)
    wheels = FuseSettings(distance_sigma=0.006, lateral_sigma=0.001, turn_sigma=0.008)
    truth, odometry = drive(rng, 322.0, wheels)
    laser = visits(rng, truth)
    times_s = np.concatenate([np.arange(begin, end, 0.1) for begin, end in VISITS])
    seen = measure(rng, truth, times_s, np.diag(np.square([0.03, 0.03, 0.03])))
    late = PlanarPoses(times_s + 0.3, seen.poses, seen.covariances)
    fusion = fuse(odometry, {"laser": laser, "camera": late})
    assert fusion.localisation is None
    assert sum(one.stream == "camera" for one in fusion.rejected) > 0.5 * len(late)


def test_a_localisation_bridges_gaps_without_drift() -> None:
    found = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth, odometry = localisation(rng)
        laser = visits(rng, truth)
        (segment,) = leave_out(odometry, {"laser": laser})
        found.append(segment)
        assert segment.position_rms_m < 0.2
        assert segment.heading_rms_rad < np.radians(3.0)
        errors = fuse(odometry, {"laser": laser}).localisation
        assert errors is not None
        assert 0.02 < errors.position_sigma < 0.15
        assert 0.015 < errors.heading_sigma < 0.06
    fused = np.mean([segment.position_rms_m**2 for segment in found])
    aligned = np.mean([segment.aligned_position_rms_m**2 for segment in found])
    assert fused < 1.1 * aligned
    # A few times its correlation time long, a visit has some ten independent numbers.
    assert 0.5 < np.mean([segment.normalised_error for segment in found]) < 1.8


def test_a_localisation_may_be_that_of_another_point_on_the_robot() -> None:
    forward_and_left_m, squared_m2 = np.array([0.25, -0.15]), np.zeros(2)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth, odometry = localisation(rng)
        laser = {"laser": visits(rng, truth)}
        shift = (rotation(odometry.poses[:, 2]) @ forward_and_left_m[:, None])[..., 0]
        poses = np.column_stack([odometry.poses[:, :2] - shift, odometry.poses[:, 2]])
        shifted = PlanarPoses(odometry.times_s, poses)
        errors = fuse(shifted, laser).localisation
        assert errors is not None
        assert [errors.forward_m, errors.left_m] == pytest.approx(forward_and_left_m, abs=0.06)
        assert errors.position_sigma < 0.1
        both = (leave_out(one, laser)[0] for one in (odometry, shifted))
        squared_m2 += [segment.position_rms_m**2 for segment in both]
    assert squared_m2[1] < 1.5 * squared_m2[0]


def test_odometry_that_drifts_is_no_localisation() -> None:
    rng = np.random.default_rng(3)
    truth, odometry = drive(rng, 322.0, FuseSettings(), rate_hz=10.0)
    fusion = fuse(odometry, {"laser": visits(rng, truth)})
    assert fusion.localisation is None


def test_jitter_of_headings_is_no_share_of_turns() -> None:
    """With the given noise: from sample to sample, jitter would pass for turns that were none."""
    rng = np.random.default_rng(5)
    truth, _ = drive(rng, 322.0, FuseSettings(), rate_hz=10.0)
    jitter = rng.normal(size=(len(truth), 3)) * [0.005, 0.005, 0.02]
    odometry = PlanarPoses(truth.times_s, truth.poses + jitter)
    laser = visits(rng, truth)
    settings = FuseSettings(learn_noise=False)
    assert abs(fuse(odometry, {"laser": laser}, settings).odometry.turn_scale) < 0.01
    (segment,) = leave_out(odometry, {"laser": laser}, settings)
    assert segment.position_rms_m < 0.3


def test_the_clock_of_a_localisation_stays_within_the_bounds() -> None:
    rng = np.random.default_rng(2)
    truth, odometry = localisation(rng)
    for segment in synchronise(odometry, visits(rng, truth)):
        assert abs(segment.rate - 1.0) <= 0.01
        assert abs(segment.offset_s) < 0.15


def test_each_segment_between_others_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    truth, odometry = localisation(rng)
    laser = visits(rng, truth)
    write_planar_poses(tmp_path / "odometry.csv", odometry)
    write_planar_poses(tmp_path / "laser.csv", laser)
    files = [str(tmp_path / name) for name in ("odometry.csv", "laser.csv", "fused.csv")]
    assert main(["fuse", files[0], "--laser", files[1], "-o", files[2], "--leave-out"]) == 0
    assert "without 150.0 s to 170.0 s: predicted to" in capsys.readouterr().out
    account = json.loads((tmp_path / "fused.json").read_text())
    assert len(account["left_out"]) == 1
    assert account["localisation"]["position_sigma"] > 0.0

    # A segment without odometry cannot be predicted; that of a single pose can.
    away = (odometry.times_s < 145.0) | (odometry.times_s > 175.0)
    single = (laser.times_s < 145.0) | (laser.times_s > 175.0)
    single[np.flatnonzero(~single)[0]] = True
    (none,) = leave_out(odometry.only(away), {"laser": laser})
    (one,) = leave_out(odometry, {"laser": laser.only(single)})
    assert none.poses == 0
    assert math.isnan(none.normalised_error)
    assert one.poses == 1
    assert one.position_rms_m < 1.0

    first = laser.times_s < 100.0
    alone = PlanarPoses(
        laser.times_s[first],
        laser.poses[first],
        None if laser.covariances is None else laser.covariances[first],
    )
    with pytest.raises(GroundTruthError, match="expected 3 or more"):
        leave_out(odometry, {"laser": alone})
