"""The whole benchmark on next to nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from camera import write_camera
from detect.sources.opening import open_run
from tools.benchmark.__main__ import main, measure_runs, perform
from tools.benchmark.functions import ALL, CIRCLES, DECODING, KERNEL, LINES, RESPONSE, commands
from tools.benchmark.material import repeated_run, run_pictures, scaled_camera, scaled_picture
from tools.benchmark.timing import number
from tools.evaluation.figures import StudyError


@pytest.fixture
def short_run(project_root: Path, tmp_path: Path) -> Path:
    return repeated_run(open_run(project_root / "images/e"), tmp_path / "short", 2)


@pytest.mark.long
def test_a_pass_over_a_run_writes_what_the_command_writes(short_run: Path, tmp_path: Path) -> None:
    output = tmp_path / "output"
    output.mkdir()
    every = [(name, 1) for name in commands(short_run, output)]
    rows = list(measure_runs(short_run, every, output, 1))
    assert [row[:3] for row in rows] == [(name, 2, 1) for name, _ in every]
    assert all(row.per_s > 0.0 for row in rows)
    written = {path.name for path in output.iterdir()}
    assert {"published.circles", "detected.circles", "detected.lines", "detected.tilt"} <= written


def test_a_pass_that_fails_is_an_error(short_run: Path, tmp_path: Path) -> None:
    (short_run / "images" / "e.0000001.jpg").write_bytes(b"no image")
    with pytest.raises(StudyError, match=r"ended with 3.*cannot be decoded"):
        perform(commands(short_run, tmp_path)["detect circles --preset published"])


def test_a_run_without_images_ends_in_one_line(
    tmp_path: Path, project_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_camera(open_run(project_root / "images/e").camera, tmp_path / "a.cam")
    assert main(["--run", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture
def reduced_run(project_root: Path, tmp_path: Path) -> Path:
    """Two frames at half the size: what is compared with takes seconds for larger noise."""
    run = open_run(project_root / "images/e")
    camera = scaled_camera(run.camera, 0.5)
    (tmp_path / "images").mkdir()
    write_camera(camera, tmp_path / "reduced.cam")
    for k, picture in enumerate(run_pictures(run, 2)):
        scaled_picture(picture, camera, 0).encoded.tofile(tmp_path / "images" / f"{k}.jpg")
    return tmp_path


@pytest.mark.long
def test_the_command_measures_everything(
    reduced_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "--run", str(reduced_run), "--photographs", str(reduced_run / "images"),
        "--pictures", "1", "--rounds", "1", "--run-rounds", "1", "--run-frames", "3",
        "--factors", "0.5", "1", "--landmarks", "0", "3", "--frames", "1", "2", "--jobs", "1",
    ]  # fmt: skip
    figures = reduced_run / "speed.json"
    assert main([*arguments, "--figures", str(figures)]) == 0
    out = capsys.readouterr().out
    assert f"numpy {np.__version__}" in out
    tables = [
        [[cell.strip() for cell in line.strip("|").split("|")] for line in part.split("\n")]
        for part in out.strip().split("\n\n")
        if part.startswith("| ")
    ]
    kinds, sizes, discs, verticals, runs = tables
    assert kinds[0] == ["", "demo", "noise", "photographs"]
    names = {row[0] for row in kinds[2:]}
    assert len(names) == len(kinds) - 2
    assert {DECODING, KERNEL, CIRCLES, RESPONSE, LINES, ALL} <= names
    assert {"cv2.HoughCircles", "cv2.SimpleBlobDetector", "skimage hough_circle"} <= names
    assert all(cell.endswith(" ms") for row in kinds[2:] for cell in row[1:])
    assert [float(size) for size in sizes[0][1:]] == pytest.approx(
        [192 * 72 / 1e6, 384 * 144 / 1e6]
    )
    assert discs[0] == verticals[0] == ["", "0", "3"]
    whole = list(commands(reduced_run, reduced_run))
    assert [row[:3] for row in runs[2:]] == [
        *([name, "3", "1"] for name in whole), ["detect all", "1", "1"], ["detect all", "2", "1"],
    ]  # fmt: skip
    found = json.loads(figures.read_text())["figures"]
    for case, name in (("demo", ALL), ("noise", LINES)):
        times = found["kinds"][case][name]
        assert 0.0 < times["lower"] <= times["median"] <= times["upper"]
        assert f"{number(times['median'])} (" in out
    assert [row["frames"] for row in found["runs"]] == [3] * len(whole) + [1, 2]
