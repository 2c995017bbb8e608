"""Tables hold a run in other axes: the error computed from them is the one of our models."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import read_camera
from redetect.array_types import FloatArray
from redetect.landmarks import wrap_angle
from redetect.landmarks.axes import from_dataset
from redetect.landmarks.map_file import write_table
from redetect.plane import between, chain_steps, rotation
from redetect.slam.formats.tables import bearing_table, disc_table, odometry_table
from redetect.slam.models import bearing_of_vertical, disc_in_robot
from redetect.slam.recording import Recording, read_recording

DEMO = Path(__file__).parents[2] / "images" / "e"


@pytest.fixture(scope="module")
def recording() -> Recording:
    return read_recording(DEMO, circles=True, lines=True)


def rows_of(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def numbers(rows: list[dict[str, str]], *names: str) -> FloatArray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def symmetric(triangle: FloatArray, size: int) -> FloatArray:
    matrices = np.zeros((len(triangle), size, size))
    matrices[:, *np.triu_indices(size)] = triangle
    return np.asarray(matrices + np.triu(matrices, 1).swapaxes(1, 2))


def squared(error: FloatArray, covariance: FloatArray) -> float:
    return float(np.einsum("ni,nij,nj", error, np.linalg.inv(covariance), error))


def estimates(recording: Recording) -> FloatArray:
    rng = np.random.default_rng(5)
    poses = chain_steps(recording.steps)
    return np.asarray(poses + rng.normal(0.0, [0.01, 0.01, 0.02], poses.shape))


TRIANGLE = ("cxx_m2", "cxy_m2", "cxphi_m_rad", "cyy_m2", "cyphi_m_rad", "cphiphi_rad2")


def test_the_error_of_odometry(tmp_path: Path, recording: Recording) -> None:
    write_table(tmp_path / "o.csv", *odometry_table(recording), ["a comment"])
    rows = rows_of(tmp_path / "o.csv")
    assert [row["prefix"] for row in rows] == list(recording.prefixes)
    assert [row["step"] for row in rows] == [str(k + 1) for k in range(80)]
    poses = estimates(recording)
    ours = between(poses[:-1], poses[1:]) - recording.steps
    ours[:, 2] = wrap_angle(ours[:, 2])
    expected = squared(ours, recording.step_covariance)

    steps = numbers(rows, "dx_m", "dy_m", "dphi_rad")
    turned = from_dataset(poses)
    error = between(turned[:-1], turned[1:]) - steps
    error[:, 2] = wrap_angle(error[:, 2])
    before = symmetric(numbers(rows, *TRIANGLE), 3)
    assert squared(error, before) == pytest.approx(expected, rel=1e-9)
    at_end = symmetric(numbers(rows, *(f"end_{name}" for name in TRIANGLE)), 3)
    error[:, :2] = np.einsum("nji,nj->ni", rotation(steps[:, 2]), error[:, :2])
    assert squared(error, at_end) == pytest.approx(expected, rel=1e-9)
    # Had the means alone been rotated, it would show.
    assert abs(squared(error, recording.step_covariance) / expected - 1.0) > 0.01


def test_the_error_of_discs(tmp_path: Path, recording: Recording) -> None:
    write_table(tmp_path / "d.csv", *disc_table(recording))
    rows = rows_of(tmp_path / "d.csv")
    some = recording.circles
    known = some.ids >= 0
    assert len(rows) == known.sum() < len(some)
    assert [int(row["id"]) for row in rows] == some.ids[known].tolist()
    assert [int(row["step"]) for row in rows] == (some.frame[known] + 1).tolist()
    rng = np.random.default_rng(6)
    place = rng.normal(0.0, 3.0, (1000, 2))
    poses = estimates(recording)
    ours = disc_in_robot(poses[some.frame[known] + 1], place[some.ids[known]]) - some.xy[known]
    expected = squared(ours, some.covariance[known])

    turned, step = from_dataset(poses), numbers(rows, "step")[:, 0].astype(int)
    discs = from_dataset(place)[numbers(rows, "id")[:, 0].astype(int)]
    error = disc_in_robot(turned[step], discs) - numbers(rows, "x_m", "y_m")
    covariance = symmetric(numbers(rows, "cxx_m2", "cxy_m2", "cyy_m2"), 2)
    assert squared(error, covariance) == pytest.approx(expected, rel=1e-9)
    assert abs(squared(error, some.covariance[known]) / expected - 1.0) > 0.01


def test_the_bearings(tmp_path: Path, recording: Recording) -> None:
    camera_xy = np.array(read_camera(DEMO / "e.cam").robot_from_camera)[:2, 3]
    ids = ((3, 8), (), *recording.lines.ids[2:])
    recording = replace(recording, lines=replace(recording.lines, ids=ids))
    write_table(tmp_path / "b.csv", *bearing_table(recording, camera_xy))
    rows = rows_of(tmp_path / "b.csv")
    some = recording.lines
    known = [0, *range(2, len(some))]
    assert [tuple(map(int, row["ids"].split(";"))) for row in rows] == [some.ids[k] for k in known]
    assert [rows[0]["ids"], len(rows)] == ["3;8", len(some) - 1]
    np.testing.assert_array_equal(numbers(rows, "sigma_rad")[:, 0], some.sigma_rad[known])
    # A line in some place is seen under the same angle in both axes.
    pose, line = np.array([0.4, -1.0, 0.7]), np.array([2.0, 3.0])
    camera = numbers(rows, "camera_x_m", "camera_y_m")[0]
    seen = disc_in_robot(from_dataset(pose), from_dataset(line)) - camera
    angle = np.arctan2(seen[1], seen[0])
    assert angle == pytest.approx(float(bearing_of_vertical(pose, line, camera_xy)), abs=1e-12)
    np.testing.assert_array_equal(numbers(rows, "bearing_rad")[:, 0], some.bearing_rad[known])
