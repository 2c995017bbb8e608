"""Pictures of calibration boards by ray casting through a camera, with exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from tyro.conf import Positional

from camera import Camera, read_camera
from camera.boards.board import Board, charuco_of
from camera.rotations import rotation_of
from camera.uncertainty import coarse_pixel_grid
from redetect.array_types import ByteArray, FloatArray, IntArray
from redetect.storage import OutputExistsError, write_bytes
from tools.evaluation.figures import Figures, Study, StudyError
from tools.simulator.files import encoded
from tools.simulator.pixels import noisy_image, subpixel_grid

#: Standard deviations of a board's turns about its axes.
_TILTS_RAD = np.array([0.45, 0.45, 0.3])
_PAPER, _INK, _ROOM = 200.0, 40.0, 110.0
# Dots of a ChArUco board's print per square.
_DOTS = 120
#: Largest number of attempts to find a pose, on average.
_TRIES = 10_000
_TOGETHER = 8  # rows of sub-pixels whose grey values are computed at once: they fit into a cache


@dataclass(frozen=True, eq=False)
class Rays:
    """Directions (x, y, 1) of all sub-pixels of a camera, (H * n, W * n, 2), and n."""

    xy: FloatArray
    samples: int
    camera: Camera


def rays_of(camera: Camera, samples: int = 4) -> Rays:
    """The rays of a camera's sub-pixels, `samples` times `samples` to a pixel."""
    return Rays(camera.undistort(subpixel_grid(camera, samples, samples)), samples, camera)


def render_board(
    rays: Rays,
    board: Board,
    rotation: FloatArray,
    translation: FloatArray,
    *,
    blur_px: float = 0.6,
    noise: float = 2.0,
    seed: int = 0,
) -> ByteArray:
    """A picture of a board. `rotation` (3, 3); `translation` (3,); returns (H, W)."""
    fine: FloatArray = np.empty(rays.xy.shape[:2])
    for rows in (slice(k, k + _TOGETHER) for k in range(0, len(fine), _TOGETHER)):
        fine[rows] = _greys(rays.xy[rows], board, rotation, translation)
    if blur_px > 0.0:
        fine = np.asarray(cv2.GaussianBlur(fine, (0, 0), blur_px * rays.samples), np.float64)
    n = rays.samples
    height, width = fine.shape[0] // n, fine.shape[1] // n
    image = fine.reshape(height, n, width, n).mean(axis=(1, 3))
    return noisy_image(image, noise, np.random.default_rng(seed))


