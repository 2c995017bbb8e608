"""Calibration boards, their dimensions in metres, and PDF pages at true scale.

A board's frame: origin in the middle of its points, x right, y up, z out of the print, held so that
a checkerboard's top left square is black, or a ChArUco board's first marker (as OpenCV prints it)
or a circle grid's first point is at the top left. Points are in rows from there; the print is a
list of black shapes in metres, in the same frame.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle

from camera.errors import CalibrationError
from camera.options import BoardFlags, BoardKind
from redetect.array_types import FloatArray
from redetect.messages import excerpt

# Larger values are assumed to be millimetres.
_LARGEST_SQUARE_M = 10.0
# OpenCV fails, or takes hours, with many more.
_MOST_COUNTED = 1000
# Spacing of neighbouring circles, in `square_m`; in an asymmetric grid, that across.
_NEIGHBOURS_SQUARES: dict[str, float] = {"circles": 1.0, "asymmetric-circles": 2.0**0.5}
_COUNTED = {"checkerboard": "inner corners", "charuco": "squares"}  # else circles
_MARGIN_M = 0.004  # Left blank by printers.
_TEXT_M = 0.012  # Left for the line of text at the bottom.
_RULER_M = 0.1  # Length of the printed ruler.
_LEAST_WIDTH_M = 0.2  # Of a page.
_M_PER_INCH = 0.0254
_INK: Any = {"facecolor": "black", "edgecolor": "none", "linewidth": 0.0}


@dataclass(frozen=True)
class Board:
    """A printed board, as its flags describe it (`camera.options.BoardFlags`).

    Raises CalibrationError if such a board is impossible.
    """

    kind: BoardKind
    columns: int
    rows: int
    #: Side of a square, or spacing of circles in a symmetric grid; for an asymmetric one half the
    #: spacing in a row, which is the distance between rows. Metres.
    square_m: float
    marker_m: float = 0.0
    dictionary: str = "DICT_5X5_100"
    #: Diameter of the circles, metres; 0 if unknown. With it, the shift of a circle's image against
    #: the image of its centre is corrected.
    circle_m: float = 0.0

    def __post_init__(self) -> None:
        counts, counted = (self.columns, self.rows), _COUNTED.get(self.kind, "circles")
        if min(counts) < 3 or max(counts) > _MOST_COUNTED:
            expected = "at least 3 x 3" if min(counts) < 3 else f"at most {_MOST_COUNTED} each way"
            raise CalibrationError(
                f"a {self.kind} board of {excerpt(self.columns)} x {excerpt(self.rows)}: expected "
                f"{expected} ({counted} are counted)"
            )
        if not 0.0 < self.square_m <= _LARGEST_SQUARE_M:
            raise CalibrationError(
                f"square_m is {self.square_m:g}: expected metres above 0, at most "
                f"{_LARGEST_SQUARE_M:g} (25 mm are 0.025)"
            )
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
    def is_symmetric(self) -> bool:
        """Whether the board is symmetric under rotation by 180 deg: its direction is ambiguous."""
        if self.kind == "checkerboard":
            return (self.columns + self.rows) % 2 == 0
        if self.kind == "asymmetric-circles":
            return self.rows % 2 == 0
        return self.kind == "circles"

    def __str__(self) -> str:
        counted = _COUNTED.get(self.kind, "circles")
        return f"{self.kind} board of {self.columns} x {self.rows} {counted}"


def board_of(flags: BoardFlags) -> Board:
    """The board that flags describe, except `discs`."""
    return Board(
        flags.board, flags.columns, flags.rows, flags.square_m, flags.marker_m, flags.dictionary,
        flags.circle_m,
    )  # fmt: skip


def charuco_of(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's object for a ChArUco board."""
    name = board.dictionary.lower()
    known = {each.lower(): each for each in dir(cv2.aruco) if each.startswith("DICT_")}
    number = getattr(cv2.aruco, known.get(f"dict_{name.removeprefix('dict_')}", ""), None)
    if number is None:
        raise CalibrationError(
            f"dictionary {board.dictionary!r} is unknown: expected a name of OpenCV's, such as "
            "DICT_5X5_100"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    markers, most = board.columns * board.rows // 2, len(dictionary.bytesList)
    if markers > most:
        raise CalibrationError(
            f"dictionary {board.dictionary} has {most} markers, and a {board} {markers}: expected "
            "the dictionary that the board was printed with"
        )
    size = board.columns, board.rows
    return cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)


class Sheet(NamedTuple):
    """The black shapes of a print, and its width and height, metres."""

    shapes: Sequence[Patch]
    width: float
    height: float
    text: str


