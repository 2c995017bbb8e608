"""The command `detect markers`: rows of a folder of images, with and without a calibration."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import write_camera
from detect.cli import main
from detect.runs.plan import FramePlan, Job
from detect.runs.stream import detect_run
from detect.settings import MarkerSettings
from detect.sources.interface import Run
from detect.sources.opening import open_source
from redetect.landmarks import read_frames
from tests.detect.commands import Captured
from tests.detect.markers.rendering import View, corners_of, exposed, pinhole, render

CAMERA = pinhole(220, 120)
VIEW = View(70.0, 20.0, 30.0, 15.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images: marker 5, nothing, markers 5 and 9."""
    run = tmp_path / "run"
    (run / "images").mkdir(parents=True)
    for index, numbers in enumerate([[5], [], [5, 9]]):
        drawn = [
            ("rawseeds", number, VIEW.pose(CAMERA, (60.0 + 100.0 * k, 60.0)))
            for k, number in enumerate(numbers)
        ]
        image = exposed(render(CAMERA, drawn, blur=0.7), 1.0, np.random.default_rng(index))
        assert cv2.imwrite(str(run / "images" / f"f{index}.png"), image)
    return run


@pytest.mark.lowest
def test_rows_of_a_folder_without_a_calibration(folder: Path, capsys: Captured) -> None:
    drawn = str(folder / "drawn")
    assert main(["markers", str(folder), "--draw", drawn, "--rejected"]) == 0
    assert "3 markers in 3 frames" in capsys.readouterr().out
    frames = list(read_frames(folder / "detected.markers"))
    assert [[row.id for row in frame.markers] for frame in frames] == [[5], [], [5, 9]]
    row = frames[0].markers[0]
    assert row.dictionary == "rawseeds"
    expected = corners_of(CAMERA, VIEW.pose(CAMERA, (60.0, 60.0)))
    found = np.array([[corner.u, corner.v] for corner in row.corners])
    assert np.abs(found - expected).max() < 0.05
    assert all(0.0 < corner.cuu < 0.01 for corner in row.corners)
    head = (folder / "detected.markers").read_text()
    assert "# camera none" in head
    assert "dictionary=rawseeds" in head
    assert len(list((folder / "drawn").glob("*.png"))) == 3


def test_ids_on_the_command_line(folder: Path) -> None:
    output = folder / "only.markers"
    assert main(["markers", str(folder), "--ids", "9", "11", "-o", str(output)]) == 0
    assert [[m.id for m in f.markers] for f in read_frames(output)] == [[], [], [9]]


def test_a_calibration_of_another_size_costs_its_frames(folder: Path) -> None:
    write_camera(pinhole(64, 48), folder / "run.cam")
    assert main(["markers", str(folder)]) == 3
    assert not any(frame.markers for frame in read_frames(folder / "detected.markers"))


def test_a_calibration_is_used_where_there_is_one(folder: Path) -> None:
    assert not isinstance(open_source(folder), Run)
    write_camera(CAMERA, folder / "run.cam")
    run = open_source(folder)
    assert isinstance(run, Run)
    assert run.camera == CAMERA
    plan = FramePlan(run.camera, markers=MarkerSettings())
    summary = detect_run(Job(run, plan, {"markers": folder / "detected.markers"}))
    assert summary.found["markers"] == 3
    assert summary.frames == 3


def test_markers_of_another_dictionary_are_told(folder: Path, capsys: Captured) -> None:
    assert main(["markers", str(folder), "--dictionary", "apriltag_36h11"]) == 0
    assert re.search("3 squares look like markers, but not of", capsys.readouterr().err)


def test_wrong_dictionaries_are_told_before_any_work(folder: Path, capsys: Captured) -> None:
    assert main(["markers", str(folder), "--dictionary", "9x9"]) == 1
    assert "no such dictionary" in capsys.readouterr().err
    assert not (folder / "detected.markers").exists()
