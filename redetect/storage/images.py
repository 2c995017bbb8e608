"""Decodes image files and opens videos: the sensor's pixels, in no more memory than they need."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from redetect.array_types import GreyImage
from redetect.storage.bounded import read_bounded
from redetect.storage.image_headers import MOST_PIXELS, claimed_size, without_orientation

_LARGEST_FILE_BYTES = 1 << 30


def read_grey(path: Path, error: type[Exception]) -> GreyImage:
    """Read an image as grey values of 8 bits, as the sensor saw it; raises an `error`."""
    try:
        content = read_bounded(path, _LARGEST_FILE_BYTES)
    except OSError as why:
        raise error(f"{path}: cannot be read: {why.strerror}") from None
    image = decoded_image(content, path, error)
    if image.dtype not in (np.uint8, np.uint16):
        raise error(f"{path}: holds {image.dtype}: expected images of 8 or 16 bits")
    if image.dtype == np.uint8:
        return np.asarray(image)
    # Cameras of 10 to 16 bits leave the upper part of the range unused: by the brightest pixel.
    brightest = max(float(image.max()), 1.0)
    return np.asarray(np.rint(image.astype(np.float64) * (255.0 / brightest)), dtype=np.uint8)


def decoded_image(content: bytes, name: object, error: type[Exception]) -> NDArray[Any]:
    """(H, W) grey values of an image file's content, of any depth.

    Orientation in metadata (Exif) turns nothing: a calibration is of the sensor's pixels. Raises an
    `error`, before memory is allocated if the image is too large.
    """
    size, image = claimed_size(content), None
    if size is not None:
        if size[0] * size[1] > MOST_PIXELS:
            claim = f"claims {size[0]}x{size[1]} px: expected at most {MOST_PIXELS} pixels"
            raise error(f"{name}: cannot be decoded: {claim}")
        flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # sizes beyond OpenCV's bounds
            image = cv2.imdecode(np.frombuffer(without_orientation(content), np.uint8), flags)
    if image is None:
        raise error(f"{name}: cannot be decoded: expected an image: JPEG, PNG, PNM, BMP or TIFF")
    return image


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Suppress messages of OpenCV and its FFmpeg on errors that are reported here."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    levels: Any = getattr(cv2.utils, "logging", cv2)  # where OpenCV 4 has them
    before = levels.getLogLevel()
    levels.setLogLevel(0)  # silent
    try:
        yield
    finally:
        levels.setLogLevel(before)


@contextmanager
def opened_video(path: Path, error: Exception) -> Iterator[cv2.VideoCapture]:
    """Open a video, of the sensor's pixels, however a player would rotate them; else an error."""
    with quiet_opencv():
        capture = cv2.VideoCapture(str(path))
    try:
        if not capture.isOpened():
            raise error
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()
