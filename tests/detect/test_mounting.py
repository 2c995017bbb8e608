"""How a camera is mounted: simulated tilts, and the demo run with a calibration that is wrong."""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera import Camera, read_camera, write_camera
from camera.calibration.model import COUNT
from camera.cli import main
from camera.model import PARAMETERS
from camera.model_checks import checked_pose
from camera.uncertainty import covariance_of, with_covariance
from detect.levelling import common_covariance
from detect.projection import image_positions, leaning_camera, level_positions
from detect.run_mounting import HEIGHT_STEPS, Mounting, mounting_of_run, remounted
from detect.run_tilt import FrameTilts
from detect.settings import LEAST_FRAMES
from redetect.storage import OutputExistsError
from tests.detect.commands import Captured

HEIGHT_M = 1.5
#: How pitch by outlines goes with the height: linear, and a little bent.
SLOPE, BEND = -3.0, 4.0


def drive(
    lean: tuple[float, float], raised_m: float, frames: int = 200
) -> tuple[FrameTilts, np.ndarray]:
    """Tilts by verticals, and pitches by outlines at the tried heights, relative to those."""
    rng = np.random.default_rng(4)
    true = lean + np.radians(0.3) * rng.standard_normal((frames, 2))
    sigma = np.full(true.shape, np.radians(0.1))
    verticals = FrameTilts(true + sigma * rng.standard_normal(true.shape), sigma**2)
    off = np.array(HEIGHT_STEPS) - raised_m / HEIGHT_M
    pitches = true[:, :1] + SLOPE * off + BEND * off**2
    pitches += np.radians(0.4) * rng.standard_normal((frames, 1))
    return verticals, pitches - verticals.tilt[:, :1]


@pytest.mark.parametrize("raised_m", [0.0, -0.045, 0.06])
def test_lean_and_height_come_back(raised_m: float) -> None:
    lean = (-0.045, 0.013)
    found = mounting_of_run(HEIGHT_M, *drive(lean, raised_m))

    assert found is not None
    assert np.all(np.abs(found.tilt_rad - lean) < found.sigma_rad)
    assert abs(found.raised_m - raised_m) < 0.01
    assert 0.01 < found.raised_sigma_m < 0.03
    assert found.frames == found.frames_with_discs == 200
    assert f"{100 * found.raised_m:+.1f}" in found.sentences()[1]
    assert "most frames show none" not in found.sentences()[1]


def test_a_height_from_few_frames_is_doubted() -> None:
    """At a wrong height, only things of another size look like discs, here and there."""
    verticals, pitches = drive((0.01, 0.0), 0.0)
    pitches[60:] = math.nan
    found = mounting_of_run(HEIGHT_M, verticals, pitches)
    assert found is not None
    assert "most frames show none" in found.sentences()[1]


def test_without_discs_the_height_stays() -> None:
    verticals, pitches = drive((0.01, 0.0), 0.0)
    pitches[LEAST_FRAMES - 1 :] = math.nan
    found = mounting_of_run(HEIGHT_M, verticals, pitches)

    assert found is not None
    assert math.isnan(found.raised_m)
    assert "height is unchanged: 19 frames with the outlines of discs" in found.sentences()[1]


@pytest.mark.parametrize("by_height", [0.0, -1.0])
def test_an_implausible_height_is_not_stated(by_height: float) -> None:
    """Nor how certain it is, since the calibration's covariance would become that."""
    verticals, _ = drive((0.01, 0.0), 0.0)
    pitches = np.full((200, 1), 1.0) + by_height * np.array(HEIGHT_STEPS)
    found = mounting_of_run(HEIGHT_M, verticals, pitches)

    assert found is not None
    assert math.isnan(found.raised_m)
    assert math.isnan(found.raised_sigma_m)
    assert "is their radius right?" in found.sentences()[1]


def test_without_verticals_there_is_no_mounting() -> None:
    verticals, pitches = drive((0.01, 0.0), 0.0)
    verticals.tilt[:] = math.nan
    assert mounting_of_run(HEIGHT_M, verticals, pitches) is None


