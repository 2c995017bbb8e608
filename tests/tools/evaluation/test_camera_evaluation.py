"""Studies of calibration: what they say where their pictures are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.evaluation.__main__ import main


def test_a_folder_without_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera-photographs", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: {tmp_path}: no photographs there")
    assert said.count("\n") == 1


def test_a_study_that_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["astrology"]) == 2
    assert "photographs" in capsys.readouterr().err
