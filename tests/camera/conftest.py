"""Photographs of a board, rendered through a small camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from camera import Camera
from camera.boards.board import Board
from tools.evaluation.boards import Rays, board_poses, rays_of, render_board

BOARD = Board("checkerboard", 9, 6, 0.04)
#: A small camera with square pixels and some distortion.
CAMERA = Camera(
    320, 240, 260.0, 260.0, 160.5, 118.0, (0.0, -0.25, 0.0, 0.3, 0.0),
    ((-1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, -1.0, 0.0, 0.0)),
)  # fmt: skip
PICTURES = 10


@pytest.fixture(scope="session")
def rays() -> Rays:
    return rays_of(CAMERA)


@pytest.fixture(scope="session")
def photographs(rays: Rays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of `PICTURES` photographs of `BOARD`."""
    folder = tmp_path_factory.mktemp("photographs")
    poses = board_poses(CAMERA, BOARD, PICTURES, 3, distances_m=(0.35, 0.55), margin_px=5.0)
    for i, (R, t) in enumerate(poses):
        cv2.imwrite(str(folder / f"{i:02d}.png"), render_board(rays, BOARD, R, t, seed=i))
    return folder
