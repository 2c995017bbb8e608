"""The radius of discs comes back from images, and is offered where hardly any were found."""

from __future__ import annotations

import math
import re
import shutil
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import cv2
import numpy as np
import pytest

from camera import Camera, read_camera, write_camera
from detect import explanation
from detect.cli import main, parsed
from detect.options import All, Circles
from detect.projection import leaning_camera
from detect.radius import find_radius
from detect.settings import CircleSettings
from lut import build_vote_table
from tests.detect.commands import Captured
from tests.detect.painted_floor import PaintedFloor

#: Every test tries the same radii with the same camera: their tables are made once.
TABLE_OF = cache(build_vote_table)

PLACES = [(0.4, -1.3), (-0.6, -1.6), (0.1, -2.1), (0.7, -2.4)]


def image(camera: Camera, radius_m: float, seed: int) -> np.ndarray:
    floor = PaintedFloor(camera)
    for place in PLACES:
        floor.disc(place, radius_m=radius_m)
    return floor.image(seed=seed)


@pytest.fixture(autouse=True)
def tables_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("detect.radius.build_vote_table", TABLE_OF)


@pytest.mark.parametrize("radius_m", [0.06, 0.1, 0.15])
def test_radius_comes_back(published_camera: Camera, radius_m: float) -> None:
    found = find_radius([image(published_camera, radius_m, 0)], published_camera, CircleSettings())

    assert found is not None
    assert found.discs == len(PLACES)
    assert abs(found.radius_m - radius_m) < 0.01 * radius_m


def test_an_empty_floor_has_no_radius(published_camera: Camera) -> None:
    bare = PaintedFloor(published_camera).image()
    assert find_radius([bare], published_camera, CircleSettings()) is None


def test_no_images_have_no_radius(published_camera: Camera) -> None:
    assert find_radius([], published_camera, CircleSettings()) is None


@pytest.mark.parametrize("radius_m", [0.06, 0.1])
def test_grains_of_the_floor_are_no_discs(published_camera: Camera, radius_m: float) -> None:
    """There are more grains of any size than discs, and the more the smaller they are."""
    rng = np.random.default_rng(0)
    floor = PaintedFloor(published_camera)
    for place in PLACES:
        floor.disc(place, radius_m=radius_m)
    places, sizes = rng.uniform((-1.5, -3.0), (1.5, -0.9), (400, 2)), rng.random(400)
    for place, share in zip(places, sizes, strict=True):
        grain_m = 0.01 * (1.0 - 0.95 * share) ** (-1.0 / 2.5)
        if np.hypot(*(np.array(PLACES) - place).T).min() > radius_m + grain_m + 0.02:
            floor.disc(place, rng.choice([50.0, 150.0, 190.0]), grain_m)

    found = find_radius([floor.image(seed=0)], published_camera, CircleSettings())

    assert found is not None
    assert found.radius_m == pytest.approx(radius_m, rel=0.03)


@pytest.mark.parametrize(
    "words",
    [
        ["--radius-m", "auto"],
        ["--radius-m=auto"],
        ["--circles.radius-m", "auto"],
        ["--radius-m", "0.06", "--radius-m", "auto"],
    ],
)
def test_auto_stands_for_finding_it(words: list[str]) -> None:
    command = "all" if "circles" in words[0] else "circles"
    flags = parsed([command, "run", *words, "--jobs", "1"])
    assert isinstance(flags, Circles | All)
    assert flags.find_radius
    assert flags.jobs == 1
    assert not parsed([command, "run"]).find_radius


@pytest.fixture
def run(published_camera: Camera, published_cam_text: str, tmp_path: Path) -> Path:
    """A dozen images of discs of radius 0.06 m."""
    folder = tmp_path / "s"
    (folder / "images").mkdir(parents=True)
    (folder / "s.cam").write_text(published_cam_text)
    images = [image(published_camera, 0.06, seed) for seed in range(2)]
    for number in range(12):
        cv2.imwrite(str(folder / "images" / f"s.{number:04d}.png"), images[number % 2])
    return folder


def number_in(text: str, words: str) -> float:
    found = re.search(rf"{words} ?([0-9.]+)", text)
    assert found is not None, text
    return float(found[1])


def test_a_run_is_detected_at_the_radius_found(run: Path, capsys: Captured) -> None:
    assert main(["circles", str(run), "--radius-m", "auto"]) == 0
    said = capsys.readouterr()
    radius = number_in(said.err, "discs have a radius of")
    assert radius == pytest.approx(0.06, rel=0.02)
    assert "48 discs in 12 frames" in said.out
    used = number_in((run / "detected.circles").read_text(), "radius_m=")
    assert used == pytest.approx(radius, abs=1e-4)


