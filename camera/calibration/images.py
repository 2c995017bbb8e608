"""Pictures for a calibration: photographs, folders of them, or a video."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from camera.errors import CalibrationError
from redetect.array_types import GreyImage
from redetect.storage.image_headers import IMAGE_SUFFIXES
from redetect.storage.images import opened_video, read_grey

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg")


def calibration_files(inputs: Sequence[Path], most: int) -> dict[str, Path]:
    """The photographs, those in folders, and then the videos, by names that differ.

    At most `most` photographs are used, evenly spaced. A file that is named twice is used once.
    Files of the same name in several folders are called by their paths below a common folder.
    """
    if most < 1:
        raise CalibrationError(f"--max-images {most}: expected 1 or more")
    images: list[Path] = []
    videos: list[Path] = []
    for path in inputs:
        if path.is_dir():
            # Hidden files are skipped: some systems keep metadata in ones named ._ and the image.
            visible = [each for each in path.iterdir() if not each.name.startswith(".")]
            images += sorted(p for p in visible if p.suffix.lower() in IMAGE_SUFFIXES)
        elif not path.exists():
            raise CalibrationError(f"{path}: no such picture, folder or video")
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            videos.append(path)
        else:
            images.append(path)
    if not images and not videos:
        raise CalibrationError(
            f"no pictures in {', '.join(str(path) for path in inputs)}: expected files ending in "
            f"{' '.join(IMAGE_SUFFIXES)}, or a video"
        )
    images = _each_once(images)
    if len(images) > most:
        images = [images[i] for i in np.linspace(0, len(images) - 1, most).round().astype(int)]
    files = images + _each_once(videos)
    named = {path.name: path for path in files}
    if len(named) < len(files):
        above = os.path.commonpath([path.resolve().parent for path in files])
        named = {str(path.resolve().relative_to(above)): path for path in files}
    return named


def calibration_images(inputs: Sequence[Path], most: int) -> Iterator[tuple[str, GreyImage]]:
    """Names and grey images of the `calibration_files`, one after the other; at most `most` frames
    of each video, evenly spaced.
    """
    for name, path in calibration_files(inputs, most).items():
        if path.suffix.lower() in VIDEO_SUFFIXES:
            yield from _frames(path, name, most)
        else:
            yield name, read_grey(path, CalibrationError)


def _each_once(paths: list[Path]) -> list[Path]:
    return list({path.resolve(): path for path in reversed(paths)}.values())[::-1]


def _frames(path: Path, name: str, most: int) -> Iterator[tuple[str, GreyImage]]:
    refused = CalibrationError(f"{path}: not a video that OpenCV can read")
    with opened_video(path, refused) as video:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        # The frames are spread over the whole video.
        step = max(1, -(-count // most))
        number = taken = 0
        while taken < most and video.grab():
            if number % step == 0:
                good, frame = video.retrieve()
                if not good:
                    raise CalibrationError(f"{path}: frame {number} cannot be read")
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                yield f"{name}:{number}", np.asarray(grey, dtype=np.uint8)
                taken += 1
            number += 1
    if taken == 0:
        raise CalibrationError(f"{path}: a video without frames")
    if taken < most and number < count:
        print(f"{path}: only {number} of {count} frames can be read", file=sys.stderr)
