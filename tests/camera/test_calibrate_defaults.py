"""What a calibration finds out by itself: the aspect ratio, a board's true count; pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.calibration.calibrate import BoardView, Calibration, aspect_of, calibrate_freely
from camera.calibration.model import CalibrationSettings
from camera.cli import main
from camera.uncertainty import covariance_of
from tools.evaluation.boards import Rays, board_poses, rays_of, render_board

BOARD = Board("checkerboard", 9, 6, 0.04)
CAMERA = Camera(
    320, 240, 260.0, 260.0, 160.5, 118.0, (0.0, -0.25, 0.0, 0.3, 0.0),
    ((-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, -1.0, 0.0, 0.0)),
)  # fmt: skip


def calibrated(aspect: float, views: int, seed: int, noise_px: float = 0.1) -> Calibration:
    """By points of boards."""
    camera = replace(CAMERA, scale_y=aspect * CAMERA.scale_x)
    rng = np.random.default_rng(seed)
    poses = board_poses(camera, BOARD, views, seed, distances_m=(0.35, 0.6), margin_px=5.0)
    seen = []
    for number, (R, t) in enumerate(poses):
        pixels = camera.project(BOARD.points @ R.T + t)
        noise = noise_px * rng.standard_normal(pixels.shape)
        seen.append(BoardView(f"{number}", np.arange(len(pixels)), pixels + noise))
    settings = CalibrationSettings(coefficients=2, tangential=False, polynomial=False)
    return calibrate_freely(seen, BOARD, (320, 240), settings)


@pytest.mark.parametrize("true", [1.0, 1.02])
def test_the_aspect_ratio_is_found(true: float) -> None:
    off = []
    for seed in range(4):
        found = aspect_of(calibrated(true, 10, seed))
        assert 0.0 < found.sigma < 0.003
        off.append((found.value - true) / found.sigma)
    assert np.abs(off).max() < 3.5


def test_pictures_that_do_not_tell_it_get_square_pixels() -> None:
    found = calibrated(1.0, 4, 6, noise_px=0.9)

    assert aspect_of(found).value == pytest.approx(1.0, abs=1e-9)
    assert any("scaleY / scaleX open" in warning for warning in found.warnings)


@pytest.fixture(scope="module")
def rays() -> Rays:
    return rays_of(replace(CAMERA, scale_y=1.02 * CAMERA.scale_x))


@pytest.fixture(scope="module")
def photographs(rays: Rays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    poses = board_poses(rays.camera, BOARD, 8, 3, distances_m=(0.35, 0.5), margin_px=8.0)
    for i, (R, t) in enumerate(poses):
        cv2.imwrite(str(folder / f"{i:02d}.png"), render_board(rays, BOARD, R, t, seed=i))
    return folder


@pytest.mark.long
@pytest.mark.parametrize("count", [("10", "7"), ("8", "5"), ("6", "9")])
def test_a_wrong_count_is_mended_and_pictures_show_it(
    rays: Rays,
    photographs: Path,
    tmp_path: Path,
    count: tuple[str, str],
    capsys: pytest.CaptureFixture[str],
) -> None:
    c, s = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    truth = replace(
        rays.camera,
        robot_from_camera=((-1.0, 0.0, 0.0, 0.05), (0.0, s, -c, -0.1), (0.0, -c, -s, 0.6)),
    )
    R = truth.rotation.T
    place = R @ (np.array([0.03, -0.75, 0.0]) - truth.centre)
    floor = render_board(rays, BOARD, R @ np.diag([-1.0, -1.0, 1.0]), place, seed=50)
    cv2.imwrite(str(tmp_path / "floor.png"), floor)
    flags = [
        "--columns", count[0], "--rows", count[1], "--square-m", "0.04", "--coefficients", "2",
        "--floor", str(tmp_path / "floor.png"), "--floor-origin", "0.03", "-0.75",
        "--floor-yaw", "180", "--pictures", str(tmp_path / "check"),
    ]  # fmt: skip
    output = tmp_path / "my.cam"

    assert main(["calibrate", str(photographs), *flags, "-o", str(output)]) == 0

    told = capsys.readouterr()
    assert ("the board has 9 x 6 inner corners" in told.err) == (count != ("6", "9"))
    found = read_camera(output)
    assert found.scale_y / found.scale_x == pytest.approx(1.02, abs=0.004)
    assert covariance_of(found) is not None
    if count != ("6", "9"):
        assert np.linalg.norm(found.centre - truth.centre) < 0.01
    grid = cv2.imread(str(tmp_path / "check" / "floor.png.grid.png"))
    above = cv2.imread(str(tmp_path / "check" / "floor.png.from-above.png"))
    assert grid is not None
    assert above is not None
    corners = list((tmp_path / "check").glob("*.corners.png"))
    assert len(corners) >= 6
