"""What a calibration finds out by itself: the aspect ratio, a board's true count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from camera.calibration.calibrate import (
    BoardView,
    Calibration,
    aspect_of,
    calibrate_with_free_aspect,
)
from camera.calibration.model import CalibrationSettings
from camera.commands.calibrate import board_as_counted, calibration_images
from tests.camera.conftest import BOARD, CAMERA
from tools.evaluation.boards import board_poses


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
    return calibrate_with_free_aspect(seen, BOARD, (320, 240), settings)


def test_the_aspect_ratio_is_found() -> None:
    off, true = [], 1.02
    for seed in range(2):
        found = aspect_of(calibrated(true, 10, seed))
        assert 0.0 < found.sigma < 0.003
        off.append((found.value - true) / found.sigma)
    assert np.abs(off).max() < 3.5


def test_pictures_that_do_not_tell_it_get_square_pixels() -> None:
    found = calibrated(1.0, 4, 6, noise_px=0.9)

    assert aspect_of(found).value == pytest.approx(1.0, abs=1e-9)
    assert any("scaleY / scaleX uncertain" in warning for warning in found.warnings)


@pytest.mark.parametrize(("columns", "rows"), [(10, 7), (8, 5), (6, 9)])
def test_a_wrong_count_is_mended(
    photographs: Path, columns: int, rows: int, capsys: pytest.CaptureFixture[str]
) -> None:
    given = replace(BOARD, columns=columns, rows=rows)
    found = board_as_counted(calibration_images([photographs], 60), given)
    told = capsys.readouterr().err
    if (columns, rows) == (6, 9):  # the same board, lying
        assert (found, told) == (given, "")
    else:
        assert found == BOARD
        assert "the board has 9 x 6 inner corners" in told
