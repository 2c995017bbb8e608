"""A stranger's drive: images, a calibration and a trajectory without covariances, to a map."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from detect.cli import main as detect
from slam.cli import main as slam

FRAMES = 40


@pytest.mark.long
def test_a_trajectory_without_covariances_leads_to_a_map(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, drive = project_root / "images" / "e", tmp_path / "drive"
    drive.mkdir()
    shutil.copy(source / "e.cam", drive)
    for number in range(FRAMES):
        shutil.copy(source / "images" / f"e.{number:04d}.jpg", drive)
    times = [f"e.{number:04d} {number + 1}\n" for number in range(FRAMES)]
    (drive / "drive.times").write_text("".join(times))
    trajectory = tmp_path / "drive.tum"
    assert slam(["export", str(source), "--to", "tum", "-o", str(trajectory)]) == 0

    assert detect(["all", str(drive), "--odometry", str(trajectory)]) == 0
    found = str(drive / "associated.circles")
    assert slam(["associate", str(drive), "-o", found]) == 0
    said = capsys.readouterr().err
    assert f"{FRAMES} of {FRAMES} steps state no covariance: taken for 5 % of the way" in said
    assert slam(["map", found, "-o", str(tmp_path / "map")]) == 0
    places = str(tmp_path / "map" / "map.csv")
    assert slam(["localize", found, "--map", places, "-o", str(tmp_path / "l")]) == 0
    assert slam(["ekf", found, "-o", str(tmp_path / "ekf")]) == 0
    assert slam(["export", found, "--to", "g2o", "-o", str(tmp_path / "drive.g2o")]) == 0

    table = json.loads((tmp_path / "map" / "table.json").read_text())
    assert 0.1 < table["table"]["factor"] < 1.3
    truth = json.loads((source / "truth.json").read_text())
    assert 5 <= table["table"]["landmarks"] <= len(truth["discs"]) + 25
    flags = ["--odometry-noise.per-metre", "0.5", "--force"]
    assert slam(["map", found, "-o", str(tmp_path / "map"), *flags]) == 0
    assert "taken for 50 % of the way" in capsys.readouterr().err
    wider = json.loads((tmp_path / "map" / "table.json").read_text())
    assert wider["table"]["odometry"] < table["table"]["odometry"]
