"""Relative errors: known ones come back, RAWSEEDS' reference figures, and evo's formulas."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from redetect.groundtruth.cli import main
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    matched_streams,
    planar_alignment,
    read_planar_poses,
)
from redetect.groundtruth.validation.scoring import (
    Relations,
    read_relations,
    relative_score,
    score_poses,
    score_relations,
    score_steps,
)

SESSIONS = ("Bicocca_2009-02-25a", "Bicocca_2009-02-26a")


def path_of(count: int, seed: int, noise: float = 0.0) -> PlanarPoses:
    """A winding path, its headings past +-pi, with noise if asked for."""
    times = np.arange(float(count))
    heading = 0.2 * times
    xy = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    rng = np.random.default_rng(seed)
    poses = np.column_stack([xy, heading]) + noise * rng.normal(size=(count, 3))
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return PlanarPoses(times, poses)


def test_the_command_gives_every_reference_figure(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "rawseeds" / "gt"
    reference = json.loads((folder / "ate_rpe_reference.json").read_text())
    for session in SESSIONS:
        for name in ("ndt_mcl_0.5.csv", f"{session}-GT-extended.csv"):
            expected = reference[f"{session} | {name}"]
            output = tmp_path / f"{session}-{name}.json"
            arguments = [
                "score", str(folder / session / name),
                str(folder / session / f"{session}-GROUNDTRUTH.csv"),
                "--interpolate", "poses", "--align", "--largest-gap-s", "inf",
                "--relations", str(folder / session / f"{session}.relations"),
                "--rpe-step", "50", "--json", str(output),
            ]  # fmt: skip
            assert main(arguments) == 0
            found = json.loads(output.read_text())
            truth = expected["GROUNDTRUTH"]
            toolkit = truth["toolkit"]
            assert found["poses"] == truth["n"]
            assert found["position_mean_m"] == pytest.approx(toolkit["mean"], abs=1e-9)
            assert found["position_sigma_m"] == pytest.approx(toolkit["std"], abs=1e-9)
            assert found["position_rmse_m"] == pytest.approx(toolkit["rmse"], abs=1e-9)
            assert found["position_max_m"] == pytest.approx(toolkit["max"], abs=1e-9)
            median = truth["evo_ape_interp"]["median"]
            assert found["position_median_m"] == pytest.approx(median, abs=1e-9)
            turned = np.degrees(found["angle_abs_mean_rad"])
            assert turned == pytest.approx(toolkit["theta_mean_deg"], abs=1e-9)
            np.testing.assert_allclose(found["alignment"], toolkit["align"], atol=1e-9)
            relations, steps = found["relative"]["relations"], found["relative"]["steps of 50"]
            told = expected["relations_toolkit"]
            assert relations["pairs"] == told["n"]
            assert relations["position_rmse_m"] == pytest.approx(told["T_rpe"], abs=1e-9)
            assert relations["position_median_m"] == pytest.approx(told["T_median"], abs=1e-9)
            turned = np.degrees(relations["angle_rmse_rad"])
            assert turned == pytest.approx(told["R_rpe_deg"], abs=1e-9)
            told = truth["rpe50"]
            assert steps["position_rmse_m"] == pytest.approx(told["evo_trans_rmse"], abs=1e-9)
            turned = np.degrees(steps["angle_rmse_rad"])
            assert turned == pytest.approx(told["evo_rot_deg_rmse"], abs=1e-9)
            arguments += ["--rpe-longest-s", "2", "--force"]
            assert main(arguments) == 0
            steps = json.loads(output.read_text())["relative"]["steps of 50"]
            position, turn, count = told["numpy_ingap_excluded"]
            assert steps["pairs"] == count
            assert steps["position_rmse_m"] == pytest.approx(position, abs=1e-9)
            assert np.degrees(steps["angle_rmse_rad"]) == pytest.approx(turn, abs=1e-9)


def test_reference_figures_against_the_extended_ground_truth(shared_data: Path) -> None:
    folder = shared_data / "rawseeds" / "gt"
    reference = json.loads((folder / "ate_rpe_reference.json").read_text())
    for session in SESSIONS:
        expected = reference[f"{session} | ndt_mcl_0.5.csv"]["GT_extended_toolkit"]
        poses, truth, _ = matched_streams(
            read_planar_poses(folder / session / "ndt_mcl_0.5.csv"),
            read_planar_poses(folder / session / f"{session}-GT-extended.csv"),
            largest_gap_s=np.inf,
            interpolate="poses",
        )
        c, s = np.cos((motion := planar_alignment(poses, truth))[2]), np.sin(motion[2])
        moved = poses.poses @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + motion
        score = score_poses(PlanarPoses(poses.times_s, moved), truth)
        assert score.poses == expected["n"]
        assert score.position_mean_m == pytest.approx(expected["mean"], abs=1e-9)
        assert score.position_sigma_m == pytest.approx(expected["std"], abs=1e-9)
        assert score.position_rmse_m == pytest.approx(expected["rmse"], abs=1e-9)
        assert score.position_max_m == pytest.approx(expected["max"], abs=1e-9)


def test_known_relative_errors_come_back() -> None:
    truth = np.array([[1.0, 0.0, 3.0], [0.0, 2.0, 0.0]])
    # The second error is 5 cm long whichever way the robot looks.
    poses = np.array([[1.0, 0.0, -3.0], [0.03, 2.04, 0.0]])
    score = relative_score(truth, poses, 7)
    assert (score.pairs, score.unmatched) == (2, 7)
    assert score.position_rmse_m == pytest.approx(0.05 / np.sqrt(2))
    assert score.position_max_m == pytest.approx(0.05)
    assert score.angle_max_rad == pytest.approx(2 * np.pi - 6.0)
    assert score.angle_abs_mean_rad == pytest.approx((2 * np.pi - 6.0) / 2)


def test_a_moved_world_makes_no_relative_error_and_order_does_not_matter() -> None:
    truth = path_of(60, 1)
    c, s = np.cos(2.0), np.sin(2.0)
    moved = truth.poses @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [3.0, -4.0, 2.0]
    poses = PlanarPoses(truth.times_s, moved)
    score = score_steps(poses, truth, 7)
    assert score.pairs == 53
    assert score.position_max_m < 1e-12
    assert score.angle_max_rad < 1e-12
    backward = Relations(np.array([9.0, 1.0]), np.array([2.0, 40.0]), np.zeros((2, 3)))
    a = score_relations(truth, backward)
    b = score_relations(poses, backward)
    assert a.position_rmse_m == pytest.approx(b.position_rmse_m, abs=1e-12)


def test_pairs_across_gaps_do_not_count() -> None:
    times = np.array([0.0, 1.0, 2.0, 300.0, 301.0])
    truth = PlanarPoses(times, np.zeros((5, 3)))
    poses = PlanarPoses(times, np.array([[0, 0, 0.0]] * 3 + [[1, 0, 0.0]] * 2))
    assert score_steps(poses, truth, 1).position_max_m == 1.0
    score = score_steps(poses, truth, 1, longest_s=5.0)
    assert (score.pairs, score.unmatched, score.position_max_m) == (3, 1, 0.0)
    relations = Relations(np.array([0.5, 0.5]), np.array([1.5, 100.0]), np.zeros((2, 3)))
    assert score_relations(poses, relations, 5.0).pairs == 1


def test_what_cannot_be_compared_is_refused(tmp_path: Path) -> None:
    poses = path_of(5, 2)
    with pytest.raises(GroundTruthError, match="no two times"):
        score_steps(poses, poses, 5)
    far = Relations(np.array([90.0]), np.array([91.0]), np.zeros((1, 3)))
    with pytest.raises(GroundTruthError, match="no two times"):
        score_relations(poses, far)
    path = tmp_path / "a.relations"
    for text, message in (
        ("1 2 0 0 0 0 0\n", ":1: 7 words: expected t_i"),
        ("0 1 0 0 0 0 0 0\n1 2 0 x 0 0 0 0\n", ":2: 'x'"),
        ("# nothing\n", "contains no relations"),
    ):
        path.write_text(text)
        with pytest.raises(GroundTruthError, match=message):
            read_relations(path)


def test_evo_computes_the_same() -> None:
    reason = "evo, the oracle of the formulas, is not installed"
    metrics: Any = pytest.importorskip("evo.core.metrics", reason=reason)
    trajectory: Any = pytest.importorskip("evo.core.trajectory", reason=reason)

    truth, poses = path_of(200, 3), path_of(200, 4, 0.05)

    def evo(stream: PlanarPoses) -> Any:
        x, y, theta = stream.poses.T
        zero = np.zeros_like(x)
        quaternions = np.column_stack([np.cos(theta / 2), zero, zero, np.sin(theta / 2)])
        return trajectory.PoseTrajectory3D(
            np.column_stack([x, y, zero]), quaternions, stream.times_s
        )

    def figures(metric: Any) -> Any:
        metric.process_data((evo(truth), evo(poses)))
        return metric.get_all_statistics()

    part = metrics.PoseRelation
    absolute = score_poses(poses, truth)
    expected = figures(metrics.APE(part.translation_part))
    assert absolute.position_rmse_m == pytest.approx(expected["rmse"], rel=1e-9)
    assert absolute.position_mean_m == pytest.approx(expected["mean"], rel=1e-9)
    assert absolute.position_median_m == pytest.approx(expected["median"], rel=1e-9)
    assert absolute.position_max_m == pytest.approx(expected["max"], rel=1e-9)
    expected = figures(metrics.APE(part.rotation_angle_rad))
    assert absolute.angle_abs_mean_rad == pytest.approx(expected["mean"], rel=1e-7)
    assert absolute.angle_max_rad == pytest.approx(expected["max"], rel=1e-7)
    for step in (1, 50):
        relative = score_steps(poses, truth, step)
        shift = {"delta": step, "delta_unit": metrics.Unit.frames, "all_pairs": True}
        expected = figures(metrics.RPE(part.translation_part, **shift))
        assert relative.position_rmse_m == pytest.approx(expected["rmse"], rel=1e-9)
        assert relative.position_median_m == pytest.approx(expected["median"], rel=1e-9)
        expected = figures(metrics.RPE(part.rotation_angle_rad, **shift))
        assert relative.angle_rmse_rad == pytest.approx(expected["rmse"], rel=1e-7)
