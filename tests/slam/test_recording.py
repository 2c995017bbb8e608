"""Reading runs for estimators: what is gathered, and what is refused with a clear answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import LandmarkFileError
from redetect.slam.errors import SlamError
from redetect.slam.models import OdometryNoise
from redetect.slam.recording import read_recording

STEP = "STEP a.{k} 0.1 -0.2 0.05 1e-4 0 1e-4 0 0 1e-5\n"
DISC = "LANDMARK_C 0.5 -2 0.9 0.002 0.0001 0.003 {id}\n"
LINE = "LANDMARK_L 0.1 -0.5 0.1 0.5 -0.3 0 0 0.002 4 7\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_rows_of_both_files_become_arrays(tmp_path: Path) -> None:
    steps = [STEP.format(k=k) for k in range(3)]
    write(
        tmp_path / "map.circles",
        steps[0] + DISC.format(id=9) + steps[1] + steps[2] + DISC.format(id=""),
    )
    write(tmp_path / "map.lines", steps[0] + steps[1] + LINE + steps[2])
    recording = read_recording(tmp_path, circles=True, lines=True)
    assert recording.prefixes == ("a.0", "a.1", "a.2")
    np.testing.assert_array_equal(recording.steps, [[0.1, -0.2, 0.05]] * 3)
    np.testing.assert_array_equal(recording.circles.frame, [0, 2])
    np.testing.assert_array_equal(recording.circles.ids, [9, -1])
    np.testing.assert_array_equal(
        recording.circles.covariance[0], [[0.002, 0.0001], [0.0001, 0.003]]
    )
    np.testing.assert_array_equal(recording.lines.frame, [1])
    assert recording.lines.ids == ((4, 7),)


@pytest.mark.parametrize(
    ("listed", "expected"), [("-1", -1), ("-2", -1), ("-1 5", 5), ("-7 5 6", 5), ("0", 0)]
)
def test_all_ids_below_0_are_unknown(tmp_path: Path, listed: str, expected: int) -> None:
    """An estimator must not take all rows of -2 for sights of one disc."""
    disc = write(tmp_path / "x.circles", STEP.format(k=0) + DISC.format(id=listed))
    assert read_recording(disc).circles.ids.tolist() == [expected]
    line = write(tmp_path / "x.lines", STEP.format(k=0) + LINE.replace("4 7", f"{listed} -3 8"))
    known = tuple(int(word) for word in f"{listed} 8".split() if int(word) >= 0)
    assert read_recording(line).lines.ids == (known,)


def test_a_landmark_before_any_step_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "x.circles", DISC.format(id=1) + STEP.format(k=0))
    with pytest.raises(LandmarkFileError, match=r"x\.circles:1: landmark before any STEP"):
        read_recording(path)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("LANDMARK_C 1 -1 .9 0.01 0.01 0.01 3\n", r"step 1 \(a\.0\): the disc at \(1, -1\)"),
        ("LANDMARK_C 1 -1 .9 -0.01 0 0.01 3\n", "not positive definite"),
        ("LANDMARK_C 1 -1 .9 0 0 0 3\n", "not positive definite"),
        ("LANDMARK_L 0 -1 0 1 0.5 0 0 0 3\n", "sigma 0: expected above 0"),
        ("LANDMARK_C nan -1 .9 .1 0 .1 3\n", "px is 'nan': expected a finite number"),
        ("STEP a.1 0 0 0 1 0 0 0 0 0\n", r"step 2 \(a\.1\): its covariance is not positive"),
        ("STEP a.1 0 0 0 1 0 1 1 0 1\n", "not positive definite"),
    ],
)
def test_what_cannot_be_weighed_is_refused(tmp_path: Path, row: str, message: str) -> None:
    path = write(tmp_path / "x.circles", STEP.format(k=0) + row)
    with pytest.raises(ValueError, match=message):
        read_recording(path)


def test_files_of_different_runs_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "map.circles", STEP.format(k=0) + STEP.format(k=1))
    write(tmp_path / "map.lines", STEP.format(k=0) + STEP.format(k=2))
    with pytest.raises(SlamError, match="expected files of one run"):
        read_recording(tmp_path, circles=True, lines=True)
    write(tmp_path / "map.lines", STEP.format(k=0))
    with pytest.raises(SlamError, match="1 steps: expected 2"):
        read_recording(tmp_path, circles=True, lines=True)


def test_a_folder_without_landmarks_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match=r"expected map\.circles or detected\.circles"):
        read_recording(tmp_path)
    with pytest.raises(SlamError, match=r"expected other\.circles"):
        read_recording(tmp_path, stem="other")
    with pytest.raises(SlamError, match="no STEP row"):
        read_recording(write(tmp_path / "x.circles", "# nothing\n"))


def test_steps_that_state_no_covariance_get_the_assumed_one(tmp_path: Path) -> None:
    rows = "STEP a.0 0.3 -0.4 0.2 1e-4 0 1e-4 0 0 1e-4\nSTEP a.1 0.3 -0.4 0.2 0 0 0 0 0 0\n"
    noise = OdometryNoise(0.1, 0.2, 0.3, 0.01, 0.02)

    recording = read_recording(write(tmp_path / "x.circles", rows), noise=noise)

    assert recording.unstated_steps == 1
    np.testing.assert_allclose(recording.step_covariance[0], 1e-4 * np.eye(3))
    of_way = (0.1 * 0.5) ** 2 + 0.01**2
    of_turn = (0.2 * 0.2) ** 2 + (0.3 * 0.5) ** 2 + 0.02**2
    np.testing.assert_allclose(recording.step_covariance[1], np.diag([of_way, of_way, of_turn]))


def test_a_noise_that_cannot_be_is_refused() -> None:
    with pytest.raises(SlamError, match="least_m is 0"):
        OdometryNoise(least_m=0.0)
