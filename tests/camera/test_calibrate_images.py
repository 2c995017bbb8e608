"""Pictures for a calibration are the sensor's, whatever a telephone writes beside them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera
from camera.calibrate_images import read_grey
from detect.sources.gray import decode_gray
from groundtruth.errors import GroundTruthError
from groundtruth.markers.boards_file import BoardImage, find_boards
from groundtruth.markers.checkerboard import Checkerboard

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
ON_ITS_HEAD, PORTRAIT = 3, 6


def held(jpeg: bytes, orientation: int) -> bytes:
    """A JPEG with an Exif tag that says how the camera was held."""
    entry = struct.pack("<HHHIHHI", 1, 0x112, 3, 1, orientation, 0, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<I", 8) + entry
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


@pytest.mark.parametrize("orientation", [ON_ITS_HEAD, PORTRAIT])
def test_how_a_telephone_was_held_turns_no_picture(tmp_path: Path, orientation: int) -> None:
    picture = np.add.outer(np.arange(24) * 4, np.arange(32) * 5).astype(np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    path = tmp_path / "a.jpg"
    path.write_bytes(held(jpeg, orientation))
    upright = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    turned = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert upright is not None
    assert turned is not None
    assert not np.array_equal(turned, upright)  # what OpenCV does unless told
    np.testing.assert_array_equal(read_grey(path), upright)
    for bits in (12, 16):
        np.testing.assert_array_equal(decode_gray(path.read_bytes(), path, bits), upright)


def test_a_board_is_looked_for_in_the_sensors_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    jpeg = cv2.imencode(".jpg", np.full((24, 32), 90, np.uint8))[1].tobytes()
    path.write_bytes(held(jpeg, PORTRAIT))
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, (0.0,) * 5, IDENTITY)
    with pytest.raises(GroundTruthError) as refused:
        find_boards(BoardImage("a", "b", 0, path, None), Checkerboard(4, 5, 0.1), camera)
    # None is in it, but it has the calibration's size.
    assert "expected 32x24" not in str(refused.value)
