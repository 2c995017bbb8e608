"""Boards as PDF: measured on the page, and found again by what looks for boards in pictures."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera.boards.board import Board
from camera.boards.points import find_board
from camera.cli import main

POINT_M = 0.0254 / 72.0
#: Of a page that is drawn to look for a board in it.
DOTS_PER_M = 4000.0


def page_of(content: bytes) -> tuple[tuple[float, float], list[NDArray[np.float64]]]:
    """Size of a PDF's page, and the outlines that are filled on it, metres from its lower left."""
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    assert box is not None
    size = float(box[1]) * POINT_M, float(box[2]) * POINT_M
    texts = [
        zlib.decompressobj().decompress(found[1]).decode("latin-1", "replace")
        for found in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL)
        if found[1][:1] == b"\x78"
    ]
    drawing = next(text for text in texts if re.search(r" m\n", text))
    outlines, path = [], []
    for line in drawing.split("\n"):
        *words, operator = line.split() or [""]
        if operator == "m":
            path = [[float(words[0]), float(words[1])]]
        elif operator == "l":
            path.append([float(words[0]), float(words[1])])
        elif operator == "c":
            path.append([float(words[4]), float(words[5])])
        elif operator in ("f", "b", "B") and path:
            outlines.append(np.array(path) * POINT_M)
            path = []
    return size, outlines


def drawn(content: bytes) -> NDArray[np.uint8]:
    """The page as a picture."""
    (width, height), outlines = page_of(content)
    size = round(height * DOTS_PER_M), round(width * DOTS_PER_M)
    picture = np.full(size, 255, np.uint8)
    for outline in outlines:
        dots = outline * DOTS_PER_M
        dots[:, 1] = size[0] - dots[:, 1]
        cv2.fillPoly(picture, [np.rint(dots * 16).astype(np.int32)], 0, shift=4)
    return picture


def test_squares_have_their_size(tmp_path: Path) -> None:
    output = tmp_path / "board.pdf"
    command = ["board", "--columns", "9", "--rows", "6", "--square-m", "0.025", "-o", str(output)]

    assert main(command) == 0

    size, outlines = page_of(output.read_bytes())
    assert size == pytest.approx((0.258, 0.207), abs=1e-5)
    squares = [o for o in outlines if np.ptp(o[:, 0]) == pytest.approx(0.025, abs=1e-5)]
    assert len(squares) == 35  # of 10 x 7, the black ones
    for square in squares:
        assert np.ptp(square, axis=0) == pytest.approx((0.025, 0.025), abs=1e-5)
    left, right = min(s[:, 0].min() for s in squares), max(s[:, 0].max() for s in squares)
    assert right - left == pytest.approx(0.25, abs=1e-5)
    (bar,) = (o for o in outlines if np.ptp(o[:, 1]) == pytest.approx(0.002, abs=1e-5))
    assert np.ptp(bar[:, 0]) == pytest.approx(0.1, abs=1e-5)
    # The same bytes again, and not unasked.
    first = output.read_bytes()
    assert main(command) == 1
    assert main([*command, "--force"]) == 0
    assert output.read_bytes() == first


@pytest.mark.parametrize(
    "board",
    [
        Board("checkerboard", 9, 6, 0.025),
        Board("charuco", 8, 6, 0.03, marker_m=0.022),
        Board("charuco", 7, 5, 0.03, marker_m=0.022, dictionary="DICT_4X4_50"),
        Board("circles", 7, 5, 0.03, circle_m=0.015),
        Board("asymmetric-circles", 4, 9, 0.02, circle_m=0.015),
    ],
    ids=str,
)
def test_printed_boards_are_found_where_they_are(board: Board, tmp_path: Path) -> None:
    output = tmp_path / "board.pdf"
    flags = [
        "--board", board.kind, "--columns", str(board.columns), "--rows", str(board.rows),
        "--square-m", str(board.square_m), "--marker-m", str(board.marker_m),
        "--dictionary", board.dictionary, "--circle-m", str(board.circle_m),
    ]  # fmt: skip

    assert main(["board", *flags, "-o", str(output)]) == 0

    picture = drawn(output.read_bytes())
    indices, pixels = find_board(picture, board)
    assert len(indices) == len(board.points)
    middle = 0.5 * np.array([picture.shape[1], picture.shape[0]]) - 0.5
    expected = middle + board.points[indices][:, :2] * [DOTS_PER_M, -DOTS_PER_M]
    np.testing.assert_allclose(pixels, expected, atol=0.7)


def test_discs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "discs.pdf"
    flags = ["--board", "discs", "--circle-m", "0.2", "-o", str(output)]

    assert main(["board", *flags]) == 0
    _, outlines = page_of(output.read_bytes())
    disc = max(outlines, key=lambda outline: float(np.ptp(outline[:, 1])))
    assert np.ptp(disc, axis=0) == pytest.approx((0.2, 0.2), abs=1e-4)
    assert main(["board", *flags, "--columns", "2", "--rows", "3", "--force"]) == 0
    size, _ = page_of(output.read_bytes())
    assert size == pytest.approx((0.428, 0.672), abs=1e-5)
    for wrong in ([], ["--circle-m", "1e9"], ["--circle-m", "0.2", "--columns", "100000"]):
        assert main(["board", "--board", "discs", *wrong, "-o", str(tmp_path / "no.pdf")]) == 1
        assert "--circle-m above 0, at most 10, and 1 to 1000 discs" in capsys.readouterr().err
