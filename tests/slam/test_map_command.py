"""The command ``slam map``: its files, its table, its refusals."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from camera import read_camera
from redetect.landmarks.map_file import read_map, read_path
from redetect.plane import between
from redetect.slam.cli import main
from redetect.slam.models import disc_in_robot


@pytest.fixture(scope="module")
def demo_run(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """The demo run without its images."""
    folder = tmp_path_factory.mktemp("map") / "e"
    folder.mkdir()
    for name in ("e.cam", "map.circles", "map.lines", "truth.json"):
        shutil.copy(project_root / "images" / "e" / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def both_kinds(demo_run: Path) -> Path:
    output = demo_run.parent / "both"
    assert main(["map", str(demo_run), "--circles", "--lines", "-o", str(output)]) == 0
    return output


@pytest.mark.lowest
def test_landmarks_stand_where_they_truly_are(demo_run: Path, both_kinds: Path) -> None:
    truth = json.loads((demo_run / "truth.json").read_text(encoding="utf-8"))
    start = np.array(truth["start"])
    found = read_map(both_kinds / "map.csv")
    for kind, landmarks, fewest in (("discs", found.discs, 31), ("edges", found.lines, 55)):
        true = {d["id"]: disc_in_robot(start, d["xy"]) for d in truth[kind]}
        off = landmarks.xy - np.array([true[int(i)] for i in landmarks.ids])
        squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(landmarks.covariance), off)
        assert len(landmarks) >= fewest
        assert np.max(squared) < 13.8  # 99.9 % of chi-squared with two degrees of freedom
        assert np.max(np.abs(off)) < 0.5
    world = np.array([truth["start"], *(frame["pose"] for frame in truth["frames"])])
    poses = between(start, world)
    path = read_path(both_kinds / "path.csv")
    assert path.prefixes[:2] == ("start", "e.0000")
    np.testing.assert_allclose(path.poses[:, :2], poses[:, :2], atol=0.25)
    assert path.covariance is not None
    assert np.all(np.linalg.eigvalsh(path.covariance[1:])[:, 0] > 0.0)


def test_the_joint_covariance_of_too_many_landmarks_is_not_written(
    demo_run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    output = demo_run.parent / "many"
    assert main(["map", str(demo_run), "-o", str(output)]) == 0
    assert ", map_covariance.npy\n" in capsys.readouterr().out
    assert (output / "map_covariance.npy").is_file()
    monkeypatch.setattr("redetect.slam.mapping.run_map.MOST_LANDMARKS_TOGETHER", 30)
    assert main(["map", str(demo_run), "-o", str(output), "--force"]) == 0
    printed = capsys.readouterr().out
    assert "more than 30 landmarks: no map_covariance.npy" in printed
    assert printed.count("map_covariance.npy") == 1
    assert not (output / "map_covariance.npy").exists()
    found = [str(demo_run), "--map", str(output / "map.csv"), "-o", str(demo_run.parent / "loc")]
    assert main(["localize", *found]) == 0


def test_table_says_what_was_done(both_kinds: Path) -> None:
    results = json.loads((both_kinds / "table.json").read_text(encoding="utf-8"))
    table = results["table"]
    assert (table["poses"], table["steps"]) == (81, 81)
    assert table["chi_squared"] == pytest.approx(
        table["odometry"] + table["discs"] + table["lines"]
    )
    assert table["factor"] == pytest.approx(table["chi_squared"] / table["expected"])
    assert results["configuration"]["lines"] is True
    left_out = results["left_out"]
    assert left_out["lines_without_parallax"] == len(set(left_out["line_ids"])) > 0
    assert results["version"]


def test_same_bytes_again(demo_run: Path, both_kinds: Path) -> None:
    again = demo_run.parent / "again"
    assert main(["map", str(demo_run), "--circles", "--lines", "-o", str(again)]) == 0
    for name in ("map.csv", "path.csv", "table.json", "map.png"):
        assert (again / name).read_bytes() == (both_kinds / name).read_bytes()


def test_the_reports_rows_are_printed(demo_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", str(demo_run), "-o", str(demo_run.parent / "printed")]) == 0
    out = capsys.readouterr().out
    for words in ("poses p", "landmarks n", "odometry t", "rows m", "dim(z) - dim(x)", "factor"):
        assert words in out


def test_calibration_of_a_rightly_mounted_camera_changes_little(
    demo_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = demo_run.parent / "calibrated"
    arguments = ["map", str(demo_run), "--calibrate"]
    assert main([*arguments, "-o", str(output)]) == 0
    mounting = json.loads((output / "table.json").read_text(encoding="utf-8"))["mounting"]
    change = np.array([*mounting["rotation_rad"], *mounting["place_m"], mounting["height_m"]])
    sigma = np.sqrt(np.diag(mounting["covariance"]))
    assert np.all(np.abs(change) < 2.5 * sigma)
    mounted = read_camera(output / "mounted.cam")
    np.testing.assert_allclose(mounted.robot_from_camera, mounting["robot_from_camera"])
    assert "gained by the mounting" in capsys.readouterr().out


def test_results_are_not_overwritten_unasked(
    demo_run: Path, both_kinds: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (both_kinds / "map.csv").read_bytes()
    assert main(["map", str(demo_run), "-o", str(both_kinds)]) == 1
    assert "--force" in capsys.readouterr().err
    assert (both_kinds / "map.csv").read_bytes() == before


def test_without_gtsam_it_is_said_how_to_get_it(
    demo_run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    output = demo_run.parent / "missing"
    assert main(["map", str(demo_run), "--solver", "gtsam", "-o", str(output)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "pip install 'redetect[slam]'" in error
    assert not output.exists()


def test_impossible_settings_are_refused(
    demo_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["map", str(demo_run), "--loss-scale", "0", "-o", str(demo_run.parent / "never")])
    assert "--loss-scale is 0: expected above 0" in capsys.readouterr().err


def test_calibrating_without_a_calibration_is_refused(
    demo_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(demo_run / "map.circles", tmp_path / "map.circles")
    assert main(["map", str(tmp_path), "--calibrate"]) == 1
    assert "no calibration" in capsys.readouterr().err


def test_a_single_row_gives_a_map_without_a_factor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "one.circles"
    run.write_text(
        "STEP a 0.1 0 0 0.01 0 0.01 0 0 0.01\nLANDMARK_C 1 -1 1 0.1 0 0.1 3\n", encoding="ascii"
    )
    assert main(["map", str(run), "-o", str(tmp_path / "out")]) == 0
    assert "nan" not in capsys.readouterr().out
    table = json.loads((tmp_path / "out" / "table.json").read_text(encoding="utf-8"))["table"]
    assert (table["expected"], table["factor"]) == (0, None)
    path = read_path(tmp_path / "out" / "path.csv")
    assert path.covariance is not None
    np.testing.assert_allclose(path.covariance[1], 0.01 * np.eye(3), atol=1e-12)


def test_lines_that_cannot_be_placed_leave_nothing_to_map(
    tmp_path: Path, project_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "one.lines"
    run.write_text(
        "STEP a 0.1 0 0 0.01 0 0.01 0 0 0.01\nLANDMARK_L 0 0 0 0 0.3 0 0 0.002 3\n",
        encoding="ascii",
    )
    camera = project_root / "images" / "e" / "e.cam"
    arguments = ["map", str(run), "--camera", str(camera), "-o", str(tmp_path / "out")]
    assert main(arguments) == 1
    assert "none of 1 lines" in capsys.readouterr().err
