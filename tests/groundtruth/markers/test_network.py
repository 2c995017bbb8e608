"""Networks of cameras from checkerboards: chained, adjusted, with true covariances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from camera import Camera, write_camera
from camera.boards.board import Board
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.boards import (
    BoardImage,
    BoardsFile,
    BoardView,
    DoubleBoard,
    read_boards,
    view_of_board,
)
from redetect.groundtruth.markers.network_estimation import (
    NetworkEstimate,
    estimate_network,
    hand_eye,
)
from redetect.groundtruth.markers.poses import solve_camera
from redetect.groundtruth.settings import NetworkSettings
from redetect.groundtruth.trajectories import se3
from tests.groundtruth.markers.scene import hall_cameras, lens

FloatArray = NDArray[np.float64]

NAMES = ("a", "b", "c", "d")
BOARD = Board("checkerboard", 7, 6, 0.08)
BOARDS = {"first": BOARD, "second": BOARD, "world": Board("checkerboard", 9, 6, 0.12)}
OFFSET = se3.exp(np.array([0.02, -0.01, -0.03, 0.02, 3.1, 0.03]))  # back to back
WORLD = se3.exp(np.array([-0.6, -0.4, 0.0, 0.0, 0.0, 0.4]))


def facing(place: FloatArray, towards: FloatArray, generator: np.random.Generator) -> FloatArray:
    """A board at a place whose print looks about towards a point."""
    z = towards - place + generator.normal(0, 0.5, 3)
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    turn = se3.exp(np.concatenate([np.zeros(5), [generator.normal(0, 0.4)]]))
    return np.asarray(se3.transform(np.stack([x, np.cross(z, x), z], axis=1), place) @ turn)


def seen(
    camera: str, board: str, pose: FloatArray, sigma_px: float, generator: np.random.Generator
) -> BoardView | None:
    """The board in the camera's image; None if it is not whole or not from its printed side."""
    number = NAMES.index(camera)
    camera_from_board = se3.inverse(hall_cameras(4)[number]) @ pose
    if -camera_from_board[:3, 2] @ camera_from_board[:3, 3] < 0.3 * camera_from_board[2, 3]:
        return None
    pixels = lens().project(se3.apply(camera_from_board, BOARDS[board].points))
    if not np.all((pixels > 5) & (pixels < [1274, 954])):
        return None
    return BoardView(camera, board, pixels + generator.normal(0, sigma_px, pixels.shape))


def shots(
    sigma_px: float, seed: int, *, per_pair: int = 6, pairs: tuple[str, ...] = ("ab", "bc", "cd")
) -> list[list[BoardView]]:
    generator = np.random.default_rng(seed)
    world = seen("a", "world", WORLD, sigma_px, generator)
    assert world is not None
    found = [[world]]
    cameras = hall_cameras(4)
    for pair in pairs:
        one, other = pair[0], pair[1]
        places = [cameras[NAMES.index(name), :3, 3] for name in (one, other)]
        count = 0
        while count < per_pair:
            place = 0.5 * (places[0] + places[1]) * [0.4, 0.4, 0.5] + generator.normal(0, 0.3, 3)
            first = facing(place, places[0], generator)
            views = [
                seen(one, "first", first, sigma_px, generator),
                seen(other, "second", first @ OFFSET, sigma_px, generator),
            ]
            if views[0] is not None and views[1] is not None:
                found.append([views[0], views[1]])
                count += 1
    return found


def estimated(
    found: list[list[BoardView]],
    offset: FloatArray | None = OFFSET,
    sigmas: FloatArray | None = None,
    sigma_px: float = 0.1,
) -> NetworkEstimate:
    covariance = np.zeros((6, 6)) if sigmas is None else np.diag(sigmas**2)
    double, cameras = DoubleBoard(offset, covariance), dict.fromkeys(NAMES, lens())
    setup = BoardsFile(BOARDS, WORLD, double, cameras, ())
    return estimate_network(setup, found, NetworkSettings(corner_sigma_px=sigma_px))


def errors_of(estimate: NetworkEstimate) -> FloatArray:
    return se3.log(se3.inverse(hall_cameras(4)) @ estimate.world_from_camera)


def test_the_network_comes_back_without_noise() -> None:
    for offset in (OFFSET, None):
        estimate = estimated(shots(1e-7, 1), offset)
        assert np.abs(errors_of(estimate)).max() < 1e-6
        assert estimate.offset is not None
        np.testing.assert_allclose(estimate.offset, OFFSET, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["known", "measured", "unknown"])
