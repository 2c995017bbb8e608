"""Surveyed points and distances: they come back, and malformed files are refused by place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.validation.reference_poses import (
    Distance,
    Survey,
    read_distances,
    read_survey,
)
from tools.simulator.laser.session_files import write_distances, write_survey

SURVEY = Survey(
    {"SW": np.array([0.0, 0.5]), "column": np.array([6.25, -3.0])},
    {"left": np.array([0.3, 0.2]), "right": np.array([0.3, -0.2])},
    0.005,
)
HEAD = "pose,t,point,fiducial,distance_m\n"


def test_points_come_back(tmp_path: Path) -> None:
    write_survey(tmp_path / "fiducials.json", SURVEY)
    read = read_survey(tmp_path / "fiducials.json")
    assert read.sigma_m == 0.005
    for a, b in (
        (read.fiducials, SURVEY.fiducials),
        (read.robot_points, SURVEY.robot_points),
    ):
        assert list(a) == list(b)
        for name, point in a.items():
            np.testing.assert_array_equal(point, b[name])


def test_distances_come_back(tmp_path: Path) -> None:
    rows = [
        Distance(0, 1235561680.25, "left", "SW", 3.1416),
        Distance(1, 1235561690.5, "right", "column", 0.0),
    ]
    write_distances(tmp_path / "distances.csv", rows)
    assert read_distances(tmp_path / "distances.csv", SURVEY) == rows
    write_distances(tmp_path / "none.csv", [])
    assert read_distances(tmp_path / "none.csv", SURVEY) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 3}, "version is 3"),
        ({"sigma_m": 0}, "sigma_m is 0"),
        ({"sigma_m": None}, "sigma_m is None"),
        ({"sigma_m": float("nan")}, "sigma_m is nan"),
        ({"fiducials": {"a": [0, 0]}}, "fiducials: expected two or more"),
        ({"fiducials": [[0, 0], [1, 1]]}, "fiducials: expected two or more"),
        ({"fiducials": {"a": [0, 0], "b": [1]}}, "fiducials: b is"),
        ({"fiducials": {"a": [0, 0], "b": [1, float("inf")]}}, "fiducials: b is"),
        ({"fiducials": {"a": [0, 0], "b": [1, 1e9]}}, "less than 1e.06 m"),
        ({"robot_points": {"a": [0, 0], "b": [True, 1]}}, "robot_points: b is"),
    ],
)
def test_malformed_surveys_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = tmp_path / "fiducials.json"
    write_survey(path, SURVEY)
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    with pytest.raises(GroundTruthError, match=message) as error:
        read_survey(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        (HEAD + "0,1,left,SW\n", 2, "4 words"),
        (HEAD + "0,1,left,SW,x\n", 2, "'x': expected a finite number"),
        (HEAD + "0.5,1,left,SW,1\n", 2, "a whole pose"),
        (HEAD + "-1,1,left,SW,1\n", 2, "0 or more"),
        (HEAD + "0,nan,left,SW,1\n", 2, "finite"),
        (HEAD + "0,1,left,SW,-1\n", 2, "0 or more"),
        (HEAD + "0,1,left,SW,nan\n", 2, "finite"),
        (HEAD + "0,1,top,SW,1\n", 2, "'top': expected one of left, right"),
        ("0,1,left,SW,1\n" + HEAD, 2, "'pose': expected a finite number"),
        ("0,1,left,NE,1\n", 1, "'NE': expected one of SW, column"),
    ],
)
def test_malformed_distances_are_refused_by_line(
    tmp_path: Path, text: str, line: int, message: str
) -> None:
    path = tmp_path / "distances.csv"
    path.write_text(text)
    with pytest.raises(GroundTruthError, match=message) as error:
        read_distances(path, SURVEY)
    assert str(error.value).startswith(f"{path}:{line}: ")


def test_files_that_are_no_text_or_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GroundTruthError, match="no such file"):
        read_distances(tmp_path / "distances.csv", SURVEY)
    (tmp_path / "distances.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(GroundTruthError, match="not text"):
        read_distances(tmp_path / "distances.csv", SURVEY)
