"""The whole benchmark on next to nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from camera import write_camera
from detect.sources.opening import open_run
from tools.benchmark.__main__ import main, measure_runs
from tools.benchmark.functions import (
    ALL,
    CIRCLES,
    DECODING,
    KERNEL,
    LINES,
    RESPONSE,
    commands,
    perform,
)
from tools.benchmark.material import BenchmarkError, repeated_run


@pytest.fixture
def short_run(project_root: Path, tmp_path: Path) -> Path:
    return repeated_run(open_run(project_root / "images/e"), tmp_path / "short", 2)


@pytest.mark.long
def test_a_pass_over_a_run_writes_what_the_command_writes(short_run: Path, tmp_path: Path) -> None:
    output = tmp_path / "output"
    output.mkdir()
    every = [(name, 1) for name in commands(short_run, output)]
    times = measure_runs(short_run, every, output, 1)
    assert [(time.command, time.jobs) for time in times] == every
    assert all(time.frames == 2 for time in times)
    assert all(time.images_per_s.median > 0.0 for time in times)
    written = {path.name for path in output.iterdir()}
    assert {"published.circles", "detected.circles", "detected.lines", "detected.tilt"} <= written


def test_a_pass_that_fails_is_an_error(short_run: Path, tmp_path: Path) -> None:
    (short_run / "images" / "e.0000001.jpg").write_bytes(b"no image")
    with pytest.raises(BenchmarkError, match=r"ended with 3.*cannot be decoded"):
        perform(commands(short_run, tmp_path)["detect circles --preset published"])


def test_a_run_without_images_ends_in_one_line(
    tmp_path: Path, project_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_camera(open_run(project_root / "images/e").camera, tmp_path / "a.cam")
    assert main(["--run", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_existing_files_are_refused_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    existing = tmp_path / "speed.json"
    existing.write_text("mine")
    assert main(["--run", str(tmp_path / "none"), "--json", str(existing)]) == 1
    assert "speed.json" in capsys.readouterr().err
    assert existing.read_text() == "mine"


@pytest.mark.long
def test_the_command_measures_everything(
    short_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {kind: tmp_path / f"speed.{kind}" for kind in ("json", "png", "md")}
    arguments = [
        "--run", str(short_run), "--photographs", str(short_run / "images"),
        "--pictures", "1", "--rounds", "1", "--run-rounds", "1", "--run-frames", "3",
        "--factors", "0.5", "1", "--landmarks", "0", "3", "--frames", "1", "2", "--jobs", "1",
        "--json", str(files["json"]), "--plot", str(files["png"]), "--markdown", str(files["md"]),
    ]  # fmt: skip
    assert main(arguments) == 0
    assert "decoding" in capsys.readouterr().out

    document = json.loads(files["json"].read_text())
    times = document["times"]
    assert all(time["ms"]["median"] > 0.0 for time in times)
    for case in ("demo", "noise", "photographs"):
        names = [t["function"] for t in times if (t["part"], t["case"]) == ("images", case)]
        assert len(set(names)) == len(names)
        assert {DECODING, KERNEL, CIRCLES, RESPONSE, LINES, ALL} <= set(names)
        assert {"cv2.HoughCircles", "cv2.SimpleBlobDetector", "skimage hough_circle"} <= set(names)
    sizes = dict.fromkeys(float(t["case"]) for t in times if t["part"] == "megapixels")
    assert list(sizes) == pytest.approx([384 * 144 / 1e6, 768 * 288 / 1e6])
    for part in ("discs", "verticals"):
        assert {t["case"] for t in times if t["part"] == part} == {"0", "3"}
    whole = [run for run in document["runs"] if run["frames"] == 3]
    assert [run["command"] for run in whole] == [*commands(short_run, tmp_path)]
    growing = [(run["frames"], run["jobs"]) for run in document["runs"] if run["frames"] < 3]
    assert growing == [(1, 1), (2, 1)]
    for run in document["runs"]:
        for kind in ("decoding", "reading"):
            alone = run[f"{kind}_images_per_s"]["median"]
            share = run[f"share_of_{kind}"]["median"]
            assert run["images_per_s"]["median"] == pytest.approx(share * alone)
    assert files["png"].read_bytes().startswith(b"\x89PNG")
    assert KERNEL in files["md"].read_text()
