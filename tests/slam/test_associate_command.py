"""``slam associate`` on files: which bytes change, what is scored, what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from redetect.landmarks import (
    CircleLandmark,
    LineLandmark,
    Step,
    read_frames,
    read_rows,
    write_rows,
)
from redetect.slam.cli import main
from redetect.slam.noise import with_relative_noise
from redetect.slam.recording import read_recording


def _without_ids(text: bytes) -> bytes:
    """Rows of discs without what follows their six numbers."""
    return re.sub(rb"(?m)^(LANDMARK_C(?: \S+){6})(?: -?\d+)*", rb"\1", text)


def test_only_ids_change_and_scores_stand_beside(project_root: Path, tmp_path: Path) -> None:
    source = project_root / "images" / "e" / "map.circles"
    target = tmp_path / "found.circles"
    assert main(["associate", str(source), "-o", str(target), "--noise", "1"]) == 0
    assert target.read_bytes() != source.read_bytes()
    assert _without_ids(target.read_bytes()) == _without_ids(source.read_bytes())
    discs = [d for frame in read_frames(target) for d in frame.circles]
    ids = [disc.ids for disc in discs]
    assert all(len(own) == 1 and (own[0] == -1 or ids.count(own) >= 3) for own in ids)
    report = json.loads((tmp_path / "found.json").read_text())
    assert [run["noise"] for run in report["runs"]] == [0.0, 1.0]
    score = report["runs"][0]["scores"]["circles"]["map"]
    assert score["rows"] == 304
    assert score["pair_precision"] == 1.0
    assert score["splits"] == 0
    assert score["unlabelled_rows"] == sum(own == (-1,) for own in ids) <= 6
    assert report["settings"]["method"] == "joint"


@pytest.mark.long
def test_discs_and_lines_of_a_folder_go_into_two_files(project_root: Path, tmp_path: Path) -> None:
    target = tmp_path / "found.circles"
    run = str(project_root / "images" / "e")
    assert main(["associate", run, "--circles", "--lines", "-o", str(target)]) == 0
    lines = [row.record for row in read_rows(tmp_path / "found.lines")]
    shipped = [row.record for row in read_rows(project_root / "images" / "e" / "map.lines")]
    assert len(lines) == len(shipped)
    for found, row in zip(lines, shipped):
        if isinstance(row, LineLandmark):
            assert isinstance(found, LineLandmark)
            assert (found.alpha, found.sigma) == (row.alpha, row.sigma)
        else:
            assert found == row
    scores = json.loads((tmp_path / "found.json").read_text())["runs"][0]["scores"]
    assert set(scores) == {"circles", "lines"}
    # Those listed cross the horizon: few of each, and near to each other.
    assert scores["lines"]["map"]["right_rows"] > 0.6


def test_a_run_without_ids_gets_some_and_no_score(tmp_path: Path, project_root: Path) -> None:
    text = _without_ids((project_root / "images" / "e" / "map.circles").read_bytes())
    (tmp_path / "detected.circles").write_bytes(text.replace(b"\n", b"\r\n"))
    assert main(["associate", str(tmp_path), "--method", "nearest", "--no-map-level"]) == 0
    result = (tmp_path / "associated.circles").read_bytes()
    assert _without_ids(result) == (tmp_path / "detected.circles").read_bytes()
    known = read_recording(project_root / "images" / "e").circles.ids
    found = read_recording(tmp_path / "associated.circles").circles.ids
    assert len(set(found[known >= 0].tolist())) == len(set(known[known >= 0].tolist()))
    report = json.loads((tmp_path / "associated.json").read_text())
    assert report["runs"][0]["scores"] == {}
    assert not any(
        isinstance(row.record, CircleLandmark) and row.record.ids
        for row in read_rows(tmp_path / "detected.circles")
    )


def test_existing_files_and_settings_without_sense_are_refused(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(project_root / "images" / "e")
    target = tmp_path / "kept.circles"
    (tmp_path / "kept.json").write_text("mine")
    assert main(["associate", run, "-o", str(target)]) == 1
    assert not target.exists()
    (tmp_path / "kept.json").unlink()
    for setting, message in (
        (["--gate-probability", "1.5"], "--gate-probability is 1.5"),
        (["--sigma-scale", "0"], "--sigma-scale is 0"),
        (["--tilt-sigma-deg", "-1"], "--tilt-sigma-deg is -1"),
        (["--kept-probability", "0"], "--kept-probability is 0"),
        (["--fewest-rows", "0"], "--fewest-rows is 0"),
        (["--noise", "-1"], "--noise is -1: expected 0 or more"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["associate", run, "-o", str(target), *setting])
        assert message in capsys.readouterr().err
        assert not target.exists()
    report = tmp_path / "found.json"
    assert main(["associate", run, "-o", str(report), "--force"]) == 1
    assert "two of the outputs would be written there" in capsys.readouterr().err
    assert not report.exists()


def test_relative_noise_is_that_multiple_of_the_rows_own(project_root: Path) -> None:
    recording = read_recording(project_root / "images" / "e", circles=True, lines=True)
    noisy = with_relative_noise(recording, 2.0, seed=4)
    assert noisy.circles.covariance == pytest.approx(5.0 * recording.circles.covariance)
    assert noisy.lines.sigma_rad == pytest.approx(np.sqrt(5.0) * recording.lines.sigma_rad)
    off = noisy.circles.xy - recording.circles.xy
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(4.0 * recording.circles.covariance), off)
    assert np.mean(squared) == pytest.approx(2.0, abs=4 * np.sqrt(4 / len(off)))
    turned = (noisy.lines.bearing_rad - recording.lines.bearing_rad) / recording.lines.sigma_rad
    assert np.std(turned) == pytest.approx(2.0, abs=4 * 2.0 / np.sqrt(2 * len(turned)))
    assert with_relative_noise(recording, 0.0, seed=4).circles.xy.tolist() == (
        recording.circles.xy.tolist()
    )


@pytest.mark.parametrize(
    ("scale", "said"),
    [(0.001, "steps lose the discs in view: do rows and odometry fit"), (100.0, "metres?")],
)
def test_odometry_in_another_unit_is_doubted(
    scale: float, said: str, project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = read_rows(project_root / "images" / "e" / "map.circles")
    scaled = []
    for row in rows:
        step = row.record
        if isinstance(step, Step):
            own = (scale * step.dx, scale * step.dy, step.dphi)
            row = row.with_record(Step(step.prefix, *own, *np.zeros(6).tolist()))
        scaled.append(row)
    write_rows(tmp_path / "map.circles", scaled)
    main(["associate", str(tmp_path)])
    assert said in capsys.readouterr().err
    main(["associate", str(project_root / "images" / "e"), "-o", str(tmp_path / "right.circles")])
    assert "metres" not in capsys.readouterr().err
