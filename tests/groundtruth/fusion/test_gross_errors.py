"""Gross errors and wrong covariances of measured poses, which must not reach the fused path."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from redetect.groundtruth.cli import main
from redetect.groundtruth.fusion.fuse import fuse
from redetect.groundtruth.fusion.stream_errors import jitter_ratio
from redetect.groundtruth.settings import FuseSettings
from redetect.groundtruth.trajectories.streams import PlanarPoses, write_planar_poses
from tests.groundtruth.fusion.drives import drive, measure, normalised_error

WHEELS = FuseSettings(
    distance_sigma=0.006, lateral_sigma=0.002, turn_sigma=0.008, turn_per_metre_sigma=0.004
)
COVARIANCE = np.diag([2.5e-5, 2.5e-5, 1.6e-5])
GAP_S = (40.0, 60.0)


def session(seed: int, rate_hz: float = 50.0) -> tuple[PlanarPoses, PlanarPoses, PlanarPoses]:
    """True path, odometry, and measured poses with a gap."""
    rng = np.random.default_rng(seed)
    truth, odometry = drive(rng, 90.0, WHEELS)
    odometry = odometry.only(slice(None, None, round(50.0 / rate_hz)))
    laser = measure(rng, truth, np.arange(0.013, 89.0, 0.08), COVARIANCE)
    return truth, odometry, laser.only(~laser.during(*GAP_S))


def errors(path: PlanarPoses, truth: PlanarPoses) -> tuple[float, float]:
    """Normalised errors per number where poses are measured, and in the gap."""
    squared, inside = normalised_error(path, truth) / 3.0, path.during(*GAP_S)
    return float(np.mean(squared[~inside])), float(np.mean(squared[inside]))


@pytest.mark.parametrize("wrong", [1, 3])
def test_wrong_first_poses_are_rejected(wrong: int) -> None:
    _, odometry, laser = session(1)
    spoilt = PlanarPoses(laser.times_s, laser.poses.copy(), laser.covariances)
    spoilt.poses[:wrong] += np.array([[0.8, -0.5, 0.1], [-0.4, 1.0, 0.0], [0.3, 0.3, 0.3]])[:wrong]
    fusion = fuse(odometry, {"laser": spoilt})
    expected = fuse(odometry, {"laser": laser.only(slice(wrong, None))})
    late = slice(len(fusion.poses) - len(expected.poses), None)
    np.testing.assert_allclose(fusion.poses.poses[late], expected.poses.poses, atol=1e-4)
    assert [one.time_s for one in fusion.rejected[:wrong]] == laser.times_s[:wrong].tolist()
    assert all(one.squared_innovation > 20.0 for one in fusion.rejected[:wrong])


def test_after_a_gap_a_carried_robot_is_where_most_poses_say() -> None:
    _, odometry, laser = session(6)
    after = laser.times_s > GAP_S[1]
    turn = np.array([[0.36, 0.93], [-0.93, 0.36]])
    moved = laser.poses.copy()
    moved[after, :2] = moved[after, :2] @ turn + [4.0, -3.0]
    moved[after, 2] += math.acos(0.36)
    carried = fuse(odometry, {"laser": PlanarPoses(laser.times_s, moved, laser.covariances)})
    moved[np.flatnonzero(after)[:2], :2] += 2.0
    spoilt = fuse(odometry, {"laser": PlanarPoses(laser.times_s, moved, laser.covariances)})
    seen = carried.poses.times_s > GAP_S[1] + 0.5
    np.testing.assert_allclose(
        spoilt.poses.poses[seen, :2], carried.poses.poses[seen, :2], atol=0.02
    )
    assert len(spoilt.restarts_s) == 1


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_many_gross_errors_leave_the_result_as_it_is(share: float) -> None:
    truth, odometry, laser = session(2)
    assert laser.covariances is not None
    rng = np.random.default_rng(3)
    gross = rng.random(len(laser)) < share
    poses = laser.poses + gross[:, None] * rng.normal(0.0, [2.0, 2.0, 0.7], (len(laser), 3))
    spoilt = PlanarPoses(laser.times_s, poses, laser.covariances)
    assert jitter_ratio(spoilt) == pytest.approx(1.0, rel=0.1)
    fusion = fuse(odometry, {"laser": spoilt})
    clean = fuse(odometry, {"laser": laser.only(~gross)})
    assert len(fusion.rejected) == pytest.approx(np.count_nonzero(gross), rel=0.03)
    assert fusion.odometry.distance_sigma == pytest.approx(clean.odometry.distance_sigma, rel=0.35)
    assert fusion.odometry.turn_sigma == pytest.approx(clean.odometry.turn_sigma, rel=0.35)
    assert errors(fusion.poses, truth) == pytest.approx(errors(clean.poses, truth), rel=0.3)


@pytest.mark.parametrize("factor", [0.0, 0.1, 3.0, 10.0])
def test_wrong_covariances_do_not_make_gaps_too_certain(factor: float) -> None:
    found = []
    for seed in range(4):
        truth, odometry, laser = session(10 + seed)
        assert laser.covariances is not None
        stated = PlanarPoses(laser.times_s, laser.poses, factor**2 * laser.covariances)
        found.append(errors(fuse(odometry, {"laser": stated}).poses, truth))
    seen, bridged = np.mean(found, axis=0)
    assert seen < 1.3
    assert 0.3 < bridged < 1.6


def test_slow_odometry_bends_between_its_samples() -> None:
    truth, odometry, laser = session(4, rate_hz=2.0)
    assert errors(fuse(odometry, {"laser": laser}).poses, truth)[0] < 1.6


def test_mirrored_odometry_is_noticed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, odometry, laser = session(5)
    mirrored = PlanarPoses(odometry.times_s, odometry.poses * [1.0, -1.0, -1.0])
    write_planar_poses(tmp_path / "odometry.csv", mirrored)
    write_planar_poses(tmp_path / "laser.csv", laser)
    files = [str(tmp_path / name) for name in ("odometry.csv", "laser.csv", "fused.csv")]
    assert main(["fuse", files[0], "--laser", files[1], "-o", files[2]]) == 0
    assert "are its angles radians, counter-clockwise?" in capsys.readouterr().err
