"""Rows of frames that are worked on together, and lines of their journal."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from detect.run import RunFrame, open_run
from detect.runs import rows as rows_module
from detect.runs.frame import FrameDetections, FramePlan, FrameTask, detect_batch, tables_of
from detect.runs.journal import (
    JournalFrame,
    JournalHead,
    left_journal,
    new_journal,
    record_of,
    unnamed_journal,
)
from detect.runs.known import KnownOfFrame
from detect.runs.rows import FrameRows, rows_of_frames
from detect.settings import PUBLISHED
from landmarks import FrameTilt

FRAMES = 12


@pytest.fixture
def tasks_and_plan(project_root: Path, tmp_path: Path) -> tuple[list[FrameTask], FramePlan]:
    """More frames than are decoded at once; of some there is no image."""
    source, run = project_root / "images" / "e", tmp_path / "e"
    (run / "images").mkdir(parents=True)
    shutil.copy(source / "e.cam", run)
    for number in range(FRAMES):
        shutil.copy(source / "images" / f"e.{number:04d}.jpg", run / "images")
    opened = open_run(run)
    (run / "images" / "e.0003.jpg").write_bytes(b"no image")
    (run / "images" / "e.0009.jpg").unlink()
    return [FrameTask(frame) for frame in opened.frames], FramePlan(
        opened.camera, circles=PUBLISHED
    )


def test_frames_have_the_same_rows_together_and_alone(
    tasks_and_plan: tuple[list[FrameTask], FramePlan],
) -> None:
    tasks, plan = tasks_and_plan
    together = rows_of_frames(tasks, plan, tables_of(plan))
    assert together == [rows for t in tasks for rows in rows_of_frames([t], plan, tables_of(plan))]
    assert [place for place, rows in enumerate(together) if rows.error is not None] == [3, 9]
    for rows, task in zip(together, tasks):
        circles = rows.rows["circles"]
        assert circles.startswith(f"STEP {task.frame.step.prefix} ".encode())
        assert rows.found.get("discs", 0) == circles.count(b"LANDMARK_C")


def test_no_more_images_are_in_memory_than_agreed(
    tasks_and_plan: tuple[list[FrameTask], FramePlan], monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks, plan = tasks_and_plan
    assert plan.camera is not None
    sizes = []

    def noted(batch: Sequence[FrameTask], *others: Any) -> list[FrameDetections]:
        sizes.append(len(batch))
        return detect_batch(batch, *others)

    monkeypatch.setattr(rows_module, "detect_batch", noted)
    monkeypatch.setattr(rows_module, "PIXELS_AT_ONCE", 5 * plan.camera.width * plan.camera.height)
    rows_of_frames(tasks, plan, tables_of(plan))
    assert sizes == [5, 5, 2]


REHEARSAL = """
import sys
from pathlib import Path
from detect.line_settings import LineSettings
from detect.run import open_run
from detect.runs.frame import FramePlan, FrameTask, rehearse, tables_of
from detect.runs.rows import rows_of_frames
from detect.settings import CircleSettings

run = open_run(Path(sys.argv[1]))
plan = FramePlan(run.camera, lines=LineSettings(), circles=CircleSettings())
rehearse(plan)
from numba.core.caching import Cache
numbas_own = Cache.load_overload
def told(cache, *others):
    print(cache.cache_path, cache._impl.filename_base)
    return numbas_own(cache, *others)
Cache.load_overload = told
frame = next(iter(run.frames))
(rows,) = rows_of_frames([FrameTask(frame)], plan, tables_of(plan))
print(rows.error, *[rows.found[kind] > 0 for kind in ("discs", "lines", "tilts")])
"""


def test_after_a_rehearsal_no_kernel_is_missing(project_root: Path) -> None:
    """Else every worker would compile it for itself."""
    run = project_root / "images" / "e"
    said = subprocess.run(
        [sys.executable, "-c", REHEARSAL, str(run)],
        cwd=project_root,
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.splitlines() == ["None True True True"]


def test_tasks_travel_whole(tasks_and_plan: tuple[list[FrameTask], FramePlan]) -> None:
    tasks, _ = tasks_and_plan
    tilt = FrameTilt("e.0001", 0.1, 0.2, 1e-6, 0.0, 1e-6, 7)
    tasks[1] = FrameTask(tasks[1].frame, KnownOfFrame(tilt))
    shipped = RunFrame(tasks[2].frame.step, None, b"content", 1.5, 12, "why")
    assert pickle.loads(pickle.dumps(tasks)) == tasks
    arrived = pickle.loads(pickle.dumps(shipped))
    assert arrived == shipped
    assert arrived.content == b"content"


FRAMES_OF_JOURNAL = (
    JournalFrame("cd", {"circles": "STEP\nLANDMARK_C\n"}, {"discs": 3, "lines": 21}, {}, None),
    JournalFrame("cd", {}, {"markers": 2}, {"size": 4, "ink": 1}, None),
    JournalFrame("", {"tilt": "\udcff"}, {}, {}, '"e.0003": cannot be decoded:\n \\ \udcff'),
)


def test_a_journal_gives_back_what_was_noted(tmp_path: Path) -> None:
    result = tmp_path / "a"
    for journal in (new_journal(tmp_path / ".a.journal", result), unnamed_journal(result)):
        assert journal is not None
        head = JournalHead("program", overwrite=False)
        for record in (head, *FRAMES_OF_JOURNAL):
            journal.write(record)
        assert (journal.head(), tuple(journal.frames())) == (head, FRAMES_OF_JOURNAL)
        assert journal.parts() is None
        journal.remove()
    assert list(tmp_path.iterdir()) == []


def test_rows_come_back_as_bytes(
    tasks_and_plan: tuple[list[FrameTask], FramePlan], tmp_path: Path
) -> None:
    task = tasks_and_plan[0][0]
    rows = FrameRows({"lines": b"a\xff\n", "tilt": b"", "times": b"1\n"}, {"lines": 1})
    journal = unnamed_journal(tmp_path / "a")
    journal.write(JournalHead("program", overwrite=False))
    journal.write(record_of(task, rows, ["lines", "tilt"]))
    (frame,) = journal.frames()
    journal.close()
    assert frame.frame_rows() == FrameRows({"lines": b"a\xff\n"}, {"lines": 1})


def test_a_journal_goes_on_behind_what_is_taken_over(tmp_path: Path) -> None:
    first, second, third = FRAMES_OF_JOURNAL
    place, result = tmp_path / ".a.journal", tmp_path / "a"
    journal = new_journal(place, result)
    assert journal is not None
    for record in (JournalHead("program", overwrite=True), first, second):
        journal.write(record)
    journal.close()
    left = left_journal(place, result)
    assert left is not None
    for frame in left.frames():
        if frame == second:
            break
    left.cut()
    left.write(third)
    left.complete([0, 1])
    assert left.parts() == [0, 1]
    assert list(left.frames()) == [first, third]
    left.remove()
