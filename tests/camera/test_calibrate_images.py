"""Pictures for a calibration are the sensor's, whatever a telephone writes beside them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera, CameraError
from camera.boards.board import Board
from camera.commands.calibrate import calibration_images
from detect.sources.grey_images import decode_grey
from detect.sources.video import VideoFile
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.markers.boards import BoardImage, view_of_board
from redetect.storage.images import read_grey, without_orientation

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
    np.testing.assert_array_equal(read_grey(path, CameraError), upright)
    np.testing.assert_array_equal(decode_grey(path.read_bytes(), path), upright)


def held_tiff(picture: NDArray[Any], orientation: int, order: str, kind: int = 3) -> bytes:
    """A TIFF with a tag that says how the camera was held."""
    height, width = picture.shape
    pixels = (picture if order == "<" else picture.byteswap()).tobytes()  # of this machine: "<"
    tags = {
        256: width, 257: height, 258: 8 * picture.itemsize, 259: 1, 262: 1, 273: 8,
        274: orientation, 277: 1, 278: height, 279: len(pixels),
    }  # fmt: skip
    entries = b"".join(
        struct.pack(order + ("HHIHxx" if size == 3 else "HHII"), tag, size, 1, value)
        for tag, value in tags.items()
        for size in [kind if tag == 274 else 4 if tag in (273, 279) else 3]
    )
    mark = b"II" if order == "<" else b"MM"
    head = mark + struct.pack(order + "HI", 42, 8 + len(pixels))
    return head + pixels + struct.pack(order + "H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("deep", [False, True])
def test_nor_does_what_a_tiff_says_of_it(
    tmp_path: Path, orientation: int, order: str, deep: bool
) -> None:
    grey = np.add.outer(np.arange(24) * 4, np.arange(32) * 5).astype(np.uint8)
    picture = grey.astype(np.uint16) * 256 if deep else grey
    path = tmp_path / "a.tif"
    path.write_bytes(held_tiff(picture, orientation, order))
    np.testing.assert_array_equal(decode_grey(path.read_bytes(), path, (32, 24)), picture)
    if not deep:  # those are stretched to the full range
        np.testing.assert_array_equal(read_grey(path, CameraError), grey)


def test_damaged_words_of_a_tiff_stay() -> None:
    content = held_tiff(np.zeros((24, 32), np.uint8), 3, "<", kind=7)
    assert without_orientation(content) == content  # no number
    ends = [without_orientation(content[:length]) for length in range(len(content))]
    assert ends == [content[:length] for length in range(len(content))]


def test_a_board_is_looked_for_in_the_sensors_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    jpeg = cv2.imencode(".jpg", np.full((24, 32), 90, np.uint8))[1].tobytes()
    path.write_bytes(held(jpeg, PORTRAIT))
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, (0.0,) * 5, IDENTITY)
    with pytest.raises(GroundTruthError) as refused:
        view_of_board(BoardImage("a", "b", 0, path), Board("checkerboard", 4, 5, 0.1), camera)
    # None is in it, but it has the calibration's size.
    assert "expected 32x24" not in str(refused.value)


def filmed(path: Path, pictures: list[NDArray[np.uint8]]) -> None:
    """A video that asks to be shown turned by 90 degrees, as of a telephone held upright."""
    height, width = pictures[0].shape
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), codec, 10.0, (width, height), isColor=True)
    assert writer.isOpened()
    for picture in pictures:
        writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()
    content = bytearray(path.read_bytes())
    # The track's header, version 0: the matrix is 40 bytes behind its flags (ISO/IEC 14496-12).
    place = content.index(b"tkhd") + 4 + 40
    one = 1 << 16
    assert struct.unpack_from(">9i", content, place) == (one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", content, place, 0, one, 0, -one, 0, 0, height * one, 0, 1 << 30)
    path.write_bytes(content)


def test_how_a_telephone_was_held_turns_no_video(tmp_path: Path) -> None:
    picture = np.zeros((48, 64), np.uint8)
    picture[:16, :16] = 250
    path = tmp_path / "a.mp4"
    filmed(path, [picture, picture])
    reader = cv2.VideoCapture(str(path))
    turned = reader.read()[1]
    reader.release()
    assert turned.shape[:2] == (64, 48)  # what OpenCV does unless told
    frames = [image for _, image in calibration_images([path], 9)]
    assert len(frames) == 2
    for frame in (*frames, *(image.content for image in VideoFile(path))):
        assert isinstance(frame, np.ndarray)
        np.testing.assert_allclose(frame, picture, atol=30)


def test_a_file_that_is_named_twice_is_taken_once(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
    # As some systems leave them on memory cards.
    (tmp_path / "._a.png").write_bytes(b"notes")
    named = [tmp_path, tmp_path / "a.png", tmp_path / "." / "b.png"]
    assert [name for name, _ in calibration_images(named, 9)] == ["a.png", "b.png"]


def test_pictures_that_a_calibration_wrote_are_none_of_a_board(tmp_path: Path) -> None:
    written = ("my.residuals.png", "my.coverage.png", "a.png.corners.png")
    for name in ("a.png", *written):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
    assert [name for name, _ in calibration_images([tmp_path], 9)] == ["a.png"]


def test_a_video_that_does_not_say_how_long_it_is_is_sampled_over_its_length(
    tmp_path: Path,
) -> None:
    frames = [cv2.imencode(".jpg", np.full((48, 64), grey, np.uint8))[1] for grey in range(20)]
    (tmp_path / "a.mjpeg").write_bytes(b"".join(frame.tobytes() for frame in frames))
    names = [name for name, _ in calibration_images([tmp_path / "a.mjpeg"], 5)]
    assert names == [f"a.mjpeg:{number}" for number in (0, 4, 8, 12, 16)]


def test_a_board_in_a_picture_of_ten_bits_is_found(tmp_path: Path) -> None:
    """Of 16 bits such a camera fills the lowest, which makes a dark picture."""
    squares = np.add.outer(np.arange(6), np.arange(7)) % 2
    board = np.kron(squares, np.full((16, 16), 900.0)) + 50.0
    sharp = np.pad(board, 24, constant_values=1000.0)
    height, width = sharp.shape
    picture = cv2.GaussianBlur(sharp, (0, 0), 1.5) * np.linspace(1.0, 0.5, width)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), picture.astype(np.uint16))
    camera = Camera(width, height, 300.0, 300.0, 80.0, 70.0, (0.0,) * 5, IDENTITY)
    found = view_of_board(BoardImage("a", "b", 0, path), Board("checkerboard", 6, 5, 0.1), camera)
    columns, rows = np.meshgrid(np.arange(6) * 16 + 39.5, np.arange(5) * 16 + 39.5)
    corners = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    away = np.linalg.norm(found.corners[:, None] - corners, axis=-1)
    # Of the highest eight bits alone, which hold four grey values, 0.9.
    assert away.min(axis=1).max() < 0.12


def test_a_video_that_is_cut_off_gives_what_it_has_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.avi"
    rng = np.random.default_rng(4)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for _ in range(20):
        writer.write(rng.integers(0, 255, (48, 64, 3), np.uint8))
    writer.release()
    assert len(list(calibration_images([path], 99))) == 20
    assert capsys.readouterr().err == ""
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 5])
    found = len(list(calibration_images([path], 99)))
    assert 5 < found < 20
    told = f"{path}: only {found} of 20 frames can be read\n"
    assert capsys.readouterr().err == told
    # Every fourth, and one of them is not there.
    assert len(list(calibration_images([path], 5))) == -(-found // 4)
    assert capsys.readouterr().err == told
