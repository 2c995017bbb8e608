"""Recordings for Rerun: the path along the steps, and refusals in one line."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from detect.cli import main
from detect.projection import summed_steps
from redetect.landmarks import Step, read_frames
from tests.detect.commands import Captured, assert_refused
from tests.detect.recordings import images_of, write_video


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


def read_back(recording: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of each entity of a recording, static ones too, by Rerun's own reader."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(str(recording))
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader.stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {name: plain(batch.column(name)) for name in batch.schema.names}
        rows = [dict(zip(columns, row)) for row in zip(*columns.values())]
        found.setdefault(chunk.entity_path, []).extend(rows)
    return found


def plain(column: Any) -> list[Any]:
    """A column's values; Python's own times know no nanoseconds."""
    pa = pytest.importorskip("pyarrow")

    kinds = {pa.types.is_timestamp: pa.timestamp("us"), pa.types.is_duration: pa.duration("us")}
    for is_kind, microseconds in kinds.items():
        if is_kind(column.type):
            column = column.cast(microseconds, safe=False)
    return list(column.to_pylist())


@pytest.mark.lowest
@pytest.mark.long
def test_recording_holds_frames_rows_and_path(
    small_run: Path, tmp_path: Path, capsys: Captured
) -> None:
    pytest.importorskip("rerun")
    output = tmp_path / "v.rrd"
    view = ["view", str(small_run), "-o", str(output)]
    assert_refused(view, small_run, "detect all", capsys)
    assert main(["all", str(small_run)]) == 0
    assert main(view) == 0
    capsys.readouterr()
    assert_refused(view, small_run, "--force", capsys)

    found = read_back(output)
    detected = list(read_frames(small_run / "detected.circles"))
    wanted = [len(frame.circles) for frame in detected]
    assert sum(wanted) == 3
    for entity in ("/camera/image", "/world/robot", "/world/robot/discs"):
        assert [row["frame"] for row in found[entity]] == [0, 1, 2]
        assert all("time" not in row for row in found[entity])
    discs = {r["frame"]: r["LineStrips3D:strips"] for r in found["/world/robot/discs"]}
    assert [len(discs[k]) for k in range(3)] == wanted
    first = detected[0].circles[0]
    np.testing.assert_allclose(np.mean(discs[0][0], axis=0), [first.px, first.py, 0.0], atol=1e-3)
    robot = {r["frame"]: r["Transform3D:translation"][0] for r in found["/world/robot"]}
    poses = summed_steps([frame.step for frame in detected])
    np.testing.assert_allclose([robot[k][:2] for k in range(3)], poses[1:, :2], atol=1e-6)
    turns = {r["frame"]: r["Transform3D:quaternion"][0] for r in found["/world/robot"]}
    half = 0.5 * poses[1:, 2]
    expected = np.column_stack([0.0 * half, 0.0 * half, np.sin(half), np.cos(half)])
    np.testing.assert_allclose([turns[k] for k in range(3)], expected, atol=1e-6)
    (path,) = found["/world/path"][0]["LineStrips3D:strips"]
    np.testing.assert_allclose(np.array(path)[:, :2], poses[:, :2], atol=1e-6)


@pytest.mark.long
def test_times_of_a_video_are_in_its_recording(small_run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    images = images_of(small_run)
    video = write_video(tmp_path / "s.avi", images)
    camera = ["--camera", str(small_run / "s.cam")]
    assert main(["circles", str(video), *camera]) == 0
    output = tmp_path / "v.rrd"
    assert main(["view", str(video), *camera, "-o", str(output)]) == 0
    times = [row["time"].total_seconds() for row in read_back(output)["/world/robot"]]
    assert times == pytest.approx([0.0, 0.1, 0.2], abs=1e-6)


@pytest.mark.long
def test_a_frame_without_rows_or_image_shows_none_of_the_one_before(
    small_run: Path, tmp_path: Path
) -> None:
    pytest.importorskip("rerun")
    assert main(["circles", str(small_run)]) == 0
    rows = small_run / "detected.circles"
    head, *frames = re.split(r"(?m)^(?=STEP )", rows.read_text())
    rows.write_text(head + frames[0])
    (small_run / "images" / "s.0001.png").write_bytes(b"no image")
    output = tmp_path / "v.rrd"
    assert main(["view", str(small_run), "-o", str(output), "--frames", "2"]) == 3
    found = read_back(output)
    discs = {row["frame"]: row["LineStrips3D:strips"] for row in found["/world/robot/discs"]}
    assert discs[0]
    assert not discs[1]
    assert [row["frame"] for row in found["/camera/image"] if row.get("Clear:is_recursive")] == [1]
