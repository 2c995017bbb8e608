"""Checkerboards with a unique orientation; `camera.boards` finds them in images.

A board's frame is that of `camera.boards.board`: origin at the middle of its inner corners, x
right, y up, z out of the print, held so that the square in its top left corner is black. With one
even and one odd number of corners only one way to hold it is like that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera.boards.board import Board
from camera.boards.points import find_board
from camera.errors import CalibrationError
from redetect.groundtruth.errors import GeometryError, GroundTruthError

FloatArray = NDArray[np.float64]

#: Half the side of the window in which a corner is refined, as a share of its squares: calibrated
#: cameras look from afar here, and blur and noise cause larger errors than the lens's distortion.
_WINDOW = 0.4


@dataclass(frozen=True)
class Checkerboard:
    """A board's inner corners.

    Attributes
    ----------
    columns, rows : int
        Numbers of inner corners; one even, one odd.
    square_m : float
        Side of a square.

    Raises
    ------
    GroundTruthError
        If the board is symmetric under rotation by 180 degrees, or is too small.
    """

    columns: int
    rows: int
    square_m: float

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
    """Find a board's inner corners (OpenCV).

    Parameters
    ----------
    image : (H, W) uint8 array
    board : Checkerboard

    Returns
    -------
    (rows * columns, 2) array
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
