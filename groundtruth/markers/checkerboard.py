"""Checkerboards in images: their inner corners, in an order that a turned board cannot change.

A board's frame is like a marker's: origin at the middle of its inner corners, x right, y up, z out
of the print, held so that the square in its top left corner is black. With one even and one odd
number of corners only one way to hold it is like that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundtruth.errors import GeometryError, GroundTruthError

FloatArray = NDArray[np.float64]

# Half the side of the window round a corner, as a share of the least distance between corners.
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
        If the board looks the same turned by 180 degrees, or is too small.
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise GroundTruthError(
                f"board of {self.columns} x {self.rows} inner corners: expected at least 3 x 3"
            )
        if (self.columns + self.rows) % 2 == 0:
            raise GroundTruthError(
                f"board of {self.columns} x {self.rows} inner corners looks the same turned by 180 "
                "degrees: expected one even and one odd number"
            )
        if not (np.isfinite(self.square_m) and self.square_m > 0.0):
            raise GroundTruthError(f"square_m is {self.square_m:g}: expected metres above 0")

    @property
    def points(self) -> FloatArray:
        """(rows * columns, 3) inner corners in the board's frame, row by row from top left (m)."""
        down, right = np.mgrid[: self.rows, : self.columns].astype(np.float64)
        right -= 0.5 * (self.columns - 1)
        up = 0.5 * (self.rows - 1) - down
        flat = np.stack([right, up, np.zeros_like(right)], axis=-1).reshape(-1, 3)
        return np.asarray(self.square_m * flat)


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
    import cv2

    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCorners(image, size)
    if not found:
        # Finds what the other does not, but is much slower.
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        raise GeometryError(
            f"no checkerboard of {board.columns} x {board.rows} inner corners in the image"
        )
    grid = np.asarray(corners, dtype=np.float32).reshape(board.rows, board.columns, 2)
    # The saddle point itself, whichever found it: from as much round it as holds no other corner.
    spacing = min(float(np.linalg.norm(np.diff(grid, axis=k), axis=-1).min()) for k in (0, 1))
    half = int(np.clip(round(_WINDOW * spacing), 2, 15))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-3)
    corners = cv2.cornerSubPix(image, grid.reshape(-1, 1, 2), (half, half), (-1, -1), stop)
    refined = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    return ordered_corners(image, refined).reshape(-1, 2)


def ordered_corners(image: NDArray[np.uint8], grid: FloatArray) -> FloatArray:
    """Bring a (rows, columns, 2) grid of corners into the board's own order.

    The board is seen from its printed side, so right x down points into the image; and the square
    right below the first corner is black, as the one beyond it is.
    """
    right = grid[:, -1] - grid[:, 0]
    down = grid[-1] - grid[0]
    if np.sum(right[:, 0]) * np.sum(down[:, 1]) < np.sum(right[:, 1]) * np.sum(down[:, 0]):
        grid = grid[:, ::-1]
    centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    columns = np.clip(np.rint(centres[..., 0]).astype(int), 0, image.shape[1] - 1)
    rows = np.clip(np.rint(centres[..., 1]).astype(int), 0, image.shape[0] - 1)
    grey = image[rows, columns].astype(np.float64)
    even = np.add.outer(np.arange(grey.shape[0]), np.arange(grey.shape[1])) % 2 == 0
    if grey[even].mean() > grey[~even].mean():
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid)
