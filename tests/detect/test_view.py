"""Recordings for Rerun: the path along the steps, and refusals in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from detect.cli import main
from detect.view_command import summed_steps
from landmarks import Step
from tests.detect.test_cli import assert_refused

Captured = pytest.CaptureFixture[str]


def test_steps_round_a_square_come_back() -> None:
    step = Step("a", 0.0, -1.0, np.pi / 2, *[0.0] * 6)
    poses = summed_steps([step] * 4)
    # Forward is -Y; after a quarter turn to the left (counterclockwise), +X.
    np.testing.assert_allclose(poses[:, :2], [[0, 0], [0, -1], [1, -1], [1, 0], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(poses[:, 2], np.arange(5) * np.pi / 2)


def test_missing_package_and_files_are_told(
    small_run: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = ["view", str(small_run), "-o", str(tmp_path / "v.rrd")]
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_refused(view, small_run, "pip install 'redetect[view]'", capsys)


@pytest.mark.long
def test_recording_is_written(small_run: Path, tmp_path: Path, capsys: Captured) -> None:
    pytest.importorskip("rerun")
    output = tmp_path / "v.rrd"
    view = ["view", str(small_run), "-o", str(output)]
    assert_refused(view, small_run, "detect all", capsys)
    assert main(["circles", str(small_run)]) == 0
    assert main(view) == 0
    content = output.read_bytes()
    assert content.startswith(b"RRF2")
    for entity in (b"camera/image/discs", b"world/path", b"world/robot"):
        assert entity in content
    capsys.readouterr()
    assert_refused(view, small_run, "--force", capsys)
