"""The command validate: known errors come back, both covariances count, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from redetect.groundtruth.cli import main
from redetect.groundtruth.lasers.building import read_building
from redetect.groundtruth.lasers.scanners import Robot, Scanner, Scans
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    read_planar_poses,
    write_planar_poses,
)
from redetect.groundtruth.validation.onboard import reference_poses
from redetect.groundtruth.validation.reference_poses import Distance, Survey, poses_from_distances
from redetect.groundtruth.validation.scoring import (
    normalised_band,
    normalised_errors,
    reference_errors,
    score_poses,
)
from tests.groundtruth.validation.test_validate_references import measured
from tools.simulator.laser.session_files import (
    write_building,
    write_distances,
    write_robot,
    write_scans,
    write_survey,
)

FloatArray = NDArray[np.float64]

SURVEY = Survey(
    {"SW": np.zeros(2), "SE": np.array([8.0, 0.0]), "NW": np.array([0.0, 6.0])},
    {"l": np.array([0.2, 0.3]), "r": np.array([0.2, -0.3]), "b": np.array([-0.4, 0.0])},
    0.004,
)
# x, y, theta of a standing robot, one every ten seconds.
STANDS = np.array([[2.0, 3.0, 0.5], [5.0, 2.0, 3.1], [4.0, 4.5, -1.0], [3.0, 1.5, 2.0]])
CLOCK_OFFSET_S = 3.0


def distances_at(stands: FloatArray, rng: np.random.Generator | None = None) -> list[Distance]:
    return [
        row
        for k, pose in enumerate(stands)
        for row in measured(pose, SURVEY, rng, stand=k, time_s=10.0 * k)
    ]


def ground_truth(stands: FloatArray, covariance: FloatArray | None = None) -> PlanarPoses:
    times = np.concatenate([[10.0 * k - 0.2, 10.0 * k + 0.2] for k in range(len(stands))])
    covariances = None if covariance is None else np.tile(covariance, (len(times), 1, 1))
    return PlanarPoses(times, np.repeat(stands, 2, axis=0), covariances)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A robot in a room with a scanner on board, whose clock is three seconds ahead."""
    folder = tmp_path / "session"
    folder.mkdir()
    write_survey(folder / "fiducials.json", SURVEY)
    write_distances(folder / "distances.csv", distances_at(STANDS, np.random.default_rng(1)))
    walls = np.array([[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0]], dtype=float)
    write_building(folder / "building.csv", walls)
    step = math.radians(1.0)
    scanner = Scanner("top", np.zeros(3), np.zeros((3, 3)), -math.pi, step, 360, 30.0, 0.01)
    outline = np.array([[0.3, 0.3], [-0.4, 0.3], [-0.4, -0.3], [0.3, -0.3]])
    write_robot(folder / "robot.json", Robot(outline, 1.0, 1.0, (scanner,)))
    rng = np.random.default_rng(2)
    times, ranges = [], []
    for k, (x, y, theta) in enumerate(STANDS):
        c, s = np.cos(theta + scanner.angles_rad), np.sin(theta + scanner.angles_rad)
        with np.errstate(divide="ignore"):
            reach = np.minimum(
                np.where(c > 0, (8.0 - x) / c, -x / c), np.where(s > 0, (6.0 - y) / s, -y / s)
            )
        for moment in np.arange(-0.45, 0.46, 0.1):
            times.append(10.0 * k + moment + CLOCK_OFFSET_S)
            ranges.append(np.rint(1e3 * (reach + 0.01 * rng.normal(size=360))).astype(np.uint16))
    write_scans(folder / "top.scans.npz", Scans(np.array(times), np.stack(ranges)))
    segment = {
        "from_s": -1.0, "to_s": 40.0, "reference_s": 0.0, "offset_s": CLOCK_OFFSET_S, "rate": 1.0,
        "angle_rad": 0.0, "sigma_offset_s": 1e-3, "sigma_rate": 1e-6,
        "turned_rad": 10.0, "status": "ok", "note": "",
    }  # fmt: skip
    (folder / "clock.json").write_text(json.dumps({"segments": [segment]}))
    return folder


