"""Calibration of a fisheye lens, which sees on where one coefficient folds."""

from __future__ import annotations

import numpy as np
import pytest

from camera.boards.board import Board
from camera.calibration.calibrate import BoardView, calibrate
from camera.calibration.model import CalibrationSettings, FreeLens
from camera.rotations import rotation_of


def test_a_fisheye_lens_is_reached_and_chosen() -> None:
    """From few coefficients, whose fold bars the way, fits would stay at residuals of pixels."""
    board = Board("checkerboard", 9, 6, 0.03)
    rng = np.random.default_rng(4)
    focal, middle = 290.0, np.array([258.0, 188.0])  # 101 degrees across
    views: list[BoardView] = []
    while len(views) < 9:
        away = rng.uniform(-0.8, 0.8, 2) * [1.0, 0.75]
        towards = rotation_of(np.array([-away[1], away[0], 0.0]))
        turned = rotation_of(rng.normal(size=3) * 0.3) @ np.diag([1.0, -1.0, -1.0])
        points = (board.points @ turned.T + [0.0, 0.0, rng.uniform(0.28, 0.4)]) @ towards.T
        across = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(across, points[:, 2])
        pixels = middle + focal * (angle / across)[:, None] * points[:, :2]
        if np.any(pixels < 3.0) or np.any(pixels > [508.0, 380.0]):
            continue
        pixels += rng.normal(scale=0.05, size=pixels.shape)
        views.append(BoardView(f"{len(views)}", np.arange(len(pixels)), pixels))
    settings = CalibrationSettings(tangential=False, polynomial=False)
    result = calibrate(views, board, (512, 384), settings)
    assert result.adjusted.sigma_px == pytest.approx(0.05, rel=0.15)
    assert result.intrinsics[:2] == pytest.approx(focal, rel=0.005)
    assert result.lens.coefficients >= 2
    assert all(result.cross_validation_px[FreeLens(count)] < 0.2 for count in (3, 4, 5))
