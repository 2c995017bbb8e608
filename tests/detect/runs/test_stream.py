"""A run in, files out: the same bytes in one pass or two, by however many workers."""

from __future__ import annotations

import json
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.runs.plan import KEPT_FAILURES, FramePlan, FramesByImage, Job, Priors, RunSummary
from detect.runs.stream import detect_run
from detect.runs.workers import local_workers
from detect.settings import CircleSettings
from detect.sources.interface import Frames, RunFrame
from detect.sources.opening import open_run
from redetect.landmarks import read_frames, read_tilts
from tests.detect.commands import files_in
from tests.detect.demo_frames import demo_frames

LIGHT = CircleSettings(polarity="light")
FRAMES = 7


@pytest.fixture
def run_folder(project_root: Path, tmp_path: Path) -> Path:
    """Some frames of the demo run; one of them is broken, one is missing."""
    run = demo_frames(project_root, tmp_path / "e", range(0, 10 * FRAMES, 10))
    (run / "images" / "e.0002.jpg").write_bytes(b"not an image")
    (run / "images" / "e.0005.jpg").unlink()
    steps = [f"STEP e.{k:04d} 0.25 0 0.01 1e-5 0 1e-5 0 0 1e-4\n" for k in range(FRAMES)]
    (run / "e.txt").write_text("".join(steps))
    return run


def detect(
    run: Path, places: dict[str, Path], jobs: int = 1, known: Priors | None = None, **plan: Any
) -> RunSummary:
    """Detect in one pass, with a plan of discs or lines or both."""
    opened = open_run(run)
    wanted = FramePlan(opened.camera, **plan)
    return detect_run(Job(opened, wanted, places, known or Priors()), local_workers(jobs))


def in_folder(folder: Path, *kinds: str) -> dict[str, Path]:
    return {kind: folder / f"detected.{kind}" for kind in kinds}


def in_two_passes(run: Path, output: Path) -> None:
    detect(run, in_folder(output, "lines", "tilt"), lines=LineSettings())
    tilts = Priors(tilts=read_tilts(output / "detected.tilt"))
    detect(run, in_folder(output, "circles"), known=tilts, circles=LIGHT)


def in_one_pass(run: Path, output: Path, jobs: int) -> None:
    places = in_folder(output, "lines", "tilt", "circles")
    summary = detect(run, places, jobs, lines=LineSettings(), circles=LIGHT)
    assert (summary.frames, summary.failed) == (FRAMES, 2)
    assert summary.found["tilts"] >= 4
    assert summary.found["discs"] >= 5


def folder_of(path: Path) -> Path:
    path.mkdir()
    return path


def test_one_pass_writes_what_two_passes_do(run_folder: Path, tmp_path: Path) -> None:
    once, twice = folder_of(tmp_path / "once"), folder_of(tmp_path / "twice")
    in_two_passes(run_folder, twice)
    in_one_pass(run_folder, once, jobs=1)
    names = ["detected.circles", "detected.lines", "detected.tilt"]
    assert sorted(files_in(once)) == sorted([*names, "detected.lines.log.json"])
    for name in names:
        assert (once / name).read_bytes() == (twice / name).read_bytes()


def all_there_is(run: Path, output: Path, jobs: int) -> dict[str, bytes]:
    """Every kind of file: rows, tilts, IDs carried over, JSON."""
    in_one_pass(run, output, jobs)
    plain = in_folder(output, "lines", "tilt")
    reference = output / "reference.lines"
    numbered = (
        row[:-2] + f"{number}" if row.startswith("LANDMARK_L") else row
        for number, row in enumerate(plain["lines"].read_text().splitlines())
    )
    reference.write_text("\n".join(numbered) + "\n")
    places = {"lines": output / "known.lines", "tilt": output / "known.tilt"}
    known = Priors(lines=FramesByImage(reference))
    detect(run, places, jobs, known, lines=LineSettings())
    places = {"circles": output / "level.circles", "json": output / "level.json"}
    known = Priors(tilts=read_tilts(plain["tilt"]))
    detect(run, places, jobs, known, circles=LIGHT)
    return files_in(output)


@pytest.mark.long
def test_processes_write_what_one_does(run_folder: Path, tmp_path: Path) -> None:
    one = all_there_is(run_folder, folder_of(tmp_path / "one"), 1)
    two = all_there_is(run_folder, folder_of(tmp_path / "two"), 2)
    assert one == two
    known = [line for f in read_frames(tmp_path / "one" / "known.lines") for line in f.lines]
    assert sum(line.ids != (-1,) for line in known) > 0.5 * len(known) > 20


def test_json_is_what_the_library_writes(run_folder: Path, tmp_path: Path) -> None:
    as_json = tmp_path / "rows.json"
    detect(run_folder, {"circles": tmp_path / "o", "json": as_json}, circles=LIGHT)
    text = as_json.read_text()
    assert text == json.dumps(json.loads(text), indent=1) + "\n"


def test_a_run_without_odometry_of_its_images(small_run: Path, tmp_path: Path) -> None:
    (small_run / "s.txt").write_text("# nothing yet\n")
    with pytest.raises(DetectError, match=r"3 images are not named by a STEP row.* none remain"):
        detect(small_run, {"circles": tmp_path / "o"}, circles=LIGHT)
    assert not (tmp_path / "o").exists()


def test_failures_are_counted_but_not_all_kept(small_run: Path, tmp_path: Path) -> None:
    count = 3 * KEPT_FAILURES
    with (small_run / "s.txt").open("a") as steps:
        for number in range(count):
            steps.write(f"STEP none.{number} 0.25 0 0.01 1e-5 0 1e-5 0 0 1e-4\n")
    summary = detect(small_run, {"circles": tmp_path / "o"}, circles=LIGHT)
    assert (summary.frames, summary.failed) == (count + 3, count)
    assert len(summary.failures) == KEPT_FAILURES
    assert summary.failures[0].startswith("none.0: no image")


class Arriving(Frames):
    """Frames of a run that come one by one, as those of a camera do, and who waits for them."""

    def __init__(self, frames: list[RunFrame], *, images_in_memory: bool) -> None:
        self.images_in_memory = images_in_memory
        self.frames = frames
        self.done = 0
        self.largest_lead = 0

    def __iter__(self) -> Generator[RunFrame, None, None]:
        for number, frame in enumerate(self.frames):
            self.largest_lead = max(self.largest_lead, number - self.done)
            yield frame

    def advance(self) -> None:
        self.done += 1


@pytest.mark.parametrize("images_in_memory", [True, False])
def test_only_files_are_asked_for_ahead(
    run_folder: Path, tmp_path: Path, images_in_memory: bool
) -> None:
    opened = open_run(run_folder)
    frames = Arriving([*opened.frames] * 5, images_in_memory=images_in_memory)
    run = replace(opened, frames=frames)
    summary = detect_run(
        Job(run, FramePlan(run.camera, circles=LIGHT), {"circles": tmp_path / "a.circles"}),
        on_progress=frames.advance,
    )
    assert summary.frames == frames.done == 5 * FRAMES
    if images_in_memory:
        assert frames.largest_lead == 0
    else:
        assert 0 < frames.largest_lead <= 128
