"""Drives with a camera of one's own, from images, odometry and calibration to a map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from detect.cli import main as detect
from redetect.array_types import FloatArray
from redetect.landmarks.axes import from_dataset
from redetect.landmarks.map_file import read_path
from redetect.plane import between, chain_steps
from redetect.slam.cli import main as slam
from redetect.slam.models import OdometryNoise
from tools.ros_bags import Ros, Said

FRAMES = 40
TIMES = 1000.0 + 0.5 * np.arange(FRAMES)
NAMES = [f"e.{number:04d}" for number in range(FRAMES)]
WHEEL_BASE, TICK = 0.5, 0.0005
# Standard deviations of a step forward and to the left (m), and of its turn, that the bag states.
STATED = np.array([0.02, 0.01, 0.015])


def steps_with_noise(true_poses: FloatArray, sigma: FloatArray) -> FloatArray:
    """True steps with errors of standard deviations (left, backward, turn)."""
    steps = between(true_poses[:-1], true_poses[1:])
    return steps + sigma * np.random.default_rng(3).standard_normal(steps.shape)


def assumed_sigma(true_poses: FloatArray) -> FloatArray:
    steps = between(true_poses[:-1], true_poses[1:])
    return np.sqrt(np.diagonal(OdometryNoise().covariance(steps), axis1=1, axis2=2))


def image_folder(source: Path, folder: Path) -> Path:
    folder.mkdir()
    for name in NAMES:
        shutil.copy(source / "images" / f"{name}.jpg", folder)
    shutil.copy(source / "e.cam", folder)
    rows = [f"{name} {time_s}\n" for name, time_s in zip(NAMES, TIMES)]
    (folder / f"{folder.name}.times").write_text("".join(rows))
    return folder


def trajectory(source: Path, folder: Path, true_poses: FloatArray) -> list[str]:
    """A TUM file: X forward, Y left."""
    drive = image_folder(source, folder / "drive")
    poses = chain_steps(steps_with_noise(true_poses, assumed_sigma(true_poses)))
    half = 0.5 * (poses[:, 2] - 0.5 * np.pi)
    zero = np.zeros(FRAMES)
    columns = [TIMES, *poses[:, :2].T, zero, zero, zero, np.sin(half), np.cos(half)]
    np.savetxt(folder / "drive.tum", np.column_stack(columns), fmt="%.9f")
    return [str(drive), "--odometry", str(folder / "drive.tum")]


def ticks(source: Path, folder: Path, true_poses: FloatArray) -> list[str]:
    """Counters of two wheels."""
    drive = image_folder(source, folder / "drive")
    steps = steps_with_noise(true_poses, assumed_sigma(true_poses))
    way = -steps[:, 1] / np.sinc(steps[:, 2] / np.pi)
    ways = np.column_stack(
        [way - 0.5 * WHEEL_BASE * steps[:, 2], way + 0.5 * WHEEL_BASE * steps[:, 2]]
    )
    counts = np.rint(np.cumsum(np.vstack([np.zeros((1, 2)), ways]), axis=0) / TICK)
    np.savetxt(folder / "drive.ticks", np.column_stack([TIMES, counts]), fmt="%.3f %d %d")
    wheels = ["--wheel-base-m", str(WHEEL_BASE), "--metres-per-tick", str(TICK)]
    return [str(drive), "--odometry", str(folder / "drive.ticks"), *wheels]


def bag(source: Path, folder: Path, true_poses: FloatArray) -> list[str]:
    """A bag whose poses always have the same covariance; that of the twist is right."""
    ros = Ros()
    poses = chain_steps(steps_with_noise(true_poses, STATED[[1, 0, 2]]))
    said = []
    for name, time_s, (x, y, theta) in zip(NAMES, TIMES, poses.tolist()):
        image = (source / "images" / f"{name}.jpg").read_bytes()
        rates = np.diag(np.square(STATED / 0.5))
        odometry = ros.odometry(x, y, theta - 0.5 * np.pi, time_s, 0.01 * np.eye(3), rates)
        said.append(Said("/odom", time_s, odometry))
        said.append(Said("/image", time_s, ros.compressed(image, "jpeg", time_s)))
    shutil.copy(source / "e.cam", folder)
    return [str(ros.write(folder / "drive", said))]


@pytest.mark.long
@pytest.mark.parametrize("recorded", [trajectory, ticks, bag])
def test_from_the_files_to_the_map(
    recorded: Callable[[Path, Path, FloatArray], list[str]],
    project_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = project_root / "images" / "e"
    truth = json.loads((source / "truth.json").read_text())
    true_poses = np.array([frame["pose"] for frame in truth["frames"][:FRAMES]])
    arguments = recorded(source, tmp_path, true_poses)
    run, start = tmp_path / "run", ["--start", *map(str, true_poses[0])]
    found = str(run / "found.circles")

    def off(result: str) -> float:
        """Root mean square of the distances of the path from the true one (m)."""
        path = read_path(tmp_path / result / "path.csv").poses
        shift = path[1:, :2] - true_poses[:, :2]
        return float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))

    assert detect(["all", *arguments, "-o", str(run)]) == 0
    assert slam(["associate", str(run), "-o", found]) == 0
    unstated = 1 if recorded is bag else FRAMES  # before the first image there is no movement
    assert f"{unstated} of {FRAMES} steps have no covariance: assumed 5 % of distance" in (
        capsys.readouterr().err
    )
    assert slam(["map", found, *start, "-o", str(tmp_path / "map")]) == 0
    map_file = str(tmp_path / "map" / "map.csv")
    assert slam(["localize", found, *start, "--map", map_file, "-o", str(tmp_path / "l")]) == 0
    assert slam(["ekf", found, *start, "-o", str(tmp_path / "ekf")]) == 0
    table = json.loads((tmp_path / "map" / "table.json").read_text())["table"]
    assert table["factor"] < 1.0  # rows state a tilt of the whole run, which no frame contradicts
    assert table["odometry"] / (3 * (FRAMES - 1)) == pytest.approx(1.0, abs=0.3)
    assert max(off(name) for name in ("map", "l", "ekf")) < 0.02

    for form, name in (("g2o", "drive.g2o"), ("csv", "tables")):
        assert slam(["export", found, "--to", form, "-o", str(tmp_path / name)]) == 0
    assert capsys.readouterr().err.count("steps have no covariance") == 5
    times = ["--times", str(run / "detected.times"), "-o", str(tmp_path / "map.tum")]
    assert slam(["export", str(tmp_path / "map" / "path.csv"), "--to", "tum", *times]) == 0
    exported = np.loadtxt(tmp_path / "map.tum")
    np.testing.assert_allclose(exported[:, 0], TIMES, atol=1e-6)
    path = read_path(tmp_path / "map" / "path.csv").poses
    np.testing.assert_allclose(exported[:, 1:3], from_dataset(path)[1:, :2])
