"""Calibration boards and their dimensions in metres.

A board's frame: origin in the middle of its points, x right, y up, z out of the print, held so that

- the square in a checkerboard's top left corner is black;
- a ChArUco board's first marker is at the top left, as OpenCV prints it;
- the first of a circle grid's points is at the top left.

A board's points go row by row from the top left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera.errors import CalibrationError
from camera.options import BoardFlags, BoardKind

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Board:
    """A printed board.

    Attributes
    ----------
    kind : str
        `checkerboard`, `charuco`, `circles` or `asymmetric-circles`.
    columns, rows : int
        Checkerboard: inner corners. ChArUco: squares. Circles: circles in a row, and rows; of
        asymmetric circles every other row is moved by `square_m`.
    square_m : float
        Side of a square, or distance of neighbouring circles in a symmetric grid; of an asymmetric
        one half the distance of neighbours in a row, which is that of rows. Metres.
    marker_m : float
        Side of a ChArUco board's markers, metres.
    dictionary : str
        The markers' dictionary, as OpenCV names it.
    circle_m : float
        Diameter of the circles, metres; 0 if unknown. With it, the shift of a circle's image
        against the image of its centre is taken into account.

    Raises
    ------
    CalibrationError
        If there can be no such board.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = "DICT_5X5_100"
    circle_m: float = 0.0

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"a {self.kind} board of {self.columns} x {self.rows}: expected at least 3 x 3 "
                f"({_WHAT_IS_COUNTED[self.kind]} are counted)"
            )
        if not (np.isfinite(self.square_m) and self.square_m > 0.0):
            raise CalibrationError(f"square_m is {self.square_m:g}: expected metres above 0")
        if self.kind == "charuco" and not 0.0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"marker_m is {self.marker_m:g}: a ChArUco board needs the side of its markers, "
                f"between 0 and square_m ({self.square_m:g})"
            )
        if self.circle_m and self.kind not in _NEIGHBOURS_SQUARES:
            raise CalibrationError(
                f"circle_m is {self.circle_m:g}: a {self.kind} board has no circles; expected none"
            )
        distance_m = self.square_m * _NEIGHBOURS_SQUARES.get(self.kind, 1.0)
        if not 0.0 <= self.circle_m < distance_m:
            raise CalibrationError(
                f"circle_m is {self.circle_m:g}: expected a diameter below the circles' distance, "
                f"{distance_m:g}"
            )

    @property
    def points(self) -> FloatArray:
        """(N, 3) points in the board's frame, metres."""
        columns, rows = self.columns, self.rows
        if self.kind == "charuco":
            columns, rows = columns - 1, rows - 1
        down, right = np.mgrid[:rows, :columns].astype(np.float64)
        if self.kind == "asymmetric-circles":
            right = 2.0 * right + down % 2.0
        flat = np.stack([right, -down, np.zeros_like(right)], axis=-1).reshape(-1, 3)
        middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
        return np.asarray(self.square_m * (flat - middle))

    @property
    def looks_turned(self) -> bool:
        """Whether the board is symmetric under rotation by 180 deg: its direction is ambiguous."""
        if self.kind == "checkerboard":
            return (self.columns + self.rows) % 2 == 0
        if self.kind == "asymmetric-circles":
            return self.rows % 2 == 0
        return self.kind == "circles"

    def __str__(self) -> str:
        counted = _WHAT_IS_COUNTED[self.kind]
        return f"{self.kind} board of {self.columns} x {self.rows} {counted}"


# How far apart neighbouring circles are, in `square_m`; those of an asymmetric grid across.
_NEIGHBOURS_SQUARES: dict[str, float] = {"circles": 1.0, "asymmetric-circles": 2.0**0.5}

_WHAT_IS_COUNTED: dict[str, str] = {
    "checkerboard": "inner corners",
    "charuco": "squares",
    "circles": "circles",
    "asymmetric-circles": "circles",
}


def board_of(flags: BoardFlags) -> Board:
    """The board that flags describe; not `discs`, which are none."""
    return Board(
        flags.board, flags.columns, flags.rows, flags.square_m, flags.marker_m, flags.dictionary,
        flags.circle_m,
    )  # fmt: skip