def test_the_published_detector_takes_the_radius_found(run: Path) -> None:
    words = ["circles", str(run), "--preset", "published", "--radius-m", "auto"]
    assert main(words) == 0
    used = number_in((run / "detected.circles").read_text(), "radius_m=")
    assert used == pytest.approx(0.06, rel=0.02)


def test_another_radius_is_offered(run: Path, capsys: Captured) -> None:
    assert main(["circles", str(run)]) == 0
    offered = number_in(capsys.readouterr().err, "radius seems to be")
    assert offered == pytest.approx(0.06, rel=0.02)


def test_another_radius_is_offered_although_a_look_alike_is_found(
    run: Path, published_camera: Camera, capsys: Captured
) -> None:
    floor = PaintedFloor(published_camera)
    for place in PLACES:
        floor.disc(place, radius_m=0.06)
    floor.disc((-0.5, -2.6), radius_m=0.1)
    for path in (run / "images").iterdir():
        cv2.imwrite(str(path), floor.image(seed=0))
    assert main(["circles", str(run)]) == 0
    said = capsys.readouterr()
    assert "12 discs in 12 frames" in said.out
    assert number_in(said.err, "radius seems to be") == pytest.approx(0.06, rel=0.02)


def test_the_other_polarity_is_offered(run: Path, capsys: Captured) -> None:
    assert main(["circles", str(run), "--radius-m", "0.06", "--polarity", "dark"]) == 0
    assert "--polarity any finds 48 in 12 of the images" in capsys.readouterr().err


def test_a_lower_camera_is_suspected(run: Path, published_cam_text: str, capsys: Captured) -> None:
    (run / "s.cam").write_text(published_cam_text.replace("1.50354", "1.0"))
    assert main(["circles", str(run), "--radius-m", "0.06"]) == 0
    said = capsys.readouterr().err
    assert number_in(said, "radius seems to be") == pytest.approx(0.06 / 1.50354, rel=0.05)
    assert "if they are not that small, the camera has another height" in said


@pytest.mark.parametrize("radius_m", [0.06, 0.0545, 0.066])
def test_discs_that_look_larger_or_smaller_are_told(
    run: Path, capsys: Captured, radius_m: float
) -> None:
    assert main(["circles", str(run), "--radius-m", str(radius_m)]) == 0
    said = capsys.readouterr().err
    assert ("the discs look" in said) == (radius_m != 0.06)
    if radius_m != 0.06:
        assert number_in(said, "the discs look") == pytest.approx(0.06 / radius_m, abs=0.03)


@pytest.mark.parametrize(
    "stage", [stage for stage in get_args(explanation.Stage) if stage != "disc"]
)
def test_every_stage_that_drops_candidates_is_told(
    stage: explanation.Stage, published_camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    dropped = [SimpleNamespace(stage=stage)]
    monkeypatch.setattr(explanation, "_candidates", lambda scene: dropped)
    blank = np.full((288, 768), 100, np.uint8)
    said = explanation.why_none([blank], published_camera, CircleSettings())
    assert said.startswith("Of 1 candidate in 1 image, 1 ")


def test_where_there_are_no_discs_it_is_said_what_to_look_at(run: Path, capsys: Captured) -> None:
    for path in (run / "images").iterdir():
        cv2.imwrite(str(path), np.full((288, 768), 100, np.uint8))
    assert main(["circles", str(run)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "0 discs of radius 0.1 m in 12 frames. There is no candidate in 12 images" in said
    assert "Other radii find no more" in said
    shutil.rmtree(run / "images")


def test_what_candidates_for_discs_fail(run: Path, capsys: Captured) -> None:
    for path in sorted((run / "images").iterdir())[3:]:
        path.unlink()
    command = ["circles", str(run), "--polarity", "dark", "--radius-m", "0.06"]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "0 discs of radius 0.06 m in 3 frames. Of " in said
    assert " are not dark (--polarity any)" in said
    assert "try --radius-m auto" in said


def test_the_lean_that_verticals_show_does_not_change_the_radius(
    project_root: Path, tmp_path: Path, capsys: Captured
) -> None:
    run, calibration = project_root / "images" / "e", tmp_path / "leaning.cam"
    write_camera(leaning_camera(read_camera(run / "e.cam"), (math.radians(2.5), 0.0)), calibration)
    command = ["circles", str(run), "--camera", str(calibration), "--radius-m", "auto"]
    assert main([*command, "--frames", "24", "-o", str(tmp_path / "e.circles")]) == 0
    said = capsys.readouterr().err
    assert number_in(said, "discs have a radius of") == pytest.approx(0.1, rel=0.05)
    assert "the discs look" not in said
