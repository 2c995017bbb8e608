"""Studies say what they expected where they find nothing, or would search for ever."""

from __future__ import annotations

from pathlib import Path

import pytest

from camera import Camera
from detect.settings import CircleSettings
from tools.evaluation.__main__ import main
from tools.evaluation.boards import IN_HAND, board_poses
from tools.evaluation.detection import _tilt_errors
from tools.evaluation.disturbed import measure_families
from tools.evaluation.figures import StudyError

#: It looks down at a spot of the floor that is smaller than a disc.
NARROW = Camera(
    48, 32, 2000.0, 2000.0, 24.0, 16.0, (0.0,) * 5,
    ((-1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 1.0)),
)  # fmt: skip


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("association", "runs: there are none"),
        ("map", "runs: there are none"),
        ("programs", "commands: there are none"),
        ("real-run tests", "tests/*.cam: there are none"),
        ("joining-pairs images/e", "pairs of 300 frames that can be joined: there are none"),
        ("tilt-of-discs . . --camera images/e/e.cam --map . --path .", "lines, 5 discs of the map"),
    ],
)
def test_nothing_to_measure(
    words: str, error: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    project_root: Path,
) -> None:  # fmt: skip
    monkeypatch.chdir(project_root)
    monkeypatch.setattr("tools.evaluation.tilt_of_discs.compare_tilts", lambda *_: {})
    assert main(words.split()) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert error in said


def test_no_frame_with_a_tilt(tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text('{"frames": []}')
    (tmp_path / "e.tilt").touch()
    with pytest.raises(StudyError, match="frames with five lines: there are none"):
        _tilt_errors(tmp_path, tmp_path / "e.tilt")


def test_a_camera_that_never_sees_a_board_or_a_disc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.evaluation.boards._TRIES", 300)
    monkeypatch.setattr("tools.evaluation.disturbed._MOST_EMPTY", 1)
    with pytest.raises(StudyError, match="in 0 poses: expected 2"):
        board_poses(NARROW, IN_HAND, 2, 1, distances_m=(0.25, 0.5))
    with pytest.raises(StudyError, match="images without a disc"):
        list(measure_families(NARROW, CircleSettings(), discs=1, shares=(0.2,), seed=1))


@pytest.mark.parametrize("there", ["boards", "floor.png"])
def test_photographs_do_not_replace_others(tmp_path: Path, there: str) -> None:
    (tmp_path / there).mkdir()
    assert main(["tutorial-photographs", str(tmp_path), "--count", "1"]) == 1
    assert [path.name for path in tmp_path.iterdir()] == [there]