def test_the_remounted_camera_sees_level(published_camera: Camera) -> None:
    """What the mounting turns level is where the remounted camera puts it."""
    tilt, raised_m = (-0.045, 0.013), -0.04
    mounting = Mounting(np.array(tilt), np.zeros(2), raised_m, 0.0, 30, 30)
    rows_xy = np.array([(0.3, -1.4), (-0.7, -2.2), (0.1, -3.3)])
    pixels = image_positions(published_camera, rows_xy)

    seen = remounted(published_camera, mounting).floor_from_pixel(pixels)

    np.testing.assert_allclose(seen, level_positions(published_camera, rows_xy, tilt, raised_m))


def test_the_remounted_camera_states_what_its_mounting_may_be_wrong_by(
    published_camera: Camera,
) -> None:
    """As positions scatter if the mounting does; levelled by verticals only its height counts."""
    tilt, raised_m, sigmas = (-0.045, 0.013), -0.04, (2e-3, 3e-3, 0.012)
    mounting = Mounting(np.array(tilt), np.array(sigmas[:2]), raised_m, sigmas[2], 30, 30)
    pixels = image_positions(published_camera, np.array([(0.3, -1.4), (-0.7, -2.2), (0.1, -3.3)]))
    exact = with_covariance(published_camera, np.zeros((PARAMETERS, PARAMETERS)))
    seen = remounted(exact, mounting)
    floor_xy = seen.floor_from_pixel(pixels)

    draws = np.random.default_rng(1).standard_normal((1500, 3)) * sigmas
    scattered = [
        remounted(
            published_camera,
            replace(mounting, tilt_rad=mounting.tilt_rad + leans, raised_m=raised_m + higher),
        ).floor_from_pixel(pixels)
        for *leans, higher in draws
    ]
    off = np.array(scattered) - floor_xy
    stated = common_covariance(seen, floor_xy, 0.0, by_verticals=False)
    normalised = np.einsum("kni,nij,knj->n", off, np.linalg.inv(stated), off) / (2 * len(off))
    np.testing.assert_allclose(normalised, 1.0, atol=0.1)

    levelled = common_covariance(seen, floor_xy, 0.0, by_verticals=True)
    raised = remounted(published_camera, replace(mounting, raised_m=raised_m + sigmas[2]))
    off = raised.floor_from_pixel(pixels) - floor_xy
    np.testing.assert_allclose(levelled, off[:, :, None] * off[:, None, :], rtol=0.1, atol=3e-6)


def test_without_a_covariance_the_remounted_camera_states_none(published_camera: Camera) -> None:
    mounting = Mounting(np.array([0.01, 0.0]), np.full(2, 2e-3), math.nan, math.nan, 30, 3)
    assert remounted(published_camera, mounting).covariance is None
    # A height that could not be estimated is known as well as before.
    before = 0.01 * np.eye(PARAMETERS)
    stated = covariance_of(remounted(with_covariance(published_camera, before), mounting))
    assert stated is not None
    assert stated[COUNT + 2, COUNT + 2] > 0.01


@pytest.mark.long
def test_the_demos_camera_comes_back(project_root: Path, tmp_path: Path, capsys: Captured) -> None:
    """A calibration that is 5 cm too low and leans by 2 degrees is put right."""
    run = project_root / "images" / "e"
    true = read_camera(run / "e.cam")
    wrong = remounted(true, Mounting(np.array([0.035, -0.01]), np.zeros(2), -0.05, 0.0, 30, 30))
    write_camera(wrong, tmp_path / "wrong.cam")
    output = tmp_path / "level.cam"

    command = ["level", str(run), "--camera", str(tmp_path / "wrong.cam"), "-o", str(output)]
    assert main(command) == 0

    said = capsys.readouterr().out
    assert re.search(r"leans -2\.\d+ \+- 0\.1\d degrees", said)
    found = read_camera(output)
    assert abs(found.centre[2] - true.centre[2]) < 0.02
    # The simulated robot itself leans by a tenth of a degree or two in the mean.
    off = np.degrees(np.arccos((np.trace(found.rotation @ true.rotation.T) - 1.0) / 2.0))
    assert off < 0.5
    # The pose is another one, and not as well known as the simulation's.
    stated = covariance_of(found)
    assert stated is not None
    assert 0.005 < math.sqrt(stated[COUNT + 2, COUNT + 2]) < 0.03
    unmoved = replace(found, robot_from_camera=true.robot_from_camera, covariance=true.covariance)
    assert unmoved == true
    assert main(command) == 1  # nothing is overwritten unasked