def _greys(xy: FloatArray, board: Board, rotation: FloatArray, place: FloatArray) -> FloatArray:
    """Grey values along rays (x, y, 1), (..., 2), to a board whose middle is at a place."""
    along = xy @ rotation[:2, 2] + rotation[2, 2]
    depth = float(rotation[:, 2] @ place) / np.where(np.abs(along) > 1e-9, along, np.nan)
    visible = np.isfinite(depth) & (depth > 0.0)
    a, b, c = xy[..., 0] * depth - place[0], xy[..., 1] * depth - place[1], depth - place[2]
    x, y = (np.where(visible, a * e[0] + b * e[1] + c * e[2], 1e9) for e in rotation.T[:2])
    square = board.square_m
    half = board.points[:, :2].max(axis=0) + (1.0 if "circles" not in board.kind else 1.5) * square
    inside = (np.abs(x) <= half[0]) & (np.abs(y) <= half[1])
    margin = (np.abs(x) <= half[0] + square) & (np.abs(y) <= half[1] + square)
    column = np.where(inside, (x + half[0]) / square, 0.0)
    row = np.where(inside, (half[1] - y) / square, 0.0)
    if board.kind == "checkerboard":
        black = (column.astype(np.int64) + row.astype(np.int64)) & 1 == 0
    elif board.kind == "charuco":
        grey = _charuco(board)
        r = np.clip((row * _DOTS).astype(int), 0, grey.shape[0] - 1)
        c = np.clip((column * _DOTS).astype(int), 0, grey.shape[1] - 1)
        black = grey[r, c] < 128
    else:
        black = np.zeros(x.shape, dtype=bool)
        radius = 0.5 * (board.circle_m or square)
        for centre in board.points:
            black |= (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2
    return np.asarray(np.where(inside & black, _INK, np.where(margin, _PAPER, _ROOM)))


@lru_cache(maxsize=4)
def _charuco(board: Board) -> ByteArray:
    size = (_DOTS * board.columns, _DOTS * board.rows)
    return np.asarray(charuco_of(board).generateImage(size), dtype=np.uint8)


def board_poses(
    camera: Camera,
    board: Board,
    count: int,
    seed: int,
    *,
    distances_m: tuple[float, float],
    margin_px: float = 8.0,
) -> list[tuple[FloatArray, FloatArray]]:
    """Poses `camera_from_board` in which all of a board is seen, spread over the image.

    Half of them have the board's corner in a corner of the image, so that that is covered.
    """
    rng = np.random.default_rng(seed)
    # Facing the camera: the board's y up is the camera's y down.
    facing = np.diag([1.0, -1.0, -1.0])
    size = np.array([camera.width, camera.height])
    points = board.points
    outer = np.abs(points[:, :2]).max(axis=0) + board.square_m
    frame = np.array([[sx * outer[0], sy * outer[1], 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    poses: list[tuple[FloatArray, FloatArray]] = []
    tries = 0
    while len(poses) < count:
        tries += 1
        if tries > _TRIES * (len(poses) + 1):
            raise StudyError(f"the whole board was seen in {len(poses)} poses: expected {count}")
        pixel = rng.uniform(margin_px, size - 1 - margin_px)
        distance = rng.uniform(*distances_m)
        direction = camera.unproject(pixel)
        direction /= np.linalg.norm(direction)
        towards = rotation_of(
            np.arctan2(np.hypot(*direction[:2]), direction[2])
            * np.array([-direction[1], direction[0], 0.0])
            / max(np.hypot(*direction[:2]), 1e-12)
        )
        tilt = rotation_of(rng.normal(size=3) * _TILTS_RAD)
        rotation = towards @ tilt @ facing
        translation = distance * direction
        if rotation[:, 2] @ translation >= 0.0:
            continue
        seen = camera.project(np.vstack([points, frame]) @ rotation.T + translation)
        inside = np.isfinite(seen).all(axis=1) & (seen >= margin_px).all(axis=1)
        inside = np.asarray(inside & (seen <= size - 1 - margin_px).all(axis=1))
        if not inside[: len(points)].all() or (len(poses) % 2 == 0 and not inside.all()):
            continue
        if len(poses) % 2 == 1 and _corner_distance(seen[: len(points)], size) > 0.12:
            continue
        poses.append((rotation, translation))
    return poses


def _corner_distance(pixels: FloatArray, size: IntArray) -> float:
    """Distance of the nearest point to a corner of the image, in diagonals."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (size - 1)
    away = np.linalg.norm((pixels[:, None, :] - corners) / size, axis=-1)
    return float(away.min())


def projection_difference(camera: Camera, other: Camera, *, rotate: bool = True) -> FloatArray:
    """How far apart two cameras project the same directions, (37, 49) pixels over the image.

    NaN where the other camera does not see the direction; with `rotate` it is turned to fit best.
    """
    pixels = coarse_pixel_grid(camera.width, camera.height)
    rays = camera.unproject(pixels)
    rotation = np.eye(3)
    if rotate:
        seen = np.isfinite(other.project(rays)).all(axis=1)

        def off(turn: FloatArray) -> FloatArray:
            return (other.project(rays[seen] @ rotation_of(turn).T) - pixels[seen]).ravel()

        rotation = rotation_of(least_squares(off, np.zeros(3), xtol=1e-14, ftol=1e-14).x)
    found = other.distort((rays @ rotation.T)[:, :2] / (rays @ rotation.T)[:, 2:])
    return np.asarray(np.linalg.norm(found - pixels, axis=1).reshape(37, 49))


#: Rays of a pixel, along either axis: of 4, edges that lie nearly along the pixels are .07 px off.
_SAMPLES = 6
#: The board in the hand, and the one that lies on the floor: squares of 4 cm and 12 cm.
IN_HAND = Board("checkerboard", 9, 6, 0.04)
ON_FLOOR = Board("checkerboard", 9, 6, 0.12)
#: Where the middle of the latter lies: X (left) and Y (backward) of the robot, metres.
FLOOR_ORIGIN = (0.0, -1.3)


@dataclass(frozen=True)
class TutorialPhotographs(Study):
    """Render the tutorial's photographs with the demo run's camera, so that the truth is known."""

    output: Positional[Path]  # Folder for `boards/*.png` and `floor.png`.
    camera: Path = Path("images/e/e.cam")  # The camera that takes them.
    count: int = 14  # Number of photographs of the hand-held board.
    seed: int = 3  # Of the board's positions and the noise.

    def measure(self) -> Figures:
        camera = read_camera(self.camera)
        boards, floor = self.output / "boards", self.output / "floor.png"
        for path in (boards, floor):
            if path.exists():
                raise OutputExistsError(path)
        boards.mkdir(parents=True)
        rays = rays_of(camera, _SAMPLES)
        poses = board_poses(camera, IN_HAND, self.count, self.seed, distances_m=(0.25, 0.5))
        for number, (rotation, translation) in enumerate(poses):
            image = render_board(rays, IN_HAND, rotation, translation, seed=self.seed + number)
            write_bytes(boards / f"{number:02}.png", encoded(image, ".png"), overwrite=False)
        # It lies like a page before somebody who looks ahead: x to the right, which is -X; z up.
        robot_from_board = np.diag([-1.0, -1.0, 1.0])
        robot_from_camera = np.asarray(camera.robot_from_camera)
        camera_from_robot = robot_from_camera[:, :3].T
        origin = camera_from_robot @ (np.array([*FLOOR_ORIGIN, 0.0]) - robot_from_camera[:, 3])
        image = render_board(rays, ON_FLOOR, camera_from_robot @ robot_from_board, origin)
        write_bytes(floor, encoded(image, ".png"), overwrite=False)
        print(f"{boards}: {self.count} photographs of a board")
        print(f"{floor}: it lies {-FLOOR_ORIGIN[1]:g} m ahead")
        return {}
