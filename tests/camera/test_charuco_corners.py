"""Corners of ChArUco boards: rendered truth back, unread markers, corners that are none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from camera.boards.board import Board
from camera.boards.charuco import find_charuco
from camera.errors import CalibrationError
from camera.rotations import rotation_of
from redetect.array_types import FloatArray
from tools.evaluation.boards import rays_of, render_board

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
BOARD = Board("charuco", 7, 6, 0.05, marker_m=0.038)
T = np.array([0.01, 0.0, 0.42])


def camera_of(height: int) -> Camera:
    """A small camera with some distortion; of 120 lines, every second one is left out."""
    share = height / 240.0
    return Camera(
        320, height, 260.0, 260.0 * share, 160.5, 118.0 * share, (0.0, -0.25, 0.0, 0.3, 0.0),
        IDENTITY,
    )  # fmt: skip


def pose(turn: tuple[float, float, float]) -> FloatArray:
    return rotation_of(np.array(turn)) @ np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def picture() -> tuple[NDArray[np.uint8], FloatArray]:
    """A tilted board, and where its corners truly are."""
    camera, R = camera_of(240), pose((0.2, -0.3, 0.15))
    return render_board(rays_of(camera), BOARD, R, T), camera.project(BOARD.points @ R.T + T)


# In half the height, the white between edge and marker is one and a half pixels high.
@pytest.mark.parametrize(("height", "allowed_px"), [(240, 0.06), (120, 0.1)])
def test_markers_close_to_the_corners_do_not_draw_them_away(height: int, allowed_px: float) -> None:
    camera = camera_of(height)
    rays = rays_of(camera)
    errors = []
    for seed, turn in enumerate([(0.0, 0.0, 0.0), (0.4, 0.0, 0.2), (0.1, -0.4, -0.1)]):
        R = pose(turn)
        indices, pixels = find_charuco(render_board(rays, BOARD, R, T, seed=seed), BOARD)
        assert len(indices) == len(BOARD.points)
        errors.append(pixels - camera.project(BOARD.points @ R.T + T)[indices])
    error = np.concatenate(errors)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < allowed_px
    assert np.all(np.abs(error.mean(axis=0)) < 0.25 * allowed_px)


def test_the_lens_bends_the_edges_of_large_squares() -> None:
    lens = (0.0, -0.25, 0.0, 0.3, 0.0)
    camera = Camera(960, 720, 780.0, 780.0, 481.5, 356.0, lens, IDENTITY)
    R, near = pose((0.1, -0.2, 0.15)), T * [1.0, 1.0, 0.7]
    indices, pixels = find_charuco(render_board(rays_of(camera), BOARD, R, near), BOARD)
    error = pixels - camera.project(BOARD.points @ R.T + near)[indices]
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.03


def test_corners_of_markers_that_were_not_read_are_found(
    picture: tuple[NDArray[np.uint8], FloatArray],
) -> None:
    image, true = picture
    spoilt = image.copy()
    # The middles of the two columns of squares at the left are blotted out, so that their markers
    # can't be read; the corners between them are left.
    grid = true.reshape(5, 6, 2)
    for row in range(4):
        for column in range(2):
            middle = grid[row : row + 2, column : column + 2].reshape(-1, 2).mean(axis=0)
            u, v = np.rint(middle).astype(int)
            spoilt[v - 6 : v + 7, u - 6 : u + 7] = 120
    indices, pixels = find_charuco(spoilt, BOARD)
    left = [7, 13, 19]
    assert np.isin(left, indices).all()
    found = pixels[np.isin(indices, left)]
    assert np.linalg.norm(found - true[left], axis=1).max() < 0.15


def test_a_corner_that_is_hidden_is_not_reported(
    picture: tuple[NDArray[np.uint8], FloatArray],
) -> None:
    image, true = picture
    hidden = image.copy()
    u, v = np.rint(true[14]).astype(int)
    hidden[v - 7 : v + 8, u - 7 : u + 8] = 90
    indices, pixels = find_charuco(hidden, BOARD)
    assert 14 not in indices
    assert len(indices) >= len(true) - 5
    assert np.linalg.norm(pixels - true[indices], axis=1).max() < 0.3


def test_a_picture_without_a_board_has_no_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    indices, pixels = find_charuco(noise, BOARD)
    assert len(indices) == 0
    assert pixels.shape == (0, 2)


def test_an_unknown_dictionary_is_named() -> None:
    board = Board("charuco", 7, 6, 0.05, marker_m=0.036, dictionary="DICT_NONE")
    with pytest.raises(CalibrationError, match="'DICT_NONE' is unknown"):
        find_charuco(np.zeros((240, 320), dtype=np.uint8), board)


def test_a_dictionary_too_small_for_the_board_is_told() -> None:
    board = Board("charuco", 12, 9, 0.05, marker_m=0.036, dictionary="DICT_5X5_50")
    with pytest.raises(CalibrationError, match=r"DICT_5X5_50 has 50 markers, and a charuco .* 54"):
        find_charuco(np.zeros((240, 320), dtype=np.uint8), board)
