"""Maps of simulated runs against their truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from redetect.slam.mapping.run_map import map_run
from redetect.slam.recording import read_recording
from tools.evaluation.__main__ import main as evaluate
from tools.evaluation.maps import disc_errors, path_distance, read_truth, with_right_odometry
from tools.simulator.__main__ import main as simulate

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "s"
    assert simulate(["rows", str(folder), "--frames", "150", "--discs", "40", "--seed", "3"]) == 0
    return folder


def test_a_map_with_right_covariances_is_as_near_as_they_say(run: Path) -> None:
    truth = read_truth(run)
    mapped = map_run(with_right_odometry(read_recording(run), truth, 1))
    assert mapped.table.factor == pytest.approx(1.0, abs=0.2)
    assert path_distance(mapped.estimate.poses, truth) < 0.5
    off, nees = disc_errors(mapped, truth)
    assert off < 0.5
    assert 0.3 < nees < 3.0


def test_only_wrong_steps_are_measured_anew(run: Path) -> None:
    truth, recording = read_truth(run), read_recording(run)
    truth.wrong_odometry[10] = True
    right = with_right_odometry(recording, truth, 1)
    changed = np.any(right.steps != recording.steps, axis=1)
    np.testing.assert_array_equal(changed, truth.wrong_odometry)


def test_tables_are_printed(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(["map", str(run)]) == 0
    out = capsys.readouterr().out
    assert "as simulated" in out
    assert "right covariances" in out
    assert evaluate(["nothing"]) == 2
