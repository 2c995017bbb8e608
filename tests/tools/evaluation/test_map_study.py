"""Maps of simulated runs against their truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from redetect.slam.commands.files import camera_of_run
from redetect.slam.mapping.run_map import map_run
from redetect.slam.models import disc_in_robot
from redetect.slam.mounting import directions_of_rows, rotation_exp, rows_through_mounting
from redetect.slam.recording import UNKNOWN_ID, read_recording
from tools.evaluation.__main__ import main as evaluate
from tools.evaluation.maps import (
    distance,
    miswritten,
    overconfident,
    read_truth,
    shown,
    true_ids,
    with_right_odometry,
    with_true_places,
)
from tools.simulator.__main__ import main as simulate

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "s"
    assert simulate(["rows", str(folder), "--frames", "150", "--discs", "40", "--seed", "3"]) == 0
    return folder


def test_overconfident_covariances_double_the_factor(run: Path) -> None:
    truth = read_truth(run)
    right = with_right_odometry(read_recording(run), truth, 1)
    mapped = map_run(right)
    assert mapped.table.factor == pytest.approx(1.0, abs=0.2)
    doubled = map_run(overconfident(right, 2.0))
    assert doubled.table.factor == pytest.approx(2.0 * mapped.table.factor, rel=1e-6)
    assert distance(mapped, truth).path_rms_m < 0.5


def test_only_wrong_steps_are_measured_anew(run: Path) -> None:
    truth, recording = read_truth(run), read_recording(run)
    truth.wrong_odometry[10] = True
    right = with_right_odometry(recording, truth, 1)
    changed = np.any(right.steps != recording.steps, axis=1)
    np.testing.assert_array_equal(changed, truth.wrong_odometry)


def test_true_identifiers_are_found_again(run: Path) -> None:
    truth, circles = read_truth(run), read_recording(run).circles
    found = true_ids(circles, truth)
    known = circles.ids != UNKNOWN_ID
    assert np.mean(found[known] == circles.ids[known]) > 0.99


def test_landmarks_are_what_most_of_their_rows_show() -> None:
    used = np.array([1, 1, 1, 2, 2])
    ids = np.array([7, 7, -1, -1, -1])
    np.testing.assert_array_equal(shown(used, ids, np.array([1, 2])), [7, -1])


def test_rows_at_true_places_have_the_errors_that_they_state(run: Path) -> None:
    truth, recording = read_truth(run), read_recording(run)
    mapped = map_run(with_true_places(recording, recording.circles.ids, truth, 5))
    rows = mapped.table.discs / (2 * len(mapped.graph.disc_pose))
    assert rows == pytest.approx(0.9, abs=0.15)


def test_rows_of_another_mounting_are_those_that_calibration_undoes(run: Path) -> None:
    truth, camera = read_truth(run), camera_of_run(run)
    recording = read_recording(run)
    change = np.array([-0.03, 0.01, 0.004, -0.02])
    same = miswritten(recording, truth, camera, np.zeros(4), 1)
    other = miswritten(recording, truth, camera, change, 1)
    noise_free = other.circles.xy - same.circles.xy
    turn, _ = rotation_exp(change[:3])
    mounting = np.column_stack(
        [turn @ camera.rotation, camera.centre + np.append([0.0, 0.0], change[3])]
    )
    places = np.array([truth.discs[int(i)] for i in same.circles.ids])
    seen = disc_in_robot(truth.poses[same.circles.frame + 1], places)
    back, _ = rows_through_mounting(camera, directions_of_rows(camera, seen + noise_free), mounting)
    np.testing.assert_allclose(back, seen, atol=2e-5)


def test_tables_are_printed(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(["map", str(run)]) == 0
    out = capsys.readouterr().out
    assert "as simulated" in out
    assert "overconfident by 2" in out
    assert evaluate(["map-redetected", str(run), str(run / "map.circles"), "--seeds", "2"]) == 0
    assert "map.circles" in capsys.readouterr().out
    assert evaluate(["nothing"]) == 2