def test_known_errors_come_back() -> None:
    references, refused = reference_poses(poses_from_distances(SURVEY, distances_at(STANDS)))
    assert not refused
    assert {reference.scans for reference in references} == {"not asked"}
    wrong = STANDS + np.array([0.03, -0.04, 0.1])
    errors, without = reference_errors(references, ground_truth(wrong))
    assert not without
    # The second heading is past pi.
    np.testing.assert_allclose(errors.error, np.tile([0.03, -0.04, 0.1], (4, 1)), atol=1e-7)
    assert np.isnan(normalised_errors(errors.poses, errors.reference_poses)).all()
    figures = score_poses(errors.poses, errors.reference_poses)
    assert figures.position_mean_m == pytest.approx(0.05, abs=1e-7)
    assert figures.position_sigma_m == pytest.approx(0.0, abs=1e-7)
    assert figures.angle_mean_rad == pytest.approx(0.1, abs=1e-7)
    assert figures.normalised == 0
    assert math.isnan(figures.normalised_error)


def test_both_covariances_are_in_the_normalised_error() -> None:
    rng = np.random.default_rng(3)
    covariance = np.diag([0.003, 0.004, 0.006]) ** 2
    total, count = 0.0, 0
    for _ in range(10):
        noisy = STANDS + rng.normal(size=STANDS.shape) * np.sqrt(np.diag(covariance))
        solved = poses_from_distances(SURVEY, distances_at(STANDS, rng))
        references, _ = reference_poses(solved)
        errors, _ = reference_errors(references, ground_truth(noisy, covariance))
        figures = score_poses(errors.poses, errors.reference_poses)
        assert figures.normalised == 4
        low, high = chi2.ppf([0.025, 0.975], 12) / 12
        assert normalised_band(4) == pytest.approx((low, high))
        total, count = total + 12 * figures.normalised_error, count + 12
    low, high = chi2.ppf([0.001, 0.999], count)
    assert low < total < high


def test_a_reference_without_ground_truth_is_named() -> None:
    references, _ = reference_poses(poses_from_distances(SURVEY, distances_at(STANDS)))
    poses = ground_truth(STANDS)
    part = PlanarPoses(poses.times_s[:4], poses.poses[:4])
    errors, without = reference_errors(references, part)
    assert [reference.index for reference in errors.references] == [0, 1]
    assert [entry.index for entry in without] == [2, 3]


def test_the_nearest_pose_counts_as_it_is() -> None:
    """A mean of two poses would be surer than each, by how much depends on their correlation."""
    references, _ = reference_poses(poses_from_distances(SURVEY, distances_at(STANDS)))
    times = np.array([-0.3, 0.1, 9.4, 10.6, 19.9, 20.1, 30.0])
    rows = np.repeat(STANDS, 2, axis=0)[[0, 1, 2, 3, 4, 5, 6]].copy()
    rows[:, 0] += [0.5, 0.001, 0.5, 0.5, 0.002, 0.5, 0.003]
    covariances = np.arange(1.0, 8.0)[:, None, None] * 1e-6 * np.eye(3)
    errors, without = reference_errors(references, PlanarPoses(times, rows, covariances))
    assert [entry.index for entry in without] == [1]  # both are more than half a second away
    assert [reference.index for reference in errors.references] == [0, 2, 3]
    np.testing.assert_allclose(errors.error[:, 0], [0.001, 0.002, 0.003], atol=1e-7)
    extra = references[0].covariance[0, 0] + references[0].covariance[1, 1]
    assert errors.sigma[0, 0] == pytest.approx(math.sqrt(2 * 2e-6 + extra))


