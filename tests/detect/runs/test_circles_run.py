"""A run in, a file of landmarks out: what it says, and what a bad frame costs."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera import Camera
from detect.runs.plan import FramePlan, Job, RunSummary
from detect.runs.stream import detect_run
from detect.settings import PUBLISHED, CircleSettings
from detect.sources.interface import Run
from detect.sources.opening import open_run
from redetect import __version__
from redetect.landmarks import read_frames, read_rows, read_steps
from tests.detect.conftest import SMALL_RUN_DISCS


def detected(
    run: Run, settings: CircleSettings, output: Path, *, overwrite: bool = False, **others: Any
) -> RunSummary:
    """The discs of a run, and those as JSON if there is a place for them."""
    plan = FramePlan(run.camera, circles=settings)
    places = {"circles": output}
    if "json_output" in others:
        places["json"] = others.pop("json_output")
    on_progress = others.pop("on_progress", None)
    job = Job(run, plan, places, overwrite=overwrite, **others)
    return detect_run(job, on_progress=on_progress)


@pytest.mark.lowest
def test_rows_are_the_discs_of_each_image(small_run: Path) -> None:
    output = small_run / "out.circles"
    summary = detected(open_run(small_run), CircleSettings(), output)
    assert (summary.frames, summary.found["discs"], summary.failures) == (3, 3, [])
    frames = list(read_frames(output))
    assert [frame.step.prefix for frame in frames] == list(SMALL_RUN_DISCS)
    for frame in frames:
        # Scan order: farther discs come first.
        places = sorted(SMALL_RUN_DISCS[frame.step.prefix], key=lambda place: place[1])
        assert len(frame.circles) == len(places)
        for row, place in zip(frame.circles, places):
            assert np.hypot(row.px - place[0], row.py - place[1]) < 0.002
            assert 0.9 < row.quality <= 1.0
            covariance = np.array([[row.cxx, row.cxy], [row.cxy, row.cyy]])
            assert np.all(np.linalg.eigvalsh(covariance) > 0.0)
            assert row.ids == (-1,)


@pytest.mark.lowest
def test_published_rows_are_printed_like_the_data_sets(
    small_run: Path, published_camera: Camera
) -> None:
    """Position and covariance follow from the integer pixel in all 6 printed digits."""
    output = small_run / "out.circles"
    detected(open_run(small_run), PUBLISHED, output)
    rows = [row for frame in read_frames(output) for row in frame.circles]
    assert len(rows) >= 3
    for row in rows:
        seen = published_camera.project_floor(np.array([row.px, row.py]))
        pixel = np.rint(seen)
        assert np.abs(seen - pixel).max() < 0.01
        x, y = published_camera.floor_from_pixel(pixel)
        jacobian = published_camera.floor_jacobian_published(pixel)
        expected = 0.04**2 * np.eye(2) + 2.0 * jacobian @ jacobian.T
        for printed, number in (
            (row.px, x),
            (row.py, y),
            (row.cxx, expected[0, 0]),
            (row.cxy, expected[0, 1]),
            (row.cyy, expected[1, 1]),
        ):
            assert f"{printed:g}" == f"{number:g}"


def test_head_tells_how_rows_were_made(small_run: Path) -> None:
    output = small_run / "out.circles"
    settings = dataclasses.replace(CircleSettings(), threshold=0.45, polarity="light")
    detected(open_run(small_run), settings, output)
    rows = list(read_rows(output))
    head = [row.source.decode() for row in rows if row.record is None and row.source is not None]
    assert all(line.startswith("#") and not line.startswith("# #") for line in head)
    text = "".join(head)
    assert f"redetect {__version__}" in text
    assert "odometry: s.txt" in text
    for name, value in dataclasses.asdict(settings).items():
        assert f" {name}={value}" in text
    assert "threshold=0.45" in text
    assert "768x288 px" in text


def test_bad_images_cost_their_frames_only(small_run: Path, tmp_path: Path) -> None:
    (small_run / "images" / "s.0001.png").write_bytes(b"no image")
    (small_run / "images" / "s.0002.png").unlink()
    output, as_json = small_run / "out.circles", tmp_path / "out.json"
    ticks = [0]

    def tick() -> None:
        ticks[0] += 1

    summary = detected(
        open_run(small_run), CircleSettings(), output, json_output=as_json, on_progress=tick
    )
    assert summary.frames == ticks[0] == 3
    assert summary.failed == 2
    assert summary.found["discs"] == 2
    broken, missing = summary.failures
    assert broken.startswith(str(small_run / "images" / "s.0001.png"))
    assert missing.startswith("s.0002: no image")
    frames = list(read_frames(output))
    assert [len(frame.circles) for frame in frames] == [2, 0, 0]
    assert [frame.step for frame in frames] == list(read_steps(small_run / "s.txt"))
    records = json.loads(as_json.read_text())["frames"]
    assert [record["frame"] for record in records] == list(SMALL_RUN_DISCS)
    assert [record.get("error") for record in records] == [None, broken, missing]


def test_json_says_what_the_rows_say_and_more(small_run: Path, tmp_path: Path) -> None:
    output, as_json = tmp_path / "out.circles", tmp_path / "out.json"
    run = open_run(small_run)
    detected(run, CircleSettings(), output, json_output=as_json)
    document = json.loads(as_json.read_text())
    assert document["version"] == __version__
    assert document["settings"] == dataclasses.asdict(CircleSettings())
    assert document["camera"] == run.camera.content_hash
    for record, frame in zip(document["frames"], read_frames(output), strict=True):
        for disc, row in zip(record["discs"], frame.circles, strict=True):
            printed = (row.px, row.py, row.quality, row.cxx, row.cxy, row.cyy)
            numbers = (disc["x_m"], disc["y_m"], disc["quality"], *disc["covariance_m2"])
            assert printed == pytest.approx(numbers, rel=1e-5)
            assert disc["evidence"] > 0.0
            pixel_xy = run.camera.floor_from_pixel(np.array(disc["pixel"], float))
            assert np.hypot(*(pixel_xy - (row.px, row.py))) < 0.06


def test_published_json_has_no_evidence(small_run: Path, tmp_path: Path) -> None:
    as_json = tmp_path / "out.json"
    detected(open_run(small_run), PUBLISHED, tmp_path / "o.circles", json_output=as_json)
    discs = [d for frame in json.loads(as_json.read_text())["frames"] for d in frame["discs"]]
    assert len(discs) >= 3
    assert all(disc["evidence"] is None for disc in discs)
