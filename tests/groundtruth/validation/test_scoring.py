"""Errors of poses: known ones come back, and RAWSEEDS' reference figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    interpolate_poses,
    moved_poses,
    planar_alignment,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import score_poses
from tests.groundtruth.comparison import compare_streams


def poses_of(times: list[float], rows: list[list[float]]) -> PlanarPoses:
    return PlanarPoses(np.array(times, dtype=float), np.array(rows, dtype=float).reshape(-1, 3))


@pytest.mark.parametrize("session", ["Bicocca_2009-02-25a", "Bicocca_2009-02-26a"])
def test_reference_figures_of_real_solutions(shared_data: Path, session: str) -> None:
    folder = shared_data / "rawseeds" / "gt"
    truth = read_planar_poses(folder / session / f"{session}-GROUNDTRUTH.csv")
    reference = json.loads((folder / "ate_rpe_reference.json").read_text())
    for name, gap in (("ndt_mcl_0.5.csv", 0.5), (f"{session}-GT-extended.csv", np.inf)):
        expected = reference[f"{session} | {name}"]["GROUNDTRUTH"]
        score = compare_streams(
            read_planar_poses(folder / session / name),
            truth,
            interpolate="poses",
            align=True,
            largest_gap_s=gap,
        )
        assert score.poses == expected["n"]
        assert score.position_mean_m == pytest.approx(expected["toolkit"]["mean"], rel=1e-9)
        assert score.position_sigma_m == pytest.approx(expected["toolkit"]["std"], rel=1e-9)
        assert score.position_rmse_m == pytest.approx(expected["toolkit"]["rmse"], rel=1e-9)


def test_known_errors_come_back() -> None:
    truth = poses_of([0, 1, 2, 3], [[0, 0, 0], [1, 0, 3.1], [1, 1, -3.1], [0, 1, 1]])
    poses = poses_of([0, 1, 2, 3], [[0.3, 0.4, 0.1], [1, 0, -3.1], [1, 1, 3.1], [0, 2, 1]])
    score = score_poses(poses, truth)
    assert score.position_mean_m == pytest.approx((0.5 + 0 + 0 + 1) / 4)
    assert score.position_max_m == pytest.approx(1.0)
    assert score.position_sigma_m == pytest.approx(np.std([0.5, 0, 0, 1], ddof=1))
    across = 2 * np.pi - 6.2  # the short way round
    assert score.angle_mean_rad == pytest.approx((0.1 + across - across) / 4)
    assert score.angle_max_rad == pytest.approx(0.1)
    assert np.isnan(score.normalised_error)
    assert score.normalised == 0


def test_the_normalised_error_counts_both_covariances_and_leaves_singular_ones_out() -> None:
    generator = np.random.default_rng(3)
    count = 2000
    root = np.array([[0.02, 0, 0], [0.01, 0.03, 0], [0.001, 0, 0.002]])
    covariance = root @ root.T
    times = np.arange(float(count))
    truth = PlanarPoses(times, generator.normal(size=(count, 3)))
    noisy = truth.poses + generator.normal(size=(count, 3)) @ root.T
    covariances = np.tile(covariance, (count, 1, 1))
    low, high = chi2.ppf([0.001, 0.999], 3 * count) / (3 * count)
    score = score_poses(PlanarPoses(times, noisy, covariances), truth)
    assert low < score.normalised_error < high
    half = score_poses(
        PlanarPoses(times, noisy, covariances), PlanarPoses(times, truth.poses, covariances)
    )
    assert half.normalised_error == pytest.approx(score.normalised_error / 2)
    covariances[::2] = 0.0
    assert score_poses(PlanarPoses(times, noisy, covariances), truth).normalised == count // 2


def test_interpolation_goes_the_short_way_and_not_across_gaps() -> None:
    poses = poses_of([0, 1, 10], [[0, 0, 3.0], [1, 2, -3.0], [5, 5, 0]])
    between, known = interpolate_poses(poses, np.array([-1, 0, 0.5, 1, 5, 10, 11.0]), 2.0)
    assert known.tolist() == [False, True, True, True, False, True, False]
    np.testing.assert_allclose(between.poses[1], [0.5, 1.0, np.pi], atol=1e-12)
    np.testing.assert_allclose(between.poses[3], [5, 5, 0])


def test_alignment_takes_a_rigid_motion_off() -> None:
    generator = np.random.default_rng(4)
    truth = PlanarPoses(np.arange(20.0), generator.normal(size=(20, 3)))
    c, s = np.cos(2.5), np.sin(2.5)
    moved = PlanarPoses(
        truth.times_s,
        np.column_stack(
            [truth.poses[:, :2] @ np.array([[c, s], [-s, c]]) + [3, -4], truth.poses[:, 2] + 2.5]
        ),
    )
    aligned = moved_poses(moved, planar_alignment(moved, truth))
    np.testing.assert_allclose(aligned.poses[:, :2], truth.poses[:, :2], atol=1e-12)
    assert score_poses(aligned, truth).angle_max_rad < 1e-12


def test_streams_without_a_common_time_are_refused() -> None:
    a = poses_of([0, 1], [[0, 0, 0], [1, 0, 0]])
    b = poses_of([5, 6], [[0, 0, 0], [1, 0, 0]])
    with pytest.raises(GroundTruthError, match="no times in common with the truth"):
        compare_streams(a, b)
    for pair in ((poses_of([], []), a), (a, poses_of([], []))):
        with pytest.raises(GroundTruthError, match="at least one of each"):
            compare_streams(*pair)
