"""``camera board``: calibration boards, and discs, as PDF pages at true scale.

A sheet is a list of black shapes in metres, its origin in the middle, x right, y up: the frame of
`camera.boards.board`.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from camera import options
from camera.boards.board import Board, board_of
from camera.boards.charuco import dictionary_of
from camera.errors import CalibrationError
from redetect.storage import demand_place, write_bytes

#: Sheets of paper, metres, the smallest first.
PAGES = {
    "A4": (0.210, 0.297),
    "A3": (0.297, 0.420),
    "A2": (0.420, 0.594),
    "A1": (0.594, 0.841),
    "A0": (0.841, 1.189),
}
#: Left blank by printers, and for the line of text at the bottom (m).
_MARGIN_M, _TEXT_M = 0.004, 0.012
_RULER_M = 0.1
_M_PER_INCH = 0.0254


def perform(command: options.Board) -> int:
    """Carry the command out; returns the exit code."""
    demand_place(command.output, overwrite=command.force)
    if command.board == "discs":
        sheet = sheet_of_discs(command.circle_m, command.columns, command.rows)
    else:
        sheet = sheet_of_board(board_of(command))
    width, height = page_for(sheet, command.page)
    write_bytes(command.output, pdf_of(sheet, (width, height)), overwrite=command.force)
    name = next(name for name, sides in PAGES.items() if set(sides) == {width, height})
    print(f"written: {command.output}: {sheet.text}, on {name}; print at 100 %, measure the bar")
    return 0


class Disc(NamedTuple):
    """A black disc: middle and radius, metres."""

    x: float
    y: float
    radius: float


class Box(NamedTuple):
    """A rectangle: lower left corner, width and height, metres."""

    x: float
    y: float
    width: float
    height: float


class Sheet(NamedTuple):
    """What is printed black, and the width and height that it takes up, metres."""

    shapes: Sequence[Disc | Box]
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
        radius = 0.5 * board.circle_m
        dots: list[Disc | Box] = [Disc(float(x), float(y), radius) for x, y, _ in board.points]
        width, height = (high - low)[:2] + board.circle_m
        text = f"{board}: distance {millimetres:g} mm, diameter {1e3 * board.circle_m:g} mm"
        return Sheet(dots, float(width), float(height), text)
    side = board.square_m
    columns, rows = board.columns, board.rows
    if board.kind == "checkerboard":
        columns, rows = columns + 1, rows + 1
    left, top = -0.5 * columns * side, 0.5 * rows * side
    black: list[Disc | Box] = [
        Box(left + column * side, top - (row + 1) * side, side, side)
        for row in range(rows)
        for column in range(columns)
        if (row + column) % 2 == 0
    ]
    text = f"{board}: squares {millimetres:g} mm"
    if board.kind == "charuco":
        black = _charuco(board, left, top)
        text += f", markers {1e3 * board.marker_m:g} mm, {board.dictionary}"
    return Sheet(black, columns * side, rows * side, text)


def _charuco(board: Board, left: float, top: float) -> list[Disc | Box]:
    """Markers, and the squares in which OpenCV puts none."""
    dictionary = dictionary_of(board)
    pattern = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_m, board.marker_m, dictionary
    )
    side, cells = board.square_m, dictionary.markerSize + 2
    cell = board.marker_m / cells
    shapes: list[Disc | Box] = []
    white = set()
    for number, corners in zip(np.ravel(pattern.getIds()), pattern.getObjPoints()):
        # OpenCV's board has its origin at the top left, y down.
        x, y = (float(value) for value in corners[0][:2])
        white.add((int(y // side), int(x // side)))
        bits = cv2.aruco.generateImageMarker(dictionary, int(number), cells)
        shapes += [
            Box(left + x + column * cell, top - y - (row + 1) * cell, cell, cell)
            for row, column in np.argwhere(bits < 128).tolist()
        ]
    squares: list[Disc | Box] = [
        Box(left + column * side, top - (row + 1) * side, side, side)
        for row in range(board.rows)
        for column in range(board.columns)
        if (row, column) not in white
    ]
    return squares + shapes


def sheet_of_discs(diameter_m: float, columns: int, rows: int) -> Sheet:
    """Discs side by side, a tenth of their diameter apart, to be cut out."""
    if not (np.isfinite(diameter_m) and diameter_m > 0.0) or min(columns, rows) < 1:
        raise CalibrationError(
            f"{columns} x {rows} discs of {diameter_m:g} m: expected a --circle-m above 0 and at "
            "least one disc"
        )
    apart = 1.1 * diameter_m
    width, height = apart * (columns - 1) + diameter_m, apart * (rows - 1) + diameter_m
    radius = 0.5 * diameter_m
    discs = [
        Disc(column * apart - 0.5 * width + radius, row * apart - 0.5 * height + radius, radius)
        for row in range(rows)
        for column in range(columns)
    ]
    return Sheet(discs, width, height, f"discs of radius {radius:g} m")


def page_for(sheet: Sheet, page: str) -> tuple[float, float]:
    """Width and height of a page (m) that a sheet fits on, upright or not; `auto`: the smallest."""
    names = list(PAGES) if page == "auto" else [page]
    for name in names:
        short, long = PAGES[name]
        for width, height in ((short, long), (long, short)):
            if (
                sheet.width <= width - 2.0 * _MARGIN_M
                and sheet.height <= height - 2.0 * _MARGIN_M - 2.0 * _TEXT_M
            ):
                return width, height
    raise CalibrationError(
        f"{1e3 * sheet.width:g} x {1e3 * sheet.height:g} mm do not fit on {names[-1]} "
        f"({' x '.join(f'{1e3 * side:g}' for side in PAGES[names[-1]])} mm) with a line of text: "
        "take fewer or smaller squares, or a larger --page"
    )


def pdf_of(sheet: Sheet, page_m: tuple[float, float]) -> bytes:
    """A PDF of one page at true scale, with a line of text and a ruler to check it by."""
    width, height = page_m
    figure = Figure(figsize=(width / _M_PER_INCH, height / _M_PER_INCH))
    figure.patch.set_visible(False)
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(-0.5 * width, 0.5 * width)
    axes.set_ylim(-0.5 * height, 0.5 * height)
    ink: Any = {"facecolor": "black", "edgecolor": "none", "linewidth": 0.0}
    for shape in sheet.shapes:
        if isinstance(shape, Disc):
            axes.add_patch(Circle((shape.x, shape.y), shape.radius, **ink))
        else:
            axes.add_patch(Rectangle((shape.x, shape.y), shape.width, shape.height, **ink))
    bottom = -0.5 * height + _MARGIN_M
    left = -0.5 * width + _MARGIN_M
    axes.add_patch(Rectangle((left, bottom), _RULER_M, 0.002, **ink))
    axes.text(
        left,
        bottom + 0.004,
        f"{sheet.text}; the bar is {1e3 * _RULER_M:g} mm long: measure it, and print at 100 %",
        fontsize=7,
    )
    stream = io.BytesIO()
    # Without a date, the same board gives the same bytes.
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Producer": None})
    return stream.getvalue()
