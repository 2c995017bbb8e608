"""Covariances below what a stream's jitter shows, and errors that all of its poses share."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.fusion.stream_errors import (
    jitter_ratio,
    read_common_covariance,
    with_common,
    with_jitter_covered,
    with_usable_covariances,
    without_common,
)
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses
from tests.groundtruth.fusion.drives import drive, measure, normalised_error

COVARIANCE = np.diag([4e-6, 9e-6, 1e-5])


@pytest.mark.parametrize("rate_hz", [5.0, 12.5, 75.0])
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_jitter_is_told_from_motion(rate_hz: float, factor: float) -> None:
    rng = np.random.default_rng(5)
    truth, _ = drive(rng, 60.0, FuseSettings(distance_sigma=0.0, lateral_sigma=0.0, turn_sigma=0.0,
                                             turn_per_metre_sigma=0.0))  # fmt: skip
    poses = measure(rng, truth, np.arange(0.0, 59.9, 1.0 / rate_hz), COVARIANCE)
    stated = PlanarPoses(poses.times_s, poses.poses, COVARIANCE[None] / factor**2
                         * np.ones((len(poses), 1, 1)))  # fmt: skip
    assert jitter_ratio(stated) == pytest.approx(factor, rel=0.2)
    covered, raised = with_jitter_covered(stated)
    assert (raised > 1.0) == (factor > 1.0)
    assert covered.covariances is not None
    assert covered.covariances[0] == pytest.approx(COVARIANCE, rel=0.4)


@pytest.mark.parametrize("phases_s", [(0.0, 0.03, 0.11), (0.0, 0.06)])
def test_cameras_that_are_not_triggered_together_do_not_jitter(phases_s: tuple[float, ...]) -> None:
    rng = np.random.default_rng(8)
    truth, odometry = drive(rng, 60.0, FuseSettings(distance_sigma=0.006, turn_sigma=0.008))
    times_s = np.sort(np.add.outer(np.arange(0.0, 59.5, 0.2), phases_s).ravel())
    poses = measure(rng, truth, times_s, COVARIANCE)
    assert jitter_ratio(poses) == pytest.approx(1.0, abs=0.2)
    fusion = fuse(odometry, {"camera": poses})
    assert 0.7 < float(np.mean(normalised_error(fusion.poses, truth))) / 3.0 < 1.5


def test_a_fusion_with_covariances_three_times_too_small_is_honest() -> None:
    rng = np.random.default_rng(6)
    wheels = FuseSettings(distance_sigma=0.006, lateral_sigma=0.001, turn_sigma=0.008)
    truth, odometry = drive(rng, 60.0, wheels)
    laser = measure(rng, truth, np.arange(0.0, 59.9, 0.08), COVARIANCE)
    assert laser.covariances is not None
    laser = PlanarPoses(laser.times_s, laser.poses, laser.covariances / 9.0)
    fusion = fuse(odometry, {"laser": laser})
    assert fusion.jitter["laser"] == pytest.approx(3.0, rel=0.15)
    assert 0.7 < float(np.mean(normalised_error(fusion.poses, truth))) / 3.0 < 1.5


def test_slow_or_short_streams_say_nothing() -> None:
    still = PlanarPoses(np.arange(100.0), np.zeros((100, 3)), np.tile(np.eye(3), (100, 1, 1)))
    assert jitter_ratio(still) == 0.0
    assert jitter_ratio(still.only(np.arange(3))) == 0.0


def test_common_errors_are_taken_out_and_put_back(tmp_path: Path) -> None:
    common = np.array([[1e-4, 2e-5, 0.0], [2e-5, 2e-4, 1e-6], [0.0, 1e-6, 1e-6]])
    poses = PlanarPoses(np.arange(5.0), np.zeros((5, 3)), np.tile(COVARIANCE + common, (5, 1, 1)))
    own, part = without_common(poses, common)
    assert own.covariances is not None
    assert own.covariances == pytest.approx(np.tile(COVARIANCE, (5, 1, 1)), abs=1e-9)
    again = with_common(own, part).covariances
    assert again == pytest.approx(poses.covariances, abs=1e-9)
    # More than a pose's own covariance: it keeps some of it.
    few, _ = without_common(poses, 3.0 * common)
    assert few.covariances is not None
    assert np.all(np.linalg.eigvalsh(few.covariances) > 0.0)
    # Negligible: nothing changes.
    same, nothing = without_common(poses, 1e-6 * common)
    assert same is poses
    assert not np.any(nothing)
    stream = tmp_path / "laser.csv"
    assert not np.any(read_common_covariance(stream))
    stream.with_suffix(".json").write_text(json.dumps({"common_covariance": common.tolist()}))
    assert read_common_covariance(stream) == pytest.approx(common)
    assert read_common_covariance(tmp_path / "laser.csv.gz") == pytest.approx(common)


def test_precise_poses_are_not_singular() -> None:
    """Covariances of a tenth of a millimetre, as of motion capture, stay as they are."""
    count = 5
    covariances = np.tile(1e-8 * np.eye(3) + 1e-9, (count, 1, 1))
    poses = PlanarPoses(np.linspace(0.0, 0.4, count), np.zeros((count, 3)), covariances)
    usable, repaired = with_usable_covariances("laser", poses)
    assert repaired == 0
    np.testing.assert_array_equal(usable.covariances, covariances)
    rounded = PlanarPoses(poses.times_s, poses.poses, covariances.round(6))
    assert with_usable_covariances("laser", rounded)[1] == count
