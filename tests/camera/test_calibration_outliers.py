"""Pictures that contradict the others: they are left out and named, and the rest calibrate."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from camera import Camera, read_camera
from camera.calibration.adjustment import Estimate, fit_points
from camera.calibration.calibrate import (
    BoardView,
    Calibration,
    calibrate,
    calibrated_camera,
    points_of,
)
from camera.calibration.consensus import demand_different_views
from camera.calibration.model import CalibrationSettings
from camera.cli import main
from camera.commands.calibrate import describe
from camera.errors import CalibrationError
from camera.rotations import rotation_of
from camera.uncertainty import UNPOSED, covariance_of, intrinsics_of
from redetect.array_types import FloatArray
from tests.camera.conftest import BOARD, CAMERA
from tools.evaluation.boards import Rays, board_poses, render_board

TRUTH = replace(
    UNPOSED, width=640, height=480, scale_x=480.0, scale_y=480.0, offset_x=322.0, offset_y=238.0,
    coef=(0.0, -0.2, 0.0, 0.3, 0.0),
)  # fmt: skip
SETTINGS = CalibrationSettings(coefficients=2, tangential=False, polynomial=False)
COUNT, SEED = 15, 12


def seen_views(
    count: int = COUNT, stretched: Sequence[int] = (), noise_px: float = 0.1
) -> list[BoardView]:
    """Points of boards; some of these are 1.3 times as wide as they should be."""
    rng = np.random.default_rng(SEED)
    views = []
    for view, (R, t) in enumerate(board_poses(TRUTH, BOARD, count, SEED, distances_m=(0.3, 0.6))):
        wide, back = ((1.3, 1.0, 1.0), 1.3) if view in stretched else ((1.0, 1.0, 1.0), 1.0)
        pixels = TRUTH.project(BOARD.points * wide @ R.T + back * t)
        noise = rng.normal(scale=noise_px, size=pixels.shape)
        views.append(BoardView(f"{view:02d}.png", np.arange(len(pixels)), pixels + noise))
    return views


def a_square_off(view: BoardView) -> None:
    """Where a row ends, its last corner is found in the next."""
    view.pixels[:-1] = view.pixels[1:].copy()


@pytest.mark.parametrize("noise_px", [0.0, 0.01, 0.1])
def test_perfect_pictures_are_never_outliers(noise_px: float) -> None:
    """Nor are good ones among them, whose points have the noise of usual photographs."""
    views, rng = seen_views(noise_px=0.0), np.random.default_rng(4)
    for view in views[:4]:
        view.pixels[:] += rng.normal(scale=noise_px, size=view.pixels.shape)
    assert calibrate(views, BOARD, (640, 480), SETTINGS).outliers == ()


def nowhere(view: BoardView) -> None:
    """Found at random."""
    view.pixels[:] = np.random.default_rng(3).uniform(0.0, 479.0, size=view.pixels.shape)


def normalised_error(truth: Camera, intrinsics: FloatArray, covariance: FloatArray) -> float:
    """Squared error of the scale, principal point and free coefficients by their covariance."""
    free = [0, 2, 3, 5, 7] if covariance[1, 1] == covariance[0, 0] else [0, 1, 2, 3, 5, 7]
    error = (intrinsics - intrinsics_of(truth))[free]
    return float(error @ np.linalg.solve(covariance[np.ix_(free, free)], error))


def assert_true(found: Calibration) -> None:
    squared = normalised_error(TRUTH, found.intrinsics, found.adjusted.covariance)
    assert squared < chi2.ppf(0.999, 5)
    assert found.adjusted.sigma_px == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("wrong", [(0, 7), pytest.param((3, 4, 8, 11, 12), marks=pytest.mark.long)])
def test_boards_found_a_square_off_are_left_out(wrong: tuple[int, ...]) -> None:
    views = seen_views()
    for view in wrong:
        a_square_off(views[view])
    found = calibrate(views, BOARD, (640, 480), SETTINGS)
    assert [name for name, _ in found.outliers] == [f"{view:02d}.png" for view in wrong]
    assert_true(found)


def test_another_board_is_left_out_even_of_few() -> None:
    views = seen_views(5, stretched=[2])
    found = calibrate(views, BOARD, (640, 480), SETTINGS)
    assert [name for name, _ in found.outliers] == ["02.png"]
    assert_true(found)


def test_a_picture_stays_for_all_but_a_point_that_is_wrong() -> None:
    views = seen_views(6)
    for view in views:
        view.pixels[view.indices[9]] += (5.0, -4.0)
    found = calibrate(views, BOARD, (640, 480), SETTINGS)
    assert found.outliers == ()
    assert found.warnings[0].startswith("6 points excluded")
    assert_true(found)


def test_a_picture_without_a_residual_is_reported() -> None:
    views = seen_views(6)
    nowhere(views[4])
    for settings in (SETTINGS, replace(SETTINGS, keep_outliers=True)):
        found = calibrate(views, BOARD, (640, 480), settings)
        assert found.outliers == (("04.png", np.inf),)
        assert_true(found)
    assert "excluded: 04.png, where no pose" in describe(found, calibrated_camera(found))


def test_pictures_that_contradict_each_other_are_named() -> None:
    views = seen_views(4)
    for view in (1, 2):
        nowhere(views[view])
    with pytest.raises(CalibrationError, match=r"01.png, 02.png contradict 00.png, 03.png"):
        calibrate(views, BOARD, (640, 480), SETTINGS)
    views = seen_views(3)
    a_square_off(views[1])
    with pytest.raises(CalibrationError, match=r"2 pictures of the board without 01.png"):
        calibrate(views, BOARD, (640, 480), SETTINGS)


def test_what_different_orientations_do_not_determine_is_not_put_on_them() -> None:
    poses = board_poses(TRUTH, BOARD, 6, SEED, distances_m=(0.3, 0.6))
    truth = Estimate(intrinsics_of(TRUTH), *map(np.stack, zip(*poses)))
    points = points_of(seen_views(6), BOARD, (640, 480))
    fit, _ = fit_points(truth, points, SETTINGS, SETTINGS.lens(2), 0.0)
    demand_different_views(fit)
    unsure = replace(fit, covariance=1e4 * fit.covariance)
    with pytest.raises(CalibrationError, match=r"not determine the lens.*% uncertain.* 32\d, 23\d"):
        demand_different_views(unsure)


@pytest.mark.long
def test_another_board_among_the_photographs_is_named(
    rays: Rays, photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "photographs"
    shutil.copytree(photographs, folder)
    R = rotation_of(np.array([0.3, -0.4, 0.15])) @ np.diag([1.0, -1.0, -1.0])
    # Its squares are 1.3 times as wide as high.
    stretched = R @ np.diag([1.0 / 1.3, 1.0, 1.0])
    other = render_board(rays, BOARD, stretched, np.array([0.01, 0.0, 0.6]), seed=99)
    cv2.imwrite(str(folder / "other.png"), other)
    output = tmp_path / "my.cam"
    command = ["calibrate", str(folder), "--columns", "9", "--rows", "6", "--square-m", "0.04"]
    command += ["--coefficients", "2", "--tangential", "off", "--polynomial", "off"]
    assert main([*command, "-o", str(output)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("excluded: ") == 1
    assert "excluded: other.png, residuals of" in printed
    found = read_camera(output)
    covariance = covariance_of(found)
    assert covariance is not None
    assert normalised_error(CAMERA, intrinsics_of(found), covariance[:14, :14]) < chi2.ppf(0.999, 6)
