"""Checkerboards, and ``boards.json``: which is in which image of which camera.

::

    {"boards": {"first": {"columns": 7, "rows": 6, "square_m": 0.11}, "second": {...},
                "world": {...}},
     "world_from_board": {"translation_m": [...], "quaternion_xyzw": [...]},
     "first_from_second": {"translation_m": [...], "quaternion_xyzw": [...], "sigmas": [...]},
     "images": [{"camera": "a", "image": "a/images/0001.png", "placement": 0, "board": "first"}]}

``first`` and ``second`` are the double board; ``first_from_second`` may be absent, then it is
estimated, and may have ``sigmas`` or a ``covariance``. Images of one placement were taken without
moving the board. Instead of ``image`` there may be ``corners``, found by other means. A camera's
calibration is ``<camera>/<camera>.cam`` beside the file.

A board's frame is that of `camera.boards.board`: origin at the middle of its inner corners, x
right, y up, z out of the print, held so that the square in its top left corner is black. With one
even and one odd number of corners only one way to hold it is like that.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from camera.boards.board import Board
from camera.boards.points import find_board
from camera.calibration.images import grey_of_content
from camera.errors import CalibrationError
from redetect.array_types import FloatArray
from redetect.groundtruth.errors import GeometryError, GroundTruthError
from redetect.groundtruth.files import covariance_entry, is_number, numbers, read_json
from redetect.groundtruth.markers.calibration import parse_pose
from redetect.storage.bounded import claimed_size, path_inside, read_bounded
from redetect.storage.messages import excerpt, one_line

#: Half the side of the window in which a corner is refined, as a share of its squares: calibrated
#: cameras look from afar here, and blur and noise cause larger errors than the lens's distortion.
_WINDOW = 0.4


@dataclass(frozen=True)
class Checkerboard:
    """A board's inner corners.

    Raises
    ------
    GroundTruthError
        If the board is symmetric under rotation by 180 degrees, or is too small.
    """

    # `columns`, `rows`: Numbers of inner corners; one even, one odd.
    columns: int
    rows: int
    square_m: float  # Side of a square

    def __post_init__(self) -> None:
        try:
            board = self.board
        except CalibrationError as error:
            raise GroundTruthError(str(error)) from None
        if board.looks_turned:
            raise GroundTruthError(
                f"board of {self.columns} x {self.rows} inner corners looks the same turned by 180 "
                "degrees: expected one even and one odd number"
            )

    @property
    def board(self) -> Board:
        """The board as used in the package `camera`."""
        return Board("checkerboard", self.columns, self.rows, self.square_m)

    @property
    def points(self) -> FloatArray:
        """(rows * columns, 3) inner corners in the board's frame, row by row from top left (m)."""
        return self.board.points


def find_checkerboard(image: NDArray[np.uint8], board: Checkerboard) -> FloatArray:
    """A board's inner corners (rows * columns, 2) in an image (H, W) (OpenCV).

    Pixels (the top left pixel's centre is 0, 0) in the order of `Checkerboard.points`.

    Raises
    ------
    GeometryError
        If there is no such board in the image.
    """
    try:
        _, pixels = find_board(image, board.board, window=_WINDOW)
    except CalibrationError:
        raise GeometryError(
            f"no checkerboard of {board.columns} x {board.rows} inner corners in the image"
        ) from None
    return pixels


