"""Rows of frames that are worked on together, and lines of their journal."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from detect.run import RunFrame, open_run
from detect.runs.frame import FramePlan, tables_of
from detect.runs.frame_rows import FrameRows, FrameTask, rows_of_frames
from detect.runs.resume_journal import Journal, JournalHead, line_of_frame, new_journal
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
        assert rows.circles.startswith(f"STEP {task.frame.step.prefix} ".encode())
        assert rows.disc_count == rows.circles.count(b"LANDMARK_C")


REHEARSAL = """
import sys
from pathlib import Path
from storage.kernel_loading import load_kernels_alone
from detect.line_settings import LineSettings
from detect.run import open_run
from detect.runs.frame import FramePlan, rehearse, tables_of
from detect.runs.frame_rows import FrameTask, rows_of_frames
from detect.settings import CircleSettings

load_kernels_alone()
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
print(rows.error, rows.disc_count > 0, rows.line_count > 0, rows.has_tilt)
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
    tasks[1] = FrameTask(tasks[1].frame, FrameTilt("e.0001", 0.1, 0.2, 1e-6, 0.0, 1e-6, 7))
    shipped = RunFrame(tasks[2].frame.step, None, b"content", 1.5, 12, "why")
    assert pickle.loads(pickle.dumps(tasks)) == tasks
    arrived = pickle.loads(pickle.dumps(shipped))
    assert arrived == shipped
    assert arrived.content == b"content"


@pytest.mark.parametrize(
    "rows",
    [
        FrameRows(disc_count=3, line_count=21, has_tilt=True),
        FrameRows(marker_count=2, rejected=(("size", 4), ("ink", 1))),
        FrameRows(error='"e.0003": cannot be decoded:\n expected an image \\ \udcff'),
    ],
)
def test_a_journal_gives_back_what_was_noted(tmp_path: Path, rows: FrameRows) -> None:
    place = tmp_path / ".a.journal"
    journal = new_journal(place)
    assert isinstance(journal, Journal)
    journal.begin(JournalHead("program", (0, 1), overwrite=False))
    content = [b"x" * 120, b""]
    check, noted = line_of_frame("program", (120, 0), "0123456789abcdef", rows, content)
    journal.write([noted])
    head, lines = journal.read()
    (line,) = lines
    assert head == JournalHead("program", (0, 1), overwrite=False)
    assert (line.lengths, line.task, line.rows) == ((120, 0), "0123456789abcdef", rows)
    assert line.check == check
    # Lines that are written sooner than others are written the same way.
    written = place.read_bytes().splitlines()[1]
    assert json.dumps(json.loads(written), separators=(",", ":")).encode() == written
    journal.remove()