def test_discs_are_searched_as_the_camera_leans(
    project_root: Path, tmp_path: Path, capsys: Captured
) -> None:
    """By a calibration that is wrong by six degrees, a quarter of the frames show no discs."""
    run = project_root / "images" / "e"
    lean = (float(np.radians(-6.0)), 0.0)
    write_camera(leaning_camera(read_camera(run / "e.cam"), lean), tmp_path / "wrong.cam")
    words = ["level", str(run), "--camera", str(tmp_path / "wrong.cam")]
    assert main([*words, "-o", str(tmp_path / "level.cam")]) == 0
    said = re.search(r"height is (\S+) .* by the discs of (\d+) frames", capsys.readouterr().out)
    assert said is not None
    assert abs(float(said[1])) < 1.0
    assert int(said[2]) > 70


@pytest.mark.long
def test_the_height_of_a_camera_that_looks_aside_comes_back(
    project_root: Path, tmp_path: Path
) -> None:
    """The robot of the demo might as well drive sideways."""
    run = project_root / "images" / "e"
    true = read_camera(run / "e.cam")
    aside = Rotation.from_euler("z", 90.0, degrees=True).as_matrix() @ true.robot_from_camera
    aside[2, 3] = 1.43
    wrong = replace(true, robot_from_camera=checked_pose("sensor2World", aside))
    write_camera(wrong, tmp_path / "wrong.cam")
    output = tmp_path / "level.cam"
    words = ["level", str(run), "--camera", str(tmp_path / "wrong.cam"), "-o", str(output)]
    assert main(words) == 0
    assert read_camera(output).centre[2] == pytest.approx(1.50354, abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize("height_m", [1.1, 1.3])
def test_a_height_far_off_is_estimated_or_left(
    project_root: Path, tmp_path: Path, capsys: Captured, height_m: float
) -> None:
    """At 1.1 instead of 1.5 m, only look-alikes are as large as discs should be."""
    run = project_root / "images" / "e"
    wrong = (run / "e.cam").read_text().replace("1.50354", f"{height_m}")
    (tmp_path / "wrong.cam").write_text(wrong)
    output = tmp_path / "level.cam"
    assert (
        main(["level", str(run), "--camera", str(tmp_path / "wrong.cam"), "-o", str(output)]) == 0
    )
    left = "its height is unchanged: no height explains" in capsys.readouterr().out
    assert left == (height_m == 1.1)
    expected = height_m if left else 1.50354
    assert read_camera(output).centre[2] == pytest.approx(expected, abs=0.02)


@pytest.mark.long
def test_failed_frames_are_told_once(project_root: Path, tmp_path: Path, capsys: Captured) -> None:
    """The height is estimated twice, from 5 cm below."""
    run = shutil.copytree(project_root / "images" / "e", tmp_path / "e")
    broken = sorted((run / "images").iterdir())[3]
    broken.write_bytes(broken.read_bytes()[:2000])
    (run / "e.cam").write_text((run / "e.cam").read_text().replace("1.50354", "1.45"))
    assert main(["level", str(run), "-o", str(tmp_path / "level.cam")]) == 3
    said = capsys.readouterr().err
    assert said.count("1 frame could not be processed") == 1
    assert read_camera(tmp_path / "level.cam").centre[2] == pytest.approx(1.50354, abs=0.02)


def test_images_of_another_size_are_told_once(
    project_root: Path, tmp_path: Path, capsys: Captured
) -> None:
    run = project_root / "images" / "e"
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((48, 64), np.uint8))
    command = ["level", str(tmp_path), "--camera", str(run / "e.cam")]
    assert main([*command, "-o", str(tmp_path / "level.cam")]) == 1
    *failures, error = capsys.readouterr().err.splitlines()
    assert failures[0] == "2 frames could not be processed:"
    assert all("expected 768x288" in line for line in failures[1:])
    assert error == f"error: {tmp_path}: none of its images could be processed"


def test_an_existing_file_is_found_first(tmp_path: Path) -> None:
    from camera.options import Level
    from detect.commands.level import perform

    output = tmp_path / "level.cam"
    output.touch()
    with pytest.raises(OutputExistsError):
        perform(Level(tmp_path / "nothing", output))
