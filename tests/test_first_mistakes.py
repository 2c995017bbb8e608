"""What a newcomer gets wrong is told on one line, with what to do next."""

from __future__ import annotations

import shutil
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from redetect.cli import PROGRAMS

DEMO = Path(__file__).parent.parent / "images/e"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with all that can be named wrongly, which is the working folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "pictures", "calibrated", "ids", "lines"):
        Path(name).mkdir()
    for place in ("pictures", "calibrated"):
        cv2.imwrite(f"{place}/a.png", np.full((288, 768), 120, np.uint8))
    shutil.copy(DEMO / "e.cam", "calibrated")
    shutil.copy(DEMO / "map.circles", "ids")
    shutil.copy(DEMO / "map.lines", "lines")
    Path("still.circles").write_text(f"STEP a{' 0' * 9}\nLANDMARK_C 1 -2 0.9 0.1 0 0.1 3\n")
    Path("steps.txt").write_text("STEP a 0.1 0 0 0.01 0 0.01 0 0 0.01\n")
    return tmp_path


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("detect circles pictures", ["no calibration", "--camera", "camera calibrate"]),
        pytest.param(
            "detect view pictures -o v.rrd",
            ["no calibration", "--camera"],
            marks=pytest.mark.skipif(find_spec("rerun") is None, reason="rerun is not installed"),
        ),
        ("detect circles empty", ["no images", "expected a run folder"]),
        ("detect circles gone", ["no such folder or file", "expected a run folder"]),
        ("detect circles calibrated -o gone/x.circles", ["no such folder: gone: make it first"]),
        ("detect circles calibrated -o ids/map.circles", ["exists already", "--force"]),
        ("detect compare calibrated", ["map.circles", "--reference"]),
        ("detect compare ids", ["detected.circles", "`detect circles` writes it", "--detected"]),
        ("detect compare lines --lines", ["`detect lines` writes it"]),
        ("detect export ids", ["is a folder", "such as map.circles"]),
        ("detect export empty", ["is a folder: expected a .circles"]),
        ("detect draw calibrated -o drawn", ["run detect all"]),
        ("detect tune calibrated --vary evidence=0,1", ["map.circles", "--reference"]),
        ("slam map gone", ["no such landmark file or folder", "expected a run folder"]),
        ("slam map empty", ["map.circles or detected.circles", "`detect circles` writes"]),
        ("slam map empty --lines", ["`detect lines` writes detected.lines", "--stem"]),
        ("slam map pictures/a.png", ["is a picture", "`detect circles`"]),
        ("slam ekf calibrated/e.cam", ["is a calibration", "--camera"]),
        ("slam map still.circles", ["no odometry", "--odometry"]),
        ("slam map steps.txt", ["no landmark in it", "`detect circles`"]),
        ("slam map lines --lines", ["no calibration", "camera calibrate"]),
        ("slam noise pictures/a.png", ["is a picture"]),
        ("slam export pictures/a.png -o x.g2o", ["is a picture"]),
        ("slam export ids -o gone/x.g2o", ["no such folder: gone: make it first"]),
        ("slam import ids/map.circles -o x.circles", ["is a landmark file", "`slam export`"]),
        ("slam localize ids --map gone.csv", ["gone.csv: cannot be read", "`slam map`"]),
        ("slam localize ids --map empty", ["empty: cannot be read", "map.csv of `slam map`"]),
        ("camera floor gone.cam a.csv -o x.cam", ["gone.cam: no such calibration file"]),
        ("camera convert calibrated/e.cam x.yaml", ["does not say which format", ".opencv.yaml"]),
        (
            "camera calibrate empty --columns 9 --rows 6 --square-m 0.02 -o x.cam",
            ["no pictures in empty", "expected files ending in"],
        ),
        (
            "camera calibrate pictures --columns 9 --rows 6 --square-m 0.02 -o x.cam",
            ["no checkerboard", "are --board, --columns and --rows right?"],
        ),
    ],
)
def test_it_is_told_what_to_do(
    line: str, told: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program, *words = line.split()
    assert import_module(PROGRAMS[program]).main(words) == 1
    (said,) = [row for row in capsys.readouterr().err.splitlines() if row.startswith("error: ")]
    for words_of_help in told:
        assert words_of_help in said


def test_a_folder_for_all_results_is_made(folder: Path) -> None:
    from detect.cli import main

    assert main(["all", "calibrated", "-o", "new/results"]) == 0
    names = {path.name for path in (folder / "new/results").iterdir()}
    assert {"detected.circles", "detected.lines", "detected.tilt"} <= names


def test_a_viewer_that_is_not_there_is_told(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rerun = pytest.importorskip("rerun")
    from detect.cli import main

    def nowhere(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to find Rerun Viewer executable in PATH.\n\n  many lines")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", nowhere)
    shutil.copy("ids/map.circles", "calibrated/detected.circles")
    assert main(["view", "calibrated"]) == 1
    assert "write a recording with -o" in capsys.readouterr().err