BOARDS_NAME = "boards.json"
_LARGEST_IMAGE_BYTES = 1 << 28
FIRST, SECOND, WORLD = "first", "second", "world"


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in an image."""

    camera: str
    board: str
    corners: FloatArray  # (K, 2): pixels, in the order of `Checkerboard.points`


@dataclass(frozen=True, eq=False)
class DoubleBoard:
    """Two boards held together."""

    first: str
    second: str
    offset: FloatArray | None  # (4, 4): `first_from_second`; None if it is to be estimated.
    covariance: FloatArray  # (6, 6): of its right perturbation; zeros if it is exactly known.


@dataclass(frozen=True, eq=False)
class BoardImage:
    """A board in an image that has not been read yet."""

    camera: str
    board: str
    placement: int
    image: Path | None
    corners: FloatArray | None


@dataclass(frozen=True, eq=False)
class BoardsFile:
    """Content of a ``boards.json``."""

    boards: dict[str, Checkerboard]
    world_from_board: FloatArray  # (4, 4)
    double: DoubleBoard | None
    cameras: dict[str, Camera]
    calibrations: dict[str, str]  # Their files, relative to the folder
    images: tuple[BoardImage, ...]


def read_boards(path: Path) -> BoardsFile:
    """Read a ``boards.json`` and the calibrations of its cameras.

    Parameters
    ----------
    path : path
        The file, or its folder.

    Raises
    ------
    GroundTruthError, camera.CameraError
        If a file cannot be read or an entry is missing or impossible.
    """
    path = path / BOARDS_NAME if path.is_dir() else path
    content = read_json(path)
    boards = {
        name: _board(f"{path}: board {one_line(name, 60)}", entry)
        for name, entry in _objects(f"{path}: boards", content.get("boards")).items()
    }
    unknown = sorted(set(boards) - {FIRST, SECOND, WORLD})
    if unknown or WORLD not in boards or (FIRST in boards) != (SECOND in boards):
        raise GroundTruthError(
            f"{path}: boards are {excerpt(sorted(boards))}: expected world, and first "
            "and second or neither"
        )
    world = parse_pose(f"{path}: world_from_board", content.get("world_from_board"))
    double = None
    if FIRST in boards:
        entry = content.get("first_from_second")
        place = f"{path}: first_from_second"
        double = DoubleBoard(
            FIRST,
            SECOND,
            None if entry is None else parse_pose(place, entry),
            np.zeros((6, 6)) if entry is None else covariance_entry(place, entry, 6),
        )
    rows = content.get("images")
    if not isinstance(rows, list) or not rows:
        raise GroundTruthError(f"{path}: images: expected a list of at least one")
    images = tuple(
        _image(f"{path}: image {i + 1}", row, path.parent, boards) for i, row in enumerate(rows)
    )
    names = sorted({image.camera for image in images})
    calibrations = {name: f"{name}/{name}.cam" for name in names}
    return BoardsFile(
        boards,
        world,
        double,
        {name: read_camera(_inside(str(path), path.parent, calibrations[name])) for name in names},
        calibrations,
        images,
    )


def find_boards(image: BoardImage, board: Checkerboard, camera: Camera) -> BoardView:
    """The corners of the board in an image.

    Raises
    ------
    GroundTruthError
        If the image cannot be read, has another size than the calibration, or shows no board.
    """
    if image.corners is not None:
        return BoardView(image.camera, image.board, image.corners)
    assert image.image is not None
    try:
        content = read_bounded(image.image, _LARGEST_IMAGE_BYTES)
    except OSError as error:
        raise GroundTruthError(f"{image.image}: cannot be read: {error.strerror}") from None
    size = claimed_size(content)
    if size is None:
        raise GroundTruthError(f"{image.image}: cannot be decoded: expected an image")
    # Larger claims are not decoded: memory is allocated for the expected size only.
    _demand_size(image.image, size, camera)
    try:
        grey = grey_of_content(content, image.image)
    except CalibrationError as error:
        raise GroundTruthError(str(error)) from None
    _demand_size(image.image, (grey.shape[1], grey.shape[0]), camera)
    try:
        corners = find_checkerboard(grey, board)
    except GeometryError as error:
        raise GroundTruthError(f"{image.image}: {error}") from None
    return BoardView(image.camera, image.board, corners)


def _demand_size(path: Path, size: tuple[int, int], camera: Camera) -> None:
    if size != (camera.width, camera.height):
        raise GroundTruthError(
            f"{path}: is {size[0]}x{size[1]} px: expected {camera.width}x{camera.height}, the "
            "calibration's size"
        )


def _inside(place: str, folder: Path, name: str) -> Path:
    try:
        return path_inside(folder, name)
    except ValueError as error:
        raise GroundTruthError(f"{place}: {excerpt(name)} {error}: expected a file in it") from None


def _objects(place: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        raise GroundTruthError(f"{place}: expected an object with at least one entry")
    return value


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _board(place: str, entry: Any) -> Checkerboard:
    columns, rows, square = (
        entry.get(key) if isinstance(entry, dict) else None
        for key in ("columns", "rows", "square_m")
    )
    if not (_is_whole(columns) and _is_whole(rows) and is_number(square)):
        raise GroundTruthError(f"{place}: expected whole columns and rows, and square_m")
    try:
        return Checkerboard(columns, rows, float(square))
    except GroundTruthError as error:
        raise GroundTruthError(f"{place}: {error}") from None


def _image(place: str, row: Any, folder: Path, boards: dict[str, Checkerboard]) -> BoardImage:
    entry = row if isinstance(row, dict) else {}
    camera, board, placement = entry.get("camera"), entry.get("board"), entry.get("placement")
    if not isinstance(camera, str) or not camera:
        raise GroundTruthError(f"{place}: camera is {excerpt(camera)}: expected its name")
    if not isinstance(board, str) or board not in boards:
        raise GroundTruthError(
            f"{place}: board is {excerpt(board)}: expected one of {sorted(boards)}"
        )
    if not _is_whole(placement):
        raise GroundTruthError(
            f"{place}: placement is {excerpt(placement)}: expected a whole number"
        )
    image, corners = entry.get("image"), entry.get("corners")
    if (image is None) == (corners is None):
        raise GroundTruthError(f"{place}: expected either image or corners")
    if image is not None:
        if not isinstance(image, str):
            raise GroundTruthError(f"{place}: image is {excerpt(image)}: expected a file's name")
        path = _inside(place, folder, image)
        return BoardImage(camera, board, placement, path, None)
    count = boards[board].rows * boards[board].columns
    array = numbers(f"{place}: corners", corners, count, 2)
    return BoardImage(camera, board, placement, None, array)