def sheet_of_board(board: Board) -> Sheet:
    """The print of a board."""
    low, high = board.points.min(axis=0), board.points.max(axis=0)
    millimetres = 1e3 * board.square_m
    if "circles" in board.kind:
        if board.circle_m == 0.0:
            raise CalibrationError("circle_m is 0: circles are printed with a diameter")
        dots = [Circle((x, y), 0.5 * board.circle_m, **_INK) for x, y, _ in board.points.tolist()]
        width, height = (high - low)[:2] + board.circle_m
        text = f"{board}: distance {millimetres:g} mm, diameter {1e3 * board.circle_m:g} mm"
        return Sheet(dots, float(width), float(height), text)
    side, columns, rows = board.square_m, board.columns, board.rows
    if board.kind == "checkerboard":
        columns, rows = columns + 1, rows + 1
    left, top = -0.5 * columns * side, 0.5 * rows * side
    squares = {
        (row, column): Rectangle((left + column * side, top - (row + 1) * side), side, side, **_INK)
        for row in range(rows)
        for column in range(columns)
    }
    text = f"{board}: squares {millimetres:g} mm"
    if board.kind == "charuco":
        markers, white = _markers(board, left, top)
        black = [square for place, square in squares.items() if place not in white] + markers
        text += f", markers {1e3 * board.marker_m:g} mm, {board.dictionary}"
    else:
        black = [square for place, square in squares.items() if sum(place) % 2 == 0]
    return Sheet(black, columns * side, rows * side, text)


def _markers(board: Board, left: float, top: float) -> tuple[list[Rectangle], set[tuple[int, int]]]:
    """A ChArUco board's markers, and the rows and columns of the squares that they are in."""
    pattern = charuco_of(board)
    dictionary = pattern.getDictionary()
    side, cells = board.square_m, dictionary.markerSize + 2
    cell = board.marker_m / cells
    shapes = []
    white = set()
    for number, corners in zip(np.ravel(pattern.getIds()), pattern.getObjPoints()):
        # OpenCV's board has its origin at the top left, y down.
        x, y = (float(value) for value in corners[0][:2])
        white.add((int(y // side), int(x // side)))
        bits = cv2.aruco.generateImageMarker(dictionary, int(number), cells)
        shapes += [
            Rectangle((left + x + column * cell, top - y - (row + 1) * cell), cell, cell, **_INK)
            for row, column in np.argwhere(bits < 128).tolist()
        ]
    return shapes, white


def sheet_of_discs(diameter_m: float, columns: int, rows: int) -> Sheet:
    """Discs side by side, a tenth of their diameter apart, to be cut out."""
    possible = 0.0 < diameter_m <= _LARGEST_SQUARE_M
    if not possible or min(columns, rows) < 1 or max(columns, rows) > _MOST_COUNTED:
        raise CalibrationError(
            f"{excerpt(columns)} x {excerpt(rows)} discs of {diameter_m:g} m: expected a "
            f"--circle-m above 0, at most {_LARGEST_SQUARE_M:g}, and 1 to {_MOST_COUNTED} discs "
            "each way"
        )
    apart = 1.1 * diameter_m
    width, height = apart * (columns - 1) + diameter_m, apart * (rows - 1) + diameter_m
    radius = 0.5 * diameter_m
    left, bottom = radius - 0.5 * width, radius - 0.5 * height
    discs = [
        Circle((column * apart + left, row * apart + bottom), radius, **_INK)
        for row in range(rows)
        for column in range(columns)
    ]
    return Sheet(discs, width, height, f"discs of radius {radius:g} m")


def pdf_of(sheet: Sheet) -> bytes:
    """A PDF of one page at true scale, with a line of text and a ruler to check it by."""
    width = max(sheet.width, _LEAST_WIDTH_M) + 2.0 * _MARGIN_M
    height = sheet.height + 2.0 * (_MARGIN_M + _TEXT_M)
    figure = Figure(figsize=(width / _M_PER_INCH, height / _M_PER_INCH))
    figure.patch.set_visible(False)
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(-0.5 * width, 0.5 * width), ylim=(-0.5 * height, 0.5 * height))
    for shape in sheet.shapes:
        axes.add_patch(shape)
    bottom = -0.5 * height + _MARGIN_M
    left = -0.5 * width + _MARGIN_M
    axes.add_patch(Rectangle((left, bottom), _RULER_M, 0.002, **_INK))
    text = f"{sheet.text}; the bar is {1e3 * _RULER_M:g} mm long: measure it, and print at 100 %"
    axes.text(left, bottom + 0.004, text, fontsize=7)
    stream = io.BytesIO()
    # Without a date, the same board gives the same bytes.
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Producer": None})
    return stream.getvalue()
