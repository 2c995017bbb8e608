"""Rows whose identifier contradicts the rest: those that are known to are found, no others."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera import Camera
from redetect.array_types import FloatArray, IntArray
from redetect.landmarks import read_frames
from redetect.plane import apply
from redetect.slam.cli import main
from redetect.slam.errors import SlamError
from redetect.slam.mapping.audit import audit_run
from redetect.slam.models import disc_in_robot
from redetect.slam.recording import LineRows, Recording, read_recording
from tests.slam.small_run import SmallRun, small_run
from tests.slam.test_map_solution import written_when_mounted


def discs_only(seed: int, discs: int = 14) -> SmallRun:
    """Two laps of 120 steps."""
    run = small_run(seed, steps=240, discs=discs)
    none = LineRows.of()
    return replace(run, recording=replace(run.recording, lines=none))


def second_lap(run: SmallRun, number: int) -> IntArray:
    """Rows of a disc in the second lap."""
    circles = run.recording.circles
    return np.flatnonzero((circles.ids == number) & (circles.frame >= 120))


def spoilt(
    run: SmallRun, *, ids: IntArray | None = None, xy: FloatArray | None = None
) -> Recording:
    circles = run.recording.circles
    ids, xy = circles.ids if ids is None else ids, circles.xy if xy is None else xy
    return replace(run.recording, circles=replace(circles, ids=ids, xy=xy))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_nothing_is_accused_where_nothing_is_wrong(seed: int) -> None:
    audit = audit_run(discs_only(seed).recording, gate=30.0)
    assert audit.groups == ()
    assert audit.before.chi_squared == pytest.approx(audit.mended.chi_squared, rel=1e-6)
    assert audit.before.measurements == audit.mended.measurements


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_exchanged_identifiers_are_found_and_exchanged_back(seed: int) -> None:
    run = discs_only(seed)
    one, other = second_lap(run, 4)[:5], second_lap(run, 9)[2:5]
    ids = run.recording.circles.ids.copy()
    ids[one], ids[other] = 9, 4
    audit = audit_run(spoilt(run, ids=ids))
    found = {int(k): group for group in audit.groups for k in group.rows}
    assert sorted(found) == sorted([*one, *other])
    assert {group.kind for group in audit.groups} == {"exchange"}
    for k, group in found.items():
        assert group.new_id == run.recording.circles.ids[k]
        assert group.mended_chi_squared < 30.0 < group.chi_squared
    true = audit_run(run.recording).before
    assert audit.before.chi_squared > 2.0 * true.chi_squared
    assert audit.mended.chi_squared == pytest.approx(true.chi_squared, rel=1e-6)
    assert audit.dropped.measurements == true.measurements - len(found)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_neighbours_in_the_same_frames_are_exchanged_back(seed: int) -> None:
    run = discs_only(seed, discs=28)
    circles = run.recording.circles
    both = np.intersect1d(circles.frame[second_lap(run, 6)], circles.frame[second_lap(run, 7)])[:4]
    rows = np.flatnonzero(np.isin(circles.frame, both) & np.isin(circles.ids, [6, 7]))
    ids = circles.ids.copy()
    ids[rows] = 13 - ids[rows]
    audit = audit_run(spoilt(run, ids=ids))
    assert sorted(np.concatenate([g.rows for g in audit.groups])) == sorted(rows)
    assert {(g.id, g.new_id) for g in audit.groups} == {(6, 7), (7, 6)}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_landmark_that_lay_elsewhere_becomes_one_of_its_own(seed: int) -> None:
    run = discs_only(seed)
    circles = run.recording.circles
    moved = second_lap(run, 5)[:6]
    pose = run.poses[circles.frame[moved] + 1]
    xy = circles.xy.copy()
    xy[moved] = disc_in_robot(pose, apply(pose, xy[moved]) + np.array([0.7, -0.5]))
    audit = audit_run(spoilt(run, xy=xy))
    (group,) = audit.groups
    assert group.rows.tolist() == moved.tolist()
    assert (group.id, group.kind, group.new_id) == (5, "split", 15)
    assert group.own_m == pytest.approx(np.hypot(0.7, 0.5), abs=0.1)
    assert audit.mended.landmarks == audit.before.landmarks + 1


def test_rows_of_a_moving_thing_are_no_landmark() -> None:
    run = discs_only(1)
    circles = run.recording.circles
    rows = second_lap(run, 5)[:6]
    pose = run.poses[circles.frame[rows] + 1]
    xy = circles.xy.copy()
    xy[rows] = disc_in_robot(pose, apply(pose, xy[rows]) + np.arange(2, 8)[:, None] * 0.3)
    audit = audit_run(spoilt(run, xy=xy))
    assert sorted(np.concatenate([g.rows for g in audit.groups])) == rows.tolist()
    assert {group.kind for group in audit.groups} == {"drop"}


def test_the_cameras_place_is_no_error_of_the_rows(published_camera: Camera) -> None:
    run = small_run(7, noise=0.0, steps=240, weave_rad=0.2)
    mounting = np.column_stack([published_camera.rotation, published_camera.centre])
    mounting[1, 3] += 0.5
    discs = replace(run.recording, lines=LineRows.of())
    written = written_when_mounted(discs, published_camera, mounting)
    ids = written.circles.ids.copy()
    ids[second_lap(run, 4)[:5]] = 9
    spoilt = replace(written, circles=replace(written.circles, ids=ids))
    (group,) = audit_run(spoilt, published_camera, calibrate=True).groups
    assert group.new_id == 4
    assert group.mended_chi_squared < 2.0


def test_a_lost_step_is_not_expected_to_have_an_error() -> None:
    run = discs_only(1).recording
    spread = run.step_covariance.copy()
    spread[100] = np.diag([1e6, 1e6, 100.0])
    audit = audit_run(replace(run, step_covariance=spread))
    assert audit.before.expected == audit.dropped.expected == audit.mended.expected
    assert audit.before.expected == audit_run(run).before.expected - 3


@pytest.fixture(scope="module")
def spoilt_demo(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """The demo run, an identifier exchanged in five of its frames, with odd blanks and comments."""
    folder = tmp_path_factory.mktemp("audit") / "e"
    shutil.copytree(project_root / "images" / "e", folder)
    file = folder / "map.circles"
    rows, wrong = [], 0
    for line in file.read_bytes().splitlines(keepends=True):
        if line.startswith(b"LANDMARK_C") and line.split()[-1] == b"11":
            wrong += 1
            if wrong <= 5:
                line = line.rstrip().removesuffix(b"11") + b"\t 30  # by hand\r\n"
        rows.append(line)
    assert wrong > 10
    file.write_bytes(b"".join(rows))
    return folder


def test_mending_leaves_all_other_rows(spoilt_demo: Path, tmp_path: Path) -> None:
    output, pictures = tmp_path / "a.circles", tmp_path / "pictures"
    arguments = ["audit", str(spoilt_demo), "-o", str(output), "--pictures", str(pictures)]
    assert main(arguments) == 0
    before = (spoilt_demo / "map.circles").read_bytes().splitlines(keepends=True)
    after = output.read_bytes().splitlines(keepends=True)
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(changed) == 5
    for a, b in changed:
        assert b.split() == a.replace(b"\t 30  # by hand", b" 11").split()
    table = output.with_suffix(".csv").read_text(encoding="utf-8").splitlines()
    assert [line.split(",")[3:6] for line in table[2:]] == [["30", "exchange", "11"]] * 5
    assert len(list(pictures.glob("*.png"))) > 0
    assert main(arguments) == 1  # nothing is overwritten unasked
    table_file = str(output.with_suffix(".csv"))
    assert main(["audit", str(spoilt_demo), "-o", table_file, "--force"]) == 1
    bytes_before = output.read_bytes(), output.with_suffix(".csv").read_bytes()
    assert main([*arguments, "--force"]) == 0
    assert (output.read_bytes(), output.with_suffix(".csv").read_bytes()) == bytes_before


def test_images_in_another_folder_leave_the_calibration_that_of_the_run(
    spoilt_demo: Path, tmp_path: Path
) -> None:
    (tmp_path / "images").mkdir()
    arguments = ["audit", str(spoilt_demo), "-o", str(tmp_path / "a.circles")]
    images = ["--images", str(tmp_path / "images"), "--pictures", str(tmp_path / "pictures")]
    assert main([*arguments, *images]) == 0


def test_dropping_leaves_out_the_lines(spoilt_demo: Path, tmp_path: Path) -> None:
    output = tmp_path / "a.circles"
    assert main(["audit", str(spoilt_demo), "--apply", "drop", "-o", str(output)]) == 0
    before = (spoilt_demo / "map.circles").read_bytes().splitlines(keepends=True)
    kept = [line for line in before if b"by hand" not in line]
    assert output.read_bytes() == b"".join(kept)


def test_what_no_landmark_explains_loses_its_identifier(project_root: Path, tmp_path: Path) -> None:
    file = tmp_path / "map.circles"
    lines = (project_root / "images" / "e" / "map.circles").read_bytes().splitlines(keepends=True)
    k = next(i for i, line in enumerate(lines) if line.split()[-1:] == [b"4"])
    lines[k] = b"LANDMARK_C 1.5 -0.9 0.9 0.0017 0 0.0017 -1 4\n"
    file.write_bytes(b"".join(lines))
    output = tmp_path / "a.circles"
    assert main(["audit", str(file), "--gate", "60", "-o", str(output)]) == 0
    after = output.read_bytes().splitlines(keepends=True)
    assert after[k].split() == b"LANDMARK_C 1.5 -0.9 0.9 0.0017 0 0.0017 -1".split()
    assert after[:k] + after[k + 1 :] == lines[:k] + lines[k + 1 :]
    assert len(list(read_frames(output))) == len(list(read_frames(file)))


def test_a_row_behind_the_camera_has_no_picture(
    project_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, file = project_root / "images" / "e", tmp_path / "map.circles"
    lines = (run / "map.circles").read_bytes().splitlines(keepends=True)
    k = next(i for i, line in enumerate(lines) if line.split()[-1:] == [b"4"])
    lines[k] = b"LANDMARK_C 1.5 3.0 0.9 0.0017 0 0.0017 -1 4\n"
    file.write_bytes(b"".join(lines))
    camera = ["--camera", str(run / "e.cam"), "--images", str(run)]
    assert main(["audit", str(file), *camera, "--pictures", str(tmp_path / "pictures")]) == 0
    assert "pictures of 0 of 1 groups" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--gate", "0"], "--gate is 0: expected above 0"),
        (["--gate", "1e300"], "--gate is 1e+300: expected above 0, at most 1e+24"),
    ],
)
def test_impossible_settings_are_refused(
    project_root: Path, flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(project_root / "images" / "e")
    with pytest.raises(SystemExit, match="2"):
        main(["audit", run, *flags])
    assert said in capsys.readouterr().err
    assert main(["audit", run, "--lines"]) == 1
    assert "expected discs" in capsys.readouterr().err


def test_a_gate_that_no_row_passes_is_refused() -> None:
    run = replace(small_run(1, steps=20).recording, lines=LineRows.of())
    with pytest.raises(SlamError, match=r"no row is certain with gate 0\.001: expected a larger"):
        audit_run(run, gate=1e-3)


@pytest.mark.long
def test_the_published_list_is_that_of_the_real_run(shared_data: Path, project_root: Path) -> None:
    recording = read_recording(shared_data / "dlr" / "map.circles")
    audit = audit_run(recording)
    lines = (project_root / "docs" / "slam" / "run-e-audit.csv").read_text().splitlines()[2:]
    listed = {(int(w[0]), int(w[3]), w[4]) for w in (line.split(",") for line in lines)}
    assert listed == {
        (int(recording.circles.frame[k]), group.id, group.kind)
        for group in audit.groups
        for k in group.rows
    }
    assert len(listed) == 49
    assert audit.before.factor == pytest.approx(2.07, abs=0.01)
    assert audit.mended.factor == pytest.approx(1.02, abs=0.01)