def test_its_covariance_is_true(kind: str) -> None:
    """With an offset that is exactly known, known with sigmas, and estimated."""
    generator = np.random.default_rng(2)
    sigmas = np.array([2e-3, 2e-3, 2e-3, 4e-3, 4e-3, 4e-3])
    squares, draws = 0.0, 4
    for seed in range(draws):
        found = shots(0.15, 10 + seed, per_pair=3)
        offset: FloatArray | None = {"known": OFFSET, "unknown": None}.get(
            kind, OFFSET @ se3.exp(sigmas * generator.normal(size=6))
        )
        estimate = estimated(found, offset, sigmas if kind == "measured" else None, sigma_px=0.15)
        error = errors_of(estimate).ravel()
        squares += float(error @ np.linalg.solve(estimate.covariance, error))
        assert estimate.adjusted.chi2_per_dof == pytest.approx(1.0, abs=0.15)
    low, high = chi2.ppf([0.005, 0.995], 24 * draws)
    assert low < squares < high


def test_the_corners_sigma_need_not_be_known() -> None:
    found = shots(0.3, 3)
    right, wrong = estimated(found, sigma_px=0.3), estimated(found, sigma_px=0.1)
    np.testing.assert_allclose(
        np.diagonal(wrong.covariance), np.diagonal(right.covariance), rtol=0.05
    )


def test_a_board_in_the_wrong_image_is_left_out() -> None:
    found = shots(0.1, 4)
    bad = found[3][1]
    found[3][1] = replace(bad, corners=bad.corners + 30.0)
    estimate = estimated(found)
    assert not estimate.adjusted.used.all()
    assert np.abs(errors_of(estimate)).max() < 0.01


def test_a_single_wrong_corner_is_left_out() -> None:
    found = shots(0.03, 8)
    exact = estimated(found, sigma_px=0.03)
    for shot, corner in ((3, 7), (9, 40)):
        view = found[shot][1]
        corners = view.corners.copy()
        corners[corner] += 8.0
        found[shot][1] = replace(view, corners=corners)
    estimate = estimated(found, sigma_px=0.03)
    assert len(estimate.adjusted.used) == len(exact.adjusted.used) - 2
    assert np.all(estimate.adjusted.used)
    np.testing.assert_allclose(
        np.diagonal(estimate.covariance), np.diagonal(exact.covariance), rtol=0.1
    )


def test_a_board_that_was_moved_between_two_pictures_is_noticed() -> None:
    found = shots(0.15, 21, per_pair=4)
    assert estimated(found).disagreement == 1.0
    view = found[1][1]
    pose = solve_camera(lens(), BOARD.points, view.corners, "iterative")[0]
    moved = pose @ se3.exp(np.array([0.01, 0.005, 0.0, 0.0, 0.0, 0.0]))
    found[1][1] = replace(view, corners=lens().project(se3.apply(moved, BOARD.points)))
    estimate = estimated(found)
    assert estimate.disagreement > 5.0
    error = errors_of(estimate).ravel()
    assert error @ np.linalg.solve(estimate.covariance, error) / len(error) < 10.0
    assert estimated(shots(0.15, 22, per_pair=1)).connections == 0


def test_what_does_not_determine_a_network_is_refused() -> None:
    with pytest.raises(GroundTruthError, match="camera d is not connected to the world"):
        estimated(shots(0.1, 5, pairs=("ab", "bc")))
    with pytest.raises(GroundTruthError, match="offset of boards first and second cannot"):
        estimated(shots(0.1, 6, per_pair=1), None)


def test_hand_eye_finds_the_common_transform() -> None:
    generator = np.random.default_rng(7)
    truth = se3.exp(generator.normal(size=6))
    left = se3.exp(generator.normal(size=(5, 6)))
    found = hand_eye(left, se3.inverse(truth) @ left @ truth)
    np.testing.assert_allclose(found, truth, atol=1e-10)


# -- boards in images -----------------------------------------------------------------------


