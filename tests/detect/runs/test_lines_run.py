"""Verticals over a run: rows, tilts, IDs, and what bad frames cost."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import read_camera, write_camera
from detect.cli import main
from detect.line_settings import LineSettings
from detect.lines import carry_ids
from detect.projection import leaning_camera
from detect.runs.plan import FramePlan, Job
from detect.runs.stream import detect_run
from detect.sources.opening import open_run
from redetect.landmarks import LineLandmark, read_frames, read_tilts
from tests.detect.commands import Captured
from tests.detect.demo_frames import demo_frames
from tests.detect.line_scene import pinhole


def line(alpha: float, ids: tuple[int, ...] = (-1,), sigma: float = 0.003) -> LineLandmark:
    return LineLandmark(0.0, -0.6, 0.0, 0.3, alpha, 0.0, 0.0, sigma, ids)


def test_ids_go_where_there_is_no_doubt() -> None:
    rows = (line(0.1), line(0.3, sigma=0.02), line(-1.0), line(1.0), line(1.005))
    reference = (
        line(0.101, (7,)),
        line(0.28, (3,)),
        line(0.32, (4, 5)),
        line(1.002, (9,)),
        line(2.0, (11,)),
    )
    carried = carry_ids(rows, reference)
    assert [row.ids for row in carried] == [(7,), (3, 4, 5), (-1,), (-1,), (-1,)]
    assert [row.alpha for row in carried] == [row.alpha for row in rows]


@pytest.fixture
def short_run(project_root: Path, tmp_path: Path) -> Path:
    return demo_frames(project_root, tmp_path / "e", range(4))


def test_rows_and_tilts_are_written(short_run: Path, project_root: Path, tmp_path: Path) -> None:
    output, tilt = tmp_path / "out.lines", tmp_path / "out.tilt"
    run = open_run(short_run)
    plan = FramePlan(run.camera, lines=LineSettings())
    summary = detect_run(Job(run, plan, {"lines": output, "tilt": tilt}))
    frames = list(read_frames(output))
    assert [frame.step.prefix for frame in frames] == [f"e.{k:04d}" for k in range(4)]
    assert sum(len(frame.lines) for frame in frames) == summary.found["lines"] >= 20
    tilts = read_tilts(tilt)
    assert len(tilts) == summary.found["tilts"] == 4
    truth = json.loads((project_root / "images" / "e" / "truth.json").read_text())
    for frame in truth["frames"][:4]:
        found = tilts[frame["prefix"]]
        np.testing.assert_allclose([found.pitch, found.roll], frame["tilt"], atol=0.003)


@pytest.mark.lowest
def test_all_corrects_discs_for_the_tilt(short_run: Path) -> None:
    assert main(["all", str(short_run), "--tilt", "frame", "--polarity", "light"]) == 0
    levelled = [f.circles for f in read_frames(short_run / "detected.circles")]
    assert main(["circles", str(short_run), "--polarity", "light", "--force"]) == 0
    plain = [f.circles for f in read_frames(short_run / "detected.circles")]
    assert [len(circles) for circles in levelled] == [len(circles) for circles in plain]
    moved = [
        np.hypot(a.px - b.px, a.py - b.py)
        for before, after in zip(plain, levelled)
        for a, b in zip(before, after)
    ]
    assert max(moved) > 0.005


def test_frames_with_a_tilt_do_not_count_the_unknown_one(short_run: Path) -> None:
    variances = []
    for sigma in ("0", "0.5"):
        assert (
            main(
                [
                    "all",
                    str(short_run),
                    "--tilt",
                    "frame",
                    "--force",
                    "--tilt-sigma-deg",
                    sigma,
                ]
            )
            == 0
        )
        frames = list(read_frames(short_run / "detected.circles"))
        variances.append([disc.cxx + disc.cyy for frame in frames for disc in frame.circles])
    without, known = map(np.array, variances)
    assert len(without) == len(known) > 10
    # The verticals tell the tilt of all these frames: it is not in the covariances twice.
    np.testing.assert_array_equal(known, without)


def test_frames_that_count_as_level_are_told(short_run: Path, capsys: Captured) -> None:
    assert main(["all", str(short_run), "--tilt", "frame"]) == 0
    assert "the tilt of 4 frames\n" in capsys.readouterr().out
    (short_run / "images" / "e.0001.jpg").write_bytes(b"not an image")
    cv2.imwrite(str(short_run / "images" / "e.0002.jpg"), np.full((288, 768), 90, np.uint8))
    assert main(["all", str(short_run), "--tilt", "frame", "--force"]) == 3
    assert (
        "the tilt of 2 frames; the other 1 are assumed level within 0.3 degrees"
        in capsys.readouterr().out
    )
    assert main(["all", str(short_run), "--tilt", "frame", "--force", "--tilt-sigma-deg", "0"]) == 3
    assert "the other 1 are assumed exactly level" in capsys.readouterr().out


def test_frames_without_a_tilt_count_as_level_as_the_others(
    short_run: Path, capsys: Captured
) -> None:
    camera = leaning_camera(read_camera(short_run / "e.cam"), (0.04, 0.0))
    write_camera(camera, short_run / "e.cam", overwrite=True)
    cv2.imwrite(str(short_run / "images" / "e.0002.jpg"), np.full((288, 768), 90, np.uint8))
    assert main(["all", str(short_run)]) == 0
    said = re.search("the tilt of 3 frames; .* level within ([0-9.]+) deg", capsys.readouterr().out)
    assert said is not None
    assert 1.0 < float(said[1]) < 2.3
    unknown = [tilt for tilt in read_tilts(short_run / "detected.tilt").values() if not tilt.lines]
    assert [math.degrees(math.sqrt(tilt.cpp)) for tilt in unknown] == [
        pytest.approx(float(said[1]), abs=0.01)
    ]


def test_tilts_that_are_known_exactly_can_be_read(short_run: Path) -> None:
    """A run without verticals, of which it is said that it is level."""
    words = ["all", str(short_run), "--least-lines", "40", "--tilt-sigma-deg", "0"]
    assert main(words) == 0
    tilts = read_tilts(short_run / "detected.tilt")
    assert len(tilts) == 4
    assert all((tilt.pitch, tilt.roll) == (0.0, 0.0) for tilt in tilts.values())


@pytest.mark.parametrize("ending", ["", ".jpg"])
def test_tilts_belong_to_images_whatever_their_extension(short_run: Path, ending: str) -> None:
    assert main(["lines", str(short_run)]) == 0
    tilts = short_run / "detected.tilt"
    tilts.write_text(re.sub(r"(TILT \S+)", rf"\1{ending}", tilts.read_text()))
    assert main(["circles", str(short_run), "--tilt", str(tilts)]) == 0
    frames = list(read_frames(short_run / "detected.circles"))
    assert all(frame.levelled_by is not None for frame in frames)


@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg", "blind"), [(80.0, 0.0, True), (0.0, 90.0, True), (30.0, 5.0, False)]
)
def test_a_camera_that_can_see_no_verticals_is_told(
    tmp_path: Path, capsys: Captured, pitch_deg: float, roll_deg: float, blind: bool
) -> None:
    camera = pinhole(90, 60, 80.0, pitch_deg=pitch_deg, roll_deg=roll_deg)
    write_camera(camera, tmp_path / "a.cam", overwrite=False)
    cv2.imwrite(str(tmp_path / "0.png"), np.full((60, 90), 99, np.uint8))
    for command in ("lines", "all"):
        capsys.readouterr()
        assert main([command, str(tmp_path), "--force"]) == 0
        assert ("no verticals: " in capsys.readouterr().err) == blind
