"""Discs are searched as the camera is mounted, though its calibration has it lean otherwise."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import redetect as rd
from camera import Camera, read_camera, write_camera
from camera.model_checks import checked_pose
from detect.circles import CircleDetections
from detect.cli import main
from detect.lean import lean_of_image
from detect.levelling import as_calibrated, level_discs
from detect.projection import circle_on_floor, leaning_camera
from detect.runs.level_run import tilt_of_some
from detect.runs.plan import FrameRows
from detect.settings import LEAST_FRAMES, CircleSettings
from detect.settings_files import read_settings
from detect.sources.opening import open_run
from detect.tuning_page import TuningSession
from redetect.landmarks import (
    FrameTilt,
    circle_arrays,
    format_no_tilt,
    format_tilt,
    read_frames,
    squared_mahalanobis,
)
from tests.detect.commands import Captured
from tests.detect.painted_floor import LIGHT, PaintedFloor

Rows = list[NDArray[np.float64]]

#: A calibration is wrong by so much, degrees.
LEANS = [(2.3, 0.0), (-2.3, 0.8)]


def wrong_by(camera: Camera, lean_deg: tuple[float, float]) -> Camera:
    """A calibration of a camera that leans by less than that."""
    pitch, roll = np.radians(lean_deg)
    return leaning_camera(camera, (float(pitch), float(roll)))


def low_camera(published_camera: Camera) -> Camera:
    """Half a metre above the floor, looking straight ahead."""
    ahead = ((-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, -1.0, 0.0, 0.5))
    return replace(
        published_camera, width=640, height=480, scale_x=420.0, scale_y=420.0, offset_x=319.5,
        offset_y=239.5, robot_from_camera=ahead,
    )  # fmt: skip


#: By which that camera leans, and the places of discs in its images.
LOW_LEAN_DEG = (-2.6, -1.4)


def low_places() -> Rows:
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid([-0.7, 0.0, 0.7], [-1.8, -2.6, -3.4]), axis=-1).reshape(-1, 2)
    return [grid + rng.uniform(-0.15, 0.15, grid.shape) for _ in range(3)]


@pytest.fixture
def low_run(published_camera: Camera, tmp_path: Path) -> Path:
    """Three images of a low camera that leans, within walls."""
    camera, run = low_camera(published_camera), tmp_path / "run"
    (run / "images").mkdir(parents=True)
    write_camera(camera, run / "run.cam")
    for k, places in enumerate(low_places()):
        floor = PaintedFloor(wrong_by(camera, LOW_LEAN_DEG)).wall()
        for xy in places:
            floor.disc(xy, LIGHT)
        cv2.imwrite(str(run / "images" / f"{k:02d}.png"), floor.image(seed=k))
    return run


def level_rows(circles: Path) -> Rows:
    return [
        np.array([(row.px, row.py) for row in frame.circles]).reshape(-1, 2)
        for frame in read_frames(circles)
    ]


def found_again(rows: Rows, others: Rows) -> float:
    """Share of rows near one of the others, within 15 cm."""
    near = [
        bool(len(there)) and bool(np.hypot(*(there - xy).T).min() < 0.15)
        for here, there in zip(rows, others, strict=True)
        for xy in here
    ]
    return float(np.mean(near))


@pytest.fixture(scope="module")
def right(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """The discs of the demo run by its own calibration."""
    output = tmp_path_factory.mktemp("right")
    assert main(["all", str(project_root / "images" / "e"), "-o", str(output)]) == 0
    return level_rows(output / "detected.circles")


@pytest.mark.parametrize("lean_deg", LEANS)
def test_a_run_with_a_wrong_calibration_finds_the_same_discs(
    project_root: Path, tmp_path: Path, capsys: Captured, right: Rows,
    lean_deg: tuple[float, float],
) -> None:  # fmt: skip
    run = project_root / "images" / "e"
    write_camera(wrong_by(read_camera(run / "e.cam"), lean_deg), tmp_path / "wrong.cam")
    wrongly = [str(run), "--camera", str(tmp_path / "wrong.cam")]
    assert main(["all", *wrongly, "-o", str(tmp_path / "wrong")]) == 0
    wrong = level_rows(tmp_path / "wrong" / "detected.circles")
    assert found_again(right, wrong) > 0.96
    assert found_again(wrong, right) > 0.96
    # `detect circles` searches alike, but for frames that tilt further, and writes rows as they are
    # seen by the calibration.
    assert "not levelled" not in capsys.readouterr().out
    assert main(["circles", *wrongly, "-o", str(tmp_path / "seen.circles")]) == 0
    assert "positions are not levelled: pitch and roll" in capsys.readouterr().out
    seen = level_rows(tmp_path / "seen.circles")
    alike = np.flatnonzero([len(a) == len(b) for a, b in zip(seen, wrong, strict=True)])
    assert len(alike) > 0.85 * len(seen)
    seen, wrong = ([rows[k] for k in alike] for rows in (seen, wrong))
    assert found_again(seen, wrong) < 0.8
    # They say how wrong they may be: by the lean and the tilt of the first frames.
    settings = read_settings(tmp_path / "seen.circles.log.json").circles
    assert settings.tilt_sigma_deg is not None
    assert settings.tilt_sigma_deg == pytest.approx(
        np.hypot(0.3, np.linalg.norm(lean_deg) / np.sqrt(2.0)), abs=0.2
    )
    off = np.concatenate(seen) - np.concatenate(wrong)
    frames = list(read_frames(tmp_path / "seen.circles"))
    covariance = np.concatenate([circle_arrays(frames[k].circles).covariance for k in alike])
    assert 0.3 < squared_mahalanobis(off, covariance).mean() / 2.0 < 1.4


def test_frames_that_are_levelled_by_themselves_say_so(
    project_root: Path, tmp_path: Path, capsys: Captured
) -> None:
    run = project_root / "images" / "e"
    camera = tmp_path / "wrong.cam"
    write_camera(wrong_by(read_camera(run / "e.cam"), (2.3, 0.0)), camera)
    rest = ["--camera", str(camera), "--tilt", "frame", "-o", str(tmp_path / "all")]
    assert main(["all", str(run), *rest]) == 0
    said = capsys.readouterr().out
    assert "not levelled" not in said
    assert "assumed level within 1." in said


def test_discs_are_searched_with_all_of_a_lean_that_only_they_show(
    published_camera: Camera, tmp_path: Path, capsys: Captured
) -> None:
    """Outlines that are found without the lean show less of it."""
    rng = np.random.default_rng(3)
    (tmp_path / "run" / "images").mkdir(parents=True)
    lean_deg = np.array([2.2, -0.8])
    grid = np.stack(np.meshgrid([-0.9, 0.0, 0.9], [-2.5, -4.2, -5.2]), axis=-1).reshape(-1, 2)
    for k in range(LEAST_FRAMES):
        pitch, roll = np.radians(lean_deg + 0.2 * rng.normal(size=2)).tolist()
        floor = PaintedFloor(leaning_camera(published_camera, (pitch, roll)))
        for xy in grid + rng.uniform(-0.2, 0.2, grid.shape):
            floor.disc(xy, LIGHT)
        cv2.imwrite(str(tmp_path / "run" / "images" / f"{k:02d}.png"), floor.image(seed=k))
    write_camera(published_camera, tmp_path / "run" / "run.cam")
    assert main(["circles", str(tmp_path / "run")]) == 0
    searched = re.search(r"pitch (-?[0-9.]+), roll (-?[0-9.]+)", capsys.readouterr().out)
    assert searched is not None
    np.testing.assert_allclose([float(x) for x in searched.groups()], lean_deg, atol=0.3)
    # Positions, which are not levelled, state at least that lean.
    settings = read_settings(tmp_path / "run" / "detected.circles.log.json").circles
    assert settings.tilt_sigma_deg is not None
    assert settings.tilt_sigma_deg > 0.85 * np.linalg.norm(lean_deg) / np.sqrt(2.0)


@pytest.mark.parametrize(("height", "lean_deg"), [(1.0, 2.3), (1.15, -2.3)])
def test_a_wrong_height_is_seen_whatever_the_lean(
    project_root: Path, tmp_path: Path, capsys: Captured, height: float, lean_deg: float
) -> None:
    run = project_root / "images" / "e"
    leaning = wrong_by(read_camera(run / "e.cam"), (lean_deg, 0.0))
    pose = np.array(leaning.robot_from_camera)
    pose[2, 3] *= height
    write_camera(
        replace(leaning, robot_from_camera=checked_pose("sensor2World", pose)), tmp_path / "w.cam"
    )
    assert main(["all", str(run), "--camera", str(tmp_path / "w.cam"), "-o", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert ("the discs look 1.15 times as large" in said.err) == (height > 1.0)
    # The camera may have turned without the robot, which moves it by height times lean.
    assert ("discs are 7 cm off" in said.out) == (height == 1.0)


def test_on_a_bare_floor_discs_level_the_run(
    published_camera: Camera, tmp_path: Path, capsys: Captured
) -> None:
    """A robot on springs, and nothing upright in sight."""
    rng = np.random.default_rng(1)
    (tmp_path / "run" / "images").mkdir(parents=True)
    places, tilt = [], np.zeros(2)
    for k in range(30):
        tilt = 0.8 * tilt + np.radians(0.6) * rng.normal(size=2)
        pitch, roll = tilt.tolist()
        floor = PaintedFloor(leaning_camera(published_camera, (pitch, roll)))
        grid = np.stack(np.meshgrid([-0.8, 0.0, 0.8], [-1.4, -2.2, -3.0]), axis=-1)
        place = grid.reshape(-1, 2) + rng.uniform(-0.2, 0.2, (9, 2))
        for xy in place:
            floor.disc(xy, LIGHT)
        places.append(place)
        cv2.imwrite(str(tmp_path / "run" / "images" / f"{k:02d}.png"), floor.image(seed=k))
    write_camera(published_camera, tmp_path / "run" / "run.cam")
    assert main(["all", str(tmp_path / "run")]) == 0
    assert "from its calibration, by the outlines of discs" in capsys.readouterr().out
    off, seen_off, covariances = [], [], []
    assert main(["all", str(tmp_path / "run"), "--tilt", "none", "-o", str(tmp_path)]) == 0
    level, seen = (
        read_frames(folder / "detected.circles") for folder in (tmp_path / "run", tmp_path)
    )
    for place, row, raw in zip(places, level, seen, strict=True):
        found = circle_arrays(row.circles)
        nearest = np.hypot(*(found.xy[:, None] - place).T).argmin(axis=0)
        off.append(found.xy - place[nearest])
        seen_off.append(circle_arrays(raw.circles).xy - place[nearest])
        covariances.append(found.covariance)
    errors = np.concatenate(off)
    assert len(errors) == 30 * 9
    assert np.median(np.hypot(*errors.T)) < 0.6 * np.median(np.hypot(*np.concatenate(seen_off).T))
    assert squared_mahalanobis(errors, np.concatenate(covariances)).mean() / 2.0 < 1.5


def test_an_image_with_a_wrong_calibration_shows_the_same_discs(project_root: Path) -> None:
    image = sorted(((project_root / "images" / "e") / "images").iterdir())[30]
    camera = read_camera((project_root / "images" / "e") / "e.cam")
    right = rd.detect(image, camera)
    wrong = rd.detect(image, wrong_by(camera, (2.3, 0.0)))
    assert len(right.discs) >= 9
    assert len(wrong.discs) == len(right.discs)
    for one, other in ((right, wrong), (wrong, right)):
        u = one.discs.u[:, None] - other.discs.u
        v = one.discs.v[:, None] - other.discs.v
        assert np.hypot(u, v).min(axis=1).max() < 0.5


def test_explanations_and_the_tuning_page_see_a_low_camera_lean(
    published_camera: Camera, low_run: Path
) -> None:
    image = low_run / "images" / "00.png"
    camera = low_camera(published_camera)
    explained = rd.explain(image, camera)
    assert explained.lean == pytest.approx(np.radians([-3.0, -1.0]))
    discs = [candidate for candidate in explained.candidates if candidate.is_disc]
    leaning = wrong_by(camera, LOW_LEAN_DEG)
    seen = leaning.project_floor(low_places()[0])
    assert len(discs) == len(seen)
    far = int(np.argmin(seen[:, 1]))
    assert rd.explain(image, camera, at=tuple(seen[far])).candidates[0].is_disc

    run = open_run(low_run)
    session = TuningSession(run, list(run.frames), CircleSettings(), low_run)
    shown = session.detect(0, asdict(CircleSettings()))["discs"]
    outlines = np.array([disc["outline"] for disc in shown])
    off = outlines.mean(axis=1)[:, None] - seen
    assert np.hypot(*np.moveaxis(off, -1, 0)).min(axis=1).max() < 1.5
    # They are as wide as the discs.
    assert np.ptp(outlines[..., 0], axis=1).max() == pytest.approx(
        np.ptp(leaning.project_floor(circle_on_floor(low_places()[0], 0.1)), axis=1)[:, 0].max(),
        rel=0.05,
    )


def test_a_few_images_show_how_a_low_camera_leans(low_run: Path) -> None:
    """The run is too short for the statistics of a lean, which is a quarter of a disc's distance
    for a camera near the floor.
    """
    assert main(["all", str(low_run)]) == 0
    found = level_rows(low_run / "detected.circles")
    assert [len(rows) for rows in found] == list(map(len, low_places()))
    assert found_again(low_places(), found) == 1.0
    assert main(["circles", str(low_run), "--tilt", "none", "--force"]) == 0
    without = level_rows(low_run / "detected.circles")
    assert 3 * sum(map(len, without)) < sum(map(len, low_places()))


@pytest.mark.parametrize("images", [1, 3])
def test_discs_of_a_few_images_say_how_far_the_lean_may_move_them(
    published_camera: Camera, low_run: Path, images: int
) -> None:
    camera = low_camera(published_camera)
    leaning = wrong_by(camera, LOW_LEAN_DEG)
    for image in sorted((low_run / "images").iterdir())[images:]:
        image.unlink()
    assert main(["circles", str(low_run)]) == 0
    frames = read_frames(low_run / "detected.circles")
    for frame, places in zip(frames, low_places(), strict=False):
        found = circle_arrays(frame.circles)
        assert len(found.xy) == len(places)
        seen = camera.floor_from_pixel(leaning.project_floor(places))
        nearest = np.hypot(*np.moveaxis(found.xy[:, None] - seen, -1, 0)).argmin(axis=1)
        off = found.xy - places[nearest]
        assert 0.2 < squared_mahalanobis(off, found.covariance).mean() / 2.0 < 3.0


def test_frames_of_a_robot_on_rough_ground_are_searched_with_their_own_tilts(
    published_camera: Camera, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    camera, run = low_camera(published_camera), tmp_path / "run"
    (run / "images").mkdir(parents=True)
    write_camera(camera, run / "run.cam")
    places = low_places()[0]
    for k in range(LEAST_FRAMES):
        pitch, roll = (1.5 * rng.normal(size=2)).tolist()
        floor = PaintedFloor(wrong_by(camera, (pitch, roll))).wall()
        for xy in places:
            floor.disc(xy, LIGHT)
        cv2.imwrite(str(run / "images" / f"{k:02d}.png"), floor.image(seed=k))
    assert main(["all", str(run)]) == 0
    found = level_rows(run / "detected.circles")
    assert sum(map(len, found)) > 0.97 * LEAST_FRAMES * len(places)
    assert found_again(found, [places] * LEAST_FRAMES) > 0.75
    # The search with the camera's lean alone loses some.
    assert main(["circles", str(run), "--force"]) == 0
    seen = level_rows(run / "detected.circles")
    assert sum(map(len, seen)) < 0.9 * sum(map(len, found))


def test_a_few_wrong_tilts_are_not_the_tilt_of_a_run(published_camera: Camera) -> None:
    def rows(name: str, tilt_deg: float | None) -> FrameRows:
        text = format_no_tilt(name, 0)
        if tilt_deg is not None:
            text = format_tilt(FrameTilt(name, math.radians(tilt_deg), 0.0, 1e-5, 0.0, 1e-5, 3))
        return FrameRows(name, {"tilt": text})

    strays = [rows(f"{k}", 7.0 if k < 2 else None) for k in range(32)]
    assert np.degrees(tilt_of_some(published_camera, strays)[1]) < 0.5
    together = [rows(f"{k}", 3.0) for k in range(3)]
    lean, usual_rad = tilt_of_some(published_camera, together)
    assert lean is not None
    np.testing.assert_allclose(lean, np.radians([3.0, 0.0]), atol=1e-6)
    assert np.degrees(usual_rad) == pytest.approx(3.0 / np.sqrt(2.0), rel=0.01)


def test_a_slight_tilt_of_a_frame_is_no_lean() -> None:
    assert lean_of_image((math.radians(0.9), math.radians(-0.9))) is None
    lean = lean_of_image((math.radians(2.3), math.radians(-0.9)))
    assert lean == pytest.approx((math.radians(2.0), math.radians(-1.0)))
    assert lean_of_image((math.radians(2.3), 0.0), usual=(math.radians(1.6), 0.0)) is None


@given(
    st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06)),
    st.lists(st.tuples(st.floats(-1.5, 1.5), st.floats(-4.0, -1.0)), min_size=1, max_size=5),
)
def test_levelling_by_the_lean_undoes_what_the_calibration_does(
    published_camera: Camera, lean: tuple[float, float], places: list[tuple[float, float]]
) -> None:
    leaning = leaning_camera(published_camera, lean)
    floor_xy = np.array(places)
    pixels = leaning.project_floor(floor_xy)
    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]]) * np.ones((len(places), 1, 1))
    found = CircleDetections(
        np.rint(np.nan_to_num(pixels)).astype(np.int64), floor_xy, covariance,
        np.ones(len(places)), np.ones(len(places)),
    )  # fmt: skip
    seen = as_calibrated(found, leaning, published_camera)
    assert len(seen) == np.isfinite(pixels).all(axis=1).sum()
    np.testing.assert_allclose(
        published_camera.project_floor(seen.floor_xy),
        pixels[np.isfinite(pixels).all(axis=1)],
        atol=1e-6,
    )
    level_xy, level_covariance, down = level_discs(
        published_camera, seen.floor_xy, seen.covariance, np.array(lean), np.zeros((2, 2))
    )
    assert down.all()
    kept = np.isfinite(pixels).all(axis=1)
    np.testing.assert_allclose(level_xy, floor_xy[kept], atol=1e-6)
    np.testing.assert_allclose(level_covariance, covariance[kept], rtol=1e-3, atol=1e-9)