def painted(board: Board, camera: Camera, pose: FloatArray) -> NDArray[np.uint8]:
    """A board as a camera sees it, supersampled."""
    fine = 3
    rows, columns = np.mgrid[: camera.height * fine, : camera.width * fine]
    pixels = np.stack([(columns + 0.5) / fine - 0.5, (rows + 0.5) / fine - 0.5], axis=-1)
    rays = camera.unproject(pixels)
    # Where the rays meet the board's plane, in its own coordinates.
    board_from_camera = se3.inverse(pose)
    directions = rays @ board_from_camera[:3, :3].T
    along = -board_from_camera[2, 3] / directions[..., 2]
    xy = board_from_camera[:2, 3] + along[..., None] * directions[..., :2]
    right = xy[..., 0] / board.square_m + 0.5 * (board.columns - 1)
    down = 0.5 * (board.rows - 1) - xy[..., 1] / board.square_m
    inside = (np.abs(right - 0.5 * (board.columns - 1)) < 0.5 * (board.columns + 1)) & (
        np.abs(down - 0.5 * (board.rows - 1)) < 0.5 * (board.rows + 1)
    )
    black = inside & ((np.floor(right) + np.floor(down)) % 2 == 0)
    grey = np.where(black, 40.0, 210.0)
    mean = grey.reshape(camera.height, fine, camera.width, fine).mean(axis=(1, 3))
    return np.asarray(np.rint(cv2.GaussianBlur(mean, (0, 0), 0.7)), dtype=np.uint8)


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, -100.0])
def test_corners_come_in_the_boards_order_however_it_is_held(
    turn_deg: float, tmp_path: Path
) -> None:
    camera = replace(lens(350.0), width=480, height=360, offset_x=240.0, offset_y=180.0)
    board = Board("checkerboard", 7, 6, 0.08)
    facing_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    facing_camera[:3, 3] = [0.02, -0.03, 0.9]
    pose = facing_camera @ se3.exp(np.array([0, 0, 0, 0.3, -0.25, 0.0]))
    pose = pose @ se3.exp(np.array([0, 0, 0, 0, 0, np.radians(turn_deg)]))
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), painted(board, camera, pose))
    image = BoardImage("a", "first", 0, path)
    corners = view_of_board(image, board, camera).corners
    expected = camera.project(se3.apply(pose, board.points))
    assert np.abs(corners - expected).max() < 0.3
    if turn_deg == 0.0:
        with pytest.raises(GroundTruthError, match="no checkerboard of 9 x 4"):
            view_of_board(image, Board("checkerboard", 9, 4, 0.08), camera)


# -- boards.json ----------------------------------------------------------------------------


def boards_content() -> dict[str, Any]:
    board = {"columns": 7, "rows": 6, "square_m": 0.08}
    pose = {"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}
    return {
        "boards": {"first": board, "second": board, "world": board},
        "world_from_board": pose,
        "first_from_second": {**pose, "sigmas": [0.001] * 6},
        "images": [{"camera": "a", "board": "first", "placement": 0, "image": "a/0.png"}],
    }


def test_a_boards_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    write_camera(lens(), tmp_path / "a" / "a.cam")
    (tmp_path / "boards.json").write_text(json.dumps(boards_content()))
    boards = read_boards(tmp_path)
    assert boards.double is not None
    assert boards.double.offset is not None
    np.testing.assert_allclose(boards.double.covariance, 1e-6 * np.eye(6))
    assert boards.images[0].image == tmp_path / "a" / "0.png"
    assert list(boards.cameras) == ["a"]


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (["boards"], {}, "boards is {}: expected an object"),
        (["boards", "third"], {"columns": 7, "rows": 6, "square_m": 1}, "expected world, and"),
        (["boards", "first"], {"columns": 7.5, "rows": 6, "square_m": 1}, "columns is 7.5"),
        (["boards", "first", "rows"], 7, "board first: board of 7 x 7"),
        (["boards", "first", "columns"], 2, "board first: .* at least 3 x 3"),
        (["boards", "first", "square_m"], 0.0, "board first: .* metres above 0"),
        (["world_from_board"], None, "world_from_board: expected"),
        (["images"], [], "images is \\[\\]: expected a list"),
        (["images", 0, "camera"], 5, "camera is 5: expected its name"),
        (["images", 0, "board"], "x", "board is 'x': expected one of"),
        (["images", 0, "placement"], "x", "placement is 'x': expected a whole number"),
        (["images", 0, "image"], 5, "image is 5: expected a file's name"),
    ],
)  # fmt: skip
def test_boards_files_that_cannot_be_are_refused(
    tmp_path: Path, place: list[Any], value: object, problem: str
) -> None:
    content = boards_content()
    inner: Any = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    # The dictionaries of the boards are one and the same object: written and read, they are not.
    (tmp_path / "boards.json").write_text(json.dumps(content))
    (tmp_path / "a").mkdir()
    write_camera(lens(), tmp_path / "a" / "a.cam")
    with pytest.raises(GroundTruthError, match=problem) as caught:
        read_boards(tmp_path)
    assert str(tmp_path / "boards.json") in str(caught.value)
