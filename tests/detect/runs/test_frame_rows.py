"""Rows of frames that are worked on together, and lines of their journal."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import lut.cache
from detect.line_settings import LineSettings
from detect.runs import frame as rows_module
from detect.runs.frame import FrameDetections, detect_batch, rows_of_frames
from detect.runs.journal import Journal, task_digest
from detect.runs.plan import FramePlan, FramePriors, FrameRows, FrameTask
from detect.settings import PUBLISHED, CircleSettings
from detect.sources.interface import RunFrame
from detect.sources.opening import open_run
from redetect.landmarks import FrameTilt
from redetect.storage.parts import left_part, new_part
from tests.detect.demo_frames import demo_frames

FRAMES = 12


@pytest.fixture
def tasks_and_plan(project_root: Path, tmp_path: Path) -> tuple[list[FrameTask], FramePlan]:
    """More frames than are decoded at once; of some there is no image."""
    run = demo_frames(project_root, tmp_path / "e", range(FRAMES))
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
    together = rows_of_frames(tasks, plan)
    assert together == [rows for t in tasks for rows in rows_of_frames([t], plan)]
    assert [place for place, rows in enumerate(together) if rows.error is not None] == [3, 9]
    for rows, task in zip(together, tasks):
        circles = rows.rows["circles"]
        assert circles.startswith(f"STEP {task.frame.step.prefix} ")
        assert rows.found.get("discs", 0) == circles.count("LANDMARK_C")


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
    rows_of_frames(tasks, plan)
    assert sizes == [5, 5, 2]


def test_tables_are_loaded_once(
    tasks_and_plan: tuple[list[FrameTask], FramePlan], monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks, plan = tasks_and_plan
    plan = replace(plan, lines=LineSettings(), circles=CircleSettings())
    first = detect_batch(tasks[:1], plan)

    def loaded_again(*_: Any, **__: Any) -> bytes:
        raise AssertionError

    monkeypatch.setattr(lut.cache, "read_bounded", loaded_again)
    again = detect_batch(tasks[:1], plan)
    assert again[0].lines is not None
    assert first[0].lines is not None
    assert again[0].lines.landmarks() == first[0].lines.landmarks()


def test_tasks_travel_whole(tasks_and_plan: tuple[list[FrameTask], FramePlan]) -> None:
    tasks, _ = tasks_and_plan
    tilt = FrameTilt("e.0001", 0.1, 0.2, 1e-6, 0.0, 1e-6, 7)
    tasks[1] = FrameTask(tasks[1].frame, FramePriors(tilt))
    shipped = RunFrame(tasks[2].frame.step, None, b"content", 1.5, "why")
    assert pickle.loads(pickle.dumps(tasks)) == tasks
    arrived = pickle.loads(pickle.dumps(shipped))
    assert arrived == shipped
    assert arrived.content == b"content"


ROWS_OF_JOURNAL = (
    FrameRows("e.0001", {"circles": "STEP\nLANDMARK_C\n"}, {"discs": 3, "lines": 21}),
    FrameRows("e.0002", {"lines": "a\udcff\n", "tilt": ""}, {"markers": 2}, {"size": 4, "ink": 1}),
    FrameRows("\udcff", {}, error='"e.0003": cannot be decoded:\n \\ \udcff'),
)


def test_a_journal_gives_back_what_was_noted(
    tasks_and_plan: tuple[list[FrameTask], FramePlan], tmp_path: Path
) -> None:
    tasks = tasks_and_plan[0][:3]
    with new_part(tmp_path / "a", "journal") as file:
        journal = Journal(file)
        journal.write(["program"])
        journal.write_frames(list(zip(tasks, ROWS_OF_JOURNAL)))
        assert journal.is_by("program")
        assert not journal.is_by("another program")
        assert list(journal.frames()) == list(zip(map(task_digest, tasks), ROWS_OF_JOURNAL))
        assert journal.complete() is None
    assert not list(tmp_path.glob(".*"))


def test_a_journal_goes_on_behind_what_is_taken_over(
    tasks_and_plan: tuple[list[FrameTask], FramePlan], tmp_path: Path
) -> None:
    first, second, third = zip(tasks_and_plan[0], ROWS_OF_JOURNAL)
    file = new_part(tmp_path / "a", "journal")
    journal = Journal(file)
    journal.write(["program"])
    journal.write_frames([first, second])
    file.close()
    left = left_part(tmp_path / "a", "journal")
    assert left is not None
    with left:
        journal = Journal(left)
        for _, rows in journal.frames():
            if rows == second[1]:
                break
        journal.cut()
        journal.write_frames([third])
        journal.write_complete([0, 1], overwrite=True)
        assert journal.complete() == ([0, 1], True)
        assert [rows for _, rows in journal.frames()] == [first[1], third[1]]