def test_the_command_writes_the_folder(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    covariance = np.diag([0.002, 0.002, 0.002]) ** 2
    rng = np.random.default_rng(4)
    noisy = STANDS + 0.002 * rng.normal(size=STANDS.shape)
    poses = session / "poses.csv"
    write_planar_poses(poses, ground_truth(noisy, covariance))
    output = session / "validation"
    command = ["validate", str(session), str(poses), "-o", str(output)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "4 (0 refused), 4 refined by scans" in printed
    assert "mean 20 mm, sigma 11; mean +0.15 deg, sigma 1.56 (published)" in printed
    content = json.loads((output / "validation.json").read_text())
    assert content["version"]
    assert content["settings"] == {"refine": "scans"}
    assert set(content["files"]) >= {"distances.csv", "top.scans.npz", "clock.json", "poses.csv"}
    expected = np.hypot(*(noisy - STANDS)[:, :2].T)
    figures = content["figures"]
    assert figures["position_mean_m"] == pytest.approx(expected.mean(), abs=5e-4)
    assert figures["position_max_m"] == pytest.approx(expected.max(), abs=5e-4)
    assert figures["normalised"] == 4
    reference = read_planar_poses(output / "reference.csv")
    np.testing.assert_allclose(reference.poses[:, :2], STANDS[:, :2], atol=1e-3)
    assert reference.covariances is not None
    assert np.sqrt(reference.covariances[:, 0, 0]).max() < 1e-3  # the scans did count
    table = (output / "table.csv").read_text().splitlines()
    assert len(table) == 5
    assert table[0].startswith("pose,t,x_m")
    assert (output / "errors.png").read_bytes().startswith(b"\x89PNG")
    before = {path.name: path.read_bytes() for path in output.iterdir()}
    assert main(command) == 1
    assert "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
    assert before == {path.name: path.read_bytes() for path in output.iterdir()}


def test_without_scans_distances_alone_count(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = session / "poses.csv"
    write_planar_poses(poses, ground_truth(STANDS))
    command = ["validate", str(session), str(poses), "-o", str(session / "v"), "--refine", "none"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "0 refined by scans" in out
    assert "no invertible covariance" in out
    assert main([*command, "--force", "--clock", "absent.json"]) == 1
    assert "--clock is for scans on board" in capsys.readouterr().err
    # Nor does an older picture of scans stay beside the new results.
    (session / "v" / "scans.png").write_bytes(b"old")
    assert main([*command, "--force"]) == 0
    assert not (session / "v" / "scans.png").exists()
    # Without the clock the scans are from another time, when the robot was elsewhere or unseen.
    (session / "clock.json").unlink()
    assert main(["validate", str(session), str(poses), "-o", str(session / "w")]) == 0
    captured = capsys.readouterr()
    assert "no clock.json" in captured.err
    assert "0 refined by scans" in captured.out
    content = json.loads((session / "w" / "validation.json").read_text())
    assert {row["scans"] for row in content["rows"]} == {"no scans"}


def test_walls_elsewhere_do_not_count(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Drawings of a whole city are cut to what can be seen; one of another place is said."""
    poses, building = session / "poses.csv", read_building(session / "building.csv")
    write_planar_poses(poses, ground_truth(STANDS))
    command = ["validate", str(session), str(poses), "-o", str(session / "v"), "--force"]
    assert main(command) == 0
    before = (session / "v" / "table.csv").read_bytes()
    city = np.concatenate([building, building + 5000.0])
    write_building(session / "building.csv", city, overwrite=True)
    assert main(command) == 0
    assert (session / "v" / "table.csv").read_bytes() == before
    write_building(session / "building.csv", building + 5000.0, overwrite=True)
    assert main(command) == 0
    assert "no wall of" in capsys.readouterr().err
    content = json.loads((session / "v" / "validation.json").read_text())
    assert {row["scans"] for row in content["rows"]} == {"no scans"}


def test_what_cannot_be_validated_is_refused(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = session / "poses.csv"
    write_planar_poses(poses, PlanarPoses(np.array([900.0, 901.0]), np.zeros((2, 3))))
    command = ["validate", str(session), str(poses), "-o", str(session / "v")]
    assert main(command) == 1
    assert "no ground truth at the time of any reference pose" in capsys.readouterr().err
    rows = [row for row in distances_at(STANDS) if row.fiducial == "SW"]
    write_distances(session / "distances.csv", rows, overwrite=True)
    assert main(command) == 1
    err = capsys.readouterr().err
    assert "pose 0: undetermined: too uncertain by its distances" in err
    assert "not a single reference pose" in err
    write_distances(session / "distances.csv", [], overwrite=True)
    assert main(command) == 1
    assert "no distances in it" in capsys.readouterr().err
    assert not (session / "v").exists()
