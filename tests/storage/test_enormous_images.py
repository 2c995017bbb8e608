"""Images that are not of a run are refused by their headers, too, before memory is taken."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera, CameraError
from camera.boards.board import Board
from detect.errors import FrameError
from detect.sources.grey_images import decode_grey
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.boards import BoardImage, view_of_board
from redetect.storage.images import MOST_PIXELS, claimed_size, read_grey
from tests.detect.runs.claimed_images import SIDE, jpeg, png


@pytest.mark.parametrize("make", [jpeg, png])
def test_pictures_for_calibrations_and_of_boards(
    tmp_path: Path, make: Callable[[int, int], bytes], published_camera: Camera
) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(make(SIDE, SIDE))
    said = re.escape(
        f"{path}: cannot be decoded: claims {SIDE}x{SIDE} px: expected at most {MOST_PIXELS} pixels"
    )
    with pytest.raises(CameraError, match=said):
        read_grey(path, CameraError)
    board = Board("checkerboard", 5, 4, 0.1)
    with pytest.raises(GroundTruthError, match=said):
        view_of_board(BoardImage("a", "b", 0, path), board, published_camera)


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("chunk", [b"IHDR", b"IDAT", b"IEND"])
def test_chunks_of_a_png_that_claim_gigabytes(tmp_path: Path, chunk: bytes, deep: bool) -> None:
    """OpenCV would take the memory first; found by fuzzing."""
    bytes_grey = np.arange(64, dtype=np.uint8).reshape(8, 8)
    grey = bytes_grey.astype(np.uint16) if deep else bytes_grey
    content = bytearray(cv2.imencode(".png", grey)[1].tobytes())
    assert claimed_size(bytes(content)) == (8, 8)
    place = content.index(chunk) - 4
    content[place] |= 0x7F
    assert claimed_size(bytes(content)) is None
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(CameraError, match="cannot be decoded: expected an image"):
        read_grey(path, CameraError)
    with pytest.raises(FrameError, match="cannot be decoded: expected an image"):
        decode_grey(bytes(content), path, (8, 8))


def test_pictures_of_other_kinds_of_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.tiff"
    assert cv2.imwrite(str(path), np.full((8, 8), 0.5, np.float32))
    with pytest.raises(CameraError, match="holds float32: expected images of 8 or 16 bits"):
        read_grey(path, CameraError)
    path.write_bytes(b"")
    with pytest.raises(CameraError, match="cannot be decoded: expected an image"):
        read_grey(path, CameraError)
    with pytest.raises(CameraError, match="Is a directory"):
        read_grey(tmp_path, CameraError)
