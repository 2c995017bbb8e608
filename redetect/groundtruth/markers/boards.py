"""Checkerboards, and ``boards.json`` (docs/groundtruth.md), which lists the images of each.

A board's frame is that of `camera.boards.board`: origin at the middle of its inner corners, x
right, y up, z out of the print, oriented so that the top left square is black. With one even and
one odd number of corners, this orientation is unique.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.boards.points import find_board
from camera.errors import CalibrationError
from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.files import JsonObject
from redetect.groundtruth.markers.session import parse_pose
from redetect.messages import excerpt
from redetect.storage.bounded import path_inside
from redetect.storage.images import read_grey

#: Half the side of a corner's refinement window, as a fraction of a square: cameras are calibrated
#: and far away here, so that blur and noise cause larger errors than the lens's distortion.
_WINDOW = 0.4

BOARDS_NAME = "boards.json"
FIRST, SECOND, WORLD = "first", "second", "world"


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in an image."""

    camera: str
    board: str
    corners: FloatArray  # (K, 2): pixels, in the order of `Board.points`


@dataclass(frozen=True, eq=False)
class DoubleBoard:
    """The boards `FIRST` and `SECOND`, rigidly connected."""

    offset: FloatArray | None  # (4, 4): `first_from_second`; None if it is to be estimated.
    covariance: FloatArray  # (6, 6): of its right perturbation; zeros if known exactly.


@dataclass(frozen=True, eq=False)
class BoardImage:
    """A board in an image that has not been read yet."""

    camera: str
    board: str
    placement: int
    image: Path


@dataclass(frozen=True, eq=False)
class BoardsFile:
    """Content of a ``boards.json``."""

    boards: dict[str, Board]
    world_from_board: FloatArray  # (4, 4)
    double: DoubleBoard | None
    cameras: dict[str, Camera]
    images: tuple[BoardImage, ...]


def read_boards(path: Path) -> BoardsFile:
    """Read a ``boards.json``, or the one in a folder, and the calibrations of its cameras.

    Raises `GroundTruthError` or `camera.CameraError` if a file or an entry is not valid.
    """
    path = path / BOARDS_NAME if path.is_dir() else path
    content = JsonObject.read(path)
    boards = {name: _board(entry) for name, entry in content.objects("boards").items()}
    unknown = sorted(set(boards) - {FIRST, SECOND, WORLD})
    if unknown or WORLD not in boards or (FIRST in boards) != (SECOND in boards):
        raise GroundTruthError(
            f"{path}: boards are {excerpt(sorted(boards))}: expected world, and both "
            "or neither of first and second"
        )
    world = parse_pose(content.inner("world_from_board"))
    double = None
    if FIRST in boards:
        double = DoubleBoard(None, np.zeros((6, 6)))
        if content.values.get("first_from_second") is not None:
            entry = content.inner("first_from_second")
            double = DoubleBoard(parse_pose(entry), entry.uncertainty(6))
    images = tuple(_image(row, path, boards) for row in content.rows("images"))
    cameras = {
        name: read_camera(_inside(path, calibration_of(name)))
        for name in sorted({image.camera for image in images})
    }
    return BoardsFile(boards, world, double, cameras, images)


def calibration_of(camera: str) -> str:
    """Path of a camera's calibration, relative to the folder of the boards' file."""
    return f"{camera}/{camera}.cam"


def view_of_board(image: BoardImage, board: Board, camera: Camera) -> BoardView:
    """Find the corners of the board in an image.

    Raises `GroundTruthError` if the image cannot be read, its size differs from the calibration's,
    or no board is found.
    """
    grey = read_grey(image.image, GroundTruthError)
    if grey.shape != (camera.height, camera.width):
        raise GroundTruthError(
            f"{image.image}: is {grey.shape[1]}x{grey.shape[0]} px: expected "
            f"{camera.width}x{camera.height}, the calibration's size"
        )
    try:
        _, corners = find_board(grey, board, window=_WINDOW)
    except CalibrationError:
        raise GroundTruthError(
            f"{image.image}: no checkerboard of {board.columns} x {board.rows} inner corners found"
        ) from None
    return BoardView(image.camera, image.board, corners)


def _inside(path: Path, name: str) -> Path:
    """Path of a file named in the file `path`, inside its folder."""
    try:
        return path_inside(path.parent, name)
    except ValueError as error:
        raise GroundTruthError(f"{path}: {excerpt(name)} {error}: expected a file in it") from None


def _board(entry: JsonObject) -> Board:
    columns, rows = entry.whole("columns"), entry.whole("rows")
    try:
        board = Board("checkerboard", columns, rows, entry.number("square_m"))
    except CalibrationError as error:
        raise GroundTruthError(f"{entry.place}: {error}") from None
    if board.is_symmetric:
        raise GroundTruthError(
            f"{entry.place}: board of {columns} x {rows} inner corners looks the same turned by "
            "180 degrees: expected one even and one odd number"
        )
    return board


def _image(row: JsonObject, path: Path, boards: dict[str, Board]) -> BoardImage:
    camera, board = row.text("camera", "its name"), row.text("board")
    if board not in boards:
        raise row.wrong("board", f"one of {sorted(boards)}")
    image = _inside(path, row.text("image", "a file's name"))
    return BoardImage(camera, board, row.whole("placement"), image)
