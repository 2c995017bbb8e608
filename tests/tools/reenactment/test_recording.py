"""Landmark files, paths and maps as arrays; what is wrong with them is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from redetect.landmarks import CircleLandmark, Frame, Step
from tests.tools.reenactment.synthetic import make_run
from tools.reenactment.recording import (
    RecordingError,
    read_map,
    read_path,
    recording_of_frames,
    start_from_odometry,
)

STEP = Step("a.0000", 0.1, -0.2, 0.3, 1.0, 0.1, 2.0, 0.2, 0.3, 3.0)
ROW = CircleLandmark(0.2, -2.0, 0.9, 0.01, 0.002, 0.03, (7,))


def test_numbers_stand_where_they_belong(published_camera: Camera) -> None:
    unknown = replace(ROW, px=0.5, ids=(-1,))
    frames = [
        Frame(STEP),
        Frame(replace(STEP, prefix="a.0001"), (unknown, ROW, replace(ROW, ids=(3,)))),
    ]
    recording = recording_of_frames(published_camera, frames)
    assert recording.prefixes.tolist() == ["a.0000", "a.0001"]
    np.testing.assert_array_equal(recording.steps, [[0.1, -0.2, 0.3]] * 2)
    np.testing.assert_array_equal(
        recording.step_covariance[0], [[1.0, 0.1, 0.2], [0.1, 2.0, 0.3], [0.2, 0.3, 3.0]]
    )
    assert recording.frame.tolist() == [1, 1]
    assert recording.disc_ids[recording.disc].tolist() == [7, 3]
    np.testing.assert_array_equal(recording.row_covariance[0], [[0.01, 0.002], [0.002, 0.03]])
    np.testing.assert_allclose(
        published_camera.floor_from_pixel(recording.pixels), [[0.2, -2.0]] * 2, atol=1e-5
    )


def test_odometry_without_errors_starts_at_the_truth(published_camera: Camera) -> None:
    run = make_run(published_camera, 1, noisy=False)
    mounted = replace(
        published_camera,
        robot_from_camera=tuple(
            map(tuple, np.column_stack([run.geometry.rotation, run.geometry.centre]).tolist())
        ),
    )
    recording = recording_of_frames(published_camera, run.frames)
    seen_right = replace(recording, row_xy=mounted.floor_from_pixel(recording.pixels))
    poses, disc_xy = start_from_odometry(seen_right)
    np.testing.assert_allclose(poses, run.geometry.poses, atol=1e-9)
    np.testing.assert_allclose(disc_xy, run.geometry.disc_xy, atol=1e-5)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (Frame(STEP, (replace(ROW, ids=(-1,)),)), "no disc with an ID"),
        (Frame(replace(STEP, cxx=0.0), (ROW,)), "a.0000: odometry covariance is singular"),
        (Frame(STEP, (replace(ROW, cyy=0.0),)), "a.0000: a disc's covariance is singular"),
        (Frame(STEP, (replace(ROW, py=9.0),)), "a.0000: a disc lies where the camera sees no"),
    ],
)
def test_what_no_world_can_be_made_of(published_camera: Camera, frame: Frame, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        recording_of_frames(published_camera, [frame])


def test_path_and_map_are_read(tmp_path: Path) -> None:
    (tmp_path / "path.csv").write_text("# x,y,theta\n0,0,0\n1,2,3\n4,5,6\n")
    (tmp_path / "map.csv").write_text("# id,x,y\n9,1.5,2.5\n3,-1,-2\n8,0,0\n")
    np.testing.assert_array_equal(read_path(tmp_path / "path.csv", 2), [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(
        read_map(tmp_path / "map.csv", np.array([3, 9])), [[-1, -2], [1.5, 2.5]]
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,0\n1,2,3\n", "2 poses: expected 3"),
        ("1,0,0\n1,2,3\n4,5,6\n", "expected 0, 0, 0"),
        ("0,0,0\n1,2\n", "expected 3 numbers a row"),
        ("0,0,0\n1,2,x\n", "could not convert.*expected 3 numbers a row"),
        ("0,0,0\n1,2,nan\n4,5,6\n", "expected 3 numbers a row"),
        ("", "expected 3 numbers a row"),
    ],
)
def test_paths_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(RecordingError, match=f"path.csv: .*{message}"):
        read_path(file, 2)


def test_map_without_a_disc_that_is_seen(tmp_path: Path) -> None:
    file = tmp_path / "map.csv"
    file.write_text("1,0,0\n2,0,0\n")
    with pytest.raises(RecordingError, match=r"map.csv: no disc with ID 5"):
        read_map(file, np.array([1, 5]))
